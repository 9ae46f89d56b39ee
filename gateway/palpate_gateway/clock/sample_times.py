"""Samples that lack a time or a number: each is derived from the other, and from the arrival."""

from __future__ import annotations

import math
from enum import Enum

_AWAKE_NS = 50_000_000
"""A process that is not stopped reads again within this time [ns]."""

_CLUMP_NS = 10_000_000
"""Adapters deliver samples in clumps worth less than this [ns]."""

_CHECK_NS = 2_000_000_000
_CHECK_SAMPLES = 30
"""The rate is measured over so long and so many samples, at least."""

_TOLERANCE = 0.05
"""Relative tolerance of the rate."""


class ArrivalTimes:
    """Times of samples that carry none, from their arrival and the sensor's rate.

    A sample that is read at once was taken now. One that waited, because this process or its host
    stood still, must not look as fresh: buffers keep the oldest samples, so it follows the last
    sample before the pause. A rate that is not the set one is measured, used and counted.
    """

    def __init__(self, period_s: float) -> None:
        self.counters = {"rate_not_as_configured": 0}
        """How often another rate was measured than the set one."""
        self._set_ns = self._period_ns = round(1e9 * period_s)
        self._check_ns = max(_CHECK_NS, _CHECK_SAMPLES * self._set_ns)
        self._suspect_ns: float | None = None
        self.begin()

    def begin(self) -> None:
        """The stream starts again: all earlier samples were read or discarded."""
        self._read_ns: int | None = None
        self._last_ns = 0
        self._behind = False
        self._check_from_ns: int | None = None
        self._came = 0

    @property
    def rate_hz(self) -> float:
        """Rate at which samples come: the set one, until another one was measured."""
        return 1e9 / self._period_ns

    @property
    def check_s(self) -> float:
        """Time after which a wrong rate is known [s]."""
        return 2.5e-9 * self._check_ns

    def times_ns(self, count: int, now_ns: int) -> list[int]:
        """Times of samples that were read together, by the host's monotonic clock [ns].

        Args:
            count: How many; at least one.
            now_ns: Host monotonic clock when they had been read [ns].
        """
        self._check_rate(count, now_ns)
        step_ns, read_ns = self._period_ns, self._read_ns
        self._read_ns = now_ns
        waited = False
        if read_ns is not None:
            waited = self._waited(count * step_ns, now_ns - read_ns)
            # Never before the last sample nor after now, and never at one time: a clump that came
            # early is packed closer.
            step_ns = min(step_ns, max(now_ns - self._last_ns, 0) // count)
        # After a pause count on from the last sample; else count back from now.
        first_ns = self._last_ns + step_ns if waited else now_ns - (count - 1) * step_ns
        times = [first_ns + k * step_ns for k in range(count)]
        self._last_ns = times[-1]
        return times

    def _waited(self, worth_ns: int, since_ns: int) -> bool:
        """Whether samples worth ``worth_ns`` had waited, ``since_ns`` after the read before."""
        more_than_came = worth_ns > 1.25 * since_ns and worth_ns - since_ns > _CLUMP_NS
        # The buffer overflowed: it holds the oldest samples. That is over when it has been read; a
        # sensor that is slower than it says looks like that every time, and must not fall behind.
        overflown = since_ns > _AWAKE_NS and _CLUMP_NS < worth_ns < 0.8 * since_ns
        waited = more_than_came or (overflown and not self._behind)
        self._behind = waited and (overflown or self._behind)
        return waited

    def _check_rate(self, count: int, now_ns: int) -> None:
        if self._check_from_ns is None:
            self._check_from_ns = now_ns
            return
        self._came += count
        waited_ns = now_ns - self._check_from_ns
        if waited_ns < self._check_ns:
            return
        period_ns = waited_ns / self._came
        self._check_from_ns, self._came = now_ns, 0
        # A pause of this process looks like another rate, so one wrong measurement is not enough.
        before_ns, self._suspect_ns = self._suspect_ns, period_ns
        if math.isclose(period_ns, self._set_ns, rel_tol=_TOLERANCE):
            self._suspect_ns, self._period_ns = None, self._set_ns
        elif before_ns is not None and math.isclose(before_ns, period_ns, rel_tol=_TOLERANCE):
            self._period_ns = round(period_ns)
            self.counters["rate_not_as_configured"] += 1


_BACKLOG_S = 2.0
"""How far sample times may run ahead of the host while it reads a backlog [s]."""


class SampleVerdict(Enum):
    """Judgement of a sample by its time."""

    NEW = "new"
    REPEATED = "repeated"
    DOUBTFUL = "doubtful"
    RESTARTED = "restarted"


class SampleClock:
    """Unwraps the clock of a sensor that stamps its samples but does not number them.

    Steady stamps show lost and repeated samples, and that the sensor has restarted. ``counters``:
    ``lost_samples``, ``repeated_samples``, and ``wrong_times`` of samples with impossible times.

    Args:
        period_us: Time between two samples [us].
        wrap_us: The clock wraps here [us].
    """

    def __init__(self, period_us: float, wrap_us: int) -> None:
        self._period_us, self._wrap_us = period_us, wrap_us
        self.tick = 0
        """Number of samples that the sensor took, lost ones included."""
        self.time_s = 0.0
        """Unwrapped time of the last new sample [s]."""
        self._time_us = 0
        self._stamp_us: int | None = None
        self._arrived_s = 0.0
        self._suspect_us: int | None = None
        self._paused = False
        self.counters = dict.fromkeys(("lost_samples", "repeated_samples", "wrong_times"), 0)

    def pause(self) -> None:
        """The sensor was stopped for a while: samples that it does not take are not lost."""
        self._paused = True
        self._suspect_us = None

    def take(self, stamp_us: int, now_s: float) -> SampleVerdict:
        """Judge the next sample, by its time as sent [us] and the host's monotonic time [s]."""
        if self._stamp_us is None:
            return self._accept(stamp_us, now_s, stamp_us, 1)
        ahead_us = (stamp_us - self._stamp_us) % self._wrap_us
        if ahead_us == 0:
            self.counters["repeated_samples"] += 1
            return SampleVerdict.REPEATED
        # Modulo the wrap a step back looks like a large step ahead; the host's clock decides.
        steps = round(ahead_us / self._period_us)
        host_us = round(1e6 * (now_s - self._arrived_s))
        if steps < 1 or ahead_us > host_us + 1e6 * _BACKLOG_S:
            if not self._paused:
                return self._doubt(stamp_us)
            # It may have reset its clock in the pause; the host's clock went on.
            ahead_us = max(host_us, round(self._period_us))
            steps = round(ahead_us / self._period_us)
        if not self._paused:
            self.counters["lost_samples"] += steps - 1
        return self._accept(stamp_us, now_s, ahead_us, steps)

    def _accept(self, stamp_us: int, now_s: float, ahead_us: int, steps: int) -> SampleVerdict:
        self.tick += steps
        self._time_us += ahead_us
        self.time_s = 1e-6 * self._time_us
        self._stamp_us, self._arrived_s = stamp_us, now_s
        self._suspect_us, self._paused = None, False
        return SampleVerdict.NEW

    def _doubt(self, stamp_us: int) -> SampleVerdict:
        """An impossible time: one alone is a damaged sample, two in a row a restarted clock."""
        if self._suspect_us is not None:
            ahead_us = (stamp_us - self._suspect_us) % self._wrap_us
            if 0 < ahead_us < 1e6 * _BACKLOG_S:
                return SampleVerdict.RESTARTED
        self._suspect_us = stamp_us
        self.counters["wrong_times"] += 1
        return SampleVerdict.DOUBTFUL
