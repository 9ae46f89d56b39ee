"""Electrodes -> displacement field of the skin: train, test on held-out trajectories, ship.

Every specimen has a network of its own; where there are several, one more is trained on all of them
and tested on each, because electrode values differ from specimen to specimen. The network that
ships is by default the one for all, since the finger of a robot is none of the training specimens.
What is reported was measured with exactly the weights that are shipped.

Networks are trained on coefficients of modes, never on whole fields. Modes are orthonormal, so the
root mean square error over the nodes is the norm of the coefficients' error over the root of the
number of nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.messages import COUNTS_MAX, TrainingRange
from palpate_training.datasets.experiment import MixedDataset, content_sha256
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning import baselines
from palpate_training.learning.export import export_fields, refuse_existing
from palpate_training.learning.field_code import FieldCode, fit_code
from palpate_training.learning.fit import FitConfig, OnEpoch, fit
from palpate_training.learning.metrics import field_errors, field_summary, join
from palpate_training.learning.networks import FieldGraph, Mlp, predict
from palpate_training.learning.ranges import ends_of, known_inputs, longest_of
from palpate_training.learning.splits import Rows, RowSplit, by_trajectory, of_units, unit_sets
from palpate_training.tasks.results import (
    ALL,
    MEAN,
    OWN,
    RIDGE,
    ZERO,
    Errors,
    ModelResult,
    OnNetwork,
    ResultPicture,
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

PARITY_ROWS = 24
"""Held-out rows of the parity check, spread over the test trajectories."""

_CHUNK_ROWS = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldFitConfig(FitConfig):
    """Settings of a training of a field or synthesis network.

    Attributes:
        rest_share: Untouched rows added to the training rows, as a share of them. The data set
            starts at 0.5 N; without them an untouched finger would be an extrapolation.
        rest_noise_counts: Standard deviation of the electrodes of such a row [counts].
    """

    widths: Sequence[int] = (256, 256, 128)
    epochs: int = 150
    patience: int = 30
    rest_share: float = 0.05
    rest_noise_counts: float = 3.0

    def rest_rows(self, train: Rows) -> int:
        """How many untouched rows are added to some training rows."""
        return math.ceil(self.rest_share * len(train))

    def untouched_rows(self, train: Rows, seed: int) -> FloatArray:
        """Tared counts of untouched rows, shape (N, 19)."""
        shape = (self.rest_rows(train), ELECTRODES)
        noise = np.random.default_rng(seed).normal(0, self.rest_noise_counts, shape)
        return noise.astype(np.float32)


@dataclass(frozen=True, slots=True)
class FieldModel:
    """Electrodes -> field.

    Attributes:
        net: Tared counts (N, 19) -> coefficients (N, K) [m].
        code: What they are coefficients of.
    """

    net: Mlp
    code: FieldCode

    def coefficients(self, tared_counts: FloatArray) -> FloatArray:
        """Coefficients [m], shape (N, K), of tared counts (N, 19)."""
        return predict(self.net, tared_counts)


def tared_counts(data: MixedDataset) -> FloatArray:
    """Tared electrodes of all rows [counts], shape (N, 19)."""
    return np.asarray(data.experiment.tared * np.float32(COUNTS_MAX), np.float32)


def fit_field(
    data: MixedDataset,
    split: RowSplit,
    *,
    code: FieldCode | None = None,
    config: FieldFitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> FieldModel:
    """Train electrodes -> field on the training rows of a split; code None = modes of these rows.

    The seed decides weights, order of rows and noise of the untouched rows.
    """
    config = config or FieldFitConfig()
    code = code or fit_code(data, split.train, split.validation)
    x, y = tared_counts(data), code.encode(data.coefficients)
    zero = code.project(np.zeros((1, len(code.mean)), np.float32))

    torch.manual_seed(seed)
    net = Mlp(config.widths, ELECTRODES, outputs=code.size)
    net.normalise_from(x[split.train], y[split.train])
    untouched = config.untouched_rows(split.train, seed)
    fit_on_norms(
        net,
        np.vstack([x[split.train], untouched]),
        np.vstack([y[split.train], np.repeat(zero, len(untouched), axis=0)]),
        (x[split.validation], y[split.validation]),
        scale=1e3 / math.sqrt(code.nodes),
        floor=0.01,
        config=config,
        on_epoch=on_epoch,
    )
    return FieldModel(net, code)


def fit_on_norms(
    net: nn.Module,
    inputs: FloatArray,
    targets: FloatArray,
    validation: tuple[FloatArray, FloatArray],
    *,
    scale: float,
    floor: float,
    config: FieldFitConfig,
    on_epoch: OnEpoch | None,
) -> None:
    """Train in place on the norm of each row's error.

    The loss of a row is ``sqrt((scale |error|)^2 + floor^2)``: an L2 norm, smooth at zero. The
    validation rows are scored by the same loss.
    """
    device = torch.get_default_device()
    seen, truth = (torch.from_numpy(part).to(device) for part in validation)

    def loss_of(estimate: Tensor, wanted: Tensor) -> Tensor:
        squares = torch.sum(torch.square(scale * (estimate - wanted)), dim=1)
        return torch.sqrt(squares + floor**2).mean()

    def score_of(net: nn.Module) -> float:
        with torch.inference_mode():
            return float(loss_of(net(seen), truth))

    fit(
        net,
        inputs,
        targets,
        loss_of=loss_of,
        score_of=score_of,
        config=config,
        on_epoch=on_epoch,
    )


def evaluate_field(
    data: MixedDataset,
    *,
    seeds: int = 3,
    split_seed: int = 0,
    config: FieldFitConfig | None = None,
    draws: int = 2000,
    on_network: OnNetwork | None = None,
) -> TaskReport:
    """Electrodes -> field, every unit and all units."""
    split = by_trajectory(data.experiment, seed=split_seed)
    counts = tared_counts(data)
    sets = unit_sets(data.experiment)
    held = {units: of_units(data.experiment, split, units) for units in sets}
    fitted: dict[tuple[str, ...], dict[str, list[Estimate]]] = {}
    modes: dict[str, object] = {}
    for units in sets:
        fold = held[units]
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
            nets.append(fit_field(data, fold, code=code, config=config, seed=seed))
            tick(on_network)
        fitted[units] = {
            MEAN: [_estimate(still.predict, code, counts)],
            RIDGE: [_estimate(line.predict, code, counts)],
            OWN: [_estimate(model.coefficients, code, counts) for model in nets],
        }

    results: list[ModelResult] = []
    force_n, error = {}, {}
    picture = None
    for units in sets:
        rows = held[units].test
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
        picture = ResultPicture(
            force_n, error, name_of(data, int(row)), truth, fitted[units][OWN][0](row[None])[0]
        )
    return TaskReport(
        "field",
        results,
        {"modes": modes, **facts_of(data, seeds, config or FieldFitConfig())},
        picture,
    )


def field_row_errors(
    data: MixedDataset, rows: Rows, models: Mapping[str, Sequence[Estimate]]
) -> dict[str, list[Errors]]:
    """Errors of every row for each model and each of its seeds; whole fields in small parts."""
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


def field_bundle(
    data: MixedDataset,
    folder: Path,
    *,
    units: Sequence[str] = (),
    name: str = "field",
    version: int = 1,
    config: FieldFitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> dict[str, float]:
    """Electrodes -> field of some units, empty = all, as a bundle; returns its held-out metrics.

    Raises:
        DatasetError: A unit is not known, or too few trajectories are left.
        BundleError: The folder exists, or parity fails; nothing is left on disk.
    """
    refuse_existing(folder)
    units = units or unit_sets(data.experiment)[-1]
    split = of_units(data.experiment, by_trajectory(data.experiment, seed=seed), units)
    model = fit_field(data, split, config=config, seed=seed, on_epoch=on_epoch)
    code, counts = model.code, tared_counts(data)

    estimate = _estimate(model.coefficients, code, counts)
    errors = field_row_errors(data, split.test, {"zero": [_still(data)], "net": [estimate]})
    metrics = field_summary(errors["net"][0], errors["zero"][0])
    metrics["zero_nodal_subset_m"] = float(errors["zero"][0]["subset_m"].mean())
    untouched = code.decode(model.coefficients(np.zeros((1, counts.shape[1]), np.float32)))
    metrics["untouched_nodal_all_m"] = float(np.linalg.norm(untouched, axis=2).mean())
    metrics |= truncation_metrics(code)
    seen, presses = seen_rows(data, split.train, config or FieldFitConfig(), seed)
    export_fields(
        folder,
        FieldGraph(model.net, code, _node_sd(data, split.validation, estimate)),
        counts[spread_rows(split.test)],
        data.mesh,
        name=name,
        version=version,
        training_data_sha256=content_sha256(data),
        trained_on=trained_on_line(data, units, split),
        metrics=metrics,
        normalisation={
            "electrodes": "standardised by the training rows, inside the graph",
            "displacement": f"{code.size} modes of the training rows, half precision in the graph",
            "displacement_sd": "constant per node: rms length of the error on validation rows",
        },
        training_range=field_range(data, split.train, seen),
        known_inputs=known_inputs(seen, presses),
    )
    return metrics


def seen_rows(
    data: MixedDataset, rows: Rows, config: FieldFitConfig, seed: int
) -> tuple[FloatArray, Rows]:
    """All inputs (N, 19) of a training on rows, untouched ones included, and the press of each."""
    untouched = config.untouched_rows(rows, seed)
    none: Rows = np.full(len(untouched), -1)
    presses = np.concatenate([data.experiment.row_trajectory[rows], none])
    return np.vstack([tared_counts(data)[rows], untouched]), presses


def field_range(data: MixedDataset, rows: Rows, seen: FloatArray) -> TrainingRange:
    """Range of a field network that was trained on rows; ``seen`` are its inputs, all of them."""
    return TrainingRange(
        source=f"{len(seen)} training rows, untouched ones included, of"
        f" {data.experiment.provenance.source}",
        data_sha256=content_sha256(data),
        rows=len(seen),
        inputs=(ends_of("electrodes", "tared counts", seen),),
        outputs=(longest_of("displacement", "m", fields_of(data, rows)),),
        combinations=True,
    )


def fields_of(data: MixedDataset, rows: Rows) -> Iterator[FloatArray]:
    """Fields of rows in small parts, each of shape (N, V, 3)."""
    for start in range(0, len(rows), _CHUNK_ROWS):
        yield data.displacement(rows[start : start + _CHUNK_ROWS])


def truncation_metrics(code: FieldCode) -> dict[str, float]:
    """Number of modes, and what they lose, for a manifest."""
    return {"modes": float(code.size), "truncation_nodal_all_m": code.truncation_m[code.size]}


def spread_rows(rows: Rows) -> Rows:
    """Rows over the whole test set; at most as many as the parity check takes."""
    chosen: Rows = rows[np.unique(np.linspace(0, len(rows) - 1, PARITY_ROWS).astype(int))]
    return chosen


def _node_sd(data: MixedDataset, rows: Rows, estimate: Callable[[Rows], FloatArray]) -> FloatArray:
    total = np.zeros(len(data.mesh.nodes))
    for start in range(0, len(rows), _CHUNK_ROWS):
        part = rows[start : start + _CHUNK_ROWS]
        total += np.square(estimate(part) - data.displacement(part)).sum(axis=(0, 2))
    return np.asarray(np.sqrt(total / len(rows)), np.float32)


def trained_on_line(data: MixedDataset, units: Sequence[str], split: RowSplit) -> str:
    """What a network was trained and tested on, one line for people."""

    def presses(rows: Rows) -> int:
        return len(np.unique(data.experiment.row_trajectory[rows]))

    return (
        f"{data.experiment.provenance.source}: {', '.join(units)}; {len(split.train)} rows of"
        f" {presses(split.train)} trajectories, tested on {presses(split.test)} others"
    )
