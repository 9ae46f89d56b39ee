"""Electrodes -> field on the held-out trajectories of each unit.

Every unit has a network of its own; where there are several, one more is trained on all of them and
tested on each, because electrode values differ from unit to unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from palpate_training.datasets.experiment import MixedDataset
from palpate_training.learning import baselines
from palpate_training.learning.field_code import FieldCode, fit_code
from palpate_training.learning.metrics import field_errors, field_summary, join
from palpate_training.learning.splits import Rows, by_trajectory, of_units, unit_sets
from palpate_training.tasks.field_fit import FitConfig, fit_field, tared_counts
from palpate_training.tasks.results import (
    ALL,
    MEAN,
    OWN,
    RIDGE,
    ZERO,
    Errors,
    OnNetwork,
    Picture,
    Result,
    TaskReport,
    facts_of,
    label_of,
    name_of,
    result_of,
    tick,
    typical,
)

FloatArray = npt.NDArray[np.float32]
Estimate = Callable[[Rows], FloatArray]

_CHUNK_ROWS = 256


def evaluate_field(
    data: MixedDataset,
    *,
    seeds: int = 3,
    split_seed: int = 0,
    config: FitConfig | None = None,
    draws: int = 2000,
    on_network: OnNetwork | None = None,
) -> TaskReport:
    """Electrodes -> field, every unit and all units.

    Args:
        data: The mixed data set.
        seeds: Networks of each kind; they share the split.
        split_seed: Seed of the split.
        config: Settings of every training.
        draws: Draws of the bootstrap over trajectories.
        on_network: Called after each training.
    """
    split = by_trajectory(data.experiment, seed=split_seed)
    counts = tared_counts(data)
    sets = unit_sets(data.experiment)
    held = {units: of_units(data.experiment, split, units) for units in sets}
    fitted: dict[tuple[str, ...], dict[str, list[Estimate]]] = {}
    modes: dict[str, object] = {}
    for units in sets:
        fold = held[units].split
        code = fit_code(data, fold.train, fold.validation)
        modes[label_of(units)] = {
            "modes": code.size,
            "truncation_m": {str(n): float(f"{v:.4g}") for n, v in code.truncation_m.items()},
        }
        y = code.encode(data.coefficients)
        sides = (counts[fold.train], y[fold.train], counts[fold.validation], y[fold.validation])
        line = baselines.ridge(*sides)
        still = baselines.constant(*sides[:2])
        nets = []
        for seed in range(seeds):
            nets.append(fit_field(data, held[units], code=code, config=config, seed=seed))
            tick(on_network)
        fitted[units] = {
            MEAN: [_estimate(still.predict, code, counts)],
            RIDGE: [_estimate(line.predict, code, counts)],
            OWN: [_estimate(model.coefficients, code, counts) for model in nets],
        }

    results: list[Result] = []
    force_n, error = {}, {}
    picture = None
    for units in sets:
        rows = held[units].split.test
        models = {ZERO: [_still(data)], **fitted[units]}
        if len(units) == 1 and len(sets) > 1:
            models[ALL] = fitted[sets[-1]][OWN]
        errors = field_row_errors(data, rows, models)
        results += [
            result_of(
                label_of(units), model, each, errors[ZERO][0], data, rows, draws, field_summary
            )
            for model, each in errors.items()
        ]
        if len(units) == 1:
            force_n[units[0]] = np.linalg.norm(data.experiment.force[rows], axis=1)
            error[units[0]] = errors[OWN][0]["all_m"]
        row = rows[typical(errors[OWN][0]["all_m"], data.experiment.force[rows])]
        truth = data.displacement(row[None])[0]
        picture = Picture(
            force_n, error, name_of(data, int(row)), truth, fitted[units][OWN][0](row[None])[0]
        )
    return TaskReport("field", results, {"modes": modes, **facts_of(data, seeds, config)}, picture)


def field_row_errors(
    data: MixedDataset, rows: Rows, models: Mapping[str, Sequence[Estimate]]
) -> dict[str, list[Errors]]:
    """Errors of every row for each model and each of its seeds; whole fields in small parts.

    Args:
        data: Rows with their true fields.
        rows: Which rows.
        models: Functions from rows to displacements [m], shape (R, V, 3).
    """
    parts: dict[str, list[list[Errors]]] = {
        name: [[] for _ in each] for name, each in models.items()
    }
    for start in range(0, len(rows), _CHUNK_ROWS):
        part = rows[start : start + _CHUNK_ROWS]
        truth = data.displacement(part)
        for name, each in models.items():
            for i, estimate in enumerate(each):
                parts[name][i].append(field_errors(estimate(part), truth, data.mesh.subset))
    return {name: [join(each) for each in found] for name, found in parts.items()}


def _estimate(
    coefficients: Callable[[FloatArray], npt.NDArray[np.floating]],
    code: FieldCode,
    counts: FloatArray,
) -> Estimate:
    return lambda rows: code.decode(coefficients(counts[rows]))


def _still(data: MixedDataset) -> Estimate:
    return lambda rows: np.zeros((len(rows), *data.mesh.nodes.shape), np.float32)
