"""What a few presses with a known force tell of a specimen: an encoder of sets.

Each row of each press is read by itself; then every row says what it holds for true, and with what
weight. Their weighted mean, with a one below for what was known without any press, is the code: no
order counts, no press at all gives zeros, and a second press like the first counts for less than
the first did. Rows of a press share its weight, so that a press is no surer for being sampled fast.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.errors import DatasetError
from palpate_training.datasets.features import ELECTRODES

FloatArray = npt.NDArray[np.float32]

INPUTS = ELECTRODES
"""Changes of the logarithms of the impedance since rest."""


@dataclass(frozen=True, slots=True)
class CalibrationPresses:
    """Presses of one specimen, none or several, whose forces are known.

    Attributes:
        inputs: Changes since rest, as a population's network reads them, shape (M, 19).
        force: [N], sensor frame, shape (M, 3).
        press: Press of each row, shape (M,).

    Raises:
        DatasetError: A shape is not this, or a value is not finite.
    """

    inputs: FloatArray
    force: npt.NDArray[np.floating]
    press: npt.NDArray[np.integer]

    def __post_init__(self) -> None:
        rows = len(self.press)
        for name, values, shape in (
            ("inputs", self.inputs, (rows, INPUTS)),
            ("force", self.force, (rows, 3)),
            ("press", self.press, (rows,)),
        ):
            if np.shape(values) != shape:
                raise DatasetError(
                    f"{name} of the calibration presses has shape {np.shape(values)}, not {shape}",
                    remedy="give the changes of all electrodes and a force for every row",
                )
            if not np.isfinite(values).all():
                raise DatasetError(
                    f"{name} of the calibration presses is not finite everywhere",
                    remedy="leave rows out whose electrodes or force are not known",
                )

    def tensor(self) -> Tensor:
        """Rows as the encoder takes them, shape (M, 23)."""
        _, number, rows = np.unique(self.press, return_inverse=True, return_counts=True)
        share = 1.0 / rows[number] if len(number) else np.zeros(0)
        return torch.from_numpy(
            np.hstack([self.inputs, self.force, share[:, None]]).astype(np.float32)
        )


class PressLayers(nn.Module):
    """What was read of rows ``(..., M, R)``, and their shares ``(..., M)``, -> code ``(..., C)``.

    Args:
        read: Values that are read of a row.
        width: Of the hidden layers.
        code: Values of the code: a half of what is held for true, a half of how sure that is.
    """

    def __init__(self, read: int, width: int, code: int) -> None:
        super().__init__()
        self.row = nn.Sequential(
            nn.Linear(read, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, code),
        )  # fmt: skip

    def forward(self, read: Tensor, share: Tensor) -> Tensor:
        """Code of each set, shape ``(..., C)``."""
        value, weight = self.row(read).chunk(2, dim=-1)
        weight = nn.functional.softplus(weight) * share[..., None]
        total = 1.0 + weight.sum(dim=-2)
        return torch.cat([(weight * value).sum(dim=-2) / total, 1.0 - 1.0 / total], dim=-1)
