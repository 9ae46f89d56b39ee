"""Bounds of errors from presses that no training saw (docs/adr/0031-intervals.md).

How large an error is to be feared follows from the estimate and its input: a quantile regression of
the error's logarithm on a few terms. What is promised does not rest on it: the regression is made
on a part of the presses and measured on the others, and all bounds are widened by the factor that
holds the wanted share of *those*. Rows of a press are nearly copies, so each press counts as one,
and one more is counted that may be anything: the next one (hierarchical conformal prediction; Lee,
Barber & Willett, "Distribution-free inference with hierarchical data", 2023).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog
from scipy.sparse import csr_matrix, eye, hstack

from palpate.files.intervals import BOUND_UNITS, TERMS, BoundFormula, bound_terms

Floats = npt.NDArray[np.float64]
Labels = npt.NDArray[np.integer]

LEVEL = 0.9
"""Share of errors within a bound."""

FOLDS = 5
"""Presses are held out from the regression in so many parts."""

PENALTY = 0.3
"""Of the regression's weights, of terms with a spread of one, in presses: what a few presses say of
a slope is not believed."""

ERROR_LEAST = 1e-9
"""Smaller errors count as this large, so that they have a logarithm."""

SIZES = 6
"""Ranges of the size, evenly over its logarithm, that count the same in the regression: most rows
are light touches, and the bound of a hard press must not be what suits these."""

ROWS_OF_PRESS = 20
"""Rows of a press that the regression sees at most; neighbours say the same."""

ROWS_LEAST = 3
"""Of each press; fewer than these, from its first to its last, were its ends alone."""

ROWS_MOST = 12_000
"""Rows that it sees in all: its time grows faster than they do."""

GOLDEN_RATIO = (np.sqrt(5.0) - 1.0) / 2.0

EVERY_TERM = (True,) * len(TERMS)


def terms_of(size: Floats, common: Floats, distance: Floats) -> Floats:
    """``bound_terms`` of every row, shape ``(N, len(TERMS))``."""
    rows = zip(size.tolist(), common.tolist(), distance.tolist(), strict=True)
    return np.array([bound_terms(*row) for row in rows]).reshape(-1, len(TERMS))


def press_quantile(scores: Floats, press: Labels, level: float) -> float:
    """What a row of one more press stays below with at least this probability.

    Each press counts the same, however many rows it has, and the next one counts as larger than
    all. Of so few presses that nothing could be promised it is the largest score.
    """
    _, number, rows = np.unique(press, return_inverse=True, return_counts=True)
    order = np.argsort(scores, kind="stable")
    weight = np.cumsum(1.0 / rows[number[order]]) / (len(rows) + 1)
    at = min(int(np.searchsorted(weight, level - 1e-12)), len(scores) - 1)
    return float(scores[order[at]])


def covered(errors: Floats, bounds: Floats, press: Labels) -> float:
    """Share of errors within their bounds, each press counted the same."""
    _, number, rows = np.unique(press, return_inverse=True, return_counts=True)
    inside = np.bincount(number, errors <= bounds) / rows
    return float(inside.mean())


def staggered(presses: Sequence[Labels], count: int) -> Labels:
    """At most ``count`` rows of many presses, dealt evenly, each from another part of its press.

    Args:
        presses: The rows of each press, in order of time; may be more than ``count``.
        count: Rows in all.
    """
    press = (np.arange(count) * len(presses) // count).tolist()
    # Multiples of the golden ratio fall evenly into an interval, however many are taken, and any
    # few in a row lie far apart.
    part = np.arange(count) * GOLDEN_RATIO % 1.0
    dealt = [presses[k][int(at * len(presses[k]))] for k, at in zip(press, part, strict=True)]
    return np.unique(dealt)


def fit_formula(
    name: str,
    errors: Floats,
    terms: Floats,
    press: Labels,
    *,
    level: float = LEVEL,
    use: Sequence[bool] = EVERY_TERM,
) -> BoundFormula:
    """The formula of one bound.

    Args:
        name: A key of ``BOUND_UNITS``.
        errors: Of rows that no training saw, shape ``(N,)``, in the unit of that error.
        terms: As ``terms_of`` gives them.
        press: Press of every row, shape ``(N,)``.
        level: Share of the errors of the next press that shall lie within.
        use: Terms that may have a weight.
    """
    logarithm = np.log(np.maximum(errors, ERROR_LEAST))
    left = logarithm.copy()
    for out in _folds(press):
        if not out.all():
            weights = _regression(terms[~out], logarithm[~out], press[~out], level, use)
            left[out] -= terms[out] @ weights
        else:  # a single press: nothing but a constant can be learned
            use = (True, *(False,) * (len(TERMS) - 1))
    weights = _regression(terms, logarithm, press, level, use)
    if len(np.unique(press)) == 1:
        left -= terms @ weights
    weights[0] += press_quantile(left, press, level)
    return BoundFormula(name, BOUND_UNITS[name], tuple(float(f"{w:.6g}") for w in weights))


def widened(
    formula: BoundFormula,
    name: str,
    errors: Floats,
    terms: Floats,
    press: Labels,
    *,
    level: float = LEVEL,
) -> BoundFormula:
    """A bound that follows a frame as another one does, by as much wider or closer as these errors.

    Args:
        formula: Of other presses, of the same kind of estimate.
        name: A key of ``BOUND_UNITS``.
        errors: Of rows that no training saw, shape ``(N,)``, in the unit of that error.
        terms: As ``terms_of`` gives them.
        press: Press of every row, shape ``(N,)``.
        level: Share of the errors of the next press that shall lie within.
    """
    weights = np.array(formula.weights)
    left = np.log(np.maximum(errors, ERROR_LEAST)) - terms @ weights
    weights[0] += press_quantile(left, press, level)
    return BoundFormula(name, BOUND_UNITS[name], tuple(float(f"{w:.6g}") for w in weights))


def bounds(formula: BoundFormula, terms: Floats) -> Floats:
    """The bound of every row, shape ``(N,)``."""
    return np.array([formula.bound(tuple(row)) for row in terms.tolist()])


def fit_formulas(
    errors: Mapping[str, Floats],
    terms: Floats,
    press: Labels,
    *,
    level: float = LEVEL,
    use: Sequence[bool] = EVERY_TERM,
) -> tuple[BoundFormula, ...]:
    """``fit_formula`` of every error; rows where it is NaN do not count."""
    found = []
    for name, values in errors.items():
        known = ~np.isnan(values)
        if known.any():
            part = fit_formula(
                name, values[known], terms[known], press[known], level=level, use=use
            )
            found.append(part)
    return tuple(found)


def _folds(press: Labels) -> Iterator[npt.NDArray[np.bool_]]:
    """Rows of each part of the presses, drawn at random, the same each time."""
    names = np.random.default_rng(0).permutation(np.unique(press))
    for part in np.array_split(names, min(FOLDS, len(names))):
        yield np.isin(press, part)


def _regression(
    terms: Floats, values: Floats, press: Labels, level: float, use: Sequence[bool]
) -> Floats:
    """Weights of the terms by which ``level`` of the values lie below, by quantile regression.

    A linear programme: what lies above a plane counts ``level``, what lies below the rest, each
    press and each range of sizes the same; the weights' size counts, too, but for that of the
    constant.
    """
    kept = _thinned(press)
    terms, values, press = terms[kept], values[kept], press[kept]
    columns = [k for k in range(1, len(TERMS)) if use[k] and terms[:, k].std() > 0.0]
    spread = terms[:, columns].std(axis=0)
    middle = terms[:, columns].mean(axis=0)
    inputs = np.column_stack([np.ones(len(terms)), (terms[:, columns] - middle) / spread])
    _, number, rows = np.unique(press, return_inverse=True, return_counts=True)
    weight = _balanced(1.0 / rows[number], terms[:, 1])
    # Unknowns: the weights as differences of two that are not negative, then above, then below.
    many, width = inputs.shape
    penalty = np.r_[0.0, np.full(width - 1, PENALTY)]
    cost = np.concatenate([penalty, penalty, level * weight, (1.0 - level) * weight])
    plane = csr_matrix(inputs)
    unit = eye(many, format="csr")
    found = linprog(cost, A_eq=hstack([plane, -plane, unit, -unit]), b_eq=values, method="highs")
    scaled = found.x[:width] - found.x[width : 2 * width]
    weights = np.zeros(len(TERMS))
    weights[columns] = scaled[1:] / spread
    weights[0] = scaled[0] - middle @ weights[columns]
    return weights


def _balanced(weight: Floats, size: Floats) -> Floats:
    """Weights of rows, of the same sum, by which each of ``SIZES`` ranges counts the same."""
    edges = np.linspace(size.min(), size.max(), SIZES + 1)[1:-1]
    number = np.searchsorted(edges, size, side="right")
    total = np.bincount(number, weight, SIZES)
    balanced: Floats = weight * weight.sum() / (np.count_nonzero(total) * total[number])
    return balanced


def _thinned(press: Labels) -> Labels:
    """At most ``ROWS_OF_PRESS`` rows of each press, evenly, and fewer of many presses."""
    order = np.argsort(press, kind="stable")
    presses = np.split(order, np.flatnonzero(np.diff(press[order])) + 1)
    most = min(ROWS_OF_PRESS, ROWS_MOST // len(presses))
    if most < ROWS_LEAST:
        return staggered(presses, ROWS_MOST)
    parts = [
        rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)] for rows in presses
    ]
    return np.sort(np.concatenate(parts))
