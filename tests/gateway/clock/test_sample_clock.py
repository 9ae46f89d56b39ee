"""A sensor's clock: unwrapped, losses counted, damaged times and restarts told apart."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate_gateway.clock.sample_times import SampleClock, SampleVerdict

WRAP_US = 2**32


def test_steady_samples_are_new_across_the_wrap() -> None:
    clock = SampleClock(996.09375, WRAP_US)
    start = WRAP_US - 5000
    for k in range(20):
        told_us = round(start + 996.09375 * k) % WRAP_US
        assert clock.take(told_us, 0.001 * k) is SampleVerdict.NEW
        assert clock.tick == k + 1
        assert clock.time_s == pytest.approx(1e-6 * (start + 996.09375 * k), abs=1e-6)
    assert set(clock.counters.values()) == {0}


def test_gaps_are_lost_samples_and_doubles_are_dropped() -> None:
    clock = SampleClock(1000.0, WRAP_US)
    verdicts = [clock.take(1000 * k, 0.001 * k) for k in (0, 1, 1, 5, 6)]
    assert verdicts == [
        SampleVerdict.NEW,
        SampleVerdict.NEW,
        SampleVerdict.REPEATED,
        SampleVerdict.NEW,
        SampleVerdict.NEW,
    ]
    assert clock.counters == {"lost_samples": 3, "repeated_samples": 1, "wrong_times": 0}
    assert clock.tick == 7


def test_one_wrong_time_is_not_believed_and_loses_nothing() -> None:
    clock = SampleClock(1000.0, WRAP_US)
    verdicts = [clock.take(t, 0.001 * k) for k, t in enumerate((0, 1000, 77_000_000, 3000, 4000))]
    assert verdicts[2] is SampleVerdict.DOUBTFUL
    assert verdicts[3:] == [SampleVerdict.NEW, SampleVerdict.NEW]
    assert clock.counters == {"lost_samples": 1, "repeated_samples": 0, "wrong_times": 1}


def test_a_clock_that_begins_anew_is_a_restart_at_its_second_sample() -> None:
    clock = SampleClock(1000.0, WRAP_US)
    clock.take(60_000_000, 100.0)
    assert clock.take(1000, 103.0) is SampleVerdict.DOUBTFUL
    assert clock.take(2000, 103.001) is SampleVerdict.RESTARTED


def test_a_backlog_of_the_host_is_no_restart() -> None:
    clock = SampleClock(10_000.0, WRAP_US)
    assert all(clock.take(10_000 * k, 5.0) is SampleVerdict.NEW for k in range(150))
    assert clock.counters["lost_samples"] == 0


def test_a_pause_loses_nothing_whether_or_not_the_clock_went_on() -> None:
    clock = SampleClock(1000.0, WRAP_US)
    clock.take(5_000_000, 10.0)
    clock.pause()
    assert clock.take(5_700_000, 10.7) is SampleVerdict.NEW
    assert clock.time_s == pytest.approx(5.7)
    clock.pause()
    assert clock.take(0, 11.2) is SampleVerdict.NEW
    assert clock.time_s == pytest.approx(6.2)
    assert clock.take(1000, 11.201) is SampleVerdict.NEW
    assert clock.time_s == pytest.approx(6.201)
    assert set(clock.counters.values()) == {0}


@given(st.lists(st.tuples(st.integers(0, WRAP_US - 1), st.floats(0.0, 1e3)), max_size=60))
def test_time_never_goes_back(samples: list[tuple[int, float]]) -> None:
    clock = SampleClock(1000.0, WRAP_US)
    now_s, last_s, last_tick = 0.0, -1.0, 0
    for told_us, wait_s in samples:
        now_s += wait_s
        if clock.take(told_us, now_s) is SampleVerdict.NEW:
            assert clock.time_s > last_s
            assert clock.tick > last_tick
            last_s, last_tick = clock.time_s, clock.tick
