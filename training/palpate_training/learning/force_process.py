"""Force of one finger, learned from a few of its own presses.

A line on tared counts extrapolates well and bends nowhere; Gaussian processes on logarithms of the
impedance follow the film, but a handful of presses says little about the electrodes' common mode,
which the temperature moves. So the magnitude is the mean of a line and of two processes that see
little of the common mode, and the direction is that of two processes that see even less of it:
compared with each of them alone in training/LOG.md.

Everything is computed in double precision, also in the exported graph: the weights of a process
nearly cancel, and single precision would lose what is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate_training.learning.electrode_nets import log_impedance

Floats = npt.NDArray[np.float64]

RIDGE = 1e-2
"""Penalty of the line, over the number of rows; inputs are standardised."""

NOISE = 0.1
"""Variance of a process's noise, over that of the forces: neighbouring rows err together."""

LINEAR = 1.5
"""Share of a process that is a straight line in its inputs."""

LOCALITIES = (0.1, 0.5)
"""``local`` of ``ForceProcesses`` to choose from."""

_COMMON_OF_MAGNITUDE = (0.1, 0.3)
_COMMON_OF_DIRECTION = (0.0, 0.1)


@dataclass(frozen=True, slots=True)
class KnownRows:
    """Rows of one finger with their force.

    Attributes:
        tared: Tared counts, shape (N, 19).
        force: [N], sensor frame, shape (N, 3).
        press: Press that each row belongs to, shape (N,).
    """

    tared: Floats
    force: Floats
    press: npt.NDArray[np.integer]

    def __len__(self) -> int:
        return len(self.press)

    def where(self, kept: npt.NDArray[np.bool_]) -> KnownRows:
        """Some of the rows."""
        return KnownRows(self.tared[kept], self.force[kept], self.press[kept])


class ForceLine(nn.Module):
    """Tared counts (N, 19) -> force [N], shape (N, 3), by a ridge regression."""

    weight: Tensor
    offset: Tensor

    def __init__(self, rows: KnownRows) -> None:
        """Fit to rows."""
        super().__init__()
        centre, mean = rows.tared.mean(axis=0), rows.force.mean(axis=0)
        spread = _spread(rows.tared)
        scaled = (rows.tared - centre) / spread
        gram = scaled.T @ scaled + RIDGE * len(rows) * np.eye(scaled.shape[1])
        weight = np.linalg.solve(gram, scaled.T @ (rows.force - mean)) / spread[:, None]
        self.register_buffer("weight", torch.from_numpy(weight))
        self.register_buffer("offset", torch.from_numpy(mean - centre @ weight))

    def forward(self, tared: Tensor) -> Tensor:
        """Forces [N]."""
        return (tared.double() @ self.weight + self.offset).float()


class ForceProcesses(nn.Module):
    """Tared counts (N, 19) -> force [N], shape (N, 3), by a line and three Gaussian processes.

    Args:
        rows: What it is fitted to; at most a few hundred.
        rest: Untouched counts of the finger, shape (19,).
        local: How fast the processes forget: ``exp(-local |a - b|^2 / 19)`` of standardised inputs.
    """

    def __init__(self, rows: KnownRows, rest: Floats, *, local: float) -> None:
        super().__init__()
        self.line = ForceLine(rows)
        self._commons = sorted({*_COMMON_OF_MAGNITUDE, *_COMMON_OF_DIRECTION})
        self.processes = nn.ModuleList(
            _CommonModeProcess(rows, rest, common=common, local=local) for common in self._commons
        )

    def forward(self, tared: Tensor) -> Tensor:
        """Forces [N]."""
        forces: dict[float, Tensor] = {
            common: each(tared) for common, each in zip(self._commons, self.processes, strict=True)
        }
        parts = [self.line(tared).double(), *(forces[common] for common in _COMMON_OF_MAGNITUDE)]
        mean = torch.stack(parts).mean(dim=0)
        magnitude = torch.linalg.vector_norm(mean, dim=1, keepdim=True)
        direction = torch.stack([_unit(forces[common]) for common in _COMMON_OF_DIRECTION])
        force: Tensor = magnitude * _unit(direction.sum(dim=0))
        return force.float()


class _CommonModeProcess(nn.Module):
    """Gaussian process whose inputs keep a share of the electrodes' common mode."""

    log_rest: Tensor
    rest: Tensor
    spread: Tensor
    rows: Tensor
    weight: Tensor
    offset: Tensor

    def __init__(self, rows: KnownRows, rest: Floats, *, common: float, local: float) -> None:
        super().__init__()
        self._common, self._local = common, local
        self.register_buffer("rest", torch.from_numpy(rest))
        self.register_buffer("log_rest", log_impedance(self.rest))
        self.register_buffer("spread", torch.ones(len(rest), dtype=torch.float64))
        with torch.inference_mode():
            inputs = self._inputs(torch.from_numpy(rows.tared))
            self.spread = torch.from_numpy(_spread(inputs.numpy()))
            inputs = inputs / self.spread
            force = torch.from_numpy(rows.force)
            mean = force.mean(dim=0)
            noise = NOISE * torch.eye(len(rows), dtype=torch.float64)
            root = torch.linalg.cholesky(self._covariance(inputs, inputs) + noise)
            weight = torch.cholesky_solve(force - mean, root)
        self.register_buffer("rows", inputs)
        self.register_buffer("weight", weight)
        self.register_buffer("offset", mean)

    def forward(self, tared: Tensor) -> Tensor:
        inputs = self._inputs(tared.double()) / self.spread
        return self._covariance(inputs, self.rows) @ self.weight + self.offset

    def _inputs(self, tared: Tensor) -> Tensor:
        rise = log_impedance(self.rest + tared) - self.log_rest
        return rise - (1.0 - self._common) * rise.mean(dim=1, keepdim=True)

    def _covariance(self, a: Tensor, b: Tensor) -> Tensor:
        product = a @ b.T
        squares = (a * a).sum(dim=1, keepdim=True) + (b * b).sum(dim=1) - 2.0 * product
        size = a.shape[1]
        local = torch.exp(-self._local / size * squares)
        return local + LINEAR / size * product


def _spread(inputs: Floats) -> Floats:
    """Of each input; one that never changes counts with one."""
    spread = inputs.std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def _unit(vectors: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(vectors, dim=1, keepdim=True)
    return vectors / length.clamp(min=1e-12)
