"""Displacement field of the skin -> electrodes of one specimen: train, test, ship.

The bundle's contract takes a field and nothing else, and specimens differ, so there is one network
for each and none for all. The network sees the coefficients of the field's modes and the film under
the skin near each electrode, both linear in the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from palpate.messages import TrainingRange
from palpate_training.datasets.experiment import MixedDataset, content_sha256
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning import baselines
from palpate_training.learning.export import export_fields, refuse_existing
from palpate_training.learning.field_code import FieldCode, FilmPooling, fit_code, pooling
from palpate_training.learning.fit import OnEpoch
from palpate_training.learning.metrics import electrode_errors, electrode_summary, rms
from palpate_training.learning.networks import FilmNet, Mlp, SynthesisGraph, predict
from palpate_training.learning.ranges import ends_of, longest_of
from palpate_training.learning.splits import Rows, RowSplit, by_trajectory, of_units, unit_sets
from palpate_training.tasks.fields import (
    FieldFitConfig,
    fields_of,
    fit_on_norms,
    spread_rows,
    tared_counts,
    trained_on_line,
    truncation_metrics,
)
from palpate_training.tasks.results import (
    MEAN,
    OWN,
    RIDGE,
    ZERO,
    ModelResult,
    OnNetwork,
    ResultPicture,
    TaskReport,
    facts_of,
    name_of,
    result_of,
    tick,
    typical,
)

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class SynthesisModel:
    """Field -> electrodes.

    Attributes:
        net: Coefficients and pooled film (N, K + P) -> tared counts (N, 19).
        code: What they are coefficients of.
        pooling: How the film is pooled.
    """

    net: FilmNet
    code: FieldCode
    pooling: FilmPooling

    def counts(self, features: FloatArray) -> FloatArray:
        """Tared counts (N, 19) of features (N, K + P) from ``synthesis_features``."""
        return predict(self.net, features)


def synthesis_features(data: MixedDataset, code: FieldCode, film: FilmPooling) -> FloatArray:
    """What the shipped graph makes of every row's field [m], shape (N, K + P), without the field.

    Projection and pooling are linear in the field and the field is linear in the data set's
    coefficients, so two small matrices do.
    """
    modes, mean = data.basis.modes, data.basis.mean[None]
    lead = _features(np.concatenate([modes + mean, mean]), code, film)
    return np.asarray(data.coefficients @ (lead[:-1] - lead[-1]) + lead[-1], np.float32)


def _features(displacement: FloatArray, code: FieldCode, film: FilmPooling) -> FloatArray:
    flat = displacement.reshape(len(displacement), -1)
    return np.hstack([code.project(flat), film.pool(displacement)])


def fit_synthesis(
    data: MixedDataset,
    split: RowSplit,
    *,
    code: FieldCode | None = None,
    config: FieldFitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> SynthesisModel:
    """Train field -> electrodes; the arguments are those of ``fit_field``."""
    config = config or FieldFitConfig()
    code = code or fit_code(data, split.train, split.validation)
    film = pooling(data.mesh)
    x, y = synthesis_features(data, code, film), tared_counts(data)
    zero = _features(np.zeros((1, *data.mesh.nodes.shape), np.float32), code, film)

    torch.manual_seed(seed)
    width = code.size + 2 * len(film.rest_m)
    net = FilmNet(Mlp(config.widths, width, outputs=ELECTRODES), code.size, film.rest_m)
    net.normalise_from(x[split.train], y[split.train])
    rest = config.rest_rows(split.train)
    fit_on_norms(
        net,
        np.vstack([x[split.train], np.repeat(zero, rest, axis=0)]),
        np.vstack([y[split.train], np.zeros((rest, ELECTRODES), np.float32)]),
        (x[split.validation], y[split.validation]),
        scale=1.0 / math.sqrt(ELECTRODES),
        floor=1.0,
        config=config,
        on_epoch=on_epoch,
    )
    return SynthesisModel(net, code, film)


def evaluate_synthesis(
    data: MixedDataset,
    *,
    seeds: int = 3,
    split_seed: int = 0,
    config: FieldFitConfig | None = None,
    draws: int = 2000,
    on_network: OnNetwork | None = None,
) -> TaskReport:
    """Field -> electrodes, every unit; the arguments are those of ``evaluate_field``."""
    split = by_trajectory(data.experiment, seed=split_seed)
    counts = tared_counts(data)
    film = pooling(data.mesh)
    results: list[ModelResult] = []
    force_n, error = {}, {}
    picture = None
    for units in unit_sets(data.experiment):
        if len(units) > 1:
            continue
        fold = of_units(data.experiment, split, units)
        rows = fold.test
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
            model = fit_synthesis(data, fold, code=code, config=config, seed=seed)
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
        picture = ResultPicture(
            force_n,
            error,
            name_of(data, int(rows[at])),
            counts[rows[at]],
            np.asarray(estimates[OWN][0][at], np.float32),
        )
    return TaskReport(
        "synthesis", results, facts_of(data, seeds, config or FieldFitConfig()), picture
    )


def synthesis_bundle(
    data: MixedDataset,
    folder: Path,
    *,
    unit: str,
    name: str = "synthesis",
    version: int = 1,
    config: FieldFitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> dict[str, float]:
    """Field -> electrodes of one unit, as a bundle; the arguments are those of ``field_bundle``."""
    refuse_existing(folder)
    split = of_units(data.experiment, by_trajectory(data.experiment, seed=seed), [unit])
    model = fit_synthesis(data, split, config=config, seed=seed, on_epoch=on_epoch)
    counts = tared_counts(data)
    features = synthesis_features(data, model.code, model.pooling)
    test, validation = split.test, split.validation
    zero = electrode_errors(np.zeros_like(counts[test]), counts[test])
    metrics = electrode_summary(electrode_errors(model.counts(features[test]), counts[test]), zero)
    residual = model.counts(features[validation]) - counts[validation]
    sd = np.asarray(rms(residual), np.float32)
    graph = SynthesisGraph(model.net, model.code, model.pooling, sd)
    with torch.inference_mode():
        untouched = graph(torch.zeros(1, 3 * model.code.nodes))[0].numpy()
    metrics["untouched_max_counts"] = float(np.abs(untouched).max())
    metrics |= truncation_metrics(model.code)
    rows = spread_rows(test)
    export_fields(
        folder,
        graph,
        data.displacement(rows).reshape(len(rows), -1),
        data.mesh,
        name=name,
        version=version,
        training_data_sha256=content_sha256(data),
        trained_on=trained_on_line(data, [unit], split),
        metrics=metrics,
        normalisation={
            "displacement": f"projected on {model.code.size} modes and pooled near 23 electrodes,"
            " inside the graph",
            "tared_counts_sd": "constant per electrode: rms residual on validation rows",
        },
        training_range=synthesis_range(data, split.train),
    )
    return metrics


def synthesis_range(data: MixedDataset, rows: Rows) -> TrainingRange:
    """Range of a synthesis network that was trained on rows."""
    return TrainingRange(
        source=f"{len(rows)} training rows of {data.experiment.provenance.source}",
        data_sha256=content_sha256(data),
        rows=len(rows),
        inputs=(longest_of("displacement", "m", fields_of(data, rows)),),
        outputs=(ends_of("tared_counts", "tared counts", tared_counts(data)[rows]),),
    )
