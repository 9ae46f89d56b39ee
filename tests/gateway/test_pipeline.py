from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.gateway.pipelines import finished, pushed

from palpate.bus.topics import TOPICS
from palpate.codec import ELECTRODE_FRAME
from palpate.errors import DeviceError
from palpate.messages import NO_TARE, ElectrodeFrame, Origin, SensorType, Tare
from palpate_gateway.clock.stamps import DueMessage, FileClock, LiveClock, PacedClock
from palpate_gateway.device import DeviceIdentity, DeviceInfo
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import ElectrodeReading, FieldReading, Reading, RecordedMessage
from palpate_gateway.service.pipeline import Pipeline

IDENTITY = DeviceIdentity("BT1", 1 / 4400)


def info(*, live: bool) -> DeviceInfo:
    return DeviceInfo("virtual", SensorType.BIOTAC, "test", 100.0, live, not live, Origin.SIMULATED)


def readings(count: int, *, first: int = 0, value: int = 2000, missed: int = 0) -> list[Reading]:
    return [
        ElectrodeReading(
            tick=k,
            time_s=k * 0.01,
            missed_before=missed,
            electrodes=np.full(19, value, np.uint16),
            pdc=2400,
            pac=np.full(22, 2040, np.uint16),
            tac=2050,
            tdc=1900,
            validity=(1 << 44) - 1,
        )
        for k in range(first, first + count)
    ]


def pipeline(*, live: bool, tare_frames: int = 10) -> Pipeline:
    made = Pipeline(info(live=live), tare_frames=tare_frames)
    made.begin(IDENTITY, LiveClock() if live else FileClock("BT1", None))
    return made


def frames(out: list[DueMessage]) -> list[ElectrodeFrame]:
    return [item.message for item in out if isinstance(item.message, ElectrodeFrame)]


def tares(out: list[DueMessage]) -> list[Tare]:
    return [item.message for item in out if isinstance(item.message, Tare)]


def test_live_frames_go_out_at_once_and_carry_the_tare_later() -> None:
    made = pipeline(live=True)
    out = pushed(made, readings(25), arrival_ns=10**9)
    ids = [frame.tare_id for frame in frames(out)]
    assert ids[:10] == [NO_TARE] * 10
    (tare,) = tares(out)
    assert ids[10:] == [tare.tare_id] * 15
    assert out[10].message is tare  # before the first frame that names it
    assert made.counters["frames_untared"] == 10
    assert made.counters["frames_published"] == 25
    assert made.ledger.find(tare.tare_id) is tare


def test_recording_is_held_until_its_tare() -> None:
    made = pipeline(live=False)
    assert pushed(made, readings(9), 0) == []
    out = pushed(made, readings(5, first=9), 0)
    (tare,) = tares(out)
    assert out[0].message is tare
    assert [frame.tare_id for frame in frames(out)] == [tare.tare_id] * 14
    assert [frame.stamp.sequence for frame in frames(out)] == list(range(1, 15))
    assert made.counters["frames_untared"] == 0
    assert made.counters["frames_published"] == 14
    assert finished(made) == []
    assert made.tare_error is None, "nothing is held any more"


def test_short_recording_goes_out_untared_and_says_so() -> None:
    made = pipeline(live=False)
    pushed(made, readings(9), 0)
    out = finished(made)
    assert [frame.tare_id for frame in frames(out)] == [NO_TARE] * 9
    assert "BT1 delivered 9 frames, a tare needs 10" in str(made.tare_error)
    assert finished(made) == []


def test_recording_that_starts_touched_is_held_for_ten_attempts_only() -> None:
    made = pipeline(live=False)
    moving = [readings(1, first=k, value=2000 + 300 * (k % 2))[0] for k in range(105)]
    assert pushed(made, moving[:99], 0) == []
    out = pushed(made, moving[99:], 0)
    assert [frame.tare_id for frame in frames(out)] == [NO_TARE] * 105
    assert made.counters["tares_refused"] == 10
    assert "E1 varies by 150 counts" in str(made.tare_error)
    # A quiet stretch later still gives a tare.
    assert len(tares(pushed(made, readings(20, first=105), 0))) == 1
    assert made.tare_error is None


def test_sequences_go_on_when_the_device_is_opened_again() -> None:
    made = pipeline(live=True)
    pushed(made, readings(5), 10**9)
    made.begin(IDENTITY, LiveClock())
    out = frames(pushed(made, readings(5), 2 * 10**9))
    assert [frame.stamp.sequence for frame in out] == [6, 7, 8, 9, 10]


def test_a_tare_outlives_the_same_finger_opened_again() -> None:
    made = pipeline(live=True)
    (tare,) = tares(pushed(made, readings(12), 10**9))
    made.begin(IDENTITY, LiveClock())
    out = pushed(made, readings(30, first=12), 2 * 10**9)
    assert not tares(out)
    assert {frame.tare_id for frame in frames(out)} == {tare.tare_id}


