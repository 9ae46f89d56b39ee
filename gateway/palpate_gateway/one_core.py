"""Binds the process to one processor core.

Python runs one thread at a time, on whatever core. Spread over several cores, a gateway with a
dozen threads spends a third more time on waking them, and its slowest frames wait three times as
long (``palpate bench hand``, ADR 17).
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from pathlib import Path
from typing import Literal

from pydantic import NonNegativeInt

from palpate.errors import ConfigError

_log = logging.getLogger(__name__)

CoreChoice = NonNegativeInt | Literal["idlest", "any"]

_LOOK_S = 0.1
_STAT = Path("/proc/stat")
_TASKS = Path("/proc/self/task")


def stay_on_one_core(choice: CoreChoice) -> int | None:
    """Bind all threads of this process, and those to come, to one core.

    Args:
        choice: Number of the core; ``idlest`` = the one with the least load; ``any`` = do nothing.

    Returns:
        The core; None if the system decides: by choice, with a single core, or without support.

    Raises:
        ConfigError: This process may not run on the core.
    """
    if choice == "any" or not hasattr(os, "sched_setaffinity"):
        return None
    allowed = os.sched_getaffinity(0)
    if choice == "idlest":
        if len(allowed) == 1 or not _STAT.exists():
            return None
        choice = _idlest(allowed)
    elif choice not in allowed:
        numbers = ", ".join(map(str, sorted(allowed)))
        raise ConfigError(
            f"[gateway] core {choice}: this process may run on {numbers}",
            remedy='name one of them, or "idlest", or "any" to let the system decide',
        )
    for task in _TASKS.iterdir():
        with contextlib.suppress(OSError):  # a thread that has just ended
            os.sched_setaffinity(int(task.name), {choice})
    _log.info("on core %d", choice)
    return choice


def _idlest(allowed: set[int]) -> int:
    before = _idle_ticks()
    time.sleep(_LOOK_S)
    after = _idle_ticks()
    # Of equals the last one: interrupts tend to be served by the first.
    return max(sorted(allowed), key=lambda core: (after.get(core, 0) - before.get(core, 0), core))


def _idle_ticks() -> dict[int, int]:
    """Idle time of each core [ticks]."""
    ticks = {}
    for line in _STAT.read_text(encoding="ascii").splitlines():
        name, _, rest = line.partition(" ")
        if name.startswith("cpu") and name[3:].isdigit():
            fields = rest.split()
            ticks[int(name[3:])] = int(fields[3]) + int(fields[4])
    return ticks
