"""Device time to host time: of live devices with and without a clock, of recordings."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate import clock
from palpate_gateway.clock.stamps import (
    ArrivalClock,
    ClockQuality,
    FileClock,
    LiveClock,
    PacedClock,
    PacedStart,
)
from palpate_gateway.clock.wall_clock import LOOK_NS, ClockPair, WallClock
from palpate_gateway.readings import ClockObservation

MS = 1_000_000
FRAME_S = 0.01
SPAN_S = 43 / 4400


def play(
    live: LiveClock, *, seconds: float, fast_ppm: float = 0.0, observed_frames: bool = False
) -> np.ndarray:
    """Errors of the stamps of frames that arrive when they are over, up to some ms late [ns]."""
    random = np.random.default_rng(4)
    errors = []
    for k in range(round(seconds / FRAME_S)):
        device_s = 1000.0 + k * FRAME_S
        begun_ns = (device_s - 1000.0) * (1.0 - 1e-6 * fast_ppm) * 1e9 + 7e9
        arrival_ns = round(begun_ns + SPAN_S * 1e9 + random.exponential(1e6))
        observed = ClockObservation(device_s + SPAN_S, arrival_ns) if observed_frames else None
        errors.append(live.map(device_s, arrival_ns, observed).monotonic_ns - begun_ns)
    return np.array(errors)


def test_the_first_slot_of_a_frame_is_stamped_by_the_arrival_of_its_last() -> None:
    live = LiveClock()
    errors = play(live, seconds=20.0, fast_ppm=-80.0, observed_frames=True)
    assert np.abs(errors[1000:]).max() < 0.2 * MS
    gauges = live.gauges()
    assert gauges["clock_quality"] == ClockQuality.FOLLOWED
    assert gauges["clock_drift_ppm"] == pytest.approx(-80.0, abs=20.0)
    # The frame itself, and the median of an exponential delay.
    assert gauges["clock_delay_p50_s"] == pytest.approx(SPAN_S + 0.69e-3, abs=0.2e-3)


def test_without_it_the_frame_itself_counts_as_delay() -> None:
    errors = play(LiveClock(), seconds=20.0)
    assert errors[1000:] == pytest.approx(SPAN_S * 1e9, abs=0.2 * MS)


def test_quality_is_told_from_the_start() -> None:
    live = LiveClock()
    assert live.gauges() == {"clock_quality": ClockQuality.SETTLING}
    play(live, seconds=2.0)
    assert live.quality is ClockQuality.SETTLING
    play(odd := LiveClock(), seconds=20.0, fast_ppm=3000.0)
    assert odd.quality is ClockQuality.ODD


def test_a_clock_that_stops_for_a_while_is_followed_again() -> None:
    live, last_ns, arrival_ns = LiveClock(), 0, 0
    for k in range(1600):
        arrival_ns = round(1e9 * (k * FRAME_S + (20.0 if k >= 800 else 0.0))) + 10**9
        stamp_ns = live.map(k * FRAME_S, arrival_ns).monotonic_ns
        assert last_ns <= stamp_ns <= arrival_ns
        last_ns = stamp_ns
        if k in (799, 1599):
            assert live.quality is ClockQuality.FOLLOWED
        elif 800 <= k < 1190:
            assert live.quality is ClockQuality.SETTLING
    assert arrival_ns - last_ns < MS
    assert live.counters == {"clock_steps": 1}


Steps = list[tuple[float, int, float]]
steps = st.lists(
    st.tuples(st.floats(0, 0.1), st.integers(0, 10**8), st.floats(0, 0.01)), min_size=1, max_size=80
)


@given(steps, st.floats(-600, 600))
def test_times_keep_their_order_and_are_never_after_the_arrival(
    steps: Steps, fast_ppm: float
) -> None:
    live, device_s, host_ns, last, arrival_ns = LiveClock(), 3.0, 10**9, 0, 0
    for step_s, delay_ns, span_s in steps:
        device_s += step_s
        host_ns += round(1e9 * step_s * (1.0 - 1e-6 * fast_ppm))
        arrival_ns = max(arrival_ns, host_ns + delay_ns)
        # With and without a newer observation; readings may be older than that.
        observed = ClockObservation(device_s, arrival_ns) if delay_ns % 2 else None
        mapped = live.map(device_s - (span_s if observed else 0.0), arrival_ns, observed)
        assert mapped.monotonic_ns <= arrival_ns
        if observed is None:
            assert mapped.monotonic_ns >= last
            last = mapped.monotonic_ns


def test_a_device_without_time_has_that_of_arrival_and_says_so() -> None:
    arrival = ArrivalClock()
    assert arrival.map(5.0, 5 * 10**9 + 300).monotonic_ns == 5 * 10**9
    assert arrival.map(4.9, 6 * 10**9).monotonic_ns == 5 * 10**9  # order is kept
    assert arrival.map(9.0, 7 * 10**9).monotonic_ns == 7 * 10**9  # never after the arrival
    assert arrival.gauges() == {"clock_quality": ClockQuality.ARRIVAL}
    assert arrival.clock_id == clock.CLOCK_ID


@pytest.mark.parametrize("kind", [LiveClock, ArrivalClock])
def test_a_step_of_the_wall_clock_moves_wall_times_only(
    kind: type[LiveClock] | type[ArrivalClock],
) -> None:
    now_ns, offset_ns = 0, 10**18
    wall = WallClock(lambda: ClockPair(now_ns, now_ns + offset_ns, 100))
    made = kind(wall)
    for k in range(100):
        now_ns = k * 10 * MS
        if k == 50:
            offset_ns += 10**9
        times = made.map(1e-9 * now_ns, now_ns)
        assert times.monotonic_ns == pytest.approx(now_ns, abs=1000)
        if not 50 <= k < 50 + LOOK_NS // (10 * MS) + 1:
            assert times.wall_ns - times.monotonic_ns == offset_ns
    assert wall.steps == 1


def test_paced_clock_starts_now_and_keeps_intervals() -> None:
    before, _ = clock.now()
    paced = PacedClock()
    first = paced.map(100.0, 0)
    second = paced.map(100.25, 0)
    assert before <= first.monotonic_ns <= clock.now()[0]
    assert second.monotonic_ns - first.monotonic_ns == 250_000_000
    assert second.wall_ns - first.wall_ns == 250_000_000
    assert paced.clock_id == clock.CLOCK_ID
    assert paced.paced


def test_file_clock_keeps_the_recorded_times() -> None:
    start = 1_594_741_080_000_000_000
    file = FileClock("BT1", start)
    assert file.map(0.0, 5) == (0, start)
    assert file.map(71.086, 6) == (71_086_000_000, start + 71_086_000_000)
    assert file.clock_id not in (0, clock.CLOCK_ID)
    assert file.clock_id == FileClock("BT1", start).clock_id
    assert FileClock("BT1", None).map(3.0, 0) == (3_000_000_000, 3_000_000_000)


def test_a_file_that_begins_later_than_its_clock_keeps_its_times() -> None:
    start = 1_594_741_080_000_000_000
    cut = FileClock("BT2", start)
    assert cut.map(30.035, 0) == (30_035_000_000, start + 30_035_000_000)
    # A stamp cannot be negative; the wall time is right all the same.
    early = FileClock("BT3", start)
    assert early.map(-0.5, 0) == (0, start - 500_000_000)
    assert early.map(0.25, 0) == (750_000_000, start + 250_000_000)
    assert FileClock("BT3", None).map(-0.5, 0) == (0, 0)


def test_the_sensors_of_a_file_start_together_at_its_pace() -> None:
    start, first_s = PacedStart(2), {"early": 5.0, "late": 8.0}
    with ThreadPoolExecutor() as pool:
        clocks = {name: PacedClock(start) for name in first_s}
        begun = {name: pool.submit(clocks[name].map, first_s[name], 0) for name in first_s}
        early, late = (begun[name].result(timeout=30.0) for name in first_s)
    assert late.monotonic_ns - early.monotonic_ns == 3_000_000_000
    assert late.wall_ns - early.wall_ns == 3_000_000_000
    assert early.monotonic_ns <= clock.now()[0]
    assert clocks["early"].map(8.0, 0) == late


def test_a_sensor_that_cannot_be_opened_does_not_keep_the_others_of_its_file() -> None:
    start = PacedStart(2)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(PacedClock(start).map, 5.0, 0)
        start.leave()
        assert waiting.result(timeout=30.0).monotonic_ns <= clock.now()[0]


def test_time_that_steps_back_stands_still() -> None:
    file = FileClock("BT1", None)
    assert [file.map(t, 0).monotonic_ns for t in (1.0, 2.0, 0.5, 1.5)] == [
        1_000_000_000,
        2_000_000_000,
        2_000_000_000,
        3_000_000_000,
    ]
