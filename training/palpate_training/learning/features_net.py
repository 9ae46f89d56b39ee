"""The network that the ``features`` task ships: all quantities from one, mirror images included.

A finger is nearly symmetric, so the estimate may be the mean of that of a row and of its mirror
image; whether that helps is decided on validation rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from palpate_training.learning.electrode_nets import MIRROR_AXES, ElectrodeNet, MembersConfig
from palpate_training.learning.fit import OnEpoch, fit
from palpate_training.learning.networks import Standardised, device_of, predict

FloatArray = npt.NDArray[np.float32]

FORCE_FLOOR_N = 0.5
"""Forces count as their error over this plus their magnitude, to the power of a half: a newton
matters less the harder the press."""

_SMOOTH = 1e-4  # of a normalised distance's square, so that its root has a slope at zero


@dataclass(frozen=True, slots=True, kw_only=True)
class FeaturesNetConfig(MembersConfig):
    """Settings of a training of all features."""


class FeaturesNet(ElectrodeNet):
    """Tared counts ``(N, 19)`` -> some quantities ``(N, 3 Q)``, three values each.

    Args:
        nets: Members, inputs ``(N, 38)`` -> quantities; the estimate is their mean.
        rest: Untouched counts that are assumed of every finger [counts], shape ``(19,)``.
        symmetric: Whether the estimate is the mean of that of a row and of its mirror image.
    """

    def __init__(self, nets: Sequence[Standardised], rest: FloatArray, *, symmetric: bool) -> None:
        signs = np.tile(MIRROR_AXES, len(nets[0].output_sd) // 3)
        super().__init__(nets, rest, signs if symmetric else None)


@dataclass(frozen=True, slots=True)
class FeaturesRows:
    """Rows to learn from or to stop on.

    Attributes:
        tared: Tared counts [counts], shape ``(N, 19)``.
        targets: Force [N] and then what only a contact has, shape ``(N, 3 Q)``; NaN where there is
            none.
    """

    tared: FloatArray
    targets: FloatArray


def fit_features_net(
    train: FeaturesRows,
    validation: FeaturesRows,
    rest: FloatArray,
    *,
    symmetric: bool,
    begun: Sequence[Standardised] = (),
    config: FeaturesNetConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> FeaturesNet:
    """Train; of each member the weights of the epoch with the best ``score_of`` are kept.

    Args:
        train: Rows to learn from.
        validation: Rows to stop on.
        rest: Untouched counts that are assumed of every finger [counts], shape ``(19,)``.
        symmetric: Whether mirror images are learned from, too, and averaged.
        begun: The first members, if they have been trained before.
        config: Settings.
        seed: Of the weights, the order of the rows and the noise.
        on_epoch: Called after each epoch, for a progress bar.
    """
    config = config or FeaturesNetConfig()
    members = [
        *begun,
        *(
            _fit_member(train, validation, rest, symmetric, config, 1000 * seed + member, on_epoch)
            for member in range(len(begun), config.members)
        ),
    ]
    return FeaturesNet(members, rest, symmetric=symmetric).to(device_of(members[0])).eval()


def _fit_member(
    train: FeaturesRows,
    validation: FeaturesRows,
    rest: FloatArray,
    symmetric: bool,
    config: FeaturesNetConfig,
    seed: int,
    on_epoch: OnEpoch | None,
) -> Standardised:
    torch.manual_seed(seed)
    quantities = train.targets.shape[1] // 3
    size = 2 * train.tared.shape[1]
    member = config.member(size, 3 * quantities)
    net = FeaturesNet([member], rest, symmetric=symmetric)
    inputs, targets = net.inputs.of(train.tared), train.targets
    if symmetric:
        inputs = np.vstack([inputs, inputs[:, net.inputs.order.numpy()]])
        targets = np.vstack([targets, targets * np.tile(MIRROR_AXES, quantities)])
    _normalise(member, inputs, targets)
    net.to(torch.get_default_device())
    fit(
        member,
        inputs,
        targets,
        loss_of=partial(_loss, sizes_of(train.targets)),
        score_of=lambda _: score_of(net, validation),
        config=config,
        augment=lambda batch, _: net.inputs.noisy(
            batch, gain_spread=config.gain_spread, drift_counts=config.drift_counts
        ),
        on_epoch=on_epoch,
    )
    return member


def _loss(sizes: FloatArray, estimate: Tensor, wanted: Tensor) -> Tensor:
    """Sum over the quantities of the mean distance, over the quantity's spread."""
    parts = []
    for number, (guess, truth) in enumerate(
        zip(torch.split(estimate, 3, dim=1), torch.split(wanted, 3, dim=1), strict=True)
    ):
        size = float(sizes[number])
        known = ~torch.isnan(truth[:, 0])
        error = torch.where(known[:, None], guess - truth, 0.0) / size
        distance = torch.sqrt(torch.square(error).sum(dim=1) + _SMOOTH)
        if number == 0:
            magnitude = torch.linalg.vector_norm(truth, dim=1)
            distance = distance * size / torch.sqrt(FORCE_FLOOR_N + magnitude)
        parts.append((distance * known).sum() / known.sum().clamp(min=1))
    return torch.stack(parts).sum()


def score_of(net: FeaturesNet, rows: FeaturesRows) -> float:
    """Sum over the quantities of the median error over the quantity's own spread."""
    estimate = predict(net, rows.tared)
    sizes = sizes_of(rows.targets)
    total = 0.0
    for number, spread in enumerate(sizes):
        part = slice(3 * number, 3 * number + 3)
        distance = np.linalg.norm(estimate[:, part] - rows.targets[:, part], axis=1)
        total += float(np.nanmedian(distance)) / float(spread)
    return total


def sizes_of(targets: FloatArray) -> FloatArray:
    """Root mean square distance of each quantity from its mean, shape ``(Q,)``."""
    parts = np.split(targets.astype(np.float64), targets.shape[1] // 3, axis=1)
    sizes = [np.sqrt(np.nansum(np.nanvar(part, axis=0))) for part in parts]
    return np.maximum(sizes, 1e-9).astype(np.float32)


def _normalise(net: Standardised, inputs: FloatArray, targets: FloatArray) -> None:
    """Set the constants; where a quantity is not known it does not count."""
    mean = np.nanmean(targets.astype(np.float64), axis=0)
    known = np.where(np.isnan(targets), mean, targets).astype(np.float32)
    net.normalise_from(inputs, known)
    spread = np.maximum(np.nanstd(targets.astype(np.float64), axis=0), 1e-6)
    net.output_sd.copy_(torch.from_numpy(spread))
