"""Electrodes -> displacement and contact forces of the skin: train, test on held-out presses, ship.

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
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.messages import COUNTS_MAX, TrainingRange
from palpate_training.datasets.experiment import MixedDataset, content_sha256
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.contact_code import (
    SPREAD_M,
    ContactCode,
    contact_coefficients,
    fit_contact_code,
    spread_forces_in_parts,
)
from palpate_training.learning.electrode_nets import (
    DRIFT_COUNTS,
    NOISE_COUNTS,
    ElectrodeInputs,
    ElectrodeNet,
    MembersConfig,
    rest_of,
)
from palpate_training.learning.export import export_fields, refuse_existing
from palpate_training.learning.field_code import FieldCode, fit_code, in_parts
from palpate_training.learning.fit import OnEpoch, fit
from palpate_training.learning.graphs import FieldGraph
from palpate_training.learning.metrics import (
    by_force,
    contact_errors,
    field_errors,
    field_summary,
    join,
)
from palpate_training.learning.networks import (
    Standardised,
    device_of,
    predict,
    round_to_half,
    training_device,
)
from palpate_training.learning.ranges import ends_of, known_inputs, longest_of
from palpate_training.learning.splits import Rows, RowSplit, by_trajectory, of_units, unit_sets
from palpate_training.tasks.results import Errors

FloatArray = npt.NDArray[np.float32]
Estimate = Callable[[Rows], FloatArray]

CONTACT_WEIGHT = 0.3
"""Of an error of contact forces [1/N], beside one of the mean displacement [1/mm], in the loss."""

PARITY_ROWS = 24
"""Held-out rows of the parity check, spread over the test trajectories."""


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
    """Electrodes -> displacement and contact forces.

    Attributes:
        net: Tared counts (N, 19) -> coefficients of the displacement [m], then of the contact
            forces [N], shape (N, K + C).
        code: What the first K are coefficients of.
        contact: What the last C are coefficients of; None if the data set has no contact forces.
    """

    net: ElectrodeNet
    code: FieldCode
    contact: ContactCode | None

    def coefficients(self, tared_counts: FloatArray) -> FloatArray:
        """Coefficients of the displacement [m], shape (N, K), of tared counts (N, 19)."""
        return predict(self.net, tared_counts)[:, : self.code.size]

    def contact_forces(self, tared_counts: FloatArray) -> FloatArray:
        """Spread forces on the outer nodes [N], shape (N, O, 3), of tared counts (N, 19)."""
        assert self.contact is not None, "the data set had no contact forces"
        return self.contact.decode(predict(self.net, tared_counts)[:, self.code.size :])


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

    Contact forces are learned by the same network if the data set has them. The seed decides
    weights, order of rows and noise.
    """
    config = config or FieldFitConfig()
    code = fit_code(data, split.train, split.validation)
    wanted = code.encode(data.coefficients)
    untouched = code.project(np.zeros((1, len(code.mean)), np.float32))
    signs, scale = code.signs, np.full(code.size, 1e3 / math.sqrt(code.nodes))
    contact = None
    if data.contact is not None:
        contact = fit_contact_code(data, split.train)
        wanted = np.hstack([wanted, contact_coefficients(data, contact)])
        untouched = np.hstack([untouched, np.zeros((1, contact.size), np.float32)])
        scale = np.concatenate([scale, np.full(contact.size, CONTACT_WEIGHT)])
        if signs is not None:
            assert contact.signs is not None, "one mesh is its own mirror image or it is not"
            signs = np.concatenate([signs, contact.signs])
    net = fit_coefficients(
        tared_counts(data),
        wanted,
        split,
        rest_counts(data, split.train),
        untouched=untouched,
        signs=signs,
        scale=scale.astype(np.float32),
        config=config,
        seed=seed,
        on_epoch=on_epoch,
    )
    return FieldModel(net, code, contact)


