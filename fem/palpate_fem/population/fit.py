"""Fit one unit: its range of tared values to that of a published sensor.

Published is little: the smallest and the largest tared value over a whole data set (paper,
"Experimental data processing"). Four parameters can bring them about: the conductivity and the
thickness of the film at the sides set where electrodes rest and how far they rise, the residual
film under pressure how far they fall. The priors of section 4.5 decide between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from palpate_fem.electrodes.circuit import FULL_SCALE
from palpate_fem.electrodes.gap import Gap
from palpate_fem.electrodes.sensor import Electrodes
from palpate_fem.electrodes.unit import LIMITS, LOG_SD, UnitParameters
from palpate_fem.population.answers import Extremes

Floats = NDArray[np.float64]

TOLERANCE = 0.004
"""Misfit of the range that weighs as much as a parameter one standard deviation off."""

SIDE_SD_M = 0.4e-3  # of the prior on side_closing_m: half its uniform range
FITTED = ("sigma_s_m", "squeeze_pa", "floor_m")  # by their logarithms; and side_closing_m itself
KEPT = 3
"""States that are kept for each electrode and end of the range while fitting."""


@dataclass(frozen=True, slots=True)
class FittedUnit:
    """A unit and what it was fitted to.

    Attributes:
        unit: Its parameters.
        found: Range that it has on all states.
        wanted: Smallest and largest tared value that it should have.
        rounds: How often the extreme states were picked anew.
    """

    unit: UnitParameters
    found: Extremes
    wanted: tuple[float, float]
    rounds: int


def fit_unit(
    sensor: Electrodes,
    states: Sequence[Gap],
    rest: Gap,
    wanted: tuple[float, float],
    *,
    rounds: int = 4,
) -> FittedUnit:
    """Fit a unit about where it is.

    Args:
        sensor: Electrodes with the unit to start from; its parameters are the priors' middle.
        states: Gaps of deep states of many trajectories.
        rest: Gap of the untouched finger.
        wanted: Smallest and largest tared value over full scale.
        rounds: How often the extreme states are picked anew, at most.

    Returns:
        The unit, with the range that it has on all the states given.
    """
    start = sensor.unit
    centre = np.array([*(np.log(getattr(start, key)) for key in FITTED), start.side_closing_m])
    spread = np.array([*(LOG_SD[key] for key in FITTED), SIDE_SD_M])
    low, high = _bounds(start)

    def unit_at(scaled: Floats) -> UnitParameters:
        at = np.clip(centre + scaled * spread, low, high)
        values = dict(zip(FITTED, np.exp(at[:-1]).tolist(), strict=True))
        return replace(start, **values, side_closing_m=float(at[-1]))

    scaled = np.zeros(len(centre))
    chosen: set[int] = set()
    done = 0
    while done < rounds:
        done += 1
        tared = _tared(sensor.with_unit(unit_at(scaled)), states, rest)
        picked = _extreme(tared)
        if picked <= chosen:
            break
        chosen |= picked
        some = [states[i] for i in sorted(chosen)]

        def misfit(scaled: Floats, some: list[Gap] = some) -> Floats:
            ends = Extremes.of(_tared(sensor.with_unit(unit_at(scaled)), some, rest))
            missed = np.array([ends.low - wanted[0], ends.high - wanted[1]]) / TOLERANCE
            return np.concatenate([missed, scaled])

        found = least_squares(misfit, scaled, diff_step=1e-2, x_scale=1.0, max_nfev=25)
        scaled = found.x
    unit = unit_at(scaled)
    return FittedUnit(unit, Extremes.of(_tared(sensor.with_unit(unit), states, rest)), wanted, done)


def _tared(sensor: Electrodes, states: Sequence[Gap], rest: Gap) -> Floats:
    """Tared values over full scale, shape (S, 19)."""
    untouched = sensor.of_gap(rest).counts
    counts = np.array([sensor.of_gap(gap).counts for gap in states])
    # What the converter can show: an ideal count may lie below its offset.
    return np.asarray((np.clip(counts, 0, FULL_SCALE) - untouched) / FULL_SCALE)


def _extreme(tared: Floats) -> set[int]:
    """States at which some electrode is lowest or highest."""
    order = np.argsort(tared, axis=0)
    return {int(i) for i in np.concatenate([order[:KEPT], order[-KEPT:]]).ravel()}


def _bounds(unit: UnitParameters) -> tuple[Floats, Floats]:
    ends = [np.log(LIMITS[key]) for key in FITTED] + [np.array(LIMITS["side_closing_m"])]
    low, high = np.array(ends).T
    high[FITTED.index("floor_m")] = np.log(unit.asperity_m)
    return low, high
