"""The kernel's receive stamps, which are wall times, as host monotonic times."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from palpate_gateway.timing.wall_clock import WallClock

OLDEST_NS = 1_000_000_000
"""Nothing waits longer in a receive queue that is read [ns], unless its reader stood still."""

_PAUSE_NS = 100_000_000
"""A longer one is remembered, until what waited meanwhile has been read [ns]."""

_EARLY_NS = 100_000
"""By how much the two clocks may seem out of order when they are read [ns]."""


class KernelStamps:
    """When the kernel received what was read later; belongs to one thread.

    A stamp that cannot be is not believed, and the time of arrival stands for it: none, one in the
    future or more than a second old (another clock's, or another host's), or any that was made
    within a second of a step of the wall clock, when it is not known on which side. After a pause
    between two reads what is read may have waited for all of it: this process may have stood still.

    Args:
        wall: The wall clock; None = one of its own.
    """

    def __init__(self, wall: WallClock | None = None) -> None:
        self._wall = wall or WallClock()
        self._steps = self._wall.steps
        self._doubt_until_ns = 0
        self._read_ns: int | None = None
        self._paused_ns = self._paused_until_ns = 0
        self.refused = 0
        """Stamps that were not believed."""

    def monotonic_ns(self, stamp_s: float, arrival_ns: int) -> int:
        """Host monotonic time of a stamp [ns], not later than the arrival.

        Args:
            stamp_s: As python-can tells it [s since the Unix epoch].
            arrival_ns: Host monotonic clock when it had been read [ns].
        """
        if not math.isfinite(stamp_s):
            self.refused += 1
            return arrival_ns
        return self.monotonic_of_ns(round(stamp_s * 1e9), arrival_ns)

    def monotonic_of_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """As ``monotonic_ns``, for a stamp in [ns since the Unix epoch]."""
        if not self._trusted(arrival_ns):
            self.refused += 1
            return arrival_ns
        received_ns = stamp_ns - self._wall.offset_ns
        if not -_EARLY_NS <= arrival_ns - received_ns <= self._oldest_ns(arrival_ns):
            self.refused += 1
            return arrival_ns
        return min(received_ns, arrival_ns)

    def monotonic_of_all(
        self, stamps_ns: npt.NDArray[np.int64], arrival_ns: int
    ) -> npt.NDArray[np.int64]:
        """As ``monotonic_of_ns``, for the stamps of what came in this order and was read at once.

        None came later than what came after it: while the kernel's stamping is being switched on,
        which takes it some milliseconds after a bus is opened, it stamps at reading.
        """
        if not self._trusted(arrival_ns):
            self.refused += len(stamps_ns)
            return np.full(len(stamps_ns), arrival_ns)
        received_ns = stamps_ns - self._wall.offset_ns
        waited_ns = arrival_ns - received_ns
        believed = (waited_ns >= -_EARLY_NS) & (waited_ns <= self._oldest_ns(arrival_ns))
        self.refused += int(len(believed) - np.count_nonzero(believed))
        came_ns = np.where(believed, np.minimum(received_ns, arrival_ns), arrival_ns)
        return np.minimum.accumulate(came_ns[::-1])[::-1]

    def _oldest_ns(self, arrival_ns: int) -> int:
        """How long what is read now may have waited [ns]."""
        paused_ns = 0 if self._read_ns is None else arrival_ns - self._read_ns
        self._read_ns = arrival_ns
        if arrival_ns > self._paused_until_ns:
            self._paused_ns = 0
        if paused_ns > _PAUSE_NS:
            self._paused_ns = max(self._paused_ns, paused_ns)
            self._paused_until_ns = arrival_ns + OLDEST_NS
        return OLDEST_NS + self._paused_ns

    def _trusted(self, arrival_ns: int) -> bool:
        """Whether stamps that were read now can be on the right side of a step."""
        wall = self._wall
        if arrival_ns >= wall.looked_ns:
            # Looking after the stamp was made, a step can be told; once for all of a batch.
            wall.look()
        if wall.steps != self._steps:
            self._steps = wall.steps
            self._doubt_until_ns = wall.looked_ns + OLDEST_NS
        return arrival_ns >= self._doubt_until_ns
