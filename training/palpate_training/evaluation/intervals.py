"""Confidence intervals of medians and of their ratios, where only trajectories are independent.

Rows of a trajectory are nearly copies, so whole trajectories are drawn with replacement. A median
of such a draw is that of all rows with a weight for each trajectory: rows are sorted once, and all
draws are made at the same time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

DRAWS = 2000
_PART = 250


def drawn_medians(
    errors: Sequence[Floats], cluster: npt.NDArray[np.integer], *, draws: int = DRAWS, seed: int = 0
) -> Floats:
    """The median error in each draw of whole clusters, averaged over seeds, shape (draws,).

    The same clusters, draws and seed give the same draws, so those of two systems can be divided.

    Args:
        errors: Of every row, shape (N,), one for each seed of a system; rows that are NaN do not
            count.
        cluster: Trajectory of every row, shape (N,).
        draws: How many.
        seed: Of the draws.
    """
    names, number = np.unique(cluster, return_inverse=True)
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(len(names), np.full(len(names), 1.0 / len(names)), size=draws)
    total = np.zeros(draws)
    for values in errors:
        order = np.argsort(values, kind="stable")
        order = order[: np.count_nonzero(~np.isnan(values))]
        for start in range(0, draws, _PART):
            part = slice(start, start + _PART)
            weight = np.cumsum(counts[part][:, number[order]], axis=1)
            middle = (weight >= 0.5 * weight[:, -1:]).argmax(axis=1)
            total[part] += np.where(weight[:, -1] > 0, values[order][middle], np.nan)
    return total / len(errors)


def interval(drawn: Floats, level: float = 0.95) -> tuple[float, float]:
    """Ends of the interval that holds a share of the draws."""
    tail = 50.0 * (1.0 - level)
    low, high = np.nanpercentile(drawn, [tail, 100.0 - tail])
    return float(low), float(high)
