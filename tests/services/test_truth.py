"""Estimates matched with a truth that has a clock of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import TOPICS, sensor_key
from palpate.files.record_writer import RecordWriter
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    IndenterPoseFrame,
    Stamp,
    WrenchFrame,
)
from palpate_services.viewer.timeline import SensorTimeline
from palpate_services.viewer.touch_errors import read_touches
from palpate_services.viewer.truth import MatchedMessages, TruthMatcher

MS = 1_000_000
SD = np.full(3, 0.1, np.float32)


@pytest.fixture
def stamp(make_frame: Callable[..., ElectrodeFrame]) -> Stamp:
    return make_frame(1, monotonic_ns=10**12).stamp


def later(stamp: Stamp, ms: float, **other: Any) -> Stamp:
    ns = round(ms * MS)
    return dataclasses.replace(
        stamp, monotonic_ns=stamp.monotonic_ns + ns, wall_ns=stamp.wall_ns + ns, **other
    )


def wrench(stamp: Stamp, force_n: float) -> WrenchFrame:
    return WrenchFrame(
        stamp, "FT", np.array([0, 0, force_n], np.float32), np.array([0.02, 0, 0], np.float32)
    )


def pose(stamp: Stamp, x_m: float = 0.0, touches: bool | None = None) -> IndenterPoseFrame:
    place = np.array([x_m, 0.0, -0.007])
    return IndenterPoseFrame(stamp, "sphere", place, np.array([1.0, 0, 0, 0]), touches)


def estimate(stamp: Stamp, force_n: float = 3.0) -> FeatureEstimate:
    force, place = np.array([0, 0, force_n], np.float32), np.array([0, 0, -0.007], np.float32)
    return FeatureEstimate(stamp, "BT", bytes(32), 5, True, force, SD, place, SD)


def press(stamp: Stamp) -> list[Any]:
    """A quarter of a second of a press of 3 N, of which each kind has its own rate and phase."""
    timed: list[tuple[float, Any]] = [
        (at + 0.311, wrench(later(stamp, at + 0.311), 3.0)) for at in range(250)
    ]
    timed += [(at + 0.077, pose(later(stamp, at + 0.077))) for at in range(0, 250, 10)]
    timed += [(float(at), estimate(later(stamp, at))) for at in range(0, 250, 10)]
    return [message for _, message in sorted(timed, key=lambda each: each[0])]


def drawn(messages: Iterable[Any]) -> dict[str, list[Any]]:
    timeline = SensorTimeline()
    for message in messages:
        timeline.add(message)
    return timeline.take()


def forces(matches: Iterable[MatchedMessages]) -> list[float | None]:
    return [None if one.wrench is None else float(one.wrench.force[2]) for one in matches]


def test_errors_and_the_true_arrow_are_drawn_of_a_sensor_with_its_own_clock(stamp: Stamp) -> None:
    rows = drawn(press(stamp))
    # The first of each has nothing before it, and the last nothing after it.
    for name in ("error/force", "error/location_mm", "arrow/truth"):
        assert len(rows[name]) == 24, name
    assert all(row.at is not None for row in rows["arrow/truth"])
    assert all(row.values is not None for row in rows["location/truth"])  # of a robot
    np.testing.assert_allclose([row.values for row in rows["error/force"]], 0.0, atol=1e-6)
    instants = [later(stamp, at).wall_ns for at in range(10, 250, 10)]
    assert [row.time_ns for row in rows["error/force"]] == instants


def test_errors_of_a_record_are_told_of_a_sensor_with_its_own_clock(
    stamp: Stamp, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    names = {WrenchFrame: "wrench", IndenterPoseFrame: "pose", FeatureEstimate: "features"}
    with RecordWriter(path, {}) as writer:
        for message in press(stamp):
            name = names[type(message)]
            codec, key = TOPICS[name].codec, sensor_key("lab", "finger", name)
            writer.write(key, codec.schema, codec.encode(message), log_time_ns=stamp.wall_ns)
    errors = read_touches(path).errors()
    assert (errors.estimates, errors.touched.frames, errors.touched.located) == (25, 24, 24)


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (2, 0, 1)])
def test_truth_lies_on_the_line_between_its_neighbours(
    stamp: Stamp, order: tuple[int, ...]
) -> None:
    messages: list[Any] = [
        wrench(later(stamp, 0.0), 1.0),
        wrench(later(stamp, 4.0), 5.0),
        estimate(later(stamp, 1.0)),
    ]
    matcher = TruthMatcher()
    found = [match for at in order for match in matcher.add(messages[at])]
    assert forces(found[-1:]) == [pytest.approx(2.0)]


def test_truth_of_the_same_instant_is_taken_as_it_is(stamp: Stamp) -> None:
    matcher = TruthMatcher()
    for at in range(3):
        matcher.add(wrench(later(stamp, 10 * at), float(at)))
        matcher.add(pose(later(stamp, 10 * at), touches=True))
    (match,) = matcher.add(estimate(later(stamp, 10)))
    assert forces([match]) == [1.0]
    assert match.pose is not None
    assert match.pose.in_contact is True
    assert match.pose.stamp == later(stamp, 10)


def test_a_gap_of_more_than_three_periods_is_not_bridged(stamp: Stamp) -> None:
    matcher = TruthMatcher()
    for at in (0, 1, 2, 3, 6, 10):
        matcher.add(wrench(later(stamp, at), 1.0))
    asked = [estimate(later(stamp, at)) for at in (4.5, 8.0, -0.5)]
    assert forces(match for one in asked for match in matcher.add(one)) == [1.0, None, None]


def test_between_touched_and_untouched_the_nearer_pose_counts(stamp: Stamp) -> None:
    matcher = TruthMatcher()
    matcher.add(pose(later(stamp, 0), touches=False))
    matcher.add(pose(later(stamp, 10), x_m=0.01, touches=True))
    matcher.add(pose(later(stamp, 20), touches=None))
    found = [matcher.add(estimate(later(stamp, at)))[0] for at in (2, 8, 18)]
    assert [one.touched for one in found] == [False, True, None]
    assert found[1].pose is not None
    assert found[1].pose.position[0] == pytest.approx(0.008)


def test_a_sensor_of_another_host_is_compared_by_wall_clocks(stamp: Stamp) -> None:
    matcher = TruthMatcher()
    for at in (0.0, 1.0, 2.0):
        there = later(stamp, at, clock_id=stamp.clock_id + 1)
        matcher.add(wrench(dataclasses.replace(there, monotonic_ns=round(at * MS)), at))
    (match,) = matcher.add(estimate(later(stamp, 1.5)))
    assert forces([match]) == [pytest.approx(1.5)]


def test_readings_that_are_kept_are_bounded_and_a_replay_begins_anew(stamp: Stamp) -> None:
    matcher = TruthMatcher(remember=10)
    for at in range(100):
        matcher.add(wrench(later(stamp, at), 1.0))
    asked = [estimate(later(stamp, at + 0.5)) for at in (10, 90)]
    assert forces(match for one in asked for match in matcher.add(one)) == [None, 1.0]
    for at in (0, 1):
        matcher.add(wrench(later(stamp, at), 2.0))
    assert forces(matcher.add(estimate(later(stamp, 0.5)))) == [2.0]


def test_a_pose_that_is_stamped_far_ahead_holds_up_no_estimate(stamp: Stamp) -> None:
    """Of a robot on a host whose wall clock was set afterwards."""
    matcher = TruthMatcher(remember=None)
    matcher.add(pose(later(stamp, 1_000_000.0)))
    matched = [match for message in press(stamp) for match in matcher.add(message)]
    assert sum(one.estimate is not None and one.wrench is not None for one in matched) >= 24
