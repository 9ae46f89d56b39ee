"""Host clocks: what a stamp's times mean and how old a reading is."""

from __future__ import annotations

import time
import zlib
from pathlib import Path

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


def now() -> tuple[int, int]:
    """Monotonic and wall clock of this host [ns], read together."""
    return time.monotonic_ns(), time.time_ns()


def age_s(stamp: Stamp, *, monotonic_ns: int | None = None, wall_ns: int | None = None) -> float:
    """Age of a reading [s]: by the monotonic clock on the same host and boot, else by wall clocks.

    The times are this host's clocks [ns]; None = now.
    """
    if stamp.clock_id == CLOCK_ID:
        now_ns = time.monotonic_ns() if monotonic_ns is None else monotonic_ns
        return (now_ns - stamp.monotonic_ns) * 1e-9
    now_ns = time.time_ns() if wall_ns is None else wall_ns
    return (now_ns - stamp.wall_ns) * 1e-9
