"""Electrodes, wrench and pose at the same instants, exactly, on stamps that are made up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.alignment import (
    AlignmentClock,
    common_clock,
    electrode_instants,
    linear,
    longest_gap_ns,
    slerp,
    times_of,
)
from palpate.errors import DatasetError
from palpate.messages import ElectrodeFrame, Origin, SensorType, Stamp, WrenchFrame

MS = 1_000_000
SLOT_NS = 227_273


def stamp(time_ns: int, clock_id: int = 7) -> Stamp:
    return Stamp(1, 1, time_ns, 10**18 + time_ns, clock_id, Origin.LIVE)


def frame(time_ns: int, kind: SensorType = SensorType.BIOTAC) -> ElectrodeFrame:
    layout = kind.layout
    return ElectrodeFrame(
        stamp=stamp(time_ns),
        sensor_serial="s1",
        sensor_type=kind,
        electrodes=np.full(layout.electrodes, 2000, np.uint16),
        pdc=2000,
        pac=np.full(layout.pac_samples, 2040, np.uint16),
        tac=2045,
        tdc=1914,
        validity=layout.all_valid,
        slot_period_ns=SLOT_NS,
    )


def wrench(time_ns: int, clock_id: int = 7) -> WrenchFrame:
    """Its force is its time in ms."""
    force = np.array([0.0, 0.0, time_ns / MS], np.float32)
    return WrenchFrame(stamp(time_ns, clock_id), "ft", force, np.zeros(3, np.float32))


def test_each_electrode_gets_the_wrench_of_its_own_instant() -> None:
    frames = [frame(k * 10 * MS) for k in range(1, 4)]
    wrenches = [wrench(2 * MS * k) for k in range(40)]
    clock = common_clock(frames, wrenches)
    at_ns = electrode_instants(frames, clock)
    assert at_ns.shape == (3, 19)
    force, known = linear(at_ns, times_of(wrenches, clock), [w.force for w in wrenches])
    assert known.all()
    np.testing.assert_allclose(force[..., 2], at_ns / MS, rtol=1e-6)
    # E19 is sampled 36 slots after E1: a wrench at the stamp would be off by 8.2 ms.
    assert force[0, 18, 2] - force[0, 0, 2] == pytest.approx(36 * SLOT_NS / MS)
    assert at_ns[0].mean() == 10 * MS + 18 * SLOT_NS


def test_nanoseconds_survive_a_host_that_is_up_for_years() -> None:
    start_ns = 10**17
    times_ns = start_ns + np.arange(10, dtype=np.int64) * MS
    value, known = linear(times_ns[:9] + 1, times_ns, np.arange(10.0)[:, None])
    assert known.all()
    np.testing.assert_allclose(value[:, 0] - np.arange(9), 1e-6, rtol=1e-6)


def test_nothing_is_invented_outside_or_in_a_gap() -> None:
    times_ns = np.array([0, 10, 20, 30, 60, 70, 101, 111], np.int64) * MS
    at_ns = np.array([-1, 0, 45, 80, 101, 111, 112], np.int64) * MS
    value, known = linear(at_ns, times_ns, times_ns[:, None] / MS)
    # The median gap is 10 ms: 30 ms are three periods, 31 ms are more.
    assert known.tolist() == [False, True, True, False, True, True, False]
    np.testing.assert_allclose(value[known, 0], at_ns[known] / MS)
    assert np.isnan(value[~known]).all()
    _, known = linear(at_ns, times_ns, times_ns[:, None] / MS, period_s=9e-3)
    assert known.tolist() == [False, True, False, False, True, True, False]


def test_order_does_not_matter_and_of_equal_times_the_last_counts() -> None:
    times_ns = np.array([20, 0, 10, 10], np.int64)
    value, known = linear(np.array([10, 15]), times_ns, [[20.0], [0.0], [9.0], [10.0]])
    assert known.all()
    assert value[:, 0].tolist() == [10.0, 15.0]


def test_one_reading_is_known_at_its_own_time_only() -> None:
    value, known = linear(np.array([4, 5, 6]), np.array([5]), [[1.0]])
    assert known.tolist() == [False, True, False]
    assert value[1, 0] == 1.0
    assert longest_gap_ns(np.array([5])) == 0.0


def test_readings_that_arrive_together_have_no_gap_between_them() -> None:
    """Three with one stamp, every 3 ms: most steps are 0."""
    times_ns = np.repeat(np.arange(20, dtype=np.int64) * 3 * MS, 3)
    value, known = linear(np.array([4 * MS]), times_ns, times_ns[:, None] / MS)
    assert known.all()
    assert value[0, 0] == pytest.approx(4.0)
    assert longest_gap_ns(times_ns) == 9 * MS
    assert longest_gap_ns(np.array([5, 5])) == 0.0


def test_orientations_turn_evenly_along_the_shorter_arc() -> None:
    def about_z(angle: float) -> list[float]:
        return [np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]

    times_ns = np.array([0, 100, 200], np.int64)
    # The last has the other sign, which means the same orientation.
    turned = [about_z(0.0), about_z(1.0), [-part for part in about_z(1.0 + 1e-6)]]
    at_ns = np.array([25, 50, 100, 150], np.int64)
    value, known = slerp(at_ns, times_ns, turned)
    assert known.all()
    np.testing.assert_allclose(np.linalg.norm(value, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(value[0], about_z(0.25), atol=1e-12)
    np.testing.assert_allclose(value[1], about_z(0.5), atol=1e-12)
    np.testing.assert_allclose(value[3], about_z(1.0 + 0.5e-6), atol=1e-12)
    value, known = slerp(np.array([-1, 250]), times_ns, turned)
    assert not known.any()
    assert np.isnan(value).all()


def test_streams_of_two_hosts_meet_on_wall_clocks() -> None:
    mine, theirs = [frame(10 * MS)], [wrench(10 * MS, clock_id=8)]
    assert common_clock(mine) is AlignmentClock.MONOTONIC
    assert common_clock(mine, theirs) is AlignmentClock.WALL
    assert times_of(theirs, AlignmentClock.WALL).tolist() == [10**18 + 10 * MS]
    assert electrode_instants(mine, AlignmentClock.WALL)[0, 0] == 10**18 + 10 * MS


def test_what_is_no_stream_is_said() -> None:
    with pytest.raises(DatasetError, match="do not form a stream"):
        linear(np.array([1]), np.array([], np.int64), np.zeros((0, 3)))
    with pytest.raises(DatasetError, match="do not form a stream"):
        slerp(np.array([1]), np.array([1, 2]), np.zeros((1, 4)))
    with pytest.raises(DatasetError, match="different numbers of electrodes"):
        electrode_instants([frame(0), frame(1, SensorType.BIOTAC_SP)], AlignmentClock.MONOTONIC)


def test_an_overloaded_reading_is_left_out_by_who_asks() -> None:
    wrenches = [wrench(k * MS) for k in range(5)]
    wrenches[2] = replace(wrenches[2], overload=True)
    kept = [one for one in wrenches if not one.overload]
    value, known = linear(
        np.array([2 * MS]), times_of(kept, AlignmentClock.MONOTONIC), [one.force for one in kept]
    )
    assert known.all()
    assert value[0, 2] == pytest.approx(2.0)
