"""One network for all specimens of a population, told which by presses of it.

What an electrode reads on touch is the change of the logarithm of its impedance since rest; what
that means depends on the specimen, which presses with a known force tell, as many as there are,
also none (``press_set``). So the layers read the change, and are modulated by the code of the
presses (FiLM: a gain and an offset of every hidden value); besides, the code multiplies the force
by one number.

The electrodes at rest are not read: they name a specimen of the training, which is then known by
heart, and presses count for nothing (training/LOG.md).

A press is read beside what the network makes of it without any: that the forces of a specimen are
wrong by one factor then lies open.

Fluids warm, and a tare is never of the same moment as a touch: that moves all electrodes alike. So
what they have in common is an input of its own, and training moves it at random
(``population_fit``).
"""

from __future__ import annotations

import json
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
from palpate_training.datasets.container import read_archive
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.electrode_nets import MIRROR_AXES, log_impedance
from palpate_training.learning.fit import FitConfig
from palpate_training.learning.press_set import INPUTS, CalibrationPresses, PressLayers

FloatArray = npt.NDArray[np.float32]

WEIGHTS = "population.npz"
"""Where ``palpate train population`` leaves the network in its folder."""

_READ = ELECTRODES + 1
"""What the layers read of inputs: changes less their mean, and that mean."""

_READ_OF_PRESS = _READ + 8
"""What is read of a row of a press: that, the force's direction, the logarithm of its magnitude,
and by what both differ from the estimate without any press."""

_SMALLEST_SD = 1e-6
_SMALLEST_N = 0.1
_FORMAT = "palpate.population-net/3"


@dataclass(frozen=True, slots=True, kw_only=True)
class PopulationConfig(FitConfig):
    """Settings of a training on a population.

    Attributes:
        width: Of the residual layers.
        blocks: Residual blocks, of two layers each.
        told_width: Hidden values between the code and what it modulates.
        press_width: Of the layers that read rows of calibration presses.
        code: Values that calibration presses are summed up in.
        common: Share of what the electrodes have in common that is read; with 0 an offset of all
            of them changes nothing.
        common_sd: Of a training row, standard deviation of the offset of all electrodes.
        offset_sd: The same of each electrode by itself: tares that are off, electrodes that drift.
        gain_sd: Standard deviation of the logarithm of the gain that all electrodes share, and of
            each's own.
        stiffness_sd: Standard deviation of the logarithm of the factor of all forces of a specimen
            whose presses are known: a skin as thick but stiffer, which only a press can tell.
        turn_sd: Of such a specimen, standard deviation of the rotation of its forces about each
            axis [rad]: a finger that sits otherwise than it is believed to.
        force_power: Errors of forces count over ``FORCE_FLOOR_N`` plus the magnitude to this power.
    """

    epochs: int = 60
    patience: int = 30
    batch_rows: int = 4096
    learning_rate: float = 2e-3
    threads: int = 1
    width: int = 256
    blocks: int = 3
    told_width: int = 64
    press_width: int = 128
    code: int = 64
    common: float = 1.0
    common_sd: float = 0.03
    offset_sd: float = 0.005
    gain_sd: float = 0.03
    stiffness_sd: float = 0.3
    turn_sd: float = 0.0
    force_power: float = 0.5


class _ModulatedLayers(nn.Module):
    """Residual layers whose normalised values a code multiplies and moves."""

    def __init__(self, outputs: int, config: PopulationConfig) -> None:
        super().__init__()
        width = config.width
        self.first = nn.Linear(_READ, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(config.blocks))
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in range(config.blocks)
        )
        last = nn.Linear(config.told_width, 2 * width * config.blocks)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.specimen = nn.Sequential(nn.Linear(config.code, config.told_width), nn.SiLU(), last)
        self.head = nn.Linear(width, outputs)

    def forward(self, read: Tensor, code: Tensor) -> Tensor:
        hidden = self.first(read)
        modulation = self.specimen(code)
        parts = modulation.chunk(2 * len(self.blocks), dim=-1)
        for number, (norm, block) in enumerate(zip(self.norms, self.blocks, strict=True)):
            gain, offset = parts[2 * number : 2 * number + 2]
            hidden = hidden + block(norm(hidden) * (1.0 + gain) + offset)
        estimate: Tensor = self.head(nn.functional.silu(hidden))
        return estimate


