"""Slots, single and in blocks.

Blocks are structures of arrays, so that a log of 10^5 slots is assembled by a few NumPy calls and a
live bus by blocks of one frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class Slot(NamedTuple):
    """One sampled channel: id, raw counts, parity good, device time [s], batch and frame index."""

    channel: int
    value: int
    good: bool
    time_s: float
    batch: int
    frame: int


@dataclass(frozen=True, slots=True)
class SlotBlock:
    """Consecutive slots of one finger as arrays of shape ``(N,)``.

    Attributes:
        channel: Channel ids, int64.
        value: Raw counts, uint16.
        good: Parity good, bool.
        time_s: Device time [s], float64.
        batch: Batch index, int64.
        frame: Frame index, int64.
    """

    channel: npt.NDArray[np.int64]
    value: npt.NDArray[np.uint16]
    good: npt.NDArray[np.bool_]
    time_s: npt.NDArray[np.float64]
    batch: npt.NDArray[np.int64]
    frame: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.channel)

    def part(self, start: int, stop: int) -> SlotBlock:
        """Slots ``start`` to ``stop - 1`` as views."""
        cut = slice(start, stop)
        return SlotBlock(
            self.channel[cut],
            self.value[cut],
            self.good[cut],
            self.time_s[cut],
            self.batch[cut],
            self.frame[cut],
        )

    def followed_by(self, other: SlotBlock) -> SlotBlock:
        """These slots and then those of another block."""
        return SlotBlock(
            np.concatenate([self.channel, other.channel]),
            np.concatenate([self.value, other.value]),
            np.concatenate([self.good, other.good]),
            np.concatenate([self.time_s, other.time_s]),
            np.concatenate([self.batch, other.batch]),
            np.concatenate([self.frame, other.frame]),
        )


def slot_block(slots: Sequence[Slot]) -> SlotBlock:
    """Arrange single slots as a block."""
    columns = list(zip(*slots, strict=True)) or [()] * 6
    return SlotBlock(
        np.array(columns[0], np.int64),
        np.array(columns[1], np.uint16),
        np.array(columns[2], np.bool_),
        np.array(columns[3], np.float64),
        np.array(columns[4], np.int64),
        np.array(columns[5], np.int64),
    )
