"""How far estimates of a bundle may be off, as the bundle keeps it (docs/adr/0031-intervals.md).

Each bound follows from five numbers that a frame and its estimate give, by a formula whose weights
stand in the manifest: ``bound = exp(weights . bound_terms(...))``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import exp, log1p
from typing import Any

from palpate.messages import ErrorBounds

BOUND_UNITS: Mapping[str, str] = {
    "force_magnitude": "N",
    "force": "N",
    "contact_location": "m",
    "displacement": "m",
}
"""Errors that may have a bound, and the unit of each; as in ``ErrorBounds``."""

BOUNDS_OF_TASK: Mapping[str, tuple[str, ...]] = {
    "features": ("force_magnitude", "force", "contact_location"),
    "field": ("displacement",),
    "synthesis": (),
}
"""Errors that estimates of a task may have bounds of."""

TERMS = ("one", "size", "large size", "common mode", "distance")
"""What ``bound_terms`` gives, in this order."""

LARGE = 3.0
"""From this size on a bound may grow otherwise with it [N, or mm]."""

DISTANCE_MOST = 4.0
"""Farther than so many limits from all training rows is as bad as this far: nothing is known there,
and an exponential would promise more than it knows."""

EXPONENT_MOST = 20.0
"""A bound is at most e to this [unit of the error]: finite in any case."""

_WEIGHT_MAX = 1e6
_TEXT_MAX = 20_000


@dataclass(frozen=True, slots=True)
class BoundFormula:
    """Formula of one bound.

    Attributes:
        name: A key of ``BOUND_UNITS``.
        unit: Of the bound.
        weights: One for each of ``TERMS``.
    """

    name: str
    unit: str
    weights: tuple[float, ...]

    def bound(self, terms: tuple[float, ...]) -> float:
        """The bound where these are the terms, in ``unit``."""
        one, size, large, common, distance = self.weights
        a, b, c, d, e = terms
        exponent = one * a + size * b + large * c + common * d + distance * e
        return exp(min(exponent, EXPONENT_MOST))


@dataclass(frozen=True, slots=True)
class Intervals:
    """Bounds of the errors of a bundle's estimates.

    Attributes:
        level: Share of the errors on held-out presses that a bound holds.
        source: What it was calibrated on, for people.
        data_sha256: Digest of that data set, hex.
        presses: Presses in it that no training saw, each counted once; one that several specimens
            executed counts once, too.
        formulas: One for each error that has a bound.
        others: Formulas for sensors that the bundle was not made for; empty = nothing is known. The
            larger of these and its own is what counts.
        others_source: What those come from, for people.
    """

    level: float
    source: str
    data_sha256: str
    presses: int
    formulas: tuple[BoundFormula, ...]
    others: tuple[BoundFormula, ...] = ()
    others_source: str = ""


def bound_terms(size: float, common: float, distance: float) -> tuple[float, ...]:
    """The terms of one estimate, in the order of ``TERMS``.

    Args:
        size: Of the estimate: length of the force [N], or of a field's coefficients [mm].
        common: Common mode: mean of the electrodes, compressed as in ``KnownInputs``.
        distance: From the nearest training row, over the limit from which an input is flagged.
    """
    grown = log1p(size)
    return 1.0, grown, max(0.0, grown - _LARGE), common, min(distance, DISTANCE_MOST)


_LARGE = log1p(LARGE)


def parse_intervals(values: object, task: object) -> Intervals:
    """The key ``intervals`` of a manifest.

    Raises:
        ValueError: It is not one, or has bounds that the task's estimates have not; says why.
    """
    known = {one.name for one in fields(Intervals)}
    if not isinstance(values, dict) or set(values) != known:
        raise ValueError(f"intervals are no object with the keys {', '.join(sorted(known))}")
    level, presses = values["level"], values["presses"]
    if not isinstance(level, float) or not 0.0 < level < 1.0:
        raise ValueError(f"intervals: level is {level!r}, not between 0 and 1")
    if isinstance(presses, bool) or not isinstance(presses, int) or not 0 < presses < 1 << 53:
        raise ValueError(f"intervals: presses is {presses!r}, not a positive whole number")
    for key in ("source", "data_sha256", "others_source"):
        if not isinstance(values[key], str) or len(values[key]) > _TEXT_MAX:
            raise ValueError(f"intervals: {key} is no text")
    allowed = BOUNDS_OF_TASK.get(str(task), ())
    return Intervals(
        level,
        values["source"],
        values["data_sha256"],
        presses,
        _formulas(values["formulas"], allowed),
        _formulas(values["others"], allowed),
        values["others_source"],
    )


def _formulas(values: Any, allowed: tuple[str, ...]) -> tuple[BoundFormula, ...]:
    if not isinstance(values, list) or len(values) > len(BOUND_UNITS):
        raise ValueError(f"intervals: the formulas are no list of at most {len(BOUND_UNITS)}")
    found = tuple(_formula(item, allowed) for item in values)
    if len({one.name for one in found}) != len(found):
        raise ValueError("intervals: an error has two formulas")
    return found


def _formula(item: Any, allowed: tuple[str, ...]) -> BoundFormula:
    if not isinstance(item, dict) or set(item) != {"name", "unit", "weights"}:
        raise ValueError(f"intervals: {str(item)[:80]!r} is no formula")
    name, unit, weights = item["name"], item["unit"], item["weights"]
    if name not in allowed or unit != BOUND_UNITS[name]:
        raise ValueError(f"intervals: {str(name)[:64]!r} [{str(unit)[:16]}] has no bound here")
    good = isinstance(weights, list) and len(weights) == len(TERMS)
    if not good or not all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _WEIGHT_MAX
        for value in weights
    ):
        raise ValueError(f"intervals: weights of {name} are not {len(TERMS)} finite numbers")
    return BoundFormula(name, unit, tuple(map(float, weights)))


def bounds_of(
    intervals: Intervals, terms: tuple[float, ...], *, others: bool, contact: bool = True
) -> ErrorBounds | None:
    """Bounds of one estimate; None where the bundle has none for it.

    For a sensor that it was not made for they are never closer than for one that it was made for.

    Args:
        intervals: Of the bundle.
        terms: Of the estimate.
        others: The sensor is none that the bundle was made for.
        contact: Whether the estimate has a contact location.
    """
    formulas = intervals.others if others else intervals.formulas
    if not formulas:
        return None
    found = {
        one.name: one.bound(terms) for one in formulas if contact or one.name != "contact_location"
    }
    if others:
        for own in intervals.formulas:
            if own.name in found:
                found[own.name] = max(found[own.name], own.bound(terms))
    return ErrorBounds(intervals.level, **found, other_sensors=others)
