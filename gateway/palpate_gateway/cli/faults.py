"""Faults on a time table: ``NAME@START[+SECONDS]``."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from typing import NamedTuple

from palpate.errors import ConfigError


class Fault(NamedTuple):
    """When a fault begins [s after the start], its name, and how long it lasts [s]; 0 = once."""

    start_s: float
    name: str
    duration_s: float


def parse_faults(texts: Iterable[str], known: Collection[str]) -> list[Fault]:
    """Faults in order of time.

    Args:
        texts: As typed.
        known: Faults that the device can have.

    Raises:
        ConfigError: A text is none, or the device has no such fault; names all that it has.
    """
    faults = []
    for text in texts:
        name, _, when = text.partition("@")
        start, plus, duration = when.partition("+")
        try:
            fault = Fault(float(start), name, float(duration) if plus else 0.0)
        except ValueError:
            fault = Fault(math.nan, name, 0.0)
        if not (0.0 <= fault.start_s < math.inf and 0.0 <= fault.duration_s < math.inf):
            raise ConfigError(
                f"--fault {text!r} is not NAME@START[+SECONDS]",
                remedy="write e.g. silence@10+3: silent from 10 s to 13 s; or lost@5: once at 5 s",
            )
        if name not in known:
            raise ConfigError(
                f"--fault {text!r}: this device cannot have the fault {name!r}",
                remedy=f"its faults: {', '.join(sorted(known))}",
            )
        faults.append(fault)
    return sorted(faults)