@pytest.mark.parametrize("tare", ["still", "query"])
def test_a_finger_of_another_kind_has_no_tare_yet(tare: Any) -> None:
    made = Pipeline(info(live=True), tare=tare, tare_frames=10)
    made.begin(IDENTITY, LiveClock())
    made.ask_tare(10)
    assert tares(pushed(made, readings(12), 10**9))
    made.begin(replace(IDENTITY, sensor_type=SensorType.BIOTAC_SP), LiveClock())
    assert made.ledger.current_id == NO_TARE
    assert made._tares.attempting == (tare == "still"), "of itself, unless tares are asked for"


def test_gaps_are_stamped_and_counted() -> None:
    made = pipeline(live=True)
    out = frames(pushed(made, readings(3, missed=2), 10**9))
    assert [frame.stamp.missed_before for frame in out] == [2, 2, 2]
    assert made.counters["missing_frames"] == 6


def test_tare_on_demand_uses_the_next_frames() -> None:
    made = pipeline(live=True)
    pushed(made, readings(10), 10**9)
    future = made.ask_tare(5)
    pushed(made, readings(4, first=10, value=1500), 10**9)
    assert not future.done()
    out = pushed(made, readings(3, first=14, value=1500), 10**9)
    tare = future.result(timeout=0)
    assert tare.electrodes.tolist() == [1500.0] * 19
    assert tares(out) == [tare]
    assert [frame.tare_id == tare.tare_id for frame in frames(out)] == [False, True, True]


def test_tare_on_demand_of_a_touched_finger_is_refused() -> None:
    made = pipeline(live=True)
    future = made.ask_tare(4)
    pushed(made, [readings(1, first=k, value=2000 + 300 * (k % 2))[0] for k in range(4)], 10**9)
    with pytest.raises(DeviceError, match="E1 varies by 150 counts"):
        future.result(timeout=0)


def test_no_tare_after_the_end() -> None:
    made = pipeline(live=False)
    future = made.ask_tare(5)
    finished(made)
    with pytest.raises(DeviceError, match="not tared: the recording has ended"):
        future.result(timeout=0)
    with pytest.raises(DeviceError, match="BT1 cannot be tared: the recording has ended"):
        made.ask_tare(5)


def test_a_sensor_without_electrodes_is_not_tared() -> None:
    """Nobody waits for frames that cannot come."""
    made = Pipeline(DeviceInfo("pose_zenoh", None, "test", 250.0, True, False, Origin.LIVE))
    made.begin(DeviceIdentity("arm", 0.004), LiveClock())
    with pytest.raises(DeviceError, match="arm cannot be tared: it has no electrodes"):
        made.ask_tare(5)


def test_rate_of_the_condition_is_that_of_the_slots() -> None:
    """44 slots at 4400 Hz are 100 frames a second."""
    made = pipeline(live=True)
    others = frames(pushed(pipeline(live=True), readings(200), 10**9))
    assert made.condition is not None
    ends = [k for k, frame in enumerate(others, start=1) if made.condition.add(frame)]
    assert ends == list(range(20, 201, 20)), "blocks of 0.2 s"


def test_rate_of_the_condition_is_that_of_a_driver_that_leaves_frames_out() -> None:
    """A hand at 20 Hz: else a stuck electrode would be told five times as late."""
    made = Pipeline(info(live=True))
    made.begin(replace(IDENTITY, rate_hz=20.0), LiveClock())
    others = frames(pushed(pipeline(live=True), readings(60), 10**9))
    assert made.condition is not None
    ends = [k for k, frame in enumerate(others, start=1) if made.condition.add(frame)]
    assert ends == list(range(10, 61, 10)), "blocks of ten frames, the least"


def test_paced_items_are_due_at_their_stamp() -> None:
    made = Pipeline(info(live=False), tare_frames=10)
    made.begin(IDENTITY, PacedClock())
    out = pushed(made, readings(20), 0)
    assert all(i.due_ns == f.stamp.monotonic_ns for i, f in zip(out[1:], frames(out), strict=True))
    assert out[0].due_ns == out[1].due_ns


def test_replaying_twice_gives_the_same_bytes() -> None:
    runs = []
    for _ in range(2):
        options = {"model": "formula", "realtime": False, "frames": 100}
        with make_device("virtual", options) as device:
            made = Pipeline(device.info)
            made.begin(device.identity, FileClock(device.identity.serial, None))
            out: list[DueMessage] = []
            while got := device.read(1.0):
                out += pushed(made, got, 0)
            runs.append([TOPICS[item.topic].codec.encode(item.message) for item in out])
    assert runs[0] == runs[1]
    assert len(runs[0]) == 301


