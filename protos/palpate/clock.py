"""Host clocks: what a stamp's times mean and how old a reading is."""

from __future__ import annotations

import threading
import time
import zlib
from collections import deque
from pathlib import Path

from palpate.errors import ClockSkewError
from palpate.messages import Stamp

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def _clock_id() -> int:
    """One number per host and boot: monotonic times compare only where it agrees."""
    try:
        name = _BOOT_ID.read_bytes()
    except OSError:  # not Linux: use the host's name and the start of its clock
        import platform

        name = f"{platform.node()}:{round(time.time() - time.monotonic(), -1)}".encode()
    return zlib.crc32(name) or 1


CLOCK_ID = _clock_id()
"""Names this host's monotonic clock in ``Stamp.clock_id``."""

EARLIEST_WALL_S = 1_704_067_200.0
"""A wall clock that says an earlier time, before 2024, has not been set [s]."""

SAME_HOST_AHEAD_S = 0.005
"""A reading of this host may be so far in the future [s]: its time is an estimate from its device's
clock, and a thread may be woken a little early."""

WALL_CLOCK_ERROR_S = 0.05
"""By default two hosts' wall clocks differ by no more than this [s]: ten times what NTP keeps in a
laboratory."""


def now() -> tuple[int, int]:
    """Monotonic and wall clock of this host [ns], read together."""
    return time.monotonic_ns(), time.time_ns()


_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
_SLEEP_NS = 1_000_000  # no host sleeps for less


def since_boot_ns() -> int:
    """Time since this host started [ns], with the time that it was asleep (suspended).

    The monotonic clock stands still while the host is asleep. Outside Linux this is that clock.
    """
    return time.clock_gettime_ns(_BOOT)


class HostSleep:
    """Notices that this host was asleep, at the next call. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # At most so long was it asleep since its start [ns].
        self._most_ns = -time.monotonic_ns() + since_boot_ns()
        # Of each sleep: a monotonic time soon after it, and how long it was [ns].
        self._sleeps: deque[tuple[int, int]] = deque(maxlen=64)

    def since_ns(self, monotonic_ns: int) -> int:
        """How long the host was asleep after a monotonic time [ns].

        When a sleep began is known to the call before it, so a time between the two calls may be
        from before or after it: that counts as before, since nothing must look fresher than it is.
        """
        with self._lock:
            before_ns = time.monotonic_ns()
            boot_ns = since_boot_ns()
            after_ns = time.monotonic_ns()
            # A thread may be interrupted between two readings: only what is certain counts.
            slept_ns = boot_ns - after_ns - self._most_ns
            if slept_ns > _SLEEP_NS:
                self._sleeps.append((after_ns, slept_ns))
                self._most_ns = boot_ns - before_ns
            else:
                self._most_ns = min(self._most_ns, boot_ns - before_ns)
            return sum(slept_ns for woke_ns, slept_ns in self._sleeps if monotonic_ns < woke_ns)


_host_sleep = HostSleep()


def elapsed_s(monotonic_ns: int) -> float:
    """Time since a monotonic time of this host [ns], with the time that the host was asleep [s]."""
    slept_ns = _host_sleep.since_ns(monotonic_ns)
    return (time.monotonic_ns() - monotonic_ns + slept_ns) * 1e-9


def age_s(stamp: Stamp, *, monotonic_ns: int | None = None, wall_ns: int | None = None) -> float:
    """Age of a reading [s]: by the monotonic clock on the same host and boot, else by wall clocks.

    The times are this host's clocks [ns]; None = now, and then the time that this host was asleep
    counts.
    """
    if stamp.clock_id == CLOCK_ID:
        if monotonic_ns is None:
            return elapsed_s(stamp.monotonic_ns)
        return (monotonic_ns - stamp.monotonic_ns) * 1e-9
    now_ns = time.time_ns() if wall_ns is None else wall_ns
    return (now_ns - stamp.wall_ns) * 1e-9


def checked_age_s(stamp: Stamp, *, wall_clock_error_s: float = WALL_CLOCK_ERROR_S) -> float:
    """Age of a reading [s], see ``age_s``, which is not in the future.

    A stamp in the future must not pass as a fresh one: it would do so until its time has come. The
    age may be as much below zero as clocks may differ: ``SAME_HOST_AHEAD_S`` on this host,
    ``wall_clock_error_s`` for another.

    Raises:
        ClockSkewError: It is farther in the future.
    """
    age = age_s(stamp)
    here = stamp.clock_id == CLOCK_ID
    allowed_s = SAME_HOST_AHEAD_S if here else wall_clock_error_s
    if age >= -allowed_s:
        return age
    if here:
        raise ClockSkewError(
            f"the reading was stamped {-age:.3f} s in the future by the clock of this host, "
            f"{allowed_s:g} s is allowed",
            remedy="do not act on it; its sender is broken: restart that gateway",
            skew_s=-age,
        )
    raise ClockSkewError(
        f"the reading was stamped {-age:.3f} s in the future: the wall clocks of its host and of "
        f"this one differ by at least that, {allowed_s:g} s is allowed",
        remedy="do not act on it; synchronise both clocks by NTP or PTP (docs/time.md), or state "
        "how far they may differ: link.wall_clock_error_s",
        skew_s=-age,
    )
