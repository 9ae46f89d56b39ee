"""The network that the ``features`` task ships: all quantities from one, mirror images included.

Inputs are tared counts and the fall of the logarithm of the impedance, which follows the film above
an electrode (``systems/ours.py`` says why). A finger is nearly symmetric, so the estimate may be
the mean of that of a row and of its mirror image; whether that helps is decided on validation rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.messages import COUNTS_MAX
from palpate_training.learning.fit import FitConfig, OnEpoch, fit
from palpate_training.learning.networks import Standardised, predict

FloatArray = npt.NDArray[np.float32]

MIRROR_AXES = np.array([1.0, -1.0, 1.0], np.float32)
NOISE_COUNTS = 2.0
FORCE_FLOOR_N = 0.5
"""Forces count as their error over this plus their magnitude, to the power of a half: a newton
matters less the harder the press."""

_SMOOTH = 1e-4  # of a normalised distance's square, so that its root has a slope at zero


@dataclass(frozen=True, slots=True, kw_only=True)
class FeaturesNetConfig(FitConfig):
    """Settings of a training of all features.

    Attributes:
        width: Of the residual layers.
        blocks: Number of residual blocks, of two layers each.
    """

    epochs: int = 80
    patience: int = 25
    batch_rows: int = 256
    learning_rate: float = 2e-3
    width: int = 256
    blocks: int = 3
    threads: int = 2


class ResidualLayers(nn.Module):
    """Blocks of two layers that add to their input."""

    def __init__(self, inputs: int, outputs: int, width: int = 256, blocks: int = 3) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(width),
                nn.Linear(width, width),
                nn.SiLU(),
                nn.Linear(width, width),
            )
            for _ in range(blocks)
        )
        self.head = nn.Linear(width, outputs)

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimate of standardised inputs."""
        hidden = self.first(inputs)
        for block in self.blocks:
            hidden = hidden + block(hidden)
        estimate: Tensor = self.head(nn.functional.silu(hidden))
        return estimate


class FeaturesNet(nn.Module):
    """Tared counts ``(N, 19)`` -> some quantities ``(N, 3 Q)``, three values each.

    Args:
        net: Inputs ``(N, 38)`` -> quantities.
        rest: Untouched counts that are assumed of every finger [counts], shape ``(19,)``.
        symmetric: Whether the estimate is the mean of that of a row and of its mirror image.
    """

    rest: Tensor
    log_rest: Tensor
    order: Tensor
    signs: Tensor

    def __init__(self, net: Standardised, rest: FloatArray, *, symmetric: bool) -> None:
        super().__init__()
        self.net = net
        self.symmetric = symmetric
        self.register_buffer("rest", torch.from_numpy(rest.astype(np.float32)))
        self.register_buffer("log_rest", _log_impedance(self.rest))
        order = np.concatenate([ELECTRODE_MIRROR, ELECTRODE_MIRROR + len(rest)])
        self.register_buffer("order", torch.from_numpy(order).long())
        mirrored = np.tile(MIRROR_AXES, len(net.output_sd) // 3)
        signs = 0.5 * np.stack([np.ones_like(mirrored), mirrored])
        self.register_buffer("signs", torch.from_numpy(signs))

    @property
    def output_sd(self) -> Tensor:
        """Standard deviation of the training targets, shape ``(3 Q,)``."""
        return self.net.output_sd

    def inputs_of(self, tared: Tensor) -> Tensor:
        """Tared counts and the fall of the logarithm of the impedance, ``(N, 38)``."""
        fall = self.log_rest - _log_impedance(self.rest + tared)
        return torch.cat([tared, fall], dim=1)

    def forward(self, tared: Tensor) -> Tensor:
        """Estimates of tared counts."""
        inputs = self.inputs_of(tared)
        if not self.symmetric:
            estimate: Tensor = self.net(inputs)
            return estimate
        both = torch.stack([inputs, torch.index_select(inputs, 1, self.order)], dim=1)
        mean: Tensor = (self.net(both) * self.signs).sum(dim=1)  # (N, 2, 3 Q) -> (N, 3 Q)
        return mean


def _log_impedance(counts: Tensor) -> Tensor:
    """Logarithm of the impedance, but for a constant; counts are kept one inside of their range."""
    return torch.log(COUNTS_MAX / counts.clamp(1.0, COUNTS_MAX - 1.0) - 1.0)


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
    config: FeaturesNetConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> FeaturesNet:
    """Train; the weights of the epoch with the best ``score_of`` are kept.

    Args:
        train: Rows to learn from.
        validation: Rows to stop on.
        rest: Untouched counts that are assumed of every finger [counts], shape ``(19,)``.
        symmetric: Whether mirror images are learned from, too, and averaged.
        config: Settings.
        seed: Of the weights, the order of the rows and the noise.
        on_epoch: Called after each epoch, for a progress bar.
    """
    config = config or FeaturesNetConfig()
    torch.manual_seed(seed)
    quantities = train.targets.shape[1] // 3
    size = 2 * train.tared.shape[1]
    layers = ResidualLayers(size, 3 * quantities, config.width, config.blocks)
    net = FeaturesNet(Standardised(layers, size, 3 * quantities), rest, symmetric=symmetric)
    with torch.inference_mode():
        inputs = net.inputs_of(torch.from_numpy(train.tared)).numpy()
    targets = train.targets
    if symmetric:
        inputs = np.vstack([inputs, inputs[:, net.order.numpy()]])
        targets = np.vstack([targets, targets * np.tile(MIRROR_AXES, quantities)])
    _normalise(net.net, inputs, targets)
    sizes = sizes_of(train.targets)
    noise = torch.from_numpy(_input_noise(rest))

    def loss_of(estimate: Tensor, wanted: Tensor) -> Tensor:
        parts = []
        for number, (guess, truth) in enumerate(
            zip(torch.split(estimate, 3, dim=1), torch.split(wanted, 3, dim=1), strict=True)
        ):
            known = ~torch.isnan(truth[:, 0])
            error = torch.where(known[:, None], guess - truth, 0.0) / float(sizes[number])
            distance = torch.sqrt(torch.square(error).sum(dim=1) + _SMOOTH)
            if number == 0:
                magnitude = torch.linalg.vector_norm(truth, dim=1)
                distance = distance * float(sizes[0]) / torch.sqrt(FORCE_FLOOR_N + magnitude)
            parts.append((distance * known).sum() / known.sum().clamp(min=1))
        return torch.stack(parts).sum()

    def noisy(batch: Tensor, rows: Tensor) -> Tensor:
        # The same noise of an electrode in both of its inputs.
        drawn = torch.randn_like(batch[:, : size // 2]).repeat(1, 2)
        return batch + noise.to(batch.device) * drawn

    fit(
        net.net,
        inputs,
        targets,
        loss_of=loss_of,
        score_of=lambda _: score_of(net, validation),
        config=config,
        augment=noisy,
        on_epoch=on_epoch,
    )
    return net.eval()


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


def _input_noise(rest: FloatArray) -> FloatArray:
    """What noise of the counts does to each input, by the slope at rest, (38,)."""
    low, high = (_log_impedance(torch.from_numpy(rest + step)).numpy() for step in (-1.0, 1.0))
    slope = (low - high) / 2.0
    return (NOISE_COUNTS * np.concatenate([np.ones_like(slope), slope])).astype(np.float32)
