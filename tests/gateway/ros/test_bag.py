"""Bags of ROS 1 and ROS 2 as devices."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from tests.gateway.ros_fakes import (
    BEGAN_NS,
    electrodes_of,
    hand_fields,
    make_bag,
    wrench_fields,
    write_bag,
)

from palpate.errors import ConfigError, RecordingError
from palpate.messages import Origin
from palpate.ros.layouts import BIOTAC_ALL, BIOTAC_HAND, WRENCH_STAMPED, Dialect, encode
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import ElectrodeReading, WrenchReading
from palpate_gateway.ros.bag import RosBagFile

PERIOD_NS = 10_000_000


def readings_of(path: Path, **options: Any) -> tuple[list[Any], dict[str, int]]:
    with make_device("ros_bag", {"path": path, **options}) as device:
        assert device.info.origin is Origin.REPLAYED
        readings: list[Any] = []
        while got := device.read(1.0):
            readings += got
        return readings, dict(device.counters)


def fingers(readings: Sequence[Any]) -> list[ElectrodeReading]:
    return [one for one in readings if isinstance(one, ElectrodeReading)]


@pytest.mark.parametrize("dialect", ["ros1", "cdr"])
@pytest.mark.parametrize("layout", [BIOTAC_HAND, BIOTAC_ALL])
def test_all_readings_of_a_bag_come_in_the_order_of_their_times(
    tmp_path: Path, dialect: Dialect, layout: str
) -> None:
    name = "run.bag" if dialect == "ros1" else "run"
    path = make_bag(tmp_path / name, 30, dialect, layout=layout)
    readings, counters = readings_of(path, wrench_topic="/ft")
    times = [one.time_s for one in readings]
    assert times == sorted(times)
    more = 7 if layout == BIOTAC_HAND else 0
    told = [one.electrodes.tolist() for one in fingers(readings)]
    assert told == [[value + more for value in electrodes_of(k)] for k in range(30)]
    wrenches = [one for one in readings if isinstance(one, WrenchReading)]
    assert [one.force.tolist() for one in wrenches] == [[0.5, -1.5, k] for k in range(0, 30, 2)]
    assert wrenches[0].serial == "ft"
    # A wrench lies 3 ms after the begin of the frame of its number, as when it was measured.
    begins = [one.time_s for one in fingers(readings)]
    assert wrenches[4].time_s - begins[8] == pytest.approx(0.003)
    assert counters["samples"] == 30
    assert counters["rejected_messages"] == counters["missing_readings"] == 0


def test_a_bag_in_mcap_is_that_in_sqlite(tmp_path: Path) -> None:
    both = [
        readings_of(make_bag(tmp_path / storage, 12, "cdr", storage=storage), wrench_topic="/ft")
        for storage in ("sqlite3", "mcap")
    ]
    assert list((tmp_path / "mcap").glob("*.mcap"))
    assert repr(both[0]) == repr(both[1])
    assert len(both[1][0]) == 18


def test_the_wall_clock_is_that_of_the_recording(tmp_path: Path) -> None:
    with make_device("ros_bag", {"path": make_bag(tmp_path / "a.bag", 3)}) as device:
        started_ns = device.identity.start_wall_ns
        assert started_ns is not None
        first = device.read(1.0)[0]
        assert not isinstance(first, str)
        assert started_ns + round(1e9 * first.time_s) == BEGAN_NS


def test_all_fingers_of_a_bag_count_from_the_earliest_time_of_its_messages(tmp_path: Path) -> None:
    """Not each from its own first, and not from when the recorder heard them."""
    messages = [
        (topic, BIOTAC_HAND, at_ns + 12_000_000, encode(hand_fields(k, at_ns), BIOTAC_HAND))
        for topic, later in (("/left", 0), ("/right", 300))
        for k in range(5)
        for at_ns in [BEGAN_NS + PERIOD_NS * (later + k)]
    ]
    path = write_bag(tmp_path / "run", messages, "cdr")
    for topic, first_s in (("/left", 0.0), ("/right", 3.0)):
        with make_device("ros_bag", {"path": path, "topic": topic}) as device:
            assert device.identity.start_wall_ns == BEGAN_NS
            assert device.read(1.0)[0].time_s == pytest.approx(first_s, abs=1e-9)


def bag_with_times(path: Path, dialect: Dialect, after_s: Sequence[float]) -> Path:
    """A finger and its wrench, recorded each 10 ms, with these times in their headers."""
    messages = []
    for k, since_s in enumerate(after_s):
        at_ns, recorded_ns = BEGAN_NS + round(1e9 * since_s), BEGAN_NS + PERIOD_NS * k
        hand = encode(hand_fields(k, at_ns, dialect), BIOTAC_HAND, dialect)
        wrench = encode(wrench_fields(k, at_ns + 3_000_000, dialect), WRENCH_STAMPED, dialect)
        messages.append(("/hand", BIOTAC_HAND, recorded_ns, hand))
        messages.append(("/ft", WRENCH_STAMPED, recorded_ns, wrench))
    return write_bag(path, messages, dialect)


@pytest.mark.parametrize("dialect", ["ros1", "cdr"])
def test_a_clock_that_was_set_back_loses_nothing(tmp_path: Path, dialect: Dialect) -> None:
    times_s = [0.01 * k - (0.15 if k >= 30 else 0.0) for k in range(60)]
    path = bag_with_times(tmp_path / ("a.bag" if dialect == "ros1" else "a"), dialect, times_s)
    readings, counters = readings_of(path, wrench_topic="/ft")
    took = fingers(readings)
    # As far apart as they were recorded, and the wrench where it was.
    assert [one.time_s for one in took] == pytest.approx([0.01 * k for k in range(60)], abs=1e-6)
    assert [one.electrodes[0] for one in took] == [electrodes_of(k)[0] + 7 for k in range(60)]
    wrenches = [one for one in readings if isinstance(one, WrenchReading)]
    assert [one.force[2] for one in wrenches] == list(range(60))
    later_s = [one.time_s - finger.time_s for one, finger in zip(wrenches, took, strict=True)]
    assert later_s == pytest.approx([0.003] * 60, abs=1e-6)
    assert counters["time_jumps"] == 2  # of both topics
    assert counters["late_messages"] == counters["late_wrenches"] == 0
    assert counters["missing_readings"] == 0


def test_a_clock_that_was_set_back_on_the_recorders_host_too_shows_by_the_numbers(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The bag is sorted by that clock: its messages are mixed, which cannot be undone."""
    messages = []
    for k in range(60):
        at_ns = BEGAN_NS + PERIOD_NS * k - (155_000_000 if k >= 30 else 0)
        hand = encode(hand_fields(k, at_ns, "ros1"), BIOTAC_HAND, "ros1")
        messages.append(("/hand", BIOTAC_HAND, at_ns + 12_000_000, hand))
    _, counters = readings_of(write_bag(tmp_path / "a.bag", messages, "ros1"))
    assert counters["time_jumps"] > 0
    assert len([one for one in caplog.messages if "not in the order" in one]) == 1


