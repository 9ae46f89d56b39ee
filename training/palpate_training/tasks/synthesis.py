"""Field -> electrodes on the held-out trajectories of each unit, one network for each.

The bundle's contract takes a field and nothing else, and units differ, so there is no network of
all units.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from palpate_training.datasets.experiment import MixedDataset
from palpate_training.learning import baselines
from palpate_training.learning.field_code import fit_code, pooling
from palpate_training.learning.metrics import electrode_errors, electrode_summary
from palpate_training.learning.splits import by_trajectory, of_units, unit_sets
from palpate_training.tasks.field_fit import (
    FitConfig,
    fit_synthesis,
    synthesis_features,
    tared_counts,
)
from palpate_training.tasks.results import (
    MEAN,
    OWN,
    RIDGE,
    ZERO,
    OnNetwork,
    Picture,
    Result,
    TaskReport,
    facts_of,
    name_of,
    result_of,
    tick,
    typical,
)


def evaluate_synthesis(
    data: MixedDataset,
    *,
    seeds: int = 3,
    split_seed: int = 0,
    config: FitConfig | None = None,
    draws: int = 2000,
    on_network: OnNetwork | None = None,
) -> TaskReport:
    """Field -> electrodes, every unit; the arguments are those of ``evaluate_field``."""
    split = by_trajectory(data.experiment, seed=split_seed)
    counts = tared_counts(data)
    film = pooling(data.mesh)
    results: list[Result] = []
    force_n, error = {}, {}
    picture = None
    for units in unit_sets(data.experiment):
        if len(units) > 1:
            continue
        held = of_units(data.experiment, split, units)
        fold, rows = held.split, held.split.test
        code = fit_code(data, fold.train, fold.validation)
        x = synthesis_features(data, code, film)
        sides = (x[fold.train], counts[fold.train], x[fold.validation], counts[fold.validation])
        estimates: dict[str, list[npt.NDArray[np.floating]]] = {
            ZERO: [baselines.zero(*sides[:2]).predict(x[rows])],
            MEAN: [baselines.constant(*sides[:2]).predict(x[rows])],
            RIDGE: [baselines.ridge(*sides).predict(x[rows])],
            OWN: [],
        }
        for seed in range(seeds):
            model = fit_synthesis(data, held, code=code, config=config, seed=seed)
            estimates[OWN].append(model.counts(x[rows]))
            tick(on_network)
        errors = {
            name: [electrode_errors(one, counts[rows]) for one in each]
            for name, each in estimates.items()
        }
        made = [
            result_of(units[0], model, each, errors[ZERO][0], data, rows, draws, electrode_summary)
            for model, each in errors.items()
        ]
        per_electrode = np.sqrt(np.mean(np.square(estimates[OWN][0] - counts[rows]), axis=0))
        for i, value in enumerate(per_electrode):
            made[-1].metrics[f"rmse_e{i + 1:02d}_counts"] = float(value)
        results += made
        force_n[units[0]] = np.linalg.norm(data.experiment.force[rows], axis=1)
        error[units[0]] = errors[OWN][0]["l2_counts"]
        at = typical(error[units[0]], data.experiment.force[rows])
        picture = Picture(
            force_n,
            error,
            name_of(data, int(rows[at])),
            counts[rows[at]],
            np.asarray(estimates[OWN][0][at], np.float32),
        )
    return TaskReport("synthesis", results, facts_of(data, seeds, config), picture)
