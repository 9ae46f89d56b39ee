"""Electrodes -> displacement field of the skin: train, test on held-out trajectories, ship.

The network that ships is by default one for all specimens, since the finger of a robot is none of
the training specimens. What is reported was measured with exactly the weights that are shipped.

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
from palpate_training.learning.electrode_nets import (
    DRIFT_COUNTS,
    NOISE_COUNTS,
    ElectrodeInputs,
    ElectrodeNet,
    MembersConfig,
    rest_of,
)
from palpate_training.learning.export import export_fields, refuse_existing
from palpate_training.learning.field_code import FieldCode, fit_code
from palpate_training.learning.fit import OnEpoch, fit
from palpate_training.learning.graphs import FieldGraph
from palpate_training.learning.metrics import field_errors, field_summary, join
from palpate_training.learning.networks import Standardised, device_of, predict
from palpate_training.learning.ranges import ends_of, known_inputs, longest_of
from palpate_training.learning.splits import Rows, RowSplit, by_trajectory, of_units, unit_sets
from palpate_training.tasks.results import Errors

FloatArray = npt.NDArray[np.float32]
Estimate = Callable[[Rows], FloatArray]

PARITY_ROWS = 24
"""Held-out rows of the parity check, spread over the test trajectories."""

_CHUNK_ROWS = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldFitConfig(MembersConfig):
    """Settings of a training of a field or synthesis network.

    Attributes:
        rest_share: Untouched rows added to the training rows, as a share of them. The data set
            starts at 0.5 N; without them an untouched finger would be an extrapolation.
    """

    rest_share: float = 0.05

    def rest_rows(self, rows: int) -> int:
        """How many untouched rows are added to so many training rows."""
        return math.ceil(self.rest_share * rows)


@dataclass(frozen=True, slots=True)
class FieldModel:
    """Electrodes -> field.

    Attributes:
        net: Tared counts (N, 19) -> coefficients (N, K) [m].
        code: What they are coefficients of.
    """

    net: ElectrodeNet
    code: FieldCode

    def coefficients(self, tared_counts: FloatArray) -> FloatArray:
        """Coefficients [m], shape (N, K), of tared counts (N, 19)."""
        return predict(self.net, tared_counts)


def tared_counts(data: MixedDataset) -> FloatArray:
    """Tared electrodes of all rows [counts], shape (N, 19)."""
    return np.asarray(data.experiment.tared * np.float32(COUNTS_MAX), np.float32)


def rest_counts(data: MixedDataset, rows: Rows) -> FloatArray:
    """Untouched counts of the fingers of some rows, their mean [counts], shape (19,)."""
    return rest_of(data.experiment.trial_rest[np.unique(data.experiment.trial[rows])])


def fit_field(
    data: MixedDataset,
    split: RowSplit,
    *,
    config: FieldFitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> FieldModel:
    """Train electrodes -> field on the training rows of a split, in modes of these rows.

    The seed decides weights, order of rows and noise.
    """
    config = config or FieldFitConfig()
    code = fit_code(data, split.train, split.validation)
    net = fit_coefficients(
        tared_counts(data),
        code.encode(data.coefficients),
        split,
        rest_counts(data, split.train),
        untouched=code.project(np.zeros((1, len(code.mean)), np.float32)),
        signs=code.signs,
        scale=1e3 / math.sqrt(code.nodes),
        config=config,
        seed=seed,
        on_epoch=on_epoch,
    )
    return FieldModel(net, code)


def fit_coefficients(
    counts: FloatArray,
    coefficients: FloatArray,
    split: RowSplit,
    rest: FloatArray,
    *,
    untouched: FloatArray,
    signs: FloatArray | None,
    scale: float,
    config: FieldFitConfig,
    seed: int,
    on_epoch: OnEpoch | None,
) -> ElectrodeNet:
    """Train electrodes -> coefficients of a field, mirror images included where there are any.

    Args:
        counts: Tared counts of all rows, shape (N, 19).
        coefficients: Of all rows, shape (N, K).
        split: Rows to learn from and to stop on.
        rest: Untouched counts that are assumed of every finger, shape (19,).
        untouched: Coefficients of an untouched finger, shape (1, K).
        signs: What a mirror image makes of each coefficient, shape (K,); None = there is none.
        scale: Makes an error of coefficients one of about 1.
        config: Settings.
        seed: Of weights, order of rows and noise.
        on_epoch: Called after each epoch, for a progress bar.
    """
    read = ElectrodeInputs(rest)
    inputs, wanted = read.of(counts[split.train]), coefficients[split.train]
    if signs is not None:
        inputs = np.vstack([inputs, inputs[:, read.order.numpy()]])
        wanted = np.vstack([wanted, wanted * signs])
    pressed = len(wanted)
    still = config.rest_rows(pressed)
    inputs = np.vstack([inputs, np.zeros((still, inputs.shape[1]), np.float32)])
    wanted = np.vstack([wanted, np.repeat(untouched, still, axis=0)])
    members = []
    for member in range(config.members):
        torch.manual_seed(1000 * seed + member)
        layers = config.member(inputs.shape[1], wanted.shape[1])
        net = ElectrodeNet([layers], rest, signs)
        layers.normalise_from(inputs[:pressed], wanted[:pressed])
        fit_on_norms(
            net,
            layers,
            inputs,
            wanted,
            (counts[split.validation], coefficients[split.validation]),
            scale=scale,
            floor=0.01,
            config=config,
            augment=net.inputs.noisy,
            on_epoch=on_epoch,
        )
        members.append(layers)
    return ElectrodeNet(members, rest, signs).to(device_of(members[0])).eval()


def fit_on_norms(
    net: nn.Module,
    layers: Standardised,
    inputs: FloatArray,
    targets: FloatArray,
    validation: tuple[FloatArray, FloatArray],
    *,
    scale: float,
    floor: float,
    config: FieldFitConfig,
    augment: Callable[[Tensor], Tensor] = lambda batch: batch,
    estimate_of: Callable[[Tensor], Tensor] = lambda estimate: estimate,
    on_epoch: OnEpoch | None,
) -> None:
    """Train a member in place on the norm of each row's error.

    The loss of a row is ``sqrt((scale |error|)^2 + floor^2)``: an L2 norm, smooth at zero. The
    validation rows are scored by the same loss.

    Args:
        net: The network whose only member is trained; what the validation rows are given to.
        layers: The member.
        inputs: Of the member, shape (N, I).
        targets: Of the network, shape (N, O).
        validation: Inputs and targets of the network.
        scale: Of an error.
        floor: Scaled error below which the loss is no longer straight.
        config: Settings.
        augment: Inputs of the member -> inputs that it sees.
        estimate_of: What the member gives -> what the network gives.
        on_epoch: Called after each epoch, for a progress bar.
    """
    device = torch.get_default_device()
    net.to(device)
    seen, truth = (torch.from_numpy(part).to(device) for part in validation)

    def distance(estimate: Tensor, wanted: Tensor) -> Tensor:
        squares = torch.sum(torch.square(scale * (estimate - wanted)), dim=1)
        return torch.sqrt(squares + floor**2).mean()

    def score_of(_: nn.Module) -> float:
        with torch.inference_mode():
            return float(distance(net(seen), truth))

    fit(
        layers,
        inputs,
        targets,
        loss_of=lambda estimate, wanted: distance(estimate_of(estimate), wanted),
        score_of=score_of,
        config=config,
        augment=lambda batch, _: augment(batch),
        on_epoch=on_epoch,
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
            "electrodes": "tared counts and logarithms of impedances for an assumed rest,"
            " standardised by the training rows, inside the graph",
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
    rng = np.random.default_rng(seed)
    count = config.rest_rows(len(rows))
    noise = rng.normal(0, NOISE_COUNTS, (count, ELECTRODES))
    untouched = (noise + rng.normal(0, DRIFT_COUNTS, (count, 1))).astype(np.float32)
    none: Rows = np.full(count, -1)
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
