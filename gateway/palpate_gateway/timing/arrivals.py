"""Times of samples that tell none, from when they were read and how many came together.

A sample that is read at once was taken now. One that waited, because this process or its host stood
still, must not look as fresh: buffers keep what came first, so that it follows the last sample that
was read before.
"""

from __future__ import annotations

_AWAKE_NS = 50_000_000
"""Between two reads of a process that is awake passes less [ns]."""

_CLUMP_NS = 10_000_000
"""Adapters hand samples over in clumps of less than this [ns]."""


class Arrivals:
    """Times the samples of one sensor.

    Args:
        period_s: Time between two samples [s].
    """

    def __init__(self, period_s: float) -> None:
        self._period_ns = round(1e9 * period_s)
        self._read_ns: int | None = None
        self._last_ns = 0

    def begin(self) -> None:
        """The stream begins anew: nothing waits that was not read away."""
        self._read_ns = None

    def times_ns(self, count: int, now_ns: int) -> list[int]:
        """Times of samples that were read together, by the host's monotonic clock [ns].

        Args:
            count: How many; at least one.
            now_ns: Host monotonic clock when they had been read [ns].
        """
        step_ns, read_ns = self._period_ns, self._read_ns
        self._read_ns = now_ns
        worth_ns = count * step_ns
        if read_ns is not None and self._waited(worth_ns, now_ns - read_ns):
            times = [min(self._last_ns + k * step_ns, now_ns) for k in range(1, count + 1)]
        else:
            if read_ns is not None:
                step_ns = min(step_ns, max(now_ns - self._last_ns, 0) // count)
            times = [now_ns - k * step_ns for k in range(count - 1, -1, -1)]
        self._last_ns = times[-1]
        return times

    def _waited(self, worth_ns: int, since_ns: int) -> bool:
        """Whether samples worth a time had waited, when this time has passed since the last."""
        more_than_came = worth_ns > 1.25 * since_ns and worth_ns - since_ns > _CLUMP_NS
        # Some were lost on the way: those that are there came first.
        overflown = since_ns > _AWAKE_NS and _CLUMP_NS < worth_ns < 0.8 * since_ns
        return more_than_came or overflown
