"""A check of the verification: a measured number, its reference and the tolerance."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from palpate.errors import PalpateError


@dataclass(frozen=True, slots=True)
class VerificationCheck:
    """One line of the suite: a check that has been run.

    Attributes:
        name: ``topic/what``.
        value: Measured value; NaN if it could not be measured.
        reference: Expected value.
        tolerance: Allowed deviation: a share of the reference, or absolute where that is 0.
        unit: Of value and reference; empty for pure numbers.
        passed: Whether it is within the tolerance.
        seconds: Time it took; work that checks share counts for the first of them.
        note: Where the reference comes from, or why there is no value.
        skipped: Not measured, because data are missing that are not part of palpate.
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
class Measurement:
    """Result of a check's function; see `VerificationCheck`."""

    value: float
    reference: float = 0.0
    note: str = ""


class MissingDataError(Exception):
    """Data that are not part of palpate are missing; the message says which."""


@dataclass(frozen=True, slots=True)
class VerificationCase:
    """A check that has not been run.

    Attributes:
        name: ``topic/what``.
        measure: Function that measures.
        tolerance: See `VerificationCheck`.
        unit: Of value and reference.
        slow: Takes more than a few seconds.
        at_least: The reference is a lower limit: any larger value passes.
    """

    name: str
    measure: Callable[[], Measurement]
    tolerance: float
    unit: str = ""
    slow: bool = False
    at_least: bool = False

    def __call__(self) -> VerificationCheck:
        """Run it; a simulation that raises an error is a failed check."""
        started = time.perf_counter()
        skipped = False
        try:
            measured = self.measure()
        except MissingDataError as reason:
            measured, skipped = Measurement(math.nan, math.nan, f"skipped: {reason}"), True
        except PalpateError as error:
            measured = Measurement(math.nan, math.nan, error.problem)
        note = (
            ", ".join(filter(None, ("at least", measured.note))) if self.at_least else measured.note
        )
        return VerificationCheck(
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

    def _holds(self, measured: Measurement) -> bool:
        allowed = self.tolerance * (abs(measured.reference) or 1.0)
        miss = measured.reference - measured.value
        return bool(miss <= allowed if self.at_least else abs(miss) <= allowed)
