"""A few trials of a data set, as a data set: a sample small enough to ship."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import overload

import numpy as np

from palpate.errors import DatasetError
from palpate_training.twin.basis import encode, fit_basis
from palpate_training.twin.content import ExperimentDataset, MixedDataset


@overload
def subset(data: ExperimentDataset, trials: Sequence[int]) -> ExperimentDataset: ...
@overload
def subset(
    data: MixedDataset, trials: Sequence[int], *, loss_mean_m: float | None = None
) -> MixedDataset: ...
def subset(
    data: ExperimentDataset | MixedDataset,
    trials: Sequence[int],
    *,
    loss_mean_m: float | None = None,
) -> ExperimentDataset | MixedDataset:
    """Keep some trials, and only the units and trajectories that they are of.

    Args:
        data: A data set.
        trials: Indices of the trials to keep; the order stays that of the data set.
        loss_mean_m: Of a mixed data set: find new modes for what is left, which loses that much
            more on average [m]; the basis then states the sum of both losses, an upper bound. None
            keeps the modes.

    Raises:
        DatasetError: A trial does not exist, or none is asked for.
    """
    if isinstance(data, ExperimentDataset):
        return _experiment(data, trials)
    rows = _rows(data.experiment, trials)
    kept = replace(
        data,
        experiment=_experiment(data.experiment, trials),
        simulated_force=data.simulated_force[rows],
        coefficients=data.coefficients[rows],
    )
    if loss_mean_m is None:
        return kept
    fields = [kept.displacement(kept.experiment.rows_of(i)) for i in range(kept.experiment.trials)]
    basis = fit_basis(lambda: fields, loss_mean_m=loss_mean_m)
    return replace(
        kept,
        coefficients=np.concatenate([encode(basis, field) for field in fields]),
        basis=replace(
            basis,
            loss_mean_m=basis.loss_mean_m + data.basis.loss_mean_m,
            loss_max_m=basis.loss_max_m + data.basis.loss_max_m,
        ),
    )


def _experiment(data: ExperimentDataset, trials: Sequence[int]) -> ExperimentDataset:
    rows = _rows(data, trials)
    chosen = np.unique(np.asarray(trials, np.int64))
    units, trial_unit = np.unique(data.trial_unit[chosen], return_inverse=True)
    trajectories, trial_trajectory = np.unique(data.trial_trajectory[chosen], return_inverse=True)
    return replace(
        data,
        unit_names=tuple(data.unit_names[i] for i in units),
        trajectories=tuple(data.trajectories[i] for i in trajectories),
        indenters=tuple(data.indenters[i] for i in trajectories),
        trial_unit=trial_unit.astype(np.int32),
        trial_trajectory=trial_trajectory.astype(np.int32),
        trial_rest=data.trial_rest[chosen],
        trial=np.searchsorted(chosen, data.trial[rows]).astype(np.int32),
        travel_m=data.travel_m[rows],
        tared=data.tared[rows],
        force=data.force[rows],
        location=data.location[rows],
    )


def _rows(
    data: ExperimentDataset, trials: Sequence[int]
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    outside = [trial for trial in trials if not 0 <= trial < data.trials]
    if outside or not len(trials):
        raise DatasetError(
            f"no trial {outside[0]}" if outside else "no trials were asked for",
            remedy=f"ask for some of 0..{data.trials - 1}",
        )
    return np.isin(data.trial, np.asarray(trials))
