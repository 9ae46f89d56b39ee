"""Experiment and simulation at the same displacements.

Paper, section "Experimental and simulation data processing".
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.twin.processing import DroppedTrial, trial_name
from palpate_training.twin.threshold import THRESHOLD_N, Floats, Values, from_threshold
from palpate_training.twin.trials import MixedRows, SimulatedTrial, TrialRows

INCREMENTS = 20
"""Evenly spaced displacements of a mixed trial (paper, step 5)."""


def common_trajectories(
    trials: Iterable[TrialRows], simulated: Collection[str]
) -> tuple[list[TrialRows], list[DroppedTrial]]:
    """Trials whose trajectory was simulated, and the others with the reason (paper, step 1).

    Args:
        trials: Processed trials.
        simulated: Ids of the trajectories that were simulated.
    """
    both, dropped = [], []
    for rows in trials:
        if rows.header.trajectory in simulated:
            both.append(rows)
        else:
            dropped.append(DroppedTrial(rows.header, "its trajectory was not simulated"))
    return both, dropped


def mix(rows: TrialRows, simulated: SimulatedTrial, count: int = INCREMENTS) -> MixedRows:
    """Bring a trial and its simulation to the same displacements (paper, steps 2 to 5).

    The simulation is cut where it diverged, begins at exactly 0.5 N like the experiment, and both
    end at the smaller of their final displacements, counted from 0.5 N.

    Args:
        rows: Processed trial; begins at exactly 0.5 N.
        simulated: Its trajectory in finite elements; its first step is below 0.5 N.
        count: Rows of the result, from 0.5 N to the common final displacement.

    Raises:
        DatasetError: They are of different trajectories, the simulation begins above 0.5 N or never
            reaches it before it diverges, or nothing but one row is common.
    """
    name = trial_name(rows.header)
    if rows.header.trajectory != simulated.trajectory:
        raise DatasetError(
            f"{name}: the simulation is of {simulated.trajectory}",
            remedy="mix a trial with the simulation of its own trajectory",
        )
    travel_m, force, displacement = _aligned(name, simulated)
    final_m = min(float(rows.travel_m[-1]), float(travel_m[-1]))
    if final_m <= 0.0:
        short = "experiment" if len(rows.travel_m) < 2 else "simulation"
        raise DatasetError(
            f"{name}: the {short} has one row at {THRESHOLD_N} N and none beyond",
            remedy="press deeper, or drop the trial",
        )
    at_m = np.linspace(0.0, final_m, count)
    measured = replace(
        rows,
        travel_m=at_m,
        tared=interpolate(at_m, rows.travel_m, rows.tared),
        force=interpolate(at_m, rows.travel_m, rows.force),
        location=interpolate(at_m, rows.travel_m, rows.location),
    )
    return MixedRows(
        rows=measured,
        simulated_force=interpolate(at_m, travel_m, force),
        displacement=interpolate(at_m, travel_m, displacement),
    )


def interpolate(at: Floats, where: Floats, values: Values) -> Values:
    """Linear interpolation along the first axis, in the type of ``values``.

    Args:
        at: Where to, within ``where``, shape (Q,).
        where: Increasing, shape (R,), two or more.
        values: Shape (R, ...).

    Returns:
        Shape (Q, ...).
    """
    after = np.clip(np.searchsorted(where, at), 1, len(where) - 1)
    low, high = where[after - 1], where[after]
    share = ((at - low) / (high - low)).reshape(-1, *[1] * (values.ndim - 1))
    first, second = values[after - 1], values[after]
    return np.asarray(first + share * (second - first), values.dtype)


def _aligned(
    name: str, simulated: SimulatedTrial
) -> tuple[Floats, Floats, npt.NDArray[np.float32]]:
    """Travel since 0.5 N, force and displacement of the steps to be believed."""
    believed = slice(0, simulated.converged)
    force = simulated.force[believed]
    if not (np.isfinite(force).all() and np.isfinite(simulated.displacement[believed]).all()):
        raise DatasetError(
            f"{name}: a step counted as converged is not finite",
            remedy="let converged count the steps before the divergence",
        )
    start = from_threshold(force)
    if start is None:
        largest = float(np.linalg.norm(force, axis=1).max(initial=0.0))
        first = float(np.linalg.norm(force[0])) if len(force) else 0.0
        if first >= THRESHOLD_N:
            raise DatasetError(
                f"{name}: the simulation begins at {first:.3g} N, above {THRESHOLD_N} N",
                remedy="give the step at first touch too, where the force is zero",
            )
        raise DatasetError(
            f"{name}: the simulation reaches {largest:.3g} N in its {len(force)} converged steps",
            remedy="smaller steps may converge further; else drop the trial",
        )
    travel_m = start.rows(simulated.travel_m[believed])
    if (np.diff(travel_m) <= 0).any():
        raise DatasetError(
            f"{name}: travel of the simulation does not increase",
            remedy="give its steps in order of travel",
        )
    displacement = start.rows(simulated.displacement[believed])
    return travel_m - travel_m[0], start.rows(force), displacement
