"""The estimator against models of delay: what is wrong with its line, after how long."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from palpate_gateway.clock.envelope import WINDOW_S, ClockEnvelope, middle_slope

Floats = npt.NDArray[np.float64]
Delay = Callable[[np.random.Generator, Floats], Floats]

RATE_HZ = 100.0
SETTLED_S = 10.0


def exponential(mean_s: float) -> Delay:
    return lambda random, times_s: random.exponential(mean_s, len(times_s))


def clumps(period_s: float) -> Delay:
    """An adapter that hands over what it has gathered, each ``period_s``."""

    def delay(random: np.random.Generator, times_s: Floats) -> Floats:
        ready_s = times_s + random.exponential(0.2e-3, len(times_s))
        return np.ceil(ready_s / period_s) * period_s - times_s

    return delay


def stalls(each_s: float, long_s: float) -> Delay:
    """A host that stands still now and then, and reads all that has come afterwards."""

    def delay(random: np.random.Generator, times_s: Floats) -> Floats:
        out = random.exponential(0.3e-3, len(times_s))
        for start_s in np.arange(0.5, times_s[-1], each_s):
            stalled = (times_s > start_s) & (times_s < start_s + long_s)
            out[stalled] += start_s + long_s - times_s[stalled]
        return out

    return delay


class Run:
    """A device whose clock is fast by some ppm, heard late."""

    def __init__(
        self,
        delay: Delay,
        *,
        fast_ppm: float | Floats = 0.0,
        seconds: float = 30.0,
        rate_hz: float = RATE_HZ,
        seed: int = 0,
    ) -> None:
        random = np.random.default_rng(seed)
        self.device_s = np.arange(round(seconds * rate_hz)) / rate_hz
        steps_s = np.full(len(self.device_s), 1.0 / rate_hz) * (1.0 - 1e-6 * fast_ppm)
        host_s = 5.0 + np.cumsum(steps_s)
        arrival_s = np.maximum.accumulate(host_s + delay(random, self.device_s))
        self.envelope = ClockEnvelope()
        mapped = []
        late_ns = 1e9 * (arrival_s - self.device_s)
        for x_s, late in zip(self.device_s.tolist(), late_ns.tolist(), strict=True):
            self.envelope.add(x_s, late)
            mapped.append(x_s + 1e-9 * self.envelope.at(x_s))
        self.error_s = np.array(mapped) - host_s

    @property
    def settled_s(self) -> Floats:
        """Errors after ten seconds [s]."""
        return self.error_s[self.device_s >= SETTLED_S]


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("rate_hz", [100.0, 500.0])
@pytest.mark.parametrize("fast_ppm", [0.0, 60.0, -300.0, 500.0, -500.0])
def test_offset_and_drift_under_exponential_delays(
    fast_ppm: float, rate_hz: float, seed: int
) -> None:
    run = Run(exponential(1e-3), fast_ppm=fast_ppm, rate_hz=rate_hz, seed=seed)
    assert np.abs(run.settled_s).max() < 0.2e-3
    assert run.envelope.drift_ppm == pytest.approx(fast_ppm, abs=20.0)


def test_heavy_delays_cost_a_tenth_of_their_mean() -> None:
    run = Run(exponential(10e-3), fast_ppm=-200.0, seconds=60.0)
    assert np.abs(run.settled_s).max() < 1e-3
    assert np.median(np.abs(run.settled_s)) < 0.3e-3


@pytest.mark.parametrize(
    ("rate_hz", "coarse_s"),
    # Samples and clumps meet again after 80 ms and 16 ms; their common step cannot be seen.
    [(100.0, 2e-3), (1000.0, 1e-3)],
)
def test_clumps_of_an_adapter_cost_no_more_than_the_common_step(
    rate_hz: float, coarse_s: float
) -> None:
    run = Run(clumps(16e-3), fast_ppm=0.0, rate_hz=rate_hz)
    assert run.settled_s.min() >= 0.0
    assert run.settled_s.max() <= coarse_s + 0.1e-3
    assert abs(run.envelope.drift_ppm) < 20.0


def test_stalls_of_the_host_change_nothing() -> None:
    run = Run(stalls(each_s=1.7, long_s=0.1), fast_ppm=300.0, rate_hz=1000.0)
    assert np.abs(run.settled_s).max() < 0.02e-3
    assert run.envelope.drift_ppm == pytest.approx(300.0, abs=2.0)


def test_a_stall_at_the_start_is_made_good_with_the_first_reading_in_time() -> None:
    def late_start(random: np.random.Generator, times_s: Floats) -> Floats:
        return np.maximum(0.1 - times_s, 0.0) + random.exponential(0.1e-3, len(times_s))

    run = Run(late_start)
    assert np.abs(run.error_s[run.device_s > 0.2]).max() < 0.5e-3


def test_the_first_seconds_are_off_by_what_the_drift_makes_of_one() -> None:
    run = Run(exponential(0.1e-3), fast_ppm=-500.0)
    assert np.abs(run.error_s[run.device_s > 0.1]).max() < 0.8e-3
    assert np.abs(run.error_s[run.device_s > 3.0]).max() < 0.05e-3


def test_a_quartz_that_warms_up_is_followed() -> None:
    warming_ppm = np.interp(np.arange(round(120 * RATE_HZ)) / RATE_HZ, [0.0, 60.0], [0.0, 30.0])
    run = Run(exponential(0.5e-3), fast_ppm=warming_ppm, seconds=120.0)
    assert np.abs(run.settled_s).max() < 0.1e-3
    assert run.envelope.drift_ppm == pytest.approx(30.0, abs=3.0)


@pytest.mark.parametrize("fast_ppm", [10_000.0, -10_000.0])
def test_a_rate_that_is_configured_wrong_by_a_hundredth_is_followed_too(fast_ppm: float) -> None:
    run = Run(exponential(0.3e-3), fast_ppm=fast_ppm)
    assert np.abs(run.settled_s).max() < 0.3e-3
    assert run.envelope.drift_ppm == pytest.approx(fast_ppm, abs=20.0)


def test_after_a_silence_it_goes_on_with_the_drift_that_it_knew() -> None:
    envelope, drift = ClockEnvelope(), -200e-6
    for start_s in (0.0, 80.0):
        for k in range(1500):
            x_s = start_s + 0.01 * k
            envelope.add(x_s, -1e9 * drift * x_s)
            assert envelope.at(x_s) == pytest.approx(-1e9 * drift * x_s, abs=2.5e5)
            if start_s:
                assert envelope.at(x_s) == pytest.approx(-1e9 * drift * x_s, abs=2e3)
    assert envelope.span_s <= WINDOW_S


def test_readings_once_a_minute_are_taken_as_they_come() -> None:
    envelope = ClockEnvelope()
    for k in range(10):
        envelope.add(60.0 * k, 1e6 * (k % 2))
        assert envelope.at(60.0 * k) <= 1e6 * (k % 2)


def test_the_slope_is_that_of_the_lower_hull_at_the_middle() -> None:
    points = [(0.0, 0.0), (1.0, 5.0), (2.0, 1.0), (3.0, 9.0), (4.0, 4.0), (5.0, 4.0)]
    # The hull: 0 - 2 with slope 1/2, then 2 - 5 with slope 1; the middle is at 2.5.
    assert middle_slope(points) == pytest.approx(1.0)
    assert middle_slope([(0.0, 3.0), (2.0, 1.0)]) == pytest.approx(-1.0)


def test_a_clock_that_is_counted_wrong_is_followed_from_there_on() -> None:
    """Our count of slots may be ahead by a frame where a stall looked like a loss."""
    random, envelope = np.random.default_rng(2), ClockEnvelope()
    errors = []
    for k in range(3000):
        x_s, ahead_ns = 0.01 * k, 10e6 * (k // 700)
        truth_ns = -80e3 * x_s - ahead_ns  # 80 ppm fast
        envelope.add(x_s, truth_ns + random.exponential(0.3e6))
        errors.append(envelope.at(x_s) - truth_ns)
    # At each miscount the next reading says so; of what is not yet seen nobody can know.
    worst = np.sort(np.abs(errors[1000:]))
    assert worst[-1] < 2e6
    assert worst[-40] < 0.3e6
    assert envelope.drift_ppm == pytest.approx(80.0, abs=30.0)


@pytest.mark.parametrize("rate_hz", [1.0, 100.0])
@pytest.mark.parametrize("before_s", [3.0, 30.0])
def test_a_clock_that_stopped_is_followed_anew(rate_hz: float, before_s: float) -> None:
    random, envelope = np.random.default_rng(5), ClockEnvelope()
    errors, doubts = [], []
    for k in range(round((before_s + 20.0) * rate_hz)):
        x_s = k / rate_hz
        truth_ns = -200e3 * x_s + (30e9 if x_s >= before_s else 0.0)
        envelope.add(x_s, truth_ns + random.exponential(0.3e6))
        errors.append(envelope.at(x_s) - truth_ns)
        doubts.append(envelope.in_doubt)
    stopped = round(before_s * rate_hz)
    anew = stopped + doubts[stopped:].index(False)
    assert not any(doubts[:stopped] + doubts[anew:])
    assert anew / rate_hz - before_s <= max(2.1, 5.0 / rate_hz)
    assert np.abs(errors[anew:]).max() < 2e6
    assert envelope.steps == 1


def late_from_ten_to_twenty_s(late_ns: Callable[[float], float]) -> ClockEnvelope:
    envelope = ClockEnvelope()
    for k in range(2000):
        x_s = 0.01 * k
        envelope.add(x_s, late_ns(x_s) if x_s >= 10.0 else 0.0)
    return envelope


def test_what_has_waited_is_no_clock_that_stopped() -> None:
    # A stall of five seconds: all comes at its end.
    stall = late_from_ten_to_twenty_s(lambda x_s: max(15.0 - x_s, 0.0) * 1e9)
    # Every tenth reading comes in time.
    bursts = late_from_ten_to_twenty_s(lambda x_s: 3e9 if round(100 * x_s) % 10 else 0.0)
    # A queue that grows.
    queue = late_from_ten_to_twenty_s(lambda x_s: 0.2e9 * (x_s - 10.0))
    for envelope in (stall, bursts, queue):
        assert envelope.steps == 0
    assert stall.at(20.0) == bursts.at(20.0) == pytest.approx(0.0, abs=1e5)
