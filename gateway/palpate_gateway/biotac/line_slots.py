"""Slots of all fingers of a line, with their place in the stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from palpate_gateway.biotac.slots import SlotBlock
from palpate_gateway.protocols.can_slots import SlotWords
from palpate_gateway.protocols.places import Floats, Ints, Places
from palpate_gateway.protocols.spi import WordKind

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
    def placed(cls, words: SlotWords, places: Places, size: int) -> Self | None:
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