def test_a_driver_that_was_started_again_is_no_jump(tmp_path: Path) -> None:
    messages = []
    for k in range(20):
        at_ns = BEGAN_NS + PERIOD_NS * k
        hand = encode(hand_fields(k % 10, at_ns, "ros1"), BIOTAC_HAND, "ros1")
        messages.append(("/hand", BIOTAC_HAND, at_ns, hand))
    readings, counters = readings_of(write_bag(tmp_path / "a.bag", messages, "ros1"))
    assert len(readings) == 20
    assert counters["time_jumps"] == 0


@pytest.mark.parametrize(
    "numbers", [[*range(100, 130), *range(7, 37)], [*range(1, 30), 31, 30, 32]]
)
def test_numbers_that_go_back_once_are_no_mixture(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, numbers: list[int]
) -> None:
    """A driver that was started again, of which the recorder missed the first; two swapped ones."""
    messages = []
    for k, number in enumerate(numbers):
        at_ns = BEGAN_NS + PERIOD_NS * k
        hand = encode(hand_fields(number, at_ns, "ros1"), BIOTAC_HAND, "ros1")
        messages.append(("/hand", BIOTAC_HAND, at_ns, hand))
    readings, counters = readings_of(write_bag(tmp_path / "a.bag", messages, "ros1"))
    assert len(readings) == len(numbers)
    assert counters["time_jumps"] == 0
    assert "not in the order" not in caplog.text


