"""The clock of a sensor that stamps its samples but does not number them.

From steady stamps follows what was lost, what came twice, and that the sensor has restarted.
"""

from __future__ import annotations

from enum import Enum

_BACKLOG_S = 2.0
"""How far samples may run ahead of the host, which reads what had waited [s]."""


class Verdict(Enum):
    """What a sample's time says of it."""

    NEW = "new"
    REPEATED = "repeated"
    DOUBTFUL = "doubtful"
    RESTARTED = "restarted"


class SampleClock:
    """Unwraps a clock and judges each sample by it.

    ``counters``: ``lost_samples``, ``repeated_samples``, and ``wrong_times`` of samples whose time
    cannot be and that must not be believed.

    Args:
        period_us: Time between two samples [us].
        wrap_us: The clock wraps here [us].
    """

    def __init__(self, period_us: float, wrap_us: int) -> None:
        self._period_us, self._wrap_us = period_us, wrap_us
        self.tick = 0
        """Samples that the sensor took, lost ones too."""
        self.time_s = 0.0
        """Unwrapped time of the last new sample [s]."""
        self._time_us = 0
        self._told_us: int | None = None
        self._heard_s = 0.0
        self._suspect_us: int | None = None
        self._paused = False
        self.counters = dict.fromkeys(("lost_samples", "repeated_samples", "wrong_times"), 0)

    def pause(self) -> None:
        """The sensor was told to stop for a while: what it does not take is not lost."""
        self._paused = True
        self._suspect_us = None

    def take(self, told_us: int, now_s: float) -> Verdict:
        """Judge the next sample.

        Args:
            told_us: Its time as told [us].
            now_s: The host's monotonic time [s].
        """
        if self._told_us is None:
            return self._accept(told_us, now_s, told_us, 1)
        ahead_us = (told_us - self._told_us) % self._wrap_us
        if ahead_us == 0:
            self.counters["repeated_samples"] += 1
            return Verdict.REPEATED
        steps = round(ahead_us / self._period_us)
        host_us = round(1e6 * (now_s - self._heard_s))
        if steps < 1 or ahead_us > host_us + 1e6 * _BACKLOG_S:
            if not self._paused:
                return self._doubt(told_us)
            # It may have set its clock back for the pause; the host's went on.
            ahead_us = max(host_us, round(self._period_us))
            steps = round(ahead_us / self._period_us)
        if not self._paused:
            self.counters["lost_samples"] += steps - 1
        return self._accept(told_us, now_s, ahead_us, steps)

    def _accept(self, told_us: int, now_s: float, ahead_us: int, steps: int) -> Verdict:
        self.tick += steps
        self._time_us += ahead_us
        self.time_s = 1e-6 * self._time_us
        self._told_us, self._heard_s = told_us, now_s
        self._suspect_us, self._paused = None, False
        return Verdict.NEW

    def _doubt(self, told_us: int) -> Verdict:
        """A time that cannot be: of a damaged sample if it is alone, else the clock began anew."""
        if self._suspect_us is not None:
            ahead_us = (told_us - self._suspect_us) % self._wrap_us
            if 0 < ahead_us < 1e6 * _BACKLOG_S:
                return Verdict.RESTARTED
        self._suspect_us = told_us
        self.counters["wrong_times"] += 1
        return Verdict.DOUBTFUL
