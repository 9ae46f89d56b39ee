"""Where a press begins: 0.5 N, in the experiment and in the simulation alike.

Paper, sections "Experimental data processing" (step 3) and "Experimental and simulation data
processing" (step 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

THRESHOLD_N = 0.5
"""Below this the paper's force/torque sensor shows noise."""

STAY_ROWS = 3
"""Rows that a crossing must hold to be the contact and not noise: 0.3 mm of travel."""

_SAME = 1e-9
"""Rounding: of a force at the threshold [N], of a row at the crossing as a share of a segment."""

Floats = npt.NDArray[np.float64]
Values = npt.NDArray[Any]
Rows = npt.NDArray[np.int64]


def onset(force: Floats, *, threshold_n: float = THRESHOLD_N, stay: int = STAY_ROWS) -> int | None:
    """First row of the contact: the first crossing that stays.

    A crossing stays if its row and the next ``stay - 1`` rows, as far as the trial has them, are
    all at or above the threshold. So a single noisy row in free motion is no contact, while a dip
    late in a press does not move its beginning.

    Args:
        force: [N], shape (R, 3).
        threshold_n: [N].
        stay: Rows it must stay.

    Returns:
        Its index, or None where the force never stays above.
    """
    above = np.linalg.norm(force, axis=1) >= threshold_n
    for row in np.flatnonzero(above):
        if above[row : row + stay].all():
            return int(row)
    return None


def crossing(before: Floats, after: Floats, *, threshold_n: float = THRESHOLD_N) -> float:
    """Where on the segment between two forces the magnitude is exactly the threshold.

    The magnitude of an interpolated vector is not the interpolated magnitude: where the direction
    turns, it is smaller. So |a + s (b - a)|^2 = threshold^2 is solved for s.

    Args:
        before: Force [N] of magnitude below the threshold, shape (3,).
        after: Force [N] of magnitude at or above it, shape (3,).
        threshold_n: [N].

    Returns:
        Share s of the way from ``before`` to ``after``, in [0, 1].
    """
    step = after - before
    a, b = float(step @ step), float(before @ step)
    c = float(before @ before) - threshold_n**2
    if np.linalg.norm(before) > threshold_n + _SAME or np.linalg.norm(after) < threshold_n - _SAME:
        raise ValueError("the segment does not cross the threshold upwards")
    root = math.sqrt(max(b * b - a * c, 0.0))
    # Of the two forms of the positive root the one without a difference of like numbers.
    share = -c / (b + root) if b > 0 else (root - b) / a
    return min(max(share, 0.0), 1.0)


@dataclass(frozen=True, slots=True)
class Onset:
    """Where a press reaches 0.5 N, and its rows from there on.

    Attributes:
        before: Last row before the contact.
        share: Share of the way to the next row where the force is exactly 0.5 N.
        kept: Rows at or above 0.5 N after ``before``.
    """

    before: int
    share: float
    kept: Rows

    @property
    def exact(self) -> bool:
        """Whether the first kept row is at exactly 0.5 N by itself, so that none is prepended."""
        return self.share > 1.0 - _SAME

    def row(self, values: Values) -> Values:
        """Value of a quantity (R, ...) at exactly 0.5 N, shape (1, ...)."""
        first, second = values[self.before], values[self.before + 1]
        return np.asarray(first + self.share * (second - first), values.dtype)[None]

    def rows(self, values: Values) -> Values:
        """The row at exactly 0.5 N and those after it, of a quantity (R, ...)."""
        return np.concatenate([self.row(values), values[self.kept[int(self.exact) :]]])


def from_threshold(force: Floats, *, threshold_n: float = THRESHOLD_N) -> Onset | None:
    """Which rows to keep and which to prepend, of forces in order of travel.

    Rows below the threshold are left out wherever they are, as the paper says, a late dip included.

    Args:
        force: [N], shape (R, 3).
        threshold_n: [N].

    Returns:
        The rows, or None where the force never stays above, or where the first row is above already
        and there is nothing to interpolate from.
    """
    first = onset(force, threshold_n=threshold_n)
    if first is None or first == 0:
        return None
    kept = first + np.flatnonzero(np.linalg.norm(force[first:], axis=1) >= threshold_n)
    share = crossing(force[first - 1], force[first], threshold_n=threshold_n)
    return Onset(first - 1, share, kept)
