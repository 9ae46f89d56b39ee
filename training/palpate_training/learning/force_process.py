"""Force of one finger, learned from a few of its own presses.

A line on tared counts extrapolates well and bends nowhere; Gaussian processes on logarithms of the
impedance follow the film, but a handful of presses says little about the electrodes' common mode,
which the temperature moves. So the magnitude is the mean of a line and of two processes that see
little of the common mode, and the direction is that of two processes that see even less of it:
compared with each of them alone in training/LOG.md. Those of the magnitude learn what a line
through the twin leaves (``TwinLine``), whose scale and axes the presses tell: it holds where the
finger has not been pressed yet.

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
from palpate_training.learning.twin_line import TwinLine, read_line

Floats = npt.NDArray[np.float64]

RIDGE = 1e-2
"""Penalty of the line, over the number of rows; inputs are standardised."""

NOISE = 0.1
"""Variance of a process's noise, over that of the forces: neighbouring rows err together."""

LINEAR = 1.5
"""Share of a process that is a straight line in its inputs."""

LOCALITIES = (0.1, 0.5)
"""``local`` of ``ForceProcesses`` to choose from."""

MAP_PENALTY_N2 = 1.0
"""Penalty of what maps the twin's forces to those of the finger, but for one factor [N^2]."""

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
    """Tared counts (N, 19) -> force [N], shape (N, 3), by a line and four Gaussian processes.

    Args:
        rows: What it is fitted to; at most a few hundred.
        rest: Untouched counts of the finger, shape (19,).
        local: How fast the processes forget: ``exp(-local |a - b|^2 / 19)`` of standardised inputs.
    """

    def __init__(self, rows: KnownRows, rest: Floats, *, local: float) -> None:
        super().__init__()
        self.line = ForceLine(rows)
        self.twin = _OwnLine(read_line(), rows, rest)
        with torch.inference_mode():
            known = self.twin(torch.from_numpy(rows.tared)).numpy()
        left = KnownRows(rows.tared, rows.force - known, rows.press)
        self.magnitude, self.direction = (
            nn.ModuleList(
                _CommonModeProcess(some, rest, common=one, local=local) for one in commons
            )
            for some, commons in ((left, _COMMON_OF_MAGNITUDE), (rows, _COMMON_OF_DIRECTION))
        )

    def forward(self, tared: Tensor) -> Tensor:
        """Forces [N]."""
        twin = self.twin(tared)
        parts = [self.line(tared).double(), *(twin + process(tared) for process in self.magnitude)]
        mean = torch.stack(parts).mean(dim=0)
        magnitude = torch.linalg.vector_norm(mean, dim=1, keepdim=True)
        direction = torch.stack([_unit(process(tared)) for process in self.direction])
        force: Tensor = magnitude * _unit(direction.sum(dim=0))
        return force.float()


class _OwnLine(nn.Module):
    """A line through the twin, mapped to a finger by rows of it."""

    rest: Tensor
    log_rest: Tensor
    weight: Tensor
    offset: Tensor

    def __init__(self, line: TwinLine, rows: KnownRows, rest: Floats) -> None:
        super().__init__()
        for name, values in (("rest", rest), ("weight", line.weight), ("offset", line.offset)):
            self.register_buffer(name, torch.from_numpy(values))
        self.register_buffer("log_rest", log_impedance(self.rest))
        with torch.inference_mode():
            guess = self(torch.from_numpy(rows.tared)).numpy()
        own = line.mapped(guess, rows.force, penalty_n2=MAP_PENALTY_N2)
        self.weight, self.offset = torch.from_numpy(own.weight), torch.from_numpy(own.offset)

    def forward(self, tared: Tensor) -> Tensor:
        """Forces [N], shape (N, 3), double."""
        rise = log_impedance(self.rest + tared.double()) - self.log_rest
        force: Tensor = (rise - rise.mean(dim=1, keepdim=True)) @ self.weight + self.offset
        return force


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
