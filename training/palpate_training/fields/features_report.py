"""Force and contact location on held-out trajectories, with the paper's network and metrics.

For every unit a network of its own, and one of all units tested on each, as in the paper's table.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX
from palpate_training import baselines
from palpate_training.evaluate import Result
from palpate_training.fields import rivals
from palpate_training.fields.evaluate import (
    ALL,
    MEAN,
    OWN,
    RIDGE,
    ZERO,
    OnNetwork,
    TaskReport,
    averaged,
    label_of,
    tick,
)
from palpate_training.fields.split import by_trajectory, of_units, unit_sets
from palpate_training.metrics import (
    cluster_bootstrap,
    force_errors,
    force_metrics,
    location_errors,
    location_metrics,
)
from palpate_training.models import Mlp, predict
from palpate_training.train import TrainConfig, train
from palpate_training.twin.content import ExperimentDataset

FloatArray = npt.NDArray[np.float32]
Floating = npt.NDArray[np.floating]

PAPER_CONFIG = TrainConfig(epochs=60, patience=20)
"""The paper's layers; epochs at most."""

Metrics = Callable[[Floating, Floating], dict[str, float]]
RowErrors = Callable[[Floating, Floating], dict[str, npt.NDArray[np.float64]]]
_QUANTITIES: dict[str, tuple[Metrics, RowErrors, tuple[str, ...]]] = {
    "force": (force_metrics, force_errors, ("magnitude_n", "angle_rad")),
    "location": (location_metrics, location_errors, ("distance_m",)),
}


def features_networks(data: ExperimentDataset, seeds: int) -> int:
    """How many networks ``evaluate_features`` trains."""
    return len(_QUANTITIES) * seeds * len(unit_sets(data))


def evaluate_features(
    data: ExperimentDataset,
    *,
    seeds: int = 3,
    split_seed: int = 0,
    config: TrainConfig = PAPER_CONFIG,
    draws: int = 2000,
    on_network: OnNetwork | None = None,
) -> list[TaskReport]:
    """Force and contact location, every unit and all units.

    Args:
        data: The purely experimental data set.
        seeds: Networks of each kind; they share the split.
        split_seed: Seed of the split.
        config: Settings of every training.
        draws: Draws of the bootstrap over trajectories.
        on_network: Called after each training.

    Returns:
        Task ``force`` and task ``location``.
    """
    split = by_trajectory(data, seed=split_seed)
    sets = unit_sets(data)
    x = np.asarray(data.tared * np.float32(COUNTS_MAX), np.float32)
    reports = []
    for quantity, (metrics_of, errors_of, headlines) in _QUANTITIES.items():
        y: FloatArray = getattr(data, quantity)
        results: list[Result] = []
        nets: dict[tuple[str, ...], list[Mlp]] = {}
        held = {units: of_units(data, split, units).split for units in sets}
        for units, fold in held.items():
            nets[units] = []
            for seed in range(seeds):
                sides = (x[fold.train], y[fold.train], x[fold.validation], y[fold.validation])
                nets[units].append(train(*sides, config=config, seed=seed).net)
                tick(on_network)
        for units, fold in held.items():
            seen, test = x[fold.train], x[fold.test]
            line = rivals.ridge(seen, y[fold.train], x[fold.validation], y[fold.validation])
            estimates: dict[str, list[Floating]] = {
                MEAN: [baselines.constant(seen, y[fold.train]).predict(test)],
                RIDGE: [line.predict(test)],
                OWN: [predict(net, test) for net in nets[units]],
            }
            if quantity == "force":  # a contact at the origin of the frame is nobody's guess
                estimates = {ZERO: [baselines.zero(seen).predict(test)], **estimates}
            if len(units) == 1 and len(sets) > 1:
                estimates[ALL] = [predict(net, test) for net in nets[sets[-1]]]
            truth, cluster = y[fold.test], data.row_trajectory[fold.test]
            for model, each in estimates.items():
                errors = [errors_of(one, truth) for one in each]
                stacked = {
                    name: np.stack([one[name] for one in errors], axis=1) for name in headlines
                }
                found = [metrics_of(one, truth) for one in each]
                ends = cluster_bootstrap(stacked, cluster, draws=draws)
                results.append(averaged(label_of(units), model, found, ends))
        facts: dict[str, object] = {
            "source": data.provenance.source,
            "rows": len(data),
            "trajectories": len(np.unique(data.row_trajectory)),
            "seeds": seeds,
        }
        reports.append(TaskReport(quantity, results, facts))
    return reports