def test_a_true_field_goes_out_with_the_serial_and_a_sequence_of_its_own() -> None:
    made = pipeline(live=True)
    pushed(made, readings(7), 10**9)
    still = np.arange(6, dtype=np.float32).reshape(2, 3)
    out = pushed(made, [FieldReading(k, k * 0.01, b"m" * 32, still) for k in (7, 12)], 10**9)
    assert [item.topic for item in out] == ["field_truth"] * 2
    for number, item in enumerate(out, start=1):
        decoded = TOPICS["field_truth"].codec.decode(
            TOPICS["field_truth"].codec.encode(item.message)
        )
        assert (decoded.stamp.sequence, decoded.sensor_serial) == (number, "BT1")
        assert decoded.mesh_sha256 == b"m" * 32
        assert np.array_equal(decoded.displacement, still)


def test_record_passes_unchanged_and_its_tares_are_known(record: Callable[..., Path]) -> None:
    with make_device("record", {"path": record(60)}) as device:
        made = Pipeline(device.info)
        made.begin(device.identity, FileClock("x", None))
        out: list[Any] = []
        while got := device.read(1.0):
            out += pushed(made, got, 0)
    assert made.counters["frames_published"] == 60
    assert made.counters["tares"] == 1
    first = next(item for item in out if item.topic == "electrodes")
    frame = ELECTRODE_FRAME.decode(first.message)
    assert made.ledger.find(frame.tare_id).tare_id == frame.tare_id
    with pytest.raises(DeviceError, match="it is a record, which brings its own tares"):
        made.ask_tare(5)


def test_real_capture_is_tared_from_its_first_frames(shared_data: Path) -> None:
    path = shared_data / "syntouch_btd_raw" / "data.btd.gz"
    if not path.is_file():
        pytest.skip("the public BTD capture is not beside the project")
    with make_device("text_log", {"path": path}) as device:
        made = Pipeline(device.info)
        identity = device.identity
        made.begin(identity, FileClock(identity.serial, identity.start_wall_ns))
        out: list[DueMessage] = []
        while got := device.read(1.0):
            out += pushed(made, got, 0)
        out += finished(made)
    assert made.counters["frames_published"] == 2124
    assert made.counters["missing_frames"] == 530
    assert made.counters["frames_untared"] == 0
    for item in out:
        TOPICS[item.topic].codec.encode(item.message)


def test_what_a_record_lost_when_it_was_taken_is_told_again_by_its_replay() -> None:
    source = pipeline(live=True)
    recorded = [
        RecordedMessage("electrodes", ELECTRODE_FRAME.encode(frame), 0.01 * i)
        for i, frame in enumerate(frames(pushed(source, readings(4, missed=3), 0)))
    ]
    replay = pipeline(live=False)
    pushed(replay, [*recorded, RecordedMessage("electrodes", b"not a frame", 0.05)], 0)
    assert replay.counters["missing_frames"] == 12
    assert replay.counters["frames_published"] == 5


@pytest.mark.parametrize(
    "there",
    [
        lambda i: i not in (10, 11, 12) and not 20 <= i < 80,
        lambda i: i < 20 or i >= 80 or i % 5 == 0,
        lambda i: not (20 <= i < 25 or 26 <= i < 31),
    ],
    ids=["two holes", "each fifth came", "one between two holes"],
)
def test_frames_that_a_record_lacks_are_missing_in_its_replay(there: Callable[[int], bool]) -> None:
    taken = frames(pushed(pipeline(live=True), readings(100), 0))
    recorded = [
        RecordedMessage("electrodes", ELECTRODE_FRAME.encode(frame), 0.01 * i)
        for i, frame in enumerate(taken)
        if there(i)
    ]
    replay = pipeline(live=False)
    pushed(replay, recorded, 0)
    assert replay.counters["missing_frames"] == 100 - len(recorded)
    assert replay.counters["frames_published"] == len(recorded)


@pytest.mark.parametrize(("topic", "refused"), [("tare", 1), ("electrodes", 0)])
def test_a_recorded_message_that_does_not_decode_goes_out(topic: str, refused: int) -> None:
    replay = pipeline(live=False)
    (item,) = pushed(replay, [RecordedMessage(topic, b"damaged", 0.01)], 0)
    assert (item.topic, item.message) == (topic, b"damaged")
    assert replay.counters["tares_refused"] == refused


def test_what_can_wait_waits_for_the_next_frame_at_most() -> None:
    made, out = pipeline(live=True, tare_frames=10), list[DueMessage]()
    for reading in readings(10):
        made.push([reading], 0, out.append, follow_later=True)
    assert len(frames(out)) == 10
    assert not tares(out), "the tenth frame was not followed up"
    made.follow_up(out.append)
    assert len(tares(out)) == 1
    asked = made.ask_tare(10)
    made.push(readings(10, first=10), 0, out.append, follow_later=True)
    assert not asked.done()
    made.push(readings(1, first=20), 0, out.append, follow_later=True)
    assert asked.result(0.0) == tares(out)[-1]


def test_a_frame_of_the_finger_before_is_not_followed_up() -> None:
    made, out = pipeline(live=True, tare_frames=10), list[DueMessage]()
    made.push(readings(10), 0, out.append, follow_later=True)
    made.begin(DeviceIdentity("BT2", 1 / 4400), LiveClock())
    made.follow_up(out.append)
    assert not tares(out)
