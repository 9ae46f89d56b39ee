"""The host's wall clock: its steps, its relation to the monotonic clock, and its error.

The monotonic clock stands still while the host is asleep (suspended), the wall clock does not.

``WallClock`` gives each stamp its wall time and notices when the clock is set. ``KernelStamps``
converts the kernel's receive stamps, which are wall times, to monotonic times. ``wall_discipline``
asks the kernel how well the clock is kept.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import math
import sys
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.clock import since_boot_ns

_log = logging.getLogger(__name__)

LOOK_NS = 100_000_000
"""How often stamps look at the wall clock [ns]."""

_TIGHT_NS = 20_000
"""Both clocks read within this time count as read at one instant [ns]."""
_ATTEMPTS = 4

_STEP_NS = 100_000
"""A change by more than this, beyond the error of reading, is a step [ns]."""

_STEERED = 1e-3
"""Outside Linux only the wall clock is slewed: both clocks then drift apart by less than this."""


class ClockPair(NamedTuple):
    """Monotonic and wall clock read together [ns], and the time between the first and last reading.

    ``asleep_ns`` is how long the host was asleep since its start [ns].
    """

    monotonic_ns: int
    wall_ns: int
    apart_ns: int
    asleep_ns: int = 0


def read_pair() -> ClockPair:
    """The clocks of this host; read again if this thread was interrupted between them."""
    best: ClockPair | None = None
    for _ in range(_ATTEMPTS):
        before_ns = time.monotonic_ns()
        wall_ns = time.time_ns()
        boot_ns = since_boot_ns()
        apart_ns = time.monotonic_ns() - before_ns
        if best is None or apart_ns < best.apart_ns:
            middle_ns = before_ns + apart_ns // 2
            best = ClockPair(middle_ns, wall_ns, apart_ns, boot_ns - middle_ns)
        if apart_ns <= _TIGHT_NS:
            break
    assert best is not None
    return best


class WallClock:
    """Turns monotonic times into wall times; one for all sensors of a process, from any thread.

    Linux slews both clocks alike, so the difference between them changes only when the wall clock
    is set: a step. Wall times follow it within ``LOOK_NS``; monotonic times do not change. The
    difference grows also by the time that the host is asleep, which is no step: times before the
    look that notices it keep their wall times.
    """

    def __init__(self, read: Callable[[], ClockPair] = read_pair) -> None:
        self.steps = 0
        """How often the wall clock was set."""
        self._read = read
        self._lock = threading.Lock()
        pair = read()
        self.offset_ns = pair.wall_ns - pair.monotonic_ns
        """Wall clock minus monotonic clock at the last look [ns]."""
        self._apart_ns, self._asleep_ns = pair.apart_ns, pair.asleep_ns
        self.looked_ns = pair.monotonic_ns
        """Monotonic time of the last look [ns]."""
        self.before_sleep = -1, self.offset_ns
        """Monotonic time at which a sleep was noticed, and the offset until then [ns]."""

    def at(self, monotonic_ns: int, *, now_ns: int) -> int:
        """Wall time of a monotonic time [ns]; looks again if the last look is old at ``now_ns``."""
        if now_ns - self.looked_ns > LOOK_NS:
            self.look()
        until_ns, offset_ns = self.before_sleep
        return monotonic_ns + (offset_ns if monotonic_ns <= until_ns else self.offset_ns)

    def look(self) -> None:
        """Read the clocks now."""
        with self._lock:
            pair = self._read()
            offset_ns = pair.wall_ns - pair.monotonic_ns
            slept_ns = pair.asleep_ns - self._asleep_ns
            change_ns = offset_ns - self.offset_ns - slept_ns
            # Either reading of the clocks may be off by the time between its parts.
            unsure_ns = pair.apart_ns + self._apart_ns
            parted_ns = _STEERED * (pair.monotonic_ns - self.looked_ns)
            self.looked_ns = pair.monotonic_ns
            if abs(change_ns) > unsure_ns + _STEP_NS + parted_ns:
                self.steps += 1
                _log.warning("the wall clock was set by %+.6f s", 1e-9 * change_ns)
                self.before_sleep = -1, offset_ns
            elif max(abs(change_ns), slept_ns) <= unsure_ns and pair.apart_ns >= self._apart_ns:
                return  # no change, and the earlier reading was more exact
            if slept_ns > unsure_ns + _STEP_NS:
                _log.warning("this host was asleep for %.3f s", 1e-9 * slept_ns)
                self.before_sleep = pair.monotonic_ns, self.offset_ns
            self.offset_ns, self._apart_ns = offset_ns, pair.apart_ns
            self._asleep_ns = pair.asleep_ns


OLDEST_NS = 1_000_000_000
"""Longest wait in a receive queue [ns], unless the process that reads it stood still."""

_PAUSE_NS = 100_000_000
"""A longer pause between two reads is taken into account until its backlog has been read [ns]."""

_EARLY_NS = 100_000
"""By how much a stamp may seem to lie in the future, by the error of reading both clocks [ns]."""


class KernelStamps:
    """Monotonic times at which the kernel received what was read later; belongs to one thread.

    An implausible stamp is replaced by the time of arrival: a missing one, one in the future or
    more than a second old (of another clock, or another host), and any within a second of a step of
    the wall clock, since it may be from before or after the step. After a pause of this process,
    stamps may be older by the length of the pause. What came before the host was asleep keeps the
    monotonic time at which it came.
    """

    def __init__(self, wall: WallClock | None = None) -> None:
        self._wall = wall or WallClock()
        self._steps = self._wall.steps
        self._doubt_until_ns = 0
        self._read_ns: int | None = None
        self._paused_ns = self._paused_until_ns = 0

    def monotonic_ns(self, stamp_s: float, arrival_ns: int) -> int:
        """Host monotonic time of a stamp [ns], not later than the arrival.

        Args:
            stamp_s: As python-can gives it [s since the Unix epoch].
            arrival_ns: Host monotonic clock when it had been read [ns].
        """
        if not math.isfinite(stamp_s):
            return arrival_ns
        return self.monotonic_of_ns(round(stamp_s * 1e9), arrival_ns)

    def monotonic_of_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """As ``monotonic_ns``, for a stamp in [ns since the Unix epoch]."""
        if not self._trusted(arrival_ns):
            return arrival_ns
        until_ns, offset_ns = self._wall.before_sleep
        if stamp_ns - offset_ns > until_ns:
            offset_ns = self._wall.offset_ns
        received_ns = stamp_ns - offset_ns
        if not -_EARLY_NS <= arrival_ns - received_ns <= self._oldest_ns(arrival_ns):
            return arrival_ns
        return min(received_ns, arrival_ns)

    def monotonic_of_all(
        self, stamps_ns: npt.NDArray[np.int64], arrival_ns: int
    ) -> npt.NDArray[np.int64]:
        """As ``monotonic_of_ns``, for the stamps of messages in order of arrival, read together.

        In the first milliseconds after a bus is opened the kernel stamps when it is read; so each
        time is limited by the times of the messages behind it.
        """
        if not self._trusted(arrival_ns):
            return np.full(len(stamps_ns), arrival_ns)
        until_ns, offset_ns = self._wall.before_sleep
        received_ns = stamps_ns - offset_ns
        received_ns = np.where(
            received_ns > until_ns, stamps_ns - self._wall.offset_ns, received_ns
        )
        waited_ns = arrival_ns - received_ns
        plausible = (waited_ns >= -_EARLY_NS) & (waited_ns <= self._oldest_ns(arrival_ns))
        came_ns = np.where(plausible, np.minimum(received_ns, arrival_ns), arrival_ns)
        return np.minimum.accumulate(came_ns[::-1])[::-1]

    def _oldest_ns(self, arrival_ns: int) -> int:
        """Longest plausible wait of what is read now [ns]."""
        paused_ns = 0 if self._read_ns is None else arrival_ns - self._read_ns
        self._read_ns = arrival_ns
        if arrival_ns > self._paused_until_ns:
            self._paused_ns = 0
        if paused_ns > _PAUSE_NS:
            self._paused_ns = max(self._paused_ns, paused_ns)
            self._paused_until_ns = arrival_ns + OLDEST_NS
        return OLDEST_NS + self._paused_ns

    def _trusted(self, arrival_ns: int) -> bool:
        """Whether no step of the wall clock can lie between the stamps and now."""
        wall = self._wall
        if arrival_ns >= wall.looked_ns:
            # A look after the stamps were made notices a step; one look is enough for a batch.
            wall.look()
        if wall.steps != self._steps:
            self._steps = wall.steps
            self._doubt_until_ns = wall.looked_ns + OLDEST_NS
        return arrival_ns >= self._doubt_until_ns


_UNKNOWN_US = 16_000_000
"""Largest error that the kernel states; it means that nothing corrects the clock [us]. The flag
STA_UNSYNC is no substitute: chrony leaves it set unless it also keeps the hardware clock."""

_STRUCT_BYTES = 512
"""More than struct timex has on any machine."""


class _Timex(ctypes.Structure):
    """The beginning of the kernel's struct timex."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
    )