class PopulationNet(nn.Module):
    """Changes and a code, ``(N, 19 + 2 C)`` -> force [N] and more, ``(N, 3 Q)``.

    The code comes from ``told``: of the presses as they are, then of their mirror image. Without
    one, ``(N, 19)``, the network knows no press.

    The estimate is the mean of that of a row and of its mirror image, the presses mirrored, too: so
    a mirrored row of a specimen whose presses are mirrored gets the mirrored estimate.

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
        codes = INPUTS + np.arange(2 * config.code)
        order = np.concatenate([ELECTRODE_MIRROR, np.roll(codes, config.code)])
        signs = np.tile(MIRROR_AXES, len(self.quantities))
        # Made where the caller's default device is; constants are moved there with the weights.
        self.register_buffer("order", torch.from_numpy(order).long())
        self.register_buffer("signs", torch.from_numpy(signs).float())
        self.register_buffer("input_mean", torch.zeros(_READ))
        self.register_buffer("input_sd", torch.ones(_READ))
        self.register_buffer("output_mean", torch.zeros(outputs))
        self.register_buffer("output_sd", torch.ones(outputs))
        self.layers = _ModulatedLayers(outputs, config)
        self.presses = PressLayers(_READ_OF_PRESS, config.press_width, config.code)
        self.factor = nn.Linear(config.code, 1, bias=False)
        nn.init.zeros_(self.factor.weight)

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimates of rows as they are, and of their mirror images, averaged."""
        inputs = self.with_code(inputs)
        mirrored = torch.index_select(inputs, -1, self.order)
        both = torch.stack([inputs, mirrored], dim=1)[..., : INPUTS + self.config.code]
        estimate = self.one_sided(both)  # (N, 2, O)
        return (estimate[:, 0] + estimate[:, 1] * self.signs) / 2.0

    def with_code(self, inputs: Tensor) -> Tensor:
        """Inputs with the code of no press, where they have none."""
        return nn.functional.pad(inputs, (0, len(self.order) - inputs.shape[-1]))

    def one_sided(self, inputs: Tensor) -> Tensor:
        """Without mirror images, ``(..., 19 + C)`` -> ``(..., O)``: what training sees."""
        known, code = inputs[..., :INPUTS], inputs[..., INPUTS:]
        estimate = self.layers(self.read(known), code) * self.output_sd + self.output_mean
        force = estimate[..., :3] * torch.exp(self.factor(code))
        return torch.cat([force, estimate[..., 3:]], dim=-1)

    def read(self, inputs: Tensor) -> Tensor:
        """What the layers read of changes, standardised, shape ``(..., 20)``."""
        return (self.parts(inputs) - self.input_mean) / self.input_sd

    def parts(self, inputs: Tensor) -> Tensor:
        """The same before it is standardised."""
        mean = inputs.mean(dim=-1, keepdim=True)
        return torch.cat([inputs - mean, self.config.common * mean], dim=-1)

    def code_of(self, presses: Tensor) -> Tensor:
        """Code of sets of rows ``(..., M, 23)``, shape ``(..., C)``."""
        inputs, force, share = torch.split(presses, [INPUTS, 3, 1], dim=-1)
        with torch.no_grad():
            nothing = nn.functional.pad(inputs, (0, self.config.code))
            guess = self.one_sided(nothing)[..., :3]
        way, length = _polar(force)
        guessed_way, guessed_length = _polar(guess)
        differs = [way - guessed_way, length - guessed_length]
        read = torch.cat([self.read(inputs), way, length, *differs], dim=-1)
        code: Tensor = self.presses(read, share[..., 0])
        return code

    def mirrored_presses(self, presses: Tensor) -> Tensor:
        """Mirror image of rows of presses, ``(..., 23)``."""
        inputs, force, share = torch.split(presses, [INPUTS, 3, 1], dim=-1)
        mirrored = torch.index_select(inputs, -1, self.order[:INPUTS])
        return torch.cat([mirrored, force * self.signs[:3], share], dim=-1)

    def told(self, inputs: FloatArray, presses: CalibrationPresses) -> FloatArray:
        """Changes ``(N, 19)`` of a specimen beside the code of presses of it.

        Returns:
            Shape ``(N, 19 + 2 C)``, for ``predict``.
        """
        with torch.inference_mode():
            rows = presses.tensor().to(self.signs.device)
            both = [self.code_of(one) for one in (rows, self.mirrored_presses(rows))]
            code = torch.cat(both).cpu().numpy()
        return np.hstack([inputs, np.tile(code, (len(inputs), 1))])

    def normalise_from(self, inputs: FloatArray, targets: FloatArray) -> None:
        """Set the constants from rows and mirror images; what is not known does not count."""
        both = np.vstack([inputs, inputs[:, self.order[:INPUTS].cpu().numpy()]])
        read = self.parts(torch.from_numpy(both)).double()
        self.input_mean.copy_(read.mean(dim=0))
        # Without a share of it, what is common stays zero whatever it is divided by.
        self.input_sd.copy_(read.std(dim=0).clamp(min=_SMALLEST_SD))
        wanted = np.vstack([targets, targets * self.signs.cpu().numpy()]).astype(np.float64)
        spread = np.maximum(np.nanstd(wanted, axis=0), _SMALLEST_SD)
        self.output_mean.copy_(torch.from_numpy(np.nanmean(wanted, axis=0)))
        self.output_sd.copy_(torch.from_numpy(spread))


