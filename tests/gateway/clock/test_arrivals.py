from __future__ import annotations

import pytest

from palpate_gateway.clock.sample_times import ArrivalTimes

MS = 1_000_000


def ms(times_ns: list[int]) -> list[float]:
    return [time / MS for time in times_ns]


def test_what_is_read_at_once_is_of_now() -> None:
    arrivals = ArrivalTimes(0.002)
    for k in range(1, 50):
        assert ms(arrivals.times_ns(1, 2 * k * MS)) == [2.0 * k]


def test_a_clump_ends_now_and_is_spread_at_the_rate() -> None:
    arrivals = ArrivalTimes(0.002)
    arrivals.times_ns(1, 100 * MS)
    assert ms(arrivals.times_ns(4, 108 * MS)) == [102.0, 104.0, 106.0, 108.0]


def test_a_faster_sensor_than_it_says_does_not_run_backwards() -> None:
    arrivals = ArrivalTimes(0.002)
    arrivals.times_ns(1, 100 * MS)
    assert ms(arrivals.times_ns(4, 104 * MS)) == [101.0, 102.0, 103.0, 104.0]


def test_a_burst_of_a_faster_sensor_after_a_stall_is_not_piled_up_at_one_time() -> None:
    """Forty samples in 20 ms, worth 80 ms: they are spread up to now, each at its own time."""
    arrivals = ArrivalTimes(0.002)
    arrivals.times_ns(1, 100 * MS)
    times = arrivals.times_ns(40, 120 * MS)
    assert times == sorted(set(times))
    assert ms(times)[0] == 100.5
    assert ms(times)[-1] == 120.0
    assert arrivals.times_ns(1, 122 * MS) == [122 * MS]


def test_after_a_stall_each_sample_has_the_time_at_which_it_was_taken() -> None:
    """A second at 500 Hz, read in pieces of what a buffer holds; then live again."""
    arrivals = ArrivalTimes(0.002)
    arrivals.times_ns(1, 1000 * MS)
    woke_ms = 2000.0
    first = ms(arrivals.times_ns(215, round(woke_ms * MS)))
    second = ms(arrivals.times_ns(215, round((woke_ms + 0.1) * MS)))
    assert first[0] == 1002.0
    assert first[-1] == 1430.0
    assert second[0] == 1432.0
    rest = ms(arrivals.times_ns(70, round((woke_ms + 0.2) * MS)))
    assert rest[-1] == woke_ms
    assert ms(arrivals.times_ns(1, round((woke_ms + 2.0) * MS))) == [2002.0]


def test_what_a_full_buffer_kept_came_first() -> None:
    """Ten seconds of standstill, half a second in the buffer: it is old, and stays old."""
    arrivals = ArrivalTimes(0.002)
    arrivals.times_ns(1, 1000 * MS)
    times = ms(arrivals.times_ns(250, 11_000 * MS))
    assert (times[0], times[-1]) == (1002.0, 1500.0)
    assert ms(arrivals.times_ns(1, 11_002 * MS)) == [11_002.0]


def test_after_a_silence_of_the_sensor_a_sample_is_of_now() -> None:
    arrivals = ArrivalTimes(0.002)
    arrivals.times_ns(1, 1000 * MS)
    assert ms(arrivals.times_ns(1, 4000 * MS)) == [4000.0]
    assert ms(arrivals.times_ns(3, 4006 * MS)) == [4002.0, 4004.0, 4006.0]


def test_a_wrong_rate_does_not_make_times_lag() -> None:
    """A process that reads every 60 ms from a sensor that is one percent slow."""
    arrivals = ArrivalTimes(0.002)
    arrivals.times_ns(1, 0)
    for k in range(1, 500):
        times = ms(arrivals.times_ns(30, round(60.6 * k * MS)))
        assert times[-1] == round(60.6 * k * MS) / MS


@pytest.mark.parametrize(
    ("set_hz", "clump", "every_ms"),
    [(10.0, 1, 143), (250.0, 6, 60), (250.0, 1, 2), (200.0, 4, 10)],
    ids=["slow", "slow in clumps", "fast", "two sensors"],
)
def test_another_rate_than_the_set_one_is_measured_and_makes_no_lag(
    set_hz: float, clump: int, every_ms: int
) -> None:
    arrivals = ArrivalTimes(1.0 / set_hz)
    true_hz = 1e3 * clump / every_ms
    for now_ms in range(every_ms, 15_000, every_ms):
        times = ms(arrivals.times_ns(clump, now_ms * MS))
        assert now_ms - times[-1] <= 1e3 * clump / true_hz
        assert times == sorted(set(times))
    assert times[-1] == now_ms
    assert arrivals.rate_hz == pytest.approx(true_hz, rel=0.01)
    assert arrivals.counters["rate_not_as_configured"] > 0


def test_pauses_of_the_process_are_no_other_rate() -> None:
    """Every five seconds it stands still for two, and half a second is in the buffer."""
    arrivals = ArrivalTimes(0.002)
    for k in range(4):
        for now_ms in range(7000 * k, 7000 * k + 5000, 2):
            arrivals.times_ns(1, now_ms * MS)
        times = ms(arrivals.times_ns(250, (7000 * k + 6998) * MS))
        assert times[-1] == 7000 * k + 4998 + 500
    assert arrivals.rate_hz == 500.0
    assert arrivals.counters == {"rate_not_as_configured": 0}


def test_a_new_stream_has_no_past() -> None:
    arrivals = ArrivalTimes(0.002)
    arrivals.times_ns(1, 1000 * MS)
    arrivals.begin()
    assert ms(arrivals.times_ns(20, 5000 * MS))[-1] == 5000.0
