"""One network for all specimens of a population, told which by its untouched electrodes.

What an electrode reads on touch is the change of the logarithm of its impedance since rest; what
that means depends on the specimen, and its rest says something about that. So the layers read the
change, and are modulated by the rest (FiLM: a gain and an offset of every hidden value).

Fluids warm, and a tare is never of the same moment as a touch: that moves all electrodes alike. So
what they have in common is an input of its own, and training moves it at random; besides, every
electrode of a training row gets a gain and an offset of its own.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate.messages import COUNTS_MAX
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.electrode_nets import MIRROR_AXES, NOISE_COUNTS, log_impedance
from palpate_training.learning.fit import FitConfig, OnEpoch, fit
from palpate_training.learning.networks import predict

FloatArray = npt.NDArray[np.float32]

INPUTS = 2 * ELECTRODES
"""Changes of the logarithms of the impedance since rest, then these logarithms at rest."""

WEIGHTS = "population.npz"
"""Where ``palpate train population`` leaves the network in its folder."""

_READ = 2 * (ELECTRODES + 1)
"""What the layers read of them: changes less their mean, that mean, and the same of the rest."""

_SMALLEST_SD = 1e-6
_SMOOTH = 1e-4  # of a normalised distance's square, so that its root has a slope at zero
_FORMAT = "palpate.population-net/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class PopulationConfig(FitConfig):
    """Settings of a training on a population.

    Attributes:
        width: Of the residual layers.
        blocks: Residual blocks, of two layers each.
        rest_width: Hidden values between the rest and what it modulates.
        common: Share of what the electrodes have in common that is read; with 0 an offset of all
            of them changes nothing.
        common_sd: Of a training row, standard deviation of the offset of all electrodes.
        offset_sd: The same of each electrode by itself: tares that are off, electrodes that drift.
        gain_sd: Of each electrode, standard deviation of the logarithm of its gain.
        rest_sd: The same of what each electrode at rest is off by; keeps specimens of the training
            from being known by heart.
        force_power: Errors of forces count over ``FORCE_FLOOR_N`` plus the magnitude to this power.
    """

    epochs: int = 100
    patience: int = 30
    batch_rows: int = 4096
    learning_rate: float = 2e-3
    threads: int = 1
    width: int = 256
    blocks: int = 3
    rest_width: int = 48
    common: float = 1.0
    common_sd: float = 0.05
    offset_sd: float = 0.01
    gain_sd: float = 0.1
    rest_sd: float = 0.05
    force_power: float = 0.75


FORCE_FLOOR_N = 0.5


class _RestLayers(nn.Module):
    """Residual layers whose normalised values the rest multiplies and moves."""

    def __init__(self, outputs: int, config: PopulationConfig) -> None:
        super().__init__()
        width, half = config.width, _READ // 2
        self.first = nn.Linear(half, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(config.blocks))
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in range(config.blocks)
        )
        last = nn.Linear(config.rest_width, 2 * width * config.blocks)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.rest = nn.Sequential(nn.Linear(half, config.rest_width), nn.SiLU(), last)
        self.head = nn.Linear(width, outputs)

    def hidden(self, read: Tensor) -> Tensor:
        """Values before the last layer, shape ``(N, width)``."""
        change, rest = read.chunk(2, dim=-1)
        hidden = self.first(change)
        parts = self.rest(rest).chunk(2 * len(self.blocks), dim=-1)
        for number, (norm, block) in enumerate(zip(self.norms, self.blocks, strict=True)):
            gain, offset = parts[2 * number : 2 * number + 2]
            hidden = hidden + block(norm(hidden) * (1.0 + gain) + offset)
        return nn.functional.silu(hidden)

    def forward(self, read: Tensor) -> Tensor:
        estimate: Tensor = self.head(self.hidden(read))
        return estimate


class PopulationNet(nn.Module):
    """Changes and rest ``(N, 38)`` -> force [N] and further quantities, ``(N, 3 Q)``.

    The estimate is the mean of that of a row and of its mirror image, so a mirrored row gets the
    mirrored estimate.

    Args:
        quantities: Names of what it estimates, three values each; the first is the force.
        config: Its settings.
    """

    order: Tensor
    signs: Tensor
    input_mean: Tensor
    input_sd: Tensor
    output_mean: Tensor
    output_sd: Tensor

    def __init__(self, quantities: Sequence[str], config: PopulationConfig) -> None:
        super().__init__()
        self.quantities, self.config = tuple(quantities), config
        outputs = 3 * len(self.quantities)
        order = np.concatenate([ELECTRODE_MIRROR, ELECTRODE_MIRROR + ELECTRODES])
        signs = np.tile(MIRROR_AXES, len(self.quantities))
        # Made where the caller's default device is; constants are moved there with the weights.
        self.register_buffer("order", torch.from_numpy(order).long())
        self.register_buffer("signs", torch.from_numpy(np.stack([np.ones_like(signs), signs]) / 2))
        self.register_buffer("input_mean", torch.zeros(_READ))
        self.register_buffer("input_sd", torch.ones(_READ))
        self.register_buffer("output_mean", torch.zeros(outputs))
        self.register_buffer("output_sd", torch.ones(outputs))
        self.layers = _RestLayers(outputs, config)

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimates of rows as they are, and of their mirror images, averaged."""
        mirrored = torch.index_select(inputs, -1, self.order)
        both = torch.stack([inputs, mirrored], dim=1)
        return (self.one_sided(both) * self.signs).sum(dim=1)  # (N, 2, O) -> (N, O)

    def one_sided(self, inputs: Tensor) -> Tensor:
        """Estimates of rows without their mirror images: what training sees."""
        estimate: Tensor = self.layers(self.read(inputs)) * self.output_sd + self.output_mean
        return estimate

    def read(self, inputs: Tensor) -> Tensor:
        """What the layers read of inputs, standardised, shape ``(N, 40)``."""
        return (self.parts(inputs) - self.input_mean) / self.input_sd

    def parts(self, inputs: Tensor) -> Tensor:
        """The same before it is standardised."""
        change, rest = inputs.chunk(2, dim=-1)
        mean, rest_mean = (part.mean(dim=-1, keepdim=True) for part in (change, rest))
        common = self.config.common * mean
        return torch.cat([change - mean, common, rest - rest_mean, rest_mean], dim=-1)

    def hidden(self, inputs: Tensor) -> Tensor:
        """Values before the last layer, even and odd ones of a mirror image, ``(N, 2 width)``."""
        mirrored = torch.index_select(inputs, -1, self.order)
        one, other = (self.layers.hidden(self.read(rows)) for rows in (inputs, mirrored))
        return torch.cat([one + other, one - other], dim=-1) / 2.0

    def normalise_from(self, inputs: Tensor, targets: FloatArray) -> None:
        """Set the constants; where a quantity is not known it does not count."""
        read = self.parts(inputs).double()
        self.input_mean.copy_(read.mean(dim=0))
        # Without a share of it, what is common stays zero whatever it is divided by.
        self.input_sd.copy_(read.std(dim=0).clamp(min=_SMALLEST_SD))
        wanted = targets.astype(np.float64)
        spread = np.maximum(np.nanstd(wanted, axis=0), _SMALLEST_SD)
        self.output_mean.copy_(torch.from_numpy(np.nanmean(wanted, axis=0)))
        self.output_sd.copy_(torch.from_numpy(spread))

    def noisy(self, inputs: Tensor) -> Tensor:
        """Inputs with noise, gains and offsets, drawn for each row."""
        config = self.config
        change, rest = inputs.chunk(2, dim=-1)
        share = torch.sigmoid(-(change + rest))  # counts over full scale
        noise = NOISE_COUNTS / COUNTS_MAX * torch.randn_like(change)
        noise = noise / (share * (1.0 - share)).clamp(min=1e-3)
        offset = config.offset_sd * torch.randn_like(change)
        common = config.common_sd * torch.randn_like(change[..., :1])
        gain = torch.exp(config.gain_sd * torch.randn_like(change))
        rest_noise = config.rest_sd * torch.randn_like(rest)
        return torch.cat([gain * change + noise + offset + common, rest + rest_noise], dim=-1)


