"""At which times the messages of a record follow one another when it is played at its own pace."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.bus.topics import TOPICS
from palpate.files.record import RecordItem, read_record
from palpate.files.record_writer import RecordWriter
from palpate.messages import Stamp
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import RecordedMessage

FRAMES = 60
PERIOD_S = 0.01
HOUR_NS = 3600 * 10**9

Change = Callable[[RecordItem, Stamp], tuple[int, Stamp]]
"""From an item and its stamp to the log time [ns] and the stamp that it gets."""


def changed(items: Iterable[RecordItem], out: Path, change: Change) -> Path:
    """A record of these items with other times."""
    with RecordWriter(out) as writer:
        for item in items:
            codec = TOPICS[item.address.topic].codec
            message = codec.decode(item.payload)
            log_time_ns, stamp = change(item, message.stamp)
            payload = codec.encode(replace(message, stamp=stamp))
            writer.write(item.key, item.schema, payload, log_time_ns=log_time_ns)
    return out


def times_of(path: Path, sensor: str = "finger") -> dict[str, list[float]]:
    """When the messages of a sensor are due, by topic [s]."""
    found: dict[str, list[float]] = {}
    with make_device("record", {"path": path, "sensor": sensor}) as device:
        while readings := device.read(1.0):
            for one in readings:
                assert isinstance(one, RecordedMessage)
                found.setdefault(one.topic, []).append(one.time_s)
    return found


def assert_even(times_s: list[float], count: int = FRAMES) -> None:
    assert len(times_s) == count
    for before_s, after_s in itertools.pairwise(times_s):
        assert after_s - before_s == pytest.approx(PERIOD_S, abs=1e-5)


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
@pytest.mark.parametrize("stamps_follow", [True, False])
def test_a_step_of_the_wall_clock_is_not_waited_for(
    record: Callable[..., Path], tmp_path: Path, step_ns: int, stamps_follow: bool
) -> None:
    """The log has it at once, the wall times of the stamps up to a tenth of a second later."""

    def after_the_step(item: RecordItem, stamp: Stamp) -> tuple[int, Stamp]:
        shift_ns = step_ns if item.sequence > FRAMES // 2 else 0
        wall_ns = stamp.wall_ns + (shift_ns if stamps_follow else 0)
        return item.log_time_ns + shift_ns, replace(stamp, wall_ns=wall_ns)

    path = record(FRAMES)
    numbered = [replace(item, sequence=_sequence(item)) for item in read_record(path)]
    times_s = times_of(changed(numbered, tmp_path / "set.mcap", after_the_step))
    assert_even(times_s["electrodes"])
    assert_even(times_s["wrench"])


def test_a_sensor_that_came_after_the_step_is_not_waited_for(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    """On one host its clock is that of the others."""

    def set_by_an_hour(item: RecordItem, stamp: Stamp) -> tuple[int, Stamp]:
        late = item.address.sensor == "thumb"
        monotonic_ns = stamp.monotonic_ns + (10**9 if late else 0)
        log_time_ns = item.log_time_ns + (HOUR_NS + 10**9 if late else 0)
        return log_time_ns, replace(stamp, clock_id=7, monotonic_ns=monotonic_ns)

    items = read_record(record(FRAMES, sensors=("index", "thumb")))
    path = changed(items, tmp_path / "set.mcap", set_by_an_hour)
    index_s, thumb_s = (times_of(path, sensor)["electrodes"] for sensor in ("index", "thumb"))
    assert_even(thumb_s)
    assert thumb_s[0] - index_s[0] == pytest.approx(1.0, abs=1e-3)


def test_a_record_of_a_fast_replay_has_the_pace_of_its_stamps(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    items = read_record(record(FRAMES))
    path = changed(items, tmp_path / "fast.mcap", lambda _, stamp: (10**18, stamp))
    assert_even(times_of(path)["electrodes"])


def test_a_tare_of_yesterday_is_due_with_its_frames(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    def yesterday(item: RecordItem, stamp: Stamp) -> tuple[int, Stamp]:
        if item.address.topic == "tare":
            return item.log_time_ns, replace(stamp, monotonic_ns=1)
        return item.log_time_ns, replace(stamp, monotonic_ns=stamp.monotonic_ns + 24 * HOUR_NS)

    items = sorted(read_record(record(FRAMES)), key=lambda item: item.address.topic != "tare")
    times_s = times_of(changed(items, tmp_path / "tared.mcap", yesterday))
    assert_even(times_s["electrodes"])
    assert times_s["tare"] == [pytest.approx(times_s["electrodes"][0], abs=1.0)]


def test_streams_that_overtake_one_another_do_not_stretch_time(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    """A frame is stamped at its begin and comes at its end, after wrenches with later stamps."""

    def wrench_is_later(item: RecordItem, stamp: Stamp) -> tuple[int, Stamp]:
        later_ns = 9_000_000 if item.address.topic == "wrench" else 0
        return item.log_time_ns, replace(stamp, monotonic_ns=stamp.monotonic_ns + later_ns)

    items = read_record(record(FRAMES))
    times_s = times_of(changed(items, tmp_path / "mixed.mcap", wrench_is_later))
    assert_even(times_s["wrench"])
    begun_s, ended_s = times_s["electrodes"][0], times_s["electrodes"][-1]
    assert ended_s - begun_s == pytest.approx((FRAMES - 1) * PERIOD_S, abs=PERIOD_S)


def test_what_was_played_twice_while_it_was_recorded_comes_twice(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    items = list(read_record(record(FRAMES)))
    again = [replace(item, log_time_ns=item.log_time_ns + 10**9) for item in items]
    path = changed(
        items + again, tmp_path / "twice.mcap", lambda item, stamp: (item.log_time_ns, stamp)
    )
    electrodes_s = times_of(path)["electrodes"]
    assert_even(electrodes_s[:FRAMES])
    assert_even(electrodes_s[FRAMES:])
    assert electrodes_s[FRAMES] - electrodes_s[0] == pytest.approx(1.0, abs=2 * PERIOD_S)


def test_messages_that_came_in_another_order_move_no_others(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    frames = [item for item in read_record(record(FRAMES)) if item.address.topic == "electrodes"]
    for k in range(10, 50, 4):
        frames[k], frames[k + 1] = frames[k + 1], frames[k]
    times = (item.log_time_ns for item in sorted(frames, key=lambda one: one.log_time_ns))
    path = changed(frames, tmp_path / "a.mcap", lambda _, stamp: (next(times), stamp))
    electrodes_s = times_of(path)["electrodes"]
    assert electrodes_s[-1] - electrodes_s[0] == pytest.approx((FRAMES - 1) * PERIOD_S, abs=1e-5)


def _sequence(item: RecordItem) -> int:
    sequence: int = TOPICS[item.address.topic].codec.decode(item.payload).stamp.sequence
    return sequence
