"""Our networks: logarithms of the impedance, the finger's symmetry, attention over electrodes.

What an electrode reads follows the film above it: its impedance is nearly inverse in the film's
thickness, so the logarithm of the impedance, less its untouched value, is nearly the logarithm of
the film's relative thickness, whatever the fluid's conductivity. The finger is symmetric, so a row
and its mirror image are both true; an estimate is the mean of both.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_training.learning.electrode_nets import (
    ASSUMED_REST,
    GAIN_SPREAD,
    MIRROR_AXES,
    ElectrodeInputs,
    ResidualLayers,
)
from palpate_training.learning.fit import FeaturesFitConfig, fit
from palpate_training.learning.networks import Standardised, predict
from palpate_training.systems.samples import (
    Estimate,
    FloatArray,
    Quantity,
    Samples,
    System,
    error_of,
)

MEMBERS = 3
"""As many as in the bundles that ship."""

MAGNITUDE_FLOOR_N = 0.5
"""Forces count as their error over this plus their magnitude, to the power of a half."""

OURS_CONFIG = FeaturesFitConfig(
    epochs=120, patience=30, batch_rows=256, learning_rate=2e-3, weight_decay=1e-5
)


class ElectrodeAttention(nn.Module):
    """Self-attention over the 19 electrodes, each with its values and its place.

    Args:
        outputs: Estimated values.
        width: Of a token.
        layers: Attention layers.
        heads: Of each.
    """

    place: Tensor

    def __init__(self, outputs: int, width: int = 64, layers: int = 3, heads: int = 4) -> None:
        super().__init__()
        place = (ELECTRODE_POSITIONS / 5e-3).astype(np.float32)
        self.register_buffer("place", torch.from_numpy(place))
        self.of_values = nn.Linear(2, width)
        self.of_place = nn.Sequential(nn.Linear(3, width), nn.SiLU(), nn.Linear(width, width))
        self.own = nn.Parameter(0.02 * torch.randn(len(place), width))
        layer = nn.TransformerEncoderLayer(
            width, heads, 2 * width, dropout=0.0, batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        self.head = nn.Sequential(
            nn.LayerNorm(width * len(place)),
            nn.Linear(width * len(place), 128),
            nn.SiLU(),
            nn.Linear(128, outputs),
        )

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimate of standardised inputs (N, 38)."""
        values = torch.stack(inputs.chunk(2, dim=1), dim=2)  # (N, 19, 2)
        tokens = self.of_values(values) + self.of_place(self.place) + self.own
        estimate: Tensor = self.head(self.encoder(tokens).flatten(1))
        return estimate


INPUTS = ElectrodeInputs(np.full(len(ELECTRODE_POSITIONS), ASSUMED_REST, np.float32))


def inputs_of(samples: Samples) -> tuple[FloatArray, FloatArray]:
    """Inputs (N, 38) of rows, and those of their mirror images."""
    inputs = INPUTS.of(samples.tared, samples.rest)
    return inputs, inputs[:, INPUTS.order.numpy()]


@dataclass(frozen=True, slots=True)
class Members:
    """An ensemble whose estimate is the mean of its members', each of a row and its mirror image.

    Attributes:
        nets: The members.
        undirected: Whether the estimates are made unit vectors.
    """

    nets: tuple[Standardised, ...]
    undirected: bool

    def estimate(self, samples: Samples) -> FloatArray:
        """Estimates of rows, shape (N, 3)."""
        inputs, mirrored = inputs_of(samples)
        total = np.zeros((len(inputs), 3), np.float64)
        for net in self.nets:
            total += predict(net, inputs) + predict(net, mirrored) * MIRROR_AXES
        mean = total / (2 * len(self.nets))
        if self.undirected:
            mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
        return mean.astype(np.float32)


def fit_members(
    layers: Callable[[], nn.Module],
    members: int,
    gain_spread: float,
    quantity: Quantity,
    train: Samples,
    validation: Samples,
    seed: int,
) -> Estimate:
    """Train an ensemble, each member from other weights and in another order of rows."""
    targets = train.truth(quantity)
    both = np.vstack(inputs_of(train))
    truths = np.vstack([targets, targets * MIRROR_AXES])
    nets = []
    for member in range(members):
        torch.manual_seed(1000 * seed + member)
        net = Standardised(layers(), both.shape[1])
        _fit_member(net, both, truths, validation, quantity, gain_spread)
        nets.append(net)
    return Members(tuple(nets), quantity == "normal").estimate


def _fit_member(
    net: Standardised,
    inputs: FloatArray,
    targets: FloatArray,
    validation: Samples,
    quantity: Quantity,
    gain_spread: float,
) -> None:
    net.normalise_from(inputs, targets)
    truth = validation.truth(quantity)
    size = float(np.sqrt(np.square(targets - targets.mean(axis=0)).sum(axis=1).mean()))
    noisy = copy.deepcopy(INPUTS).to(torch.get_default_device()).noisy

    def loss_of(estimate: Tensor, wanted: Tensor) -> Tensor:
        squares = torch.square((estimate - wanted) / size).sum(dim=1)
        distance = torch.sqrt(squares + 1e-4)
        if quantity != "force":
            return distance.mean()
        # A newton matters less the harder the press: what a robot needs is a share of the force.
        magnitude = torch.linalg.vector_norm(wanted, dim=1)
        return (distance * size / torch.sqrt(MAGNITUDE_FLOOR_N + magnitude)).mean()

    fit(
        net,
        inputs,
        targets,
        loss_of=loss_of,
        score_of=lambda _: error_of(Members((net,), False).estimate(validation), truth),
        config=OURS_CONFIG,
        augment=lambda batch, _: noisy(batch, gain_spread=gain_spread, drift_counts=0.0),
    )


_EVERY: tuple[Quantity, ...] = ("location", "force", "centre", "normal")

_SOURCE = "ours: log impedances, mirror images"

OURS = (
    System(
        "residual network",
        _SOURCE,
        partial(fit_members, partial(ResidualLayers, 38, 3), 1, 0.0),
        _EVERY,
        seeded=True,
    ),
    System(
        "residual networks, mean of three",
        f"{_SOURCE}, ensemble",
        partial(fit_members, partial(ResidualLayers, 38, 3), MEMBERS, 0.0),
        _EVERY,
        seeded=True,
    ),
    System(
        "residual networks, gains in training",
        f"{_SOURCE}, ensemble; electrodes of other fingers stood for by random gains",
        partial(fit_members, partial(ResidualLayers, 38, 3), MEMBERS, GAIN_SPREAD),
        _EVERY,
        seeded=True,
    ),
    System(
        "attention over electrodes",
        _SOURCE,
        partial(fit_members, partial(ElectrodeAttention, 3), 1, 0.0),
        _EVERY,
        seeded=True,
    ),
)
