"""The host's wall clock beside its monotonic one, and being told when somebody sets it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

_log = logging.getLogger(__name__)

LOOK_NS = 100_000_000
"""How often stamps look at the wall clock [ns]."""

_TIGHT_NS = 20_000
"""Two readings within this time are one instant [ns]."""
_ATTEMPTS = 4

_STEP_NS = 100_000
"""A larger change that the readings do not explain is a step [ns]."""

_STEERED = 1e-3
"""Where the monotonic clock is not steered as the wall clock is, as it is on Linux, they part by
less than this."""


class ClockPair(NamedTuple):
    """Monotonic and wall clock read together [ns], and how far apart that may have been [ns]."""

    monotonic_ns: int
    wall_ns: int
    apart_ns: int


def read_pair() -> ClockPair:
    """Both clocks of this host; read again if this thread was put aside between them."""
    best: ClockPair | None = None
    for _ in range(_ATTEMPTS):
        before_ns = time.monotonic_ns()
        wall_ns = time.time_ns()
        apart_ns = time.monotonic_ns() - before_ns
        if best is None or apart_ns < best.apart_ns:
            best = ClockPair(before_ns + apart_ns // 2, wall_ns, apart_ns)
        if apart_ns <= _TIGHT_NS:
            break
    assert best is not None
    return best


class WallClock:
    """Turns monotonic times into wall times; one for all sensors of a process. Safe with threads.

    Linux steers both clocks alike, so what lies between them changes only when somebody sets the
    wall clock: a step. Stamps follow it within ``LOOK_NS``; monotonic times know nothing of it.

    Args:
        read: Reads both clocks.
    """

    def __init__(self, read: Callable[[], ClockPair] = read_pair) -> None:
        self.steps = 0
        """How often the wall clock was set."""
        self._read = read
        self._lock = threading.Lock()
        pair = read()
        self.offset_ns = pair.wall_ns - pair.monotonic_ns
        """Wall less monotonic clock at the last look [ns]."""
        self._apart_ns = pair.apart_ns
        self.looked_ns = pair.monotonic_ns
        """Monotonic time of the last look [ns]."""

    def at(self, monotonic_ns: int, *, now_ns: int) -> int:
        """Wall time of a monotonic time [ns].

        Args:
            monotonic_ns: Which instant [ns].
            now_ns: The monotonic clock about now, to look again if the last look is old [ns].
        """
        if now_ns - self.looked_ns > LOOK_NS:
            self.look()
        return monotonic_ns + self.offset_ns

    def look(self) -> None:
        """Read both clocks now."""
        with self._lock:
            pair = self._read()
            offset_ns = pair.wall_ns - pair.monotonic_ns
            change_ns = offset_ns - self.offset_ns
            unsure_ns = pair.apart_ns + self._apart_ns
            parted_ns = _STEERED * (pair.monotonic_ns - self.looked_ns)
            self.looked_ns = pair.monotonic_ns
            if abs(change_ns) > unsure_ns + _STEP_NS + parted_ns:
                self.steps += 1
                _log.warning("the wall clock was set by %+.6f s", 1e-9 * change_ns)
            elif abs(change_ns) <= unsure_ns and pair.apart_ns >= self._apart_ns:
                return  # the same, and it was read better before
            self.offset_ns, self._apart_ns = offset_ns, pair.apart_ns
