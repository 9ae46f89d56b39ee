"""Slots, single and in blocks.

Blocks are structures of arrays, so that a log of 10^5 slots is assembled by a few NumPy calls and a
live bus by blocks of one frame.


Slots of all fingers of a line, with their place in the stream.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from palpate_gateway.protocols.can_slots import SlotWords
from palpate_gateway.protocols.slot_clock import Floats, Ints, SlotPlaces
from palpate_gateway.protocols.spi import WordKind

UNKNOWN = -1
"""Position of a slot whose source tells channels and frames only, e.g. a text log."""


class Slot(NamedTuple):
    """One sampled channel: id, raw counts, parity good, device time [s], batch and frame index.

    ``position`` is its place in the sampling round from 0; ``UNKNOWN`` if the source does not tell.
    """

    channel: int
    value: int
    good: bool
    time_s: float
    batch: int
    frame: int
    position: int = UNKNOWN


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
        position: Place in the sampling round from 0, int64; ``UNKNOWN`` where the source does not
            tell. Slots of one frame are either all told or all unknown. It places PAC, whose
            samples look alike; all other channels are known by their id.
    """

    channel: npt.NDArray[np.int64]
    value: npt.NDArray[np.uint16]
    good: npt.NDArray[np.bool_]
    time_s: npt.NDArray[np.float64]
    batch: npt.NDArray[np.int64]
    frame: npt.NDArray[np.int64]
    position: npt.NDArray[np.int64]

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
            self.position[cut],
        )

    def followed_by(self, other: SlotBlock) -> SlotBlock:
        """These slots and then those of another block."""
        return SlotBlock.joined([self, other])

    @staticmethod
    def joined(blocks: Sequence[SlotBlock]) -> SlotBlock:
        """Consecutive blocks, one at least, as one."""
        blocks = [block for block in blocks if len(block)] or blocks[:1]
        if len(blocks) == 1:
            return blocks[0]
        return SlotBlock(
            np.concatenate([block.channel for block in blocks]),
            np.concatenate([block.value for block in blocks]),
            np.concatenate([block.good for block in blocks]),
            np.concatenate([block.time_s for block in blocks]),
            np.concatenate([block.batch for block in blocks]),
            np.concatenate([block.frame for block in blocks]),
            np.concatenate([block.position for block in blocks]),
        )


def slot_block(slots: Sequence[Slot]) -> SlotBlock:
    """Arrange single slots as a block."""
    columns = list(zip(*slots, strict=True)) or [()] * 7
    return SlotBlock(
        np.array(columns[0], np.int64),
        np.array(columns[1], np.uint16),
        np.array(columns[2], np.bool_),
        np.array(columns[3], np.float64),
        np.array(columns[4], np.int64),
        np.array(columns[5], np.int64),
        np.array(columns[6], np.int64),
    )


_GOOD = WordKind.GOOD.value
"""Of an enum costs as much as the comparison."""


@dataclass(frozen=True, slots=True)
class LineSlots:
    """Consecutive slots of a line; arrays of shape ``(N,)``, words ``(N, fingers)``.

    Attributes:
        channel: Channel indices.
        value: Raw counts of each finger, 0 where not good, uint16.
        kind: ``WordKind`` numbers of each finger, uint8.
        run: Counts connections and changes of the sequence.
        frame: Frame numbers.
        position: Places in the sequence.
        time_s: When they were sampled [s].
        size: Slots of a frame.
    """

    channel: Ints
    value: npt.NDArray[np.uint16]
    kind: npt.NDArray[np.uint8]
    run: Ints
    frame: Ints
    position: Ints
    time_s: Floats
    size: int

    @classmethod
    def placed(cls, words: SlotWords, places: SlotPlaces, size: int) -> Self | None:
        """Words that have a place; None if none has.

        Args:
            words: Of all slots.
            places: Of some of them.
            size: Slots of a frame.
        """
        if not len(places):
            return None
        kept = places.kept
        return cls(
            words.channel[kept],
            words.value[kept],
            words.kind[kept],
            places.run,
            places.frame,
            places.position,
            places.time_s,
            size,
        )

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Consecutive parts, one at least, as one."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            np.concatenate([part.channel for part in parts]),
            np.concatenate([part.value for part in parts]),
            np.concatenate([part.kind for part in parts]),
            np.concatenate([part.run for part in parts]),
            np.concatenate([part.frame for part in parts]),
            np.concatenate([part.position for part in parts]),
            np.concatenate([part.time_s for part in parts]),
            parts[-1].size,
        )

    def __len__(self) -> int:
        return len(self.channel)

    def part(self, start: int, stop: int) -> LineSlots:
        """Slots ``start`` to ``stop - 1`` as views."""
        cut = slice(start, stop)
        return LineSlots(
            self.channel[cut],
            self.value[cut],
            self.kind[cut],
            self.run[cut],
            self.frame[cut],
            self.position[cut],
            self.time_s[cut],
            self.size,
        )

    def over(self) -> int:
        """How many of the slots belong to frames that are over, as far as these slots tell."""
        if self.position[-1] == self.size - 1:
            return len(self)
        earlier = np.flatnonzero((self.frame != self.frame[-1]) | (self.run != self.run[-1]))
        return int(earlier[-1]) + 1 if len(earlier) else 0

    def goes_on_with(self, after: LineSlots) -> bool:
        """Whether the slots after these begin in the frame in which these end."""
        return bool(self.frame[-1] == after.frame[0] and self.run[-1] == after.run[0])

    def of(self, finger: int) -> SlotBlock:
        """One finger's slots, by its index."""
        good = self.kind[:, finger] == _GOOD
        return SlotBlock(
            self.channel,
            self.value[:, finger],
            good,
            self.time_s,
            self.run,
            self.frame,
            self.position,
        )
