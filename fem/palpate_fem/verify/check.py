"""What a check is: a measured number, what it should be, and how far off it may be."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from palpate.errors import PalpateError


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the suite.

    Attributes:
        name: ``topic/what``.
        value: What was measured; NaN if nothing could be.
        reference: What it should be.
        tolerance: Allowed deviation: a share of the reference, or absolute where that is 0.
        unit: Of value and reference; empty for pure numbers.
        passed: Whether it is within the tolerance.
        seconds: What it took; work shared with other checks counts for the first of them.
        note: Where the reference comes from, or why there is no value.
        skipped: Not measured, because something that is not part of the program is not there.
    """

    name: str
    value: float
    reference: float
    tolerance: float
    unit: str
    passed: bool
    seconds: float
    note: str
    skipped: bool = False


@dataclass(frozen=True, slots=True)
class Measured:
    """What a check's function returns; see `Check`."""

    value: float
    reference: float = 0.0
    note: str = ""


class Absent(Exception):
    """Something that is not part of the program is not there; the message says what."""


@dataclass(frozen=True, slots=True)
class Case:
    """A check that has not been run.

    Attributes:
        name: ``topic/what``.
        measure: Does the work.
        tolerance: See `Check`.
        unit: Of value and reference.
        slow: Takes more than a few seconds.
        at_least: The reference is a lower limit: any larger value passes.
    """

    name: str
    measure: Callable[[], Measured]
    tolerance: float
    unit: str = ""
    slow: bool = False
    at_least: bool = False

    def __call__(self) -> Check:
        """Run it; a simulation that cannot be run is a check that fails."""
        started = time.perf_counter()
        skipped = False
        try:
            measured = self.measure()
        except Absent as reason:
            measured, skipped = Measured(math.nan, math.nan, f"skipped: {reason}"), True
        except PalpateError as error:
            measured = Measured(math.nan, math.nan, error.problem)
        note = (
            ", ".join(filter(None, ("at least", measured.note))) if self.at_least else measured.note
        )
        return Check(
            name=self.name,
            value=float(measured.value),
            reference=float(measured.reference),
            tolerance=self.tolerance,
            unit=self.unit,
            passed=skipped or self._holds(measured),
            seconds=time.perf_counter() - started,
            note=note,
            skipped=skipped,
        )

    def _holds(self, measured: Measured) -> bool:
        allowed = self.tolerance * (abs(measured.reference) or 1.0)
        miss = measured.reference - measured.value
        return bool(miss <= allowed if self.at_least else abs(miss) <= allowed)
