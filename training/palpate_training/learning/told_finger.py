"""A finger that is like those of a simulated population: its network, told by presses of it.

The network that ships is of 30,000 presses on thirty fingertips (docs/results/population.md). It
estimates more than a force/torque sensor tells: where and in which direction the skin is touched,
too. How far that may be off is known of simulated specimens that it had not met.

    palpate train population features.h5 OUT     leaves OUT/population.npz and .json
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.errors import DatasetError
from palpate.files.intervals import BOUND_UNITS, BoundFormula
from palpate_training.learning.electrode_nets import log_impedance
from palpate_training.learning.force_process import KnownRows
from palpate_training.learning.population_fit import TOUCHED_N
from palpate_training.learning.population_net import (
    WEIGHTS,
    PopulationNet,
    inputs_of,
    load_population_net,
)
from palpate_training.learning.press_set import INPUTS, CalibrationPresses

Floats = npt.NDArray[np.float64]
FloatArray = npt.NDArray[np.float32]

REPORT = "population.json"
"""What a training says of its network, beside the weights."""


@dataclass(frozen=True, slots=True)
class ToldNetwork:
    """A population's network, and how far it is off on specimens that it has not met.

    Attributes:
        net: The network.
        contact_sd: Of what only a contact has, by name, as ``FeaturesGraph`` takes it.
        bounds: Of errors, by name, as far as they are known.
        source: What is known of it, for people.
    """

    net: PopulationNet
    contact_sd: dict[str, FloatArray]
    bounds: dict[str, BoundFormula]
    source: str


def read_told_network(folder: Path) -> ToldNetwork:
    """Read what ``palpate train population`` left in a folder.

    Raises:
        DatasetError: There is no network, or it is damaged.
    """
    net = load_population_net(folder / WEIGHTS)
    path = folder / REPORT
    try:
        told = json.loads(path.read_text(encoding="utf-8"))["told"]
        return ToldNetwork(
            net,
            {name: np.asarray(told["sd"][name], np.float32) for name in net.quantities[1:]},
            {
                name: BoundFormula(name, BOUND_UNITS[name], tuple(weights))
                for name, weights in told["bounds"].items()
            },
            f"{told['specimens']} simulated specimens that the network had not met,"
            f" {told['shots']} presses of each known",
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} does not say how far its network is off: {error!r}",
            remedy="give the folder that `palpate train population` wrote",
        ) from error


@cache
def shipped_network() -> ToldNetwork:
    """The one that ships."""
    return read_told_network(Path(str(files("palpate_training") / "samples")))


class ToldFinger(nn.Module):
    """Tared counts (N, 19) -> force [N] and what only a contact has, shape (N, 3 Q), of one finger.

    Args:
        rows: Of presses of the finger.
        rest: Untouched counts of it, shape (19,).
        told: The network; None = the one that ships.
    """

    rest: Tensor
    log_rest: Tensor
    code: Tensor

    def __init__(self, rows: KnownRows, rest: Floats, told: ToldNetwork | None = None) -> None:
        super().__init__()
        self.told = told or shipped_network()
        self.net = self.told.net
        pressed = rows.where(np.linalg.norm(rows.force, axis=1) >= TOUCHED_N)
        presses = CalibrationPresses(
            inputs_of(pressed.tared + rest, np.broadcast_to(rest, pressed.tared.shape)),
            pressed.force,
            pressed.press,
        )
        code = self.net.told(np.zeros((1, INPUTS), np.float32), presses)[:, INPUTS:]
        untouched = torch.from_numpy(rest.astype(np.float32))
        for name, value in (
            ("rest", untouched),
            ("log_rest", log_impedance(untouched)),
            ("code", torch.from_numpy(code.astype(np.float32))),
        ):
            self.register_buffer(name, value)

    @property
    def output_sd(self) -> Tensor:
        """Standard deviation of the training targets, shape ``(3 Q,)``."""
        return self.net.output_sd

    def forward(self, tared: Tensor) -> Tensor:
        """Estimates of tared counts."""
        change = log_impedance(self.rest + tared.float()) - self.log_rest
        code = self.code.expand(tared.shape[0], -1)
        estimate: Tensor = self.net(torch.cat([change, code], dim=1))
        return estimate