def test_all_readings_before_a_damage_are_delivered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_bag(tmp_path / "a.bag", 20)
    whole = RosBagFile.messages

    def messages(self: RosBagFile, topic: str) -> Iterator[tuple[bytes, int]]:
        yield from itertools.islice(whole(self, topic), 10)
        raise RecordingError("it is damaged here", remedy="none")

    readings: list[Any] = []
    with make_device("ros_bag", {"path": path}) as device:
        monkeypatch.setattr(RosBagFile, "messages", messages)
        while len(readings) < 10:
            readings += device.read(1.0)
        with pytest.raises(RecordingError, match="damaged here"):
            device.read(1.0)
    assert len(fingers(readings)) == 10


@pytest.mark.parametrize("dialect", ["ros1", "cdr"])
def test_one_message_that_is_stamped_ahead_moves_no_other(tmp_path: Path, dialect: Dialect) -> None:
    times_s = [0.01 * k + (0.2 if k == 20 else 0.0) for k in range(60)]
    path = bag_with_times(tmp_path / ("a.bag" if dialect == "ros1" else "a"), dialect, times_s)
    readings, counters = readings_of(path, wrench_topic="/ft")
    others_s = [0.01 * k for k in range(60) if k != 20]
    assert [one.time_s for one in fingers(readings)] == pytest.approx(others_s, abs=1e-6)
    assert counters["wrenches"] == 59
    assert counters["early_messages"] == 2  # of both topics
    assert counters["time_jumps"] == 0


def test_a_few_late_messages_are_dropped_and_counted(tmp_path: Path) -> None:
    times_s = [0.01 * k for k in range(20)]
    times_s[7], times_s[12] = 0.045, 0.11
    path = bag_with_times(tmp_path / "a", "cdr", times_s)
    readings, counters = readings_of(path, wrench_topic="/ft")
    assert len(fingers(readings)) == counters["wrenches"] == 18
    assert counters["late_messages"] == counters["late_wrenches"] == 1
    assert counters["repeated_messages"] == counters["repeated_wrenches"] == 1
    assert counters["time_jumps"] == 0


def test_the_indenter_feels_the_reaction(tmp_path: Path) -> None:
    path = make_bag(tmp_path / "a.bag", 4)
    readings, _ = readings_of(path, wrench_topic="/ft", mount={"carries": "indenter"})
    forces = [one.force.tolist() for one in readings if isinstance(one, WrenchReading)]
    assert forces == [[-0.5, 1.5, -k] for k in (0.0, 2.0)]


@pytest.mark.parametrize("dialect", ["ros1", "cdr"])
def test_messages_that_the_recorder_lost_are_missing_readings(
    tmp_path: Path, dialect: Dialect
) -> None:
    name = "run.bag" if dialect == "ros1" else "run"
    path = make_bag(tmp_path / name, 20, dialect, leave_out=lambda k: 5 <= k < 9)
    readings, counters = readings_of(path)
    assert [one.missed_before for one in readings] == [0] * 5 + [4] + [0] * 10
    assert counters["missing_readings"] == 4


