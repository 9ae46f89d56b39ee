from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from palpate.gateway.timing.clock_map import FileClock, LiveClock, PacedClock
from palpate.protos import clock


def test_live_clock_is_the_lower_envelope() -> None:
    random = np.random.default_rng(0)
    times_s = np.arange(2000) * 0.01
    delay_ns = random.exponential(2e6, len(times_s)) + 1e6
    arrivals = (times_s * 1e9 + 5e9 + delay_ns).astype(int)
    live = LiveClock()
    mapped = np.array(
        [live.map(t, int(a)).monotonic_ns for t, a in zip(times_s, arrivals, strict=True)]
    )
    error_ns = mapped - (times_s * 1e9 + 5e9)
    # Delays vary by milliseconds; the map stays within 0.4 ms above the least of them.
    assert (error_ns[200:] < 1.4e6).all()
    assert (error_ns >= 1e6 - 1).all()


def test_live_clock_follows_a_slow_device() -> None:
    # The device's clock runs 50 ppm slow: in 100 s it falls 5 ms behind.
    live = LiveClock()
    for k in range(10_000):
        host_s = k * 0.01
        mapped = live.map(host_s * (1 - 50e-6), round(host_s * 1e9)).monotonic_ns
    assert abs(mapped - host_s * 1e9) < 0.1e6


@given(st.lists(st.tuples(st.floats(0, 0.1), st.integers(0, 10**8)), min_size=1, max_size=50))
def test_live_clock_never_goes_back_nor_ahead_of_arrival(steps: list[tuple[float, int]]) -> None:
    live, time_s, last = LiveClock(), 0.0, 0
    for step_s, delay_ns in steps:
        time_s += step_s
        arrival_ns = round(time_s * 1e9) + 10**9 + delay_ns
        mapped = live.map(time_s, arrival_ns)
        assert last <= mapped.monotonic_ns
        assert mapped.monotonic_ns <= max(arrival_ns, last) + 1
        last = mapped.monotonic_ns


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
    assert FileClock("BT1", None).map(3.0, 0) == (0, 0)


def test_time_that_steps_back_stands_still() -> None:
    file = FileClock("BT1", None)
    assert [file.map(t, 0).monotonic_ns for t in (1.0, 2.0, 0.5, 1.5)] == [
        0,
        1_000_000_000,
        1_000_000_000,
        2_000_000_000,
    ]
