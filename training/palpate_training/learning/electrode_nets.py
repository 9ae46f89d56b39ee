"""Networks that read electrodes: their inputs, their layers, mirror images, means of several.

What an electrode reads follows the film above it: its impedance is nearly inverse in the film's
thickness, so the fall of its logarithm is nearly the fall of the logarithm of the film, whatever
the fluid's conductivity. A finger is nearly symmetric, so the mirror image of a row is one more
row, and an estimate may be the mean of that of a row and of its mirror image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.messages import COUNTS_MAX
from palpate_training.learning.fit import FitConfig
from palpate_training.learning.networks import Standardised

FloatArray = npt.NDArray[np.float32]

MIRROR_AXES = np.array([1.0, -1.0, 1.0], np.float32)
"""What a mirror image makes of a vector: y turns round."""

NOISE_COUNTS = 2.0
DRIFT_COUNTS = 10.0
"""Standard deviation of what all electrodes of a training row have drifted alike since the tare:
half a kelvin. A network that never saw it takes 20 counts for 0.85 N (training/LOG.md)."""

GAIN_SPREAD = 0.1
"""Standard deviation of the logarithm of the gain that each electrode of a training row gets. It
stands for the electrodes of other fingers, which are stronger or weaker: without it errors on them
are larger, and on the fingers of the training smaller (training/LOG.md)."""

_LANES = 16


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


@dataclass(frozen=True, slots=True, kw_only=True)
class MembersConfig(FitConfig):
    """Settings of a training of several residual networks.

    Attributes:
        members: Networks whose estimates are averaged; each has weights and an order of its own.
        width: Of the residual layers.
        blocks: Number of residual blocks, of two layers each.
        gain_spread: Of the electrodes that are read in training, standard deviation of the gain's
            logarithm; 0 for a network that is to read the fingers of its training and no others.
        drift_counts: What they have drifted alike since the tare, standard deviation [counts].
    """

    epochs: int = 80
    patience: int = 25
    learning_rate: float = 2e-3
    members: int = 3
    width: int = 256
    blocks: int = 3
    gain_spread: float = GAIN_SPREAD
    drift_counts: float = DRIFT_COUNTS

    def member(self, inputs: int, outputs: int) -> Standardised:
        """A member before its training."""
        return Standardised(
            ResidualLayers(inputs, outputs, self.width, self.blocks), inputs, outputs
        )


class ElectrodeInputs(nn.Module):
    """Tared counts ``(N, 19)`` and the fall of the logarithm of the impedance, ``(N, 38)``.

    Args:
        rest: Untouched counts that are assumed of every finger [counts], shape ``(19,)``. Where
            those of each row are known, they are given with the rows.
    """

    rest: Tensor
    log_rest: Tensor
    order: Tensor
    slope: Tensor

    def __init__(self, rest: FloatArray) -> None:
        super().__init__()
        self.register_buffer("rest", torch.from_numpy(rest.astype(np.float32)))
        self.register_buffer("log_rest", log_impedance(self.rest))
        order = np.concatenate([ELECTRODE_MIRROR, ELECTRODE_MIRROR + len(rest)])
        self.register_buffer("order", torch.from_numpy(order).long())
        low, high = (log_impedance(self.rest + step) for step in (-1.0, 1.0))
        # What a count more of an electrode at rest adds to each input.
        self.register_buffer("slope", torch.cat([torch.ones_like(low), (low - high) / 2.0]))

    def forward(self, tared: Tensor) -> Tensor:
        """Inputs of tared counts."""
        return torch.cat([tared, self.log_rest - log_impedance(self.rest + tared)], dim=1)

    def of(self, tared: FloatArray, rest: FloatArray | None = None) -> FloatArray:
        """Inputs of tared counts ``(N, 19)``, as arrays; ``rest``: of each row, NaN = not known."""
        with torch.inference_mode(), torch.device("cpu"):
            counts = torch.from_numpy(tared)
            if rest is None:
                return np.asarray(self(counts), np.float32)
            known = torch.from_numpy(rest)
            known = torch.where(torch.isfinite(known), known, self.rest)
            fall = log_impedance(known) - log_impedance(known + counts)
            return np.asarray(torch.cat([counts, fall], dim=1), np.float32)

    def mirrored(self, inputs: Tensor) -> Tensor:
        """Inputs of the mirror images."""
        return torch.index_select(inputs, 1, self.order)

    def noisy(self, inputs: Tensor, *, gain_spread: float, drift_counts: float) -> Tensor:
        """Inputs with noise, a common drift and gains of the electrodes, drawn for each row."""
        half = inputs.shape[1] // 2
        noise = NOISE_COUNTS * torch.randn_like(inputs[:, :half])
        drift = drift_counts * torch.randn_like(inputs[:, :1])
        gain = torch.exp(gain_spread * torch.randn_like(inputs[:, :half]))
        # The same counts and gain of an electrode in both of its inputs.
        moved = inputs + self.slope * (noise + drift).repeat(1, 2)
        return moved * gain.repeat(1, 2)


class ElectrodeNet(nn.Module):
    """Tared counts ``(N, 19)`` -> ``(N, O)``, the mean of some networks.

    Args:
        nets: Members, inputs ``(N, 38)`` -> ``(N, O)``.
        rest: Untouched counts that are assumed of every finger [counts], shape ``(19,)``.
        signs: What a mirror image makes of each output, 1 or -1, shape ``(O,)``; then the estimate
            is the mean of that of a row and of its mirror image. None = of the row alone.
    """

    signs: Tensor

    def __init__(
        self, nets: Sequence[Standardised], rest: FloatArray, signs: FloatArray | None
    ) -> None:
        super().__init__()
        self.nets = nn.ModuleList(nets)
        self.inputs = ElectrodeInputs(rest)
        self.symmetric = signs is not None
        given = np.ones(len(nets[0].output_sd), np.float32) if signs is None else signs
        both = 0.5 * np.stack([np.ones_like(given), given])
        self.register_buffer("signs", torch.from_numpy(both.astype(np.float32)))

    @property
    def output_sd(self) -> Tensor:
        """Standard deviation of the training targets, shape ``(O,)``."""
        sd: Tensor = self.nets[0].get_buffer("output_sd")
        return sd

    def forward(self, tared: Tensor) -> Tensor:
        """Estimates of tared counts."""
        inputs = self.inputs(tared)
        if not self.symmetric:
            return self._mean_of(inputs)
        both = torch.stack([inputs, self.inputs.mirrored(inputs)], dim=1)
        return (self._mean_of(both) * self.signs).sum(dim=1)  # (N, 2, O) -> (N, O)

    def _mean_of(self, inputs: Tensor) -> Tensor:
        estimates: list[Tensor] = [net(inputs) for net in self.nets]
        return torch.stack(estimates).sum(dim=0) / len(estimates)


def in_lanes(function: Callable[[Tensor], Tensor], values: Tensor) -> Tensor:
    """A function of each value (N, W), with the same bits in a batch as alone.

    Processors take 16 logarithms or exponentials at once and the rest one by one, in other bits.
    Rows of 19 would have other bits in a batch than alone; rows of a whole number of sixteens do
    not.
    """
    width = values.shape[-1]
    whole = nn.functional.pad(values, (0, -width % _LANES), value=1.0)
    return function(whole)[..., :width]


def log_impedance(counts: Tensor) -> Tensor:
    """Logarithm of the impedance, but for a constant; counts are kept one inside of their range."""
    return in_lanes(
        lambda whole: torch.log(COUNTS_MAX / whole.clamp(1.0, COUNTS_MAX - 1.0) - 1.0), counts
    )


def rest_of(trial_rest: FloatArray) -> FloatArray:
    """Untouched counts to assume: the mean of trials (M, 19) [counts]; where none is known, 3200.

    Returns:
        Shape (19,).
    """
    known = np.isfinite(trial_rest)
    total = np.where(known, trial_rest, 0.0).sum(axis=0, dtype=np.float64)
    count = known.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), ASSUMED_REST).astype(np.float32)


ASSUMED_REST = 3200.0
"""Untouched counts of every electrode where the source does not hold them."""
