"""Slots in blocks: of one finger, and of all fingers that share a line.

Blocks are structures of arrays, so that a log of 10^5 slots is assembled by a few NumPy calls and a
live bus by blocks of one frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Self

import numpy as np
import numpy.typing as npt

from palpate_gateway.protocols.can_slots import SlotWords
from palpate_gateway.protocols.silences import Floats
from palpate_gateway.protocols.slot_clock import Ints, SlotPlaces
from palpate_gateway.protocols.spi import WordKind

UNKNOWN = -1
"""Position of a slot whose source tells channels and frames only, e.g. a text log."""

_GOOD = WordKind.GOOD.value
"""A plain number: looking up a member of an enum costs as much as the comparison."""


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
            tell it. Within a frame either all positions are known or none. The position identifies
            PAC samples, which look alike; all other channels are known by their id.
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
        # Spelled out, as it runs for every block: a loop over the columns takes 1.5 times as long.
        return SlotBlock(
            self.channel[cut],
            self.value[cut],
            self.good[cut],
            self.time_s[cut],
            self.batch[cut],
            self.frame[cut],
            self.position[cut],
        )

    @staticmethod
    def joined(blocks: Sequence[SlotBlock]) -> SlotBlock:
        """Consecutive blocks, one at least, as one."""
        blocks = [block for block in blocks if len(block)] or blocks[:1]
        if len(blocks) == 1:
            return blocks[0]
        columns = zip(*map(_BLOCK_COLUMNS, blocks), strict=True)
        return SlotBlock(*map(np.concatenate, columns))


_BLOCK_COLUMNS = attrgetter(*SlotBlock.__slots__)

NO_SLOTS = SlotBlock(*(np.zeros(0, kind) for kind in (int, np.uint16, bool, float, int, int, int)))


@dataclass(frozen=True, slots=True)
class LineSlots:
    """Consecutive slots of a line; arrays of shape ``(N,)``, words ``(N, fingers)``.

    Attributes:
        size: Slots of a frame.
        channel: Channel indices.
        value: Raw counts of each finger, 0 where not good, uint16.
        kind: ``WordKind`` numbers of each finger, uint8.
        run: Counts connections and changes of the sequence.
        frame: Frame numbers.
        position: Places in the sequence.
        time_s: When they were sampled [s].
    """

    size: int
    channel: Ints
    value: npt.NDArray[np.uint16]
    kind: npt.NDArray[np.uint8]
    run: Ints
    frame: Ints
    position: Ints
    time_s: Floats

    @classmethod
    def placed(cls, words: SlotWords, places: SlotPlaces, size: int) -> Self | None:
        """Those of the words that have a place, in frames of ``size`` slots; None if none has."""
        if not len(places):
            return None
        kept = places.kept
        return cls(
            size,
            words.channel[kept],
            words.value[kept],
            words.kind[kept],
            places.run,
            places.frame,
            places.position,
            places.time_s,
        )

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Consecutive parts, one at least, as one."""
        if len(parts) == 1:
            return parts[0]
        columns = zip(*map(_LINE_COLUMNS, parts), strict=True)
        return cls(parts[-1].size, *map(np.concatenate, columns))

    def __len__(self) -> int:
        return len(self.channel)

    def part(self, start: int, stop: int) -> LineSlots:
        """Slots ``start`` to ``stop - 1`` as views."""
        cut = slice(start, stop)
        return LineSlots(
            self.size,
            self.channel[cut],
            self.value[cut],
            self.kind[cut],
            self.run[cut],
            self.frame[cut],
            self.position[cut],
            self.time_s[cut],
        )

    def over(self) -> int:
        """How many of the slots belong to frames that have ended, as far as these slots show."""
        if self.position[-1] == self.size - 1:
            return len(self)
        earlier = np.flatnonzero((self.frame != self.frame[-1]) | (self.run != self.run[-1]))
        return int(earlier[-1]) + 1 if len(earlier) else 0

    def goes_on_with(self, after: LineSlots) -> bool:
        """Whether the slots after these begin in the frame in which these end."""
        return bool(self.frame[-1] == after.frame[0] and self.run[-1] == after.run[0])

    def of(self, finger: int) -> SlotBlock:
        """One finger's slots, by its index."""
        return SlotBlock(
            self.channel,
            self.value[:, finger],
            self.kind[:, finger] == _GOOD,
            self.time_s,
            self.run,
            self.frame,
            self.position,
        )


_LINE_COLUMNS = attrgetter(*LineSlots.__slots__[1:])
