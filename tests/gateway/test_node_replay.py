"""The gateway as a process with recordings: nothing lost, same bytes, damage told."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace as changed
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from tests.gateway.ros_fakes import BEGAN_NS, hand_fields, write_bag

from palpate.bus import Session, endpoints
from palpate.bus.topics import TOPICS
from palpate.codec import TARE
from palpate.errors import RecordingError, RemoteError
from palpate.files.record import read_record
from palpate.files.record_writer import RecordWriter
from palpate.messages import ElectrodeFrame, Origin, ServiceRequest, ServiceState, Status
from palpate.ros.layouts import BIOTAC_HAND, encode

PATIENCE_S = 30.0


def replay(path: Path, **more: Any) -> dict[str, Any]:
    return {
        "sensors": [{"driver": "text_log", "options": {"path": path}}],
        "pace": "fast",
        "wait_for": ["features"],
        **more,
    }


def test_fast_replay_loses_nothing_and_finishes(
    bus: Any, log: Callable[..., Any], tmp_path: Path
) -> None:
    numbers = [k for k in range(400) if k % 5]
    path = log(frame_numbers=numbers).write(tmp_path / "a.btd.gz", gz=True)
    with bus.gateway(replay(path)) as running:
        assert bus.until(lambda: bus.status()).state is ServiceState.STARTING
        with bus.consumer() as tap:
            got = bus.take(tap, len(numbers) + 1)
            now = bus.state(ServiceState.FINISHED)
            assert bus.ask_tare("finger", got[0][1].tare_id).sensor_serial
            with pytest.raises(RemoteError, match="does not deliver"):
                bus.ask_tare("finger")
        assert running.thread.is_alive()  # answers until it is stopped
    frames = [message for topic, message in got if topic == "electrodes"]
    assert [frame.stamp.device_tick for frame in frames] == numbers
    assert len({frame.tare_id for frame in frames} - {0}) == 1
    assert all(frame.stamp.origin is Origin.REPLAYED for frame in frames)
    assert now.counters["samples"] == len(numbers) * 44
    assert now.counters["frames_published"] == len(numbers)
    assert now.counters["missing_frames"] == 79
    assert "320 frames published" in now.message


def test_two_fast_replays_give_the_same_bytes(
    bus: Any, log: Callable[..., Any], tmp_path: Path
) -> None:
    path = log(80).write(tmp_path / "a.btd")
    runs = []
    with bus.consumer() as tap:
        for _ in range(2):
            with bus.gateway(replay(path, exit_at_end=True, linger_s=0.0)) as running:
                samples = [tap.next(timeout_s=PATIENCE_S) for _ in range(81)]
                running.thread.join(PATIENCE_S)
                assert running.error is None
            electrodes = [s.payload for s in samples if s.topic == "electrodes"]
            runs.append(electrodes)
    assert runs[0] == runs[1]
    assert len(runs[0]) == 80


def test_it_does_not_leave_before_all_have_read(
    bus: Any, log: Callable[..., Any], tmp_path: Path
) -> None:
    """A service that reads slowly answers late: what it has not read would be lost."""
    asked, read = threading.Event(), threading.Event()

    def answer(_: ServiceRequest) -> Status:
        asked.set()
        assert read.wait(PATIENCE_S)
        return Status("features", "features", ServiceState.READY, 1, 1, 1.0, "1")

    path = log(80).write(tmp_path / "a.btd")
    with Session.open(bus.link) as slow, bus.consumer():
        slow.queryable(endpoints.STATUS, answer, service="features", instance="features")
        with bus.gateway(replay(path, exit_at_end=True, linger_s=2.5)) as running:
            assert asked.wait(PATIENCE_S)
            assert running.thread.is_alive()
            read.set()
            running.thread.join(PATIENCE_S)
            assert not running.thread.is_alive()
            assert running.error is None


def test_a_record_keeps_the_session_of_its_run(
    bus: Any, record: Callable[..., Path], tmp_path: Path
) -> None:
    """The gateway that plays it has another."""
    named = tmp_path / "named.mcap"
    with RecordWriter(named) as writer:
        for item in read_record(record(50)):
            codec = TOPICS[item.address.topic].codec
            message = codec.decode(item.payload)
            stamp = changed(message.stamp, session_id=0xFEED)
            payload = codec.encode(changed(message, stamp=stamp))
            writer.write(item.key, codec.schema, payload, log_time_ns=item.log_time_ns)
    values = replay(named)
    values["sensors"] = [{"driver": "record", "options": {"path": named}}]
    wanted = Counter((item.address.topic, item.payload) for item in read_record(named))
    with bus.consumer() as tap, bus.gateway(values):
        samples = [tap.next(timeout_s=PATIENCE_S) for _ in range(wanted.total())]
    assert Counter((sample.topic, sample.payload) for sample in samples) == wanted
    decoded = [TOPICS[sample.topic].codec.decode(sample.payload) for sample in samples]
    assert {message.stamp.session_id for message in decoded} == {0xFEED}


def test_record_is_republished_byte_for_byte(bus: Any, record: Callable[..., Path]) -> None:
    path = record(100)
    wanted: dict[str, list[bytes]] = {}
    for item in read_record(path):
        wanted.setdefault(item.address.topic, []).append(item.payload)
    values = replay(path)
    values["sensors"] = [{"driver": "record", "options": {"path": path}}]
    got: dict[str, list[bytes]] = {}
    with bus.consumer() as tap, bus.gateway(values):
        for _ in range(301):
            sample = tap.next(timeout_s=PATIENCE_S)
            got.setdefault(sample.topic, []).append(sample.payload)
        tare = TARE.decode(wanted["tare"][0])
        assert bus.ask_tare("finger", tare.tare_id).tare_id == tare.tare_id
    assert got == wanted


def test_recorded_pace_stamps_are_now(bus: Any, log: Callable[..., Any], tmp_path: Path) -> None:
    path = log(60).write(tmp_path / "a.btd")
    before_ns = time.monotonic_ns()
    values = replay(path, pace="recorded")
    with bus.consumer() as tap, bus.gateway(values):
        got = bus.take(tap, 61)
    frames = [message for _, message in got if isinstance(message, ElectrodeFrame)]
    assert frames[0].stamp.monotonic_ns > before_ns
    spans = {
        round((b.stamp.monotonic_ns - a.stamp.monotonic_ns) / 1e6) for a, b in pairwise(frames)
    }
    assert spans == {10}


def test_fingers_of_a_file_stay_as_far_apart_as_they_were_recorded(
    bus: Any, tmp_path: Path
) -> None:
    later_ns = {"/left": 0, "/right": 300_000_000}
    messages = [
        (topic, BIOTAC_HAND, at_ns, encode(hand_fields(k, at_ns), BIOTAC_HAND))
        for topic, late_ns in later_ns.items()
        for k in range(30)
        for at_ns in [BEGAN_NS + late_ns + 10_000_000 * k]
    ]
    path = write_bag(tmp_path / "run", messages, "cdr")
    values = replay(path, pace="recorded")
    values["sensors"] = [
        {"name": topic[1:], "driver": "ros_bag", "options": {"path": path, "topic": topic}}
        for topic in later_ns
    ]
    firsts: dict[str, ElectrodeFrame] = {}
    with bus.consumer() as tap, bus.gateway(values):
        while len(firsts) < 2:
            sample = tap.next(timeout_s=PATIENCE_S)
            if sample.topic == "electrodes":
                frame = TOPICS[sample.topic].codec.decode(sample.payload)
                firsts.setdefault(sample.sensor, frame)
    left, right = firsts["left"].stamp, firsts["right"].stamp
    assert right.monotonic_ns - left.monotonic_ns == 300_000_000
    assert right.wall_ns - left.wall_ns == 300_000_000


def test_truncated_log_publishes_what_it_has_then_fails(
    bus: Any, log: Callable[..., Any], tmp_path: Path
) -> None:
    path = log(80).write(tmp_path / "cut.btd", cut=5)
    values = replay(path, exit_at_end=True, linger_s=1.0)
    with bus.consumer() as tap, bus.gateway(values) as running:
        got = bus.take(tap, 80)
        now = bus.state(ServiceState.DEGRADED)
        running.thread.join(PATIENCE_S)
    assert sum(topic == "electrodes" for topic, _ in got) == 79
    assert now.last_error is not None
    assert "cut.btd, line 3533: the last line is cut" in now.last_error.message
    assert now.counters["frames_published"] == 79
    assert isinstance(running.error, RecordingError)


def test_real_capture_through_the_gateway(bus: Any, shared_data: Path) -> None:
    path = shared_data / "syntouch_btd_raw" / "data.btd.gz"
    if not path.is_file():
        pytest.skip("the public BTD capture is not beside the project")
    with bus.consumer() as tap, bus.gateway(replay(path)):
        got = bus.take(tap, 2125)
        now = bus.state(ServiceState.FINISHED)
    assert sum(topic == "electrodes" for topic, _ in got) == 2124
    wanted = {"samples": 93_456, "frames_published": 2124, "missing_frames": 530, "time_jumps": 154}
    assert {name: now.counters[name] for name in wanted} == wanted