def inputs_of(counts: npt.NDArray[Any], rest: npt.NDArray[Any]) -> FloatArray:
    """Raw and untouched counts ``(N, 19)`` -> inputs ``(N, 38)``; NumPy, rows by rows the same."""
    now, untouched = (
        np.log(COUNTS_MAX / np.clip(values.astype(np.float64), 1.0, COUNTS_MAX - 1.0) - 1.0)
        for values in (counts, rest)
    )
    return np.hstack([now - untouched, untouched]).astype(np.float32)


def hidden_values(net: PopulationNet, inputs: FloatArray) -> npt.NDArray[np.float64]:
    """Values before the last layer of rows ``(N, 38)``, as ``PopulationNet.hidden`` has them."""
    with torch.inference_mode():
        parts = [net.hidden(part) for part in torch.split(torch.from_numpy(inputs), 8192)]
    return np.asarray(torch.cat(parts).numpy(), np.float64)


def hidden_axes(net: PopulationNet, inputs: FloatArray, count: int) -> npt.NDArray[np.float64]:
    """Principal axes of the hidden values of rows, first ``count`` even, then as many odd ones.

    Returns:
        Shape ``(2 width, 2 count)``.
    """
    some = hidden_values(net, inputs[:: max(1, len(inputs) // 2000)])
    width = some.shape[1] // 2
    axes = np.zeros((2 * width, 2 * count))
    for kind in range(2):
        own = slice(kind * width, (kind + 1) * width)
        values = some[:, own] - (0.0 if kind else some[:, own].mean(axis=0))
        principal = np.linalg.svd(values, full_matrices=False)[2]
        axes[own, kind * count : (kind + 1) * count] = principal[:count].T
    return axes


class CountsGraph(nn.Module):
    """Raw counts and untouched counts ``(N, 38)`` -> estimates: the network as it is shipped."""

    def __init__(self, net: PopulationNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, counts: Tensor) -> tuple[Tensor]:
        """Estimates, shape ``(N, 3 Q)``."""
        now, rest = (log_impedance(half) for half in counts.chunk(2, dim=-1))
        return (self.net(torch.cat([now - rest, rest], dim=-1)),)


@dataclass(frozen=True, slots=True)
class PopulationRows:
    """Rows to learn from or to stop on.

    Attributes:
        inputs: As ``inputs_of`` gives them, shape ``(N, 38)``.
        targets: Force [N], then what only a contact has, shape ``(N, 3 Q)``; NaN where there is
            none.
    """

    inputs: FloatArray
    targets: FloatArray


def fit_population(
    train: PopulationRows,
    validation: Sequence[PopulationRows],
    quantities: Sequence[str],
    *,
    config: PopulationConfig,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> PopulationNet:
    """Train on torch's default device; the weights of the best epoch are kept.

    Args:
        train: Rows to learn from; their mirror images are learned from, too.
        validation: Sets of rows to stop on; the mean of their scores counts.
        quantities: Names of the targets, three values each.
        config: Settings.
        seed: Of the weights, the order of the rows and the noise.
        on_epoch: Called after each epoch, for a progress bar.
    """
    torch.manual_seed(seed)
    with torch.device("cpu"):
        net = PopulationNet(quantities, config)
        order, signs = net.order.numpy(), np.tile(MIRROR_AXES, len(quantities))
        inputs = np.vstack([train.inputs, train.inputs[:, order]])
        targets = np.vstack([train.targets, train.targets * signs])
        net.normalise_from(torch.from_numpy(inputs), targets)
        sizes = sizes_of(train.targets)
    fit(
        _OneSided(net),
        inputs,
        targets,
        loss_of=lambda estimate, truth: _loss(sizes, config.force_power, estimate, truth),
        score_of=lambda _: float(
            np.mean([score_of(predict(net, rows.inputs), rows.targets) for rows in validation])
        ),
        config=config,
        augment=lambda batch, _: net.noisy(batch),
        on_epoch=on_epoch,
    )
    return net.cpu().eval()


class _OneSided(nn.Module):
    """The network as it is trained: both sides of a finger are rows of their own."""

    def __init__(self, net: PopulationNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, inputs: Tensor) -> Tensor:
        return self.net.one_sided(inputs)


def sizes_of(targets: FloatArray) -> list[float]:
    """Root mean square distance of each quantity from its mean."""
    parts = np.split(targets.astype(np.float64), targets.shape[1] // 3, axis=1)
    return [max(1e-9, float(np.sqrt(np.nansum(np.nanvar(part, axis=0))))) for part in parts]


def _loss(sizes: Sequence[float], power: float, estimate: Tensor, wanted: Tensor) -> Tensor:
    """Sum over the quantities of the mean distance: of a force over its magnitude, else spread."""
    total = torch.zeros((), device=estimate.device)
    parts = zip(torch.split(estimate, 3, dim=1), torch.split(wanted, 3, dim=1), strict=True)
    for number, (guess, truth) in enumerate(parts):
        known = ~torch.isnan(truth[:, 0])
        error = torch.where(known[:, None], guess - torch.nan_to_num(truth), 0.0)
        if number == 0:
            magnitude = torch.linalg.vector_norm(torch.nan_to_num(truth), dim=1, keepdim=True)
            error = error / (FORCE_FLOOR_N + magnitude) ** power
        else:
            error = error / sizes[number]
        distance = torch.sqrt(torch.square(error).sum(dim=1) + _SMOOTH)
        total = total + (distance * known).sum() / known.sum().clamp(min=1)
    return total


def score_of(estimate: FloatArray, targets: FloatArray) -> float:
    """Force: median error over floor and magnitude; of all others over their spread; summed."""
    total = 0.0
    for number, size in enumerate(sizes_of(targets)):
        part = slice(3 * number, 3 * number + 3)
        if np.isnan(targets[:, part]).all():
            continue
        distance = np.linalg.norm(estimate[:, part] - targets[:, part], axis=1)
        if number == 0:
            distance = distance / (FORCE_FLOOR_N + np.linalg.norm(targets[:, part], axis=1))
            size = 1.0
        total += float(np.nanmedian(distance)) / size
    return total


def save_population_net(path: Path, net: PopulationNet) -> None:
    """Write weights and settings as plain arrays (.npz), whole or not at all.

    Raises:
        DatasetError: The disk refused.
    """
    settings = {"format": _FORMAT, "quantities": net.quantities, "config": asdict(net.config)}
    arrays = {name: values.detach().cpu().numpy() for name, values in net.state_dict().items()}
    with written_whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, settings=np.array(json.dumps(settings)), **arrays)


def load_population_net(path: Path) -> PopulationNet:
    """Read what ``save_population_net`` wrote.

    Raises:
        DatasetError: There is no such file, or it holds something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        settings = json.loads(str(arrays.pop("settings")))
        if settings["format"] != _FORMAT:
            raise ValueError(f"format {settings['format']!r}")
        known = {field.name for field in fields(PopulationConfig)}
        config = {name: value for name, value in settings["config"].items() if name in known}
        net = PopulationNet(settings["quantities"], PopulationConfig(**config))
        net.load_state_dict({name: torch.from_numpy(values) for name, values in arrays.items()})
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, zipfile.BadZipFile) as error:
        raise DatasetError(
            f"{path} holds no network of a population: {error}",
            remedy="give the folder that `palpate train population` wrote",
        ) from error
    return net.eval()