def test_a_message_that_is_damaged_is_counted_and_the_others_come(tmp_path: Path) -> None:
    payloads = [encode(hand_fields(k, BEGAN_NS + PERIOD_NS * k), BIOTAC_HAND) for k in range(6)]
    payloads[2] = payloads[2][:-30]
    messages = [
        ("/hand", BIOTAC_HAND, BEGAN_NS + PERIOD_NS * k, payload)
        for k, payload in enumerate(payloads)
    ]
    readings, counters = readings_of(write_bag(tmp_path / "run", messages, "cdr"))
    assert len(readings) == 5
    assert counters["rejected_messages"] == 1
    assert [one.missed_before for one in readings] == [0, 0, 1, 0, 0]


def test_a_bag_of_several_topics_needs_a_choice(tmp_path: Path) -> None:
    payload = encode(hand_fields(0, BEGAN_NS), BIOTAC_HAND)
    both = [(name, BIOTAC_HAND, BEGAN_NS, payload) for name in ("/left", "/right")]
    path = write_bag(tmp_path / "run", both, "cdr")
    with pytest.raises(ConfigError, match=r"2 topics hold .*name one; it holds: /left"):
        readings_of(path)
    assert len(readings_of(path, topic="/right")[0]) == 1
    with pytest.raises(ConfigError, match=r"/up holds no sr_robot_msgs"):
        readings_of(path, topic="/up")
    with pytest.raises(ConfigError, match=r"/left holds no geometry_msgs/msg/WrenchStamped"):
        readings_of(path, topic="/right", wrench_topic="/left")


def test_a_finger_that_is_not_in_the_bag_is_named(tmp_path: Path) -> None:
    path = make_bag(tmp_path / "a.bag", 3)
    with pytest.raises(RecordingError, match=r"no readings of finger 2 .*it has fingers \[1\]"):
        readings_of(path, finger=2)
    with pytest.raises(RecordingError, match="correct finger or serial"):
        readings_of(path, serial="BT9")


def test_another_version_of_a_message_is_refused(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    newer = "std_msgs/Header header\nuint16[24] electrodes\n"
    store.register(get_types_from_msg(newer, BIOTAC_HAND))
    with Writer(tmp_path / "a.bag") as bag:
        connection = bag.add_connection("/hand", BIOTAC_HAND, typestore=store)
        bag.write(connection, BEGAN_NS, bytes(100))
    with pytest.raises(RecordingError, match="of another version"):
        readings_of(tmp_path / "a.bag")


@pytest.mark.parametrize("cut", [1, 200, 3000])
def test_a_bag_that_was_cut_is_a_typed_error(tmp_path: Path, cut: int) -> None:
    path = make_bag(tmp_path / "a.bag", 20)
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(RecordingError, match=r"a\.bag"):
        readings_of(path)


def test_what_is_no_bag_is_a_typed_error(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 256, 5000, np.uint8).tobytes()
    for name, data in (("a.bag", b""), ("b.bag", noise), ("c.bag", b"#ROSBAG V2.0\n" + noise)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(RecordingError, match="is no bag of ROS"):
            readings_of(tmp_path / name)
    (tmp_path / "folder").mkdir()
    with pytest.raises(RecordingError, match="is no bag of ROS"):
        readings_of(tmp_path / "folder")


def test_bytes_flipped_anywhere_never_crash(tmp_path: Path) -> None:
    path = make_bag(tmp_path / "a.bag", 6)
    data = path.read_bytes()
    random = np.random.default_rng(7)
    for _ in range(30):
        damaged = bytearray(data)
        for at in random.integers(0, len(data), 8):
            damaged[at] ^= 1 << int(random.integers(8))
        path.write_bytes(damaged)
        try:
            readings, _ = readings_of(path, wrench_topic="/ft")
        except (RecordingError, ConfigError):
            continue
        assert all(np.isfinite(one.time_s) for one in readings)


def test_a_channel_that_the_driver_does_not_fill_is_told_to_the_gateway(tmp_path: Path) -> None:
    options = {"path": make_bag(tmp_path / "a.bag", 3), "missing": ["tac", "pac"]}
    with make_device("ros_bag", options) as device:
        assert device.identity.unfilled == {"TAC", "PAC"}