def fit_coefficients(
    counts: FloatArray,
    coefficients: FloatArray,
    split: RowSplit,
    rest: FloatArray,
    *,
    untouched: FloatArray,
    signs: FloatArray | None,
    scale: FloatArray,
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
        scale: Of the error of each coefficient in the loss, shape (K,).
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
            augment=partial(
                net.inputs.noisy, gain_spread=config.gain_spread, drift_counts=config.drift_counts
            ),
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
    scale: float | FloatArray,
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
        scale: Of an error, or of the error of each target, shape (O,).
        floor: Scaled error below which the loss is no longer straight.
        config: Settings.
        augment: Inputs of the member -> inputs that it sees.
        estimate_of: What the member gives -> what the network gives.
        on_epoch: Called after each epoch, for a progress bar.
    """
    device = torch.get_default_device()
    net.to(device)
    seen, truth = (torch.from_numpy(part).to(device) for part in validation)
    weight = torch.as_tensor(scale, dtype=torch.float32, device=device)

    def distance(estimate: Tensor, wanted: Tensor) -> Tensor:
        squares = torch.sum(torch.square(weight * (estimate - wanted)), dim=1)
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
    for part in in_parts(rows):
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
    serials: Sequence[str] = (),
    device: str = "cpu",
    on_epoch: OnEpoch | None = None,
) -> dict[str, float]:
    """Electrodes -> field of some units, empty = all, as a bundle; returns its held-out metrics.

    ``serials`` are those of the manifest, ``device`` is where it is trained: cpu, cuda, or auto =
    on a GPU if there is one.

    Raises:
        ConfigError: There is no GPU, but one is wanted.
        DatasetError: A unit is not known, or too few trajectories are left.
        BundleError: The folder exists, or parity fails; nothing is left on disk.
    """
    refuse_existing(folder, name)
    where = training_device(device)
    units = units or unit_sets(data.experiment)[-1]
    split = of_units(data.experiment, by_trajectory(data.experiment, seed=seed), units)
    with torch.device(where):
        model = fit_field(data, split, config=config, seed=seed, on_epoch=on_epoch)
    round_to_half(model.net.cpu())
    code, counts = model.code, tared_counts(data)
    force_n = np.linalg.norm(data.experiment.force[split.test].astype(np.float64), axis=1)

    estimate = _estimate(model.coefficients, code, counts)
    errors = field_row_errors(data, split.test, {"zero": [_still(data)], "net": [estimate]})
    metrics = field_summary(errors["net"][0], errors["zero"][0])
    metrics |= by_force("nodal_all_m", errors["net"][0]["all_m"], force_n, _mean)
    metrics["zero_nodal_subset_m"] = float(errors["zero"][0]["subset_m"].mean())
    untouched = code.decode(model.coefficients(np.zeros((1, counts.shape[1]), np.float32)))
    metrics["untouched_nodal_all_m"] = float(np.linalg.norm(untouched, axis=2).mean())
    metrics |= truncation_metrics(code)
    if model.contact is not None:
        metrics |= _contact_metrics(data, model, split.test, force_n)
    node_sd = _node_sd(data, split.validation, estimate)
    seen, presses = seen_rows(data, split.train, config or FieldFitConfig(), seed)
    export_fields(
        folder,
        FieldGraph(model.net, code, node_sd, model.contact),
        counts[spread_rows(split.test)],
        data.mesh,
        name=name,
        version=version,
        training_data_sha256=content_sha256(data),
        trained_on=trained_on_line(data, units, split),
        sensor_serials=tuple(serials),
        metrics=metrics,
        normalisation={
            "electrodes": "tared counts and logarithms of impedances for an assumed rest,"
            " standardised by the training rows, inside the graph",
            "displacement": f"{code.size} modes of the training rows, half precision in the graph",
            "contact_force": f"each node's force spread by a Gaussian of {1e3 * SPREAD_M} mm, in"
            " modes of the training rows, half precision in the graph",
            "displacement_sd": "constant per node: rms length of the error on validation rows",
        },
        training_range=field_range(data, split.train, seen, contact=model.contact is not None),
        known_inputs=known_inputs(seen, presses),
    )
    return metrics


def _contact_metrics(
    data: MixedDataset, model: FieldModel, rows: Rows, force_n: npt.NDArray[np.float64]
) -> dict[str, float]:
    """How well contact forces are estimated, medians over rows, for a manifest."""
    assert model.contact is not None
    counts = tared_counts(data)
    errors = join(
        [
            contact_errors(model.contact_forces(counts[part]), truth)
            for part, truth in zip(in_parts(rows), spread_forces_in_parts(data, rows), strict=True)
        ]
    )
    net = errors["net_n"] / np.linalg.norm(data.simulated_force[rows].astype(np.float64), axis=1)
    return {
        "contact_modes": float(model.contact.size),
        "contact_spread_m": SPREAD_M,
        "contact_misplaced": _median(errors["misplaced"]),
        "contact_net_over_norm": _median(net),
        **by_force("contact_misplaced", errors["misplaced"], force_n, _median),
        **by_force("contact_net_over_norm", net, force_n, _median),
    }


def _mean(values: npt.NDArray[np.float64]) -> float:
    return float(np.mean(values))


def _median(values: npt.NDArray[np.float64]) -> float:
    return float(np.median(values))


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


def field_range(
    data: MixedDataset, rows: Rows, seen: FloatArray, *, contact: bool
) -> TrainingRange:
    """Range of a field network that was trained on rows.

    Args:
        data: The rows.
        rows: Which of them.
        seen: Its inputs, all of them.
        contact: Whether the network estimates contact forces.
    """
    outputs = [longest_of("displacement", "m", fields_of(data, rows))]
    if contact:
        outputs.append(longest_of("contact_force", "N", spread_forces_in_parts(data, rows)))
    return TrainingRange(
        source=f"{len(seen)} training rows, untouched ones included, of"
        f" {data.experiment.provenance.source}",
        data_sha256=content_sha256(data),
        rows=len(seen),
        inputs=(ends_of("electrodes", "tared counts", seen),),
        outputs=tuple(outputs),
        combinations=True,
    )


def fields_of(data: MixedDataset, rows: Rows) -> Iterator[FloatArray]:
    """Fields of rows in small parts, each of shape (N, V, 3)."""
    for part in in_parts(rows):
        yield data.displacement(part)


def truncation_metrics(code: FieldCode) -> dict[str, float]:
    """Number of modes, and what they lose, for a manifest."""
    return {"modes": float(code.size), "truncation_nodal_all_m": code.truncation_m[code.size]}


def spread_rows(rows: Rows) -> Rows:
    """Rows over the whole test set; at most as many as the parity check takes."""
    chosen: Rows = rows[np.unique(np.linspace(0, len(rows) - 1, PARITY_ROWS).astype(int))]
    return chosen


def _node_sd(data: MixedDataset, rows: Rows, estimate: Callable[[Rows], FloatArray]) -> FloatArray:
    total = np.zeros(len(data.mesh.nodes))
    for part in in_parts(rows):
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
