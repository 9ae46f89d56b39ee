"""What the kernel knows of the wall clock: whether something keeps it right, and how well.

Whoever sets the clock by the network (chrony, ntpd, systemd-timesyncd, phc2sys) tells the kernel;
anybody may ask it. Elsewhere than on Linux, and where a sandbox forbids to ask, it is not known.
"""

from __future__ import annotations

import ctypes
import sys
from typing import NamedTuple

_UNKNOWN_US = 16_000_000
"""The kernel's largest error, which means that nothing has corrected the clock for long [us]. Its
flag STA_UNSYNC would not do: chrony leaves it set unless it also keeps the hardware clock."""

_STRUCT_BYTES = 512
"""More than struct timex has on any machine."""


class _Timex(ctypes.Structure):
    """The beginning of struct timex, in which longs are as long as the machine's."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
    )


class Discipline(NamedTuple):
    """How the wall clock is kept.

    Attributes:
        synchronised: Whether something keeps it.
        error_s: Largest error by the kernel's account [s], as chrony and ntpd tell it; others tell
            0. It grows by 0.5 ms a second until the clock is corrected again.
    """

    synchronised: bool
    error_s: float


def wall_discipline() -> Discipline | None:
    """How the wall clock of this host is kept; None = not known here."""
    if not sys.platform.startswith("linux"):
        return None
    memory = ctypes.create_string_buffer(_STRUCT_BYTES)
    state = _Timex.from_buffer(memory)
    try:
        ask = ctypes.CDLL(None, use_errno=True).adjtimex
    except (OSError, AttributeError):
        return None
    if ask(memory) < 0:
        return None
    return Discipline(state.maxerror < _UNKNOWN_US, 1e-6 * state.maxerror)
