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
        twin = read_line()
        guess = twin.force(rest + rows.tared, rest)
        own = twin.mapped(guess, rows.force, penalty_n2=MAP_PENALTY_N2)
        self.twin = MappedLine(own, rest)
        left = rows.force - own.force(rest + rows.tared, rest)

        def processes(wanted: Floats, commons: tuple[float, ...]) -> nn.ModuleList:
            inputs = {one: changes_of(rows.tared, rest, one) for one in commons}
            return nn.ModuleList(
                CommonModeProcess(inputs[one], wanted, rest, common=one, local=local)
                for one in commons
            )

        self.magnitude = processes(left, _COMMON_OF_MAGNITUDE)
        self.direction = processes(rows.force, _COMMON_OF_DIRECTION)

    def forward(self, tared: Tensor) -> Tensor:
        """Forces [N]."""
        twin = self.twin(tared)
        parts = [self.line(tared).double(), *(twin + process(tared) for process in self.magnitude)]
        mean = torch.stack(parts).mean(dim=0)
        magnitude = torch.linalg.vector_norm(mean, dim=1, keepdim=True)
        direction = torch.stack([unit(process(tared)) for process in self.direction])
        force: Tensor = magnitude * unit(direction.sum(dim=0))
        return force.float()


class MappedLine(nn.Module):
    """A line through the twin, mapped to real fingers, as one of them reads: tared counts -> force.

    Args:
        line: The mapped line.
        rest: Untouched counts of the finger, shape (19,).
    """

    rest: Tensor
    weight: Tensor
    offset: Tensor

    def __init__(self, line: TwinLine, rest: Floats) -> None:
        super().__init__()
        for name, values in (("rest", rest), ("weight", line.weight), ("offset", line.offset)):
            self.register_buffer(name, torch.from_numpy(values))

    def forward(self, tared: Tensor) -> Tensor:
        """Forces [N], shape (N, 3), double."""
        force: Tensor = _changes(tared.double(), self.rest, 0.0) @ self.weight + self.offset
        return force


class CommonModeProcess(nn.Module):
    """Gaussian process whose inputs keep a share of the electrodes' common mode.

    Args:
        inputs: What it is fitted to, of any finger, as ``changes_of`` gives them, shape (M, 19).
        wanted: What it estimates there, shape (M, K).
        rest: Untouched counts of the finger that it will estimate for, shape (19,).
        common: Share of the common mode, that of ``inputs``.
        local: As that of ``ForceProcesses``.
    """

    rest: Tensor
    spread: Tensor
    rows: Tensor
    weight: Tensor
    offset: Tensor

    def __init__(
        self, inputs: Floats, wanted: Floats, rest: Floats, *, common: float, local: float
    ) -> None:
        super().__init__()
        self._common, self._local = common, local
        self.register_buffer("rest", torch.from_numpy(rest))
        self.register_buffer("spread", torch.from_numpy(_spread(inputs)))
        rows = torch.from_numpy(inputs) / self.spread
        targets = torch.from_numpy(wanted)
        mean = targets.mean(dim=0)
        noise = NOISE * torch.eye(len(rows), dtype=torch.float64)
        root = torch.linalg.cholesky(self._covariance(rows, rows) + noise)
        self.register_buffer("rows", rows)
        self.register_buffer("weight", torch.cholesky_solve(targets - mean, root))
        self.register_buffer("offset", mean)

    def forward(self, tared: Tensor) -> Tensor:
        """Estimates of tared counts (N, 19), shape (N, K), double."""
        inputs = _changes(tared.double(), self.rest, self._common) / self.spread
        return self._covariance(inputs, self.rows) @ self.weight + self.offset

    def _covariance(self, a: Tensor, b: Tensor) -> Tensor:
        product = a @ b.T
        squares = (a * a).sum(dim=1, keepdim=True) + (b * b).sum(dim=1) - 2.0 * product
        size = a.shape[1]
        local = torch.exp(-self._local / size * squares)
        return local + LINEAR / size * product


def changes_of(tared: Floats, rest: Floats, common: float) -> Floats:
    """Changes of the logarithms of the impedances of rows since rest, shape (N, 19).

    Args:
        tared: Tared counts, shape (N, 19).
        rest: Untouched counts, shape (19,).
        common: Share of the common mode that is kept.
    """
    return np.asarray(_changes(torch.from_numpy(tared), torch.from_numpy(rest), common).numpy())


def _changes(tared: Tensor, rest: Tensor, common: float) -> Tensor:
    change = log_impedance(rest + tared) - log_impedance(rest)
    return change - (1.0 - common) * change.mean(dim=1, keepdim=True)


_CONSTANT = 1e-9
"""A smaller spread, of counts or logarithms, is rounding."""


def _spread(inputs: Floats) -> Floats:
    """Of each input; one that never changes counts with one."""
    spread = inputs.std(axis=0)
    return np.where(spread > _CONSTANT, spread, 1.0)


def unit(vectors: Tensor) -> Tensor:
    """Vectors (N, 3) of length one."""
    length: Tensor = torch.linalg.vector_norm(vectors, dim=1, keepdim=True)
    return vectors / length.clamp(min=1e-12)