class WallDiscipline(NamedTuple):
    """How well the wall clock is kept.

    Attributes:
        synchronised: Whether a program corrects it.
        error_s: Largest error that the kernel states [s], as chrony and ntpd report it; others
            report 0. It grows by 0.5 ms a second until the next correction.
    """

    synchronised: bool
    error_s: float


@functools.cache
def _adjtimex() -> Callable[[object], int] | None:
    """The call of the kernel, looked up once: each ``CDLL`` makes a class, a circle of garbage."""
    try:
        found: Callable[[object], int] = ctypes.CDLL(None, use_errno=True).adjtimex
    except (OSError, AttributeError):
        return None
    return found


def wall_discipline() -> WallDiscipline | None:
    """How well the wall clock of this host is kept; None = unknown.

    Programs that correct the clock (chrony, ntpd, systemd-timesyncd, phc2sys) report to the kernel.
    Outside Linux, and where a sandbox forbids the call, it is unknown.
    """
    if not sys.platform.startswith("linux"):
        return None
    memory = ctypes.create_string_buffer(_STRUCT_BYTES)
    state = _Timex.from_buffer(memory)
    ask = _adjtimex()
    if ask is None or ask(memory) < 0:
        return None
    return WallDiscipline(state.maxerror < _UNKNOWN_US, 1e-6 * state.maxerror)
