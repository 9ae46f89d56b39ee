"""Force of a finger by what other real fingers taught, and by presses of its own.

Fingers differ in their common mode above all: conductivity and temperature of the fluid. Without it
their electrodes tell forces alike, so what was learned on others holds for a finger that was never
pressed (``systems/transfer.py``, which measures it, and uses moving means, too; a bundle's graph
sees one frame). A finger's own presses know its directions better, but a minute of them says little
of baselines that wander for minutes. So a force is the mean of both, the finger's own counting more
the more presses there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.anatomy import ELECTRODE_MIRROR
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.force_process import (
    LOCALITIES,
    CommonModeProcess,
    Floats,
    ForceProcesses,
    KnownRows,
    MappedLine,
    changes_of,
    unit,
)
from palpate_training.learning.twin_line import read_line

ROWS_OF_FINGER = 450
"""Rows of another finger at most, each used with its mirror image: neighbouring rows err together,
so more of them only sharpen what is wrong."""

ROWS_OF_ALL = 900
"""Rows of all other fingers at most: an estimate costs time for each."""

LOCALITIES_OF_OTHERS = (0.05, 0.1)
"""``local`` of the processes, whose mean counts."""

PRESSES_OF_OTHERS = 20
"""As many presses of its own count as much as all other fingers."""


@dataclass(frozen=True, slots=True)
class OtherFinger:
    """A finger that was pressed against a force sensor.

    Attributes:
        name: For people.
        rows: Rows of its presses.
        rest: Its untouched counts, shape (19,).
        touched: In which rows it is touched, shape (N,).
    """

    name: str
    rows: KnownRows
    rest: Floats
    touched: npt.NDArray[np.bool_]


class OtherFingers(nn.Module):
    """Tared counts (N, 19) -> force [N], shape (N, 3), of a finger that none of these rows is of.

    The magnitude's processes start from a line through the twin, mapped to real fingers.

    Args:
        others: At least one.
        rest: Untouched counts of the finger itself, shape (19,).
    """

    def __init__(self, others: Sequence[OtherFinger], rest: Floats) -> None:
        super().__init__()
        most = min(ROWS_OF_FINGER, ROWS_OF_ALL // len(others))
        some = [(_evenly(other.rows, most), other.rest) for other in others]
        twin = read_line()
        guess = np.vstack([twin.force(own + rows.tared, own) for rows, own in some])
        line = twin.mapped(guess, np.vstack([rows.force for rows, _ in some]))
        inputs, wanted = [], []
        for rows, own in [*some, *(_mirrored(*one) for one in some)]:
            inputs.append(changes_of(rows.tared, own, 0.0))
            left = rows.force - line.force(own + rows.tared, own)
            wanted.append(np.hstack([left, rows.force]))
        self.line = MappedLine(line, rest)
        self.processes = nn.ModuleList(
            CommonModeProcess(np.vstack(inputs), np.vstack(wanted), rest, common=0.0, local=one)
            for one in LOCALITIES_OF_OTHERS
        )

    def forward(self, tared: Tensor) -> Tensor:
        """Forces [N]."""
        line = self.line(tared)
        lengths, directions = [], []
        for process in self.processes:
            left, whole = process(tared).split(3, dim=1)
            lengths.append(torch.linalg.vector_norm(line + left, dim=1, keepdim=True))
            directions.append(unit(whole))
        magnitude = torch.stack(lengths).mean(dim=0)
        force: Tensor = magnitude * unit(torch.stack(directions).sum(dim=0))
        return force.float()


class SharedForce(nn.Module):
    """Tared counts (N, 19) -> force [N], shape (N, 3), by other fingers and the finger's presses.

    Args:
        others: Fitted to other fingers, for this one.
        rows: Of the finger's own presses.
        rest: Its untouched counts, shape (19,).
    """

    def __init__(self, others: OtherFingers, rows: KnownRows, rest: Floats) -> None:
        super().__init__()
        self.others = others
        self.own = ForceProcesses(rows, rest, local=LOCALITIES[-1])
        presses = len(np.unique(rows.press))
        self.share = presses / (presses + PRESSES_OF_OTHERS)

    def forward(self, tared: Tensor) -> Tensor:
        """Forces [N]."""
        own, others = self.own(tared).double(), self.others(tared).double()
        length = [torch.linalg.vector_norm(one, dim=1, keepdim=True) for one in (own, others)]
        magnitude = self.share * length[0] + (1.0 - self.share) * length[1]
        direction = self.share * unit(own) + (1.0 - self.share) * unit(others)
        force: Tensor = magnitude * unit(direction)
        return force.float()


def _evenly(rows: KnownRows, most: int) -> KnownRows:
    kept = np.zeros(len(rows), bool)
    kept[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)] = True
    return rows.where(kept)


def _mirrored(rows: KnownRows, rest: Floats) -> tuple[KnownRows, Floats]:
    """What a finger would have read, had all been its mirror image."""
    return (
        KnownRows(rows.tared[:, ELECTRODE_MIRROR], rows.force * MIRROR_AXES, rows.press),
        rest[ELECTRODE_MIRROR],
    )
