"""Field from electrodes, and electrodes from the field, in every split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX
from palpate_training.datasets.experiment import MixedDataset
from palpate_training.evaluation.cells import Arrays, Cell, CellResult, Tested, grouped
from palpate_training.evaluation.features import Scores
from palpate_training.learning.metrics import (
    by_force,
    cluster_bootstrap,
    drawn_medians,
    interval,
    root_mean,
)
from palpate_training.learning.splits import Fold, RowSplit
from palpate_training.systems.fields import FIELD_SYSTEMS, FieldSystem
from palpate_training.systems.synthesis import SYNTHESIS_SYSTEMS, SynthesisSystem
from palpate_training.tasks.fields import tared_counts

Floats = npt.NDArray[np.float64]

BOOTSTRAP_DRAWS = 500
"""Of means, which are drawn one by one."""


@dataclass(frozen=True, slots=True)
class FieldTask:
    """Electrodes to field.

    Attributes:
        data_sha256: Content hash of the data set.
        data: The rows.
        name: As tables call it.
        systems: That can estimate it.
    """

    data_sha256: str
    data: MixedDataset
    name: str = "field"
    systems: tuple[FieldSystem, ...] = FIELD_SYSTEMS

    def fit_and_test(self, system: Tested, rows: RowSplit, seed: int) -> Arrays:
        """Train, and give the errors of the test rows by name [m], each of shape (N,)."""
        errors = system.fit(self.data, rows, seed).errors(rows.test)
        return {name: values.astype(np.float32) for name, values in errors.items()}


@dataclass(frozen=True, slots=True)
class SynthesisTask:
    """Field to electrodes; the attributes are those of ``FieldTask``."""

    data_sha256: str
    data: MixedDataset
    name: str = "synthesis"
    systems: tuple[SynthesisSystem, ...] = SYNTHESIS_SYSTEMS

    def fit_and_test(self, system: Tested, rows: RowSplit, seed: int) -> Arrays:
        """Train, and estimate the tared counts of the test rows: ``estimate``, shape (N, 19)."""
        return {"estimate": system.fit(self.data, rows, seed)(rows.test)}


def of_one_unit(folds: Sequence[Fold], data: MixedDataset) -> list[Fold]:
    """Folds that train and test on one unit: electrodes differ from unit to unit."""
    return [fold for fold in folds if fold.test in data.experiment.unit_names]


def score_fields(task: FieldTask, results: Mapping[Cell, CellResult]) -> list[Scores]:
    """The table of fields: mean over rows of each error [m], also of hard and light presses."""
    experiment = task.data.experiment
    found = []
    for key, by_seed in grouped(results):
        rows = np.concatenate([cell.fold.rows.test for cell in by_seed[0]])
        force_n = np.linalg.norm(experiment.force[rows].astype(np.float64), axis=1)
        errors = [
            {
                name: np.concatenate([results[cell].arrays[name] for cell in cells])
                for name in results[cells[0]].arrays
            }
            for cells in by_seed
        ]
        metrics: dict[str, float] = {}
        for name in errors[0]:
            stacked = np.stack([one[name] for one in errors]).astype(np.float64)
            metrics[f"{name}_mean"] = float(np.nanmean(stacked))
            metrics |= by_force(
                f"{name}_mean", stacked.T, force_n, lambda some: float(np.nanmean(some))
            )
        ends = cluster_bootstrap(
            {
                f"{name}_mean": np.stack([one[name] for one in errors], axis=1).astype(np.float64)
                for name in ("subset_m", "all_m")
                if name in errors[0]
            },
            experiment.row_trajectory[rows],
            statistic=lambda values: float(np.nanmean(values)),
            draws=BOOTSTRAP_DRAWS,
        )
        found.append(_scores(task.name, key, metrics, ends, results, by_seed))
    return found


def score_synthesis(task: SynthesisTask, results: Mapping[Cell, CellResult]) -> list[Scores]:
    """The table of synthesis: root mean square [counts], median norm, and of each electrode."""
    counts = tared_counts(task.data)
    force_n = np.linalg.norm(task.data.experiment.force.astype(np.float64), axis=1)
    found = []
    for key, by_seed in grouped(results):
        rows = np.concatenate([cell.fold.rows.test for cell in by_seed[0]])
        cluster = task.data.experiment.row_trajectory[rows]
        left = [
            np.concatenate([results[cell].arrays["estimate"] for cell in cells]) - counts[rows]
            for cells in by_seed
        ]
        squares = [np.square(one.astype(np.float64)) for one in left]
        lengths = [np.sqrt(one.sum(axis=1)) for one in squares]
        rmse = float(np.mean([root_mean(one) for one in squares]))
        metrics = {
            "rmse_counts": rmse,
            "rmse": rmse / COUNTS_MAX,
            "l2_counts_median": float(np.mean([np.median(one) for one in lengths])),
        }
        for electrode in range(counts.shape[1]):
            each = [root_mean(one[:, electrode]) for one in squares]
            metrics[f"rmse_e{electrode + 1:02d}_counts"] = float(np.mean(each))
        mean_squares = np.stack([one.mean(axis=1) for one in squares], axis=1)
        metrics |= by_force(
            "rmse_counts",
            mean_squares,
            force_n[rows],
            lambda some: float(np.mean([root_mean(one) for one in some.T])),
        )
        ends = cluster_bootstrap(
            {"rmse_counts": mean_squares}, cluster, statistic=root_mean, draws=BOOTSTRAP_DRAWS
        )
        ends["l2_counts_median"] = interval(drawn_medians(lengths, cluster))
        found.append(_scores(task.name, key, metrics, ends, results, by_seed))
    return found


def _scores(
    task: str,
    key: tuple[str, str, str],
    metrics: dict[str, float],
    intervals: dict[str, tuple[float, float]],
    results: Mapping[Cell, CellResult],
    by_seed: list[list[Cell]],
) -> Scores:
    seconds = float(np.mean([results[cell].seconds for cells in by_seed for cell in cells]))
    return Scores(task, *key, metrics, intervals, seconds, len(by_seed))
