"""A check of the verification: a measured number, its reference and the tolerance."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import Any

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
    measure: Callable[..., Measurement]
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


CASES: dict[str, list[VerificationCase]] = defaultdict(list)
"""Registered checks by the module of their function."""

Variants = Mapping[Any, object] | Iterable[object]
Registrar = Callable[[Callable[..., Any]], Callable[..., Any]]


def check(name: str, tolerance: float, unit: str = "", **options: Any) -> Registrar:
    """Register a function that returns one `Measurement`; see `checks`."""
    return checks((name, tolerance, unit), **options)


def checks(
    *rows: tuple[str, float, str], slow: bool = False, at_least: bool = False, **variants: Variants
) -> Registrar:
    """Register a function as one check for each of its measurements and each variant.

    Args:
        rows: Name, tolerance and unit of each measurement. If there are several, the function
            returns a tuple of them and runs only once.
        slow: See `VerificationCase`.
        at_least: See `VerificationCase`.
        variants: Values of the function's arguments, or these by their labels; every combination is
            a check, and ``{argument}`` in a name stands for the value or label.
    """
    labelled = [v if isinstance(v, Mapping) else {x: x for x in v} for v in variants.values()]

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        measure = function if len(rows) == 1 else cache(function)
        for labels in product(*labelled):
            given = {k: v[x] for k, v, x in zip(variants, labelled, labels, strict=True)}
            for part, (name, tolerance, unit) in enumerate(rows):
                CASES[function.__module__].append(
                    VerificationCase(
                        name.format(**dict(zip(variants, labels, strict=True))),
                        partial(_part, measure, part, **given),
                        tolerance,
                        unit,
                        slow=slow,
                        at_least=at_least,
                    )
                )
        return function

    return register


def _part(measure: Callable[..., Any], part: int, **given: Any) -> Measurement:
    found = measure(**given)
    return found if isinstance(found, Measurement) else found[part]