def _polar(force: Tensor) -> tuple[Tensor, Tensor]:
    """Direction of forces [N] and logarithm of their magnitude; tiny ones have nearly none."""
    squares = torch.square(force).sum(dim=-1, keepdim=True) + _SMALLEST_N**2
    return force * torch.rsqrt(squares), 0.5 * torch.log(squares)


def inputs_of(counts: npt.NDArray[Any], rest: npt.NDArray[Any]) -> FloatArray:
    """Raw and untouched counts ``(N, 19)`` -> inputs ``(N, 19)``; NumPy, rows by rows the same."""
    now, untouched = (
        np.log(COUNTS_MAX / np.clip(values.astype(np.float64), 1.0, COUNTS_MAX - 1.0) - 1.0)
        for values in (counts, rest)
    )
    return np.asarray((now - untouched).astype(np.float32))


class CountsGraph(nn.Module):
    """Raw and untouched counts and the code, ``(N, 38 + 2 C)`` -> estimates: as it is shipped.

    Presses are encoded once for a finger, not for every frame; a code of zeros is that of none.
    """

    def __init__(self, net: PopulationNet) -> None:
        super().__init__()
        self.net, self.code = net, 2 * net.config.code

    def forward(self, known: Tensor) -> tuple[Tensor]:
        """Estimates, shape ``(N, 3 Q)``."""
        counts, rest, code = torch.split(known, [ELECTRODES, ELECTRODES, self.code], dim=-1)
        change = log_impedance(counts) - log_impedance(rest)
        return (self.net(torch.cat([change, code], dim=-1)),)


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
    remedy = "give the folder that `palpate train population` wrote"
    arrays = read_archive(path, list, remedy=remedy)
    try:
        settings = json.loads(str(arrays.pop("settings")))
        if settings["format"] != _FORMAT:
            raise ValueError(f"format {settings['format']!r}")
        known = {field.name for field in fields(PopulationConfig)}
        config = {name: value for name, value in settings["config"].items() if name in known}
        net = PopulationNet(settings["quantities"], PopulationConfig(**config))
        net.load_state_dict({name: torch.from_numpy(values) for name, values in arrays.items()})
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise DatasetError(
            f"{path} holds no network of a population: {error}", remedy=remedy
        ) from error
    return net.eval()
