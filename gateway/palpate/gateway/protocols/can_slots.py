"""BioTac slots on a CAN bus (format A, hardware reference 2.1): a frame per sampled channel.

Byte 0 is the sampling command, then comes one word per finger exactly as clocked from SPI. The
public driver that shows this format is for the NumaTac; that a BioTac sends the same is a
well-founded inference, never confirmed by a public capture. Frames carry no number:
``slot_clock.SlotClock`` finds their place by the order of the channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from palpate.gateway.protocols import channels as ch
from palpate.gateway.protocols.spi import (
    ERROR_WORDS,
    Word,
    WordKind,
    channel_of_command,
    decode_word,
)

CAN_FINGERS_MAX = 3
"""Words that fit a classic CAN frame behind the command."""

FINGERS_MAX = 5
"""Ports of the maker's larger board (hardware reference 1.8)."""


def _error_key(meaning: str) -> str:
    return "device_error_" + meaning.replace(" ", "_").replace("-", "_")


_FINGER_KEYS = ("parity_errors", "absent", "suspicious", *map(_error_key, ERROR_WORDS.values()))


@dataclass(frozen=True, slots=True)
class SlotWords:
    """One sampled channel of all fingers.

    Attributes:
        channel: Channel index, a key of ``channels.CHANNEL_NAMES``.
        words: What each finger answered, in order of the ports.
    """

    channel: int
    words: tuple[Word, ...]


class SlotDecoder:
    """Command and words of a slot, as a CAN frame or the project's own bridge carries them.

    ``counters`` counts slots and what was refused whole; ``finger_counters`` has one dictionary per
    finger, in order of the ports, that counts words which are not good, and suspicious ones.

    Args:
        fingers: Words in each slot, 1..5.
    """

    def __init__(self, *, fingers: int) -> None:
        if not 1 <= fingers <= FINGERS_MAX:
            raise ValueError(f"{fingers} fingers are not in 1..{FINGERS_MAX}")
        self._fingers = fingers
        self.counters: dict[str, int] = dict.fromkeys(
            ("slots", "bad_commands", "unknown_channels", "short_slots"), 0
        )
        self.finger_counters: tuple[dict[str, int], ...] = tuple(
            dict.fromkeys(_FINGER_KEYS, 0) for _ in range(fingers)
        )

    def decode(self, payload: bytes) -> SlotWords | None:
        """Decode one slot; None if it is none. Bytes behind the last finger's are ignored."""
        channel = channel_of_command(payload[0]) if payload else None
        if channel is None:
            self.counters["bad_commands"] += 1
            return None
        if channel not in ch.CHANNEL_NAMES:
            self.counters["unknown_channels"] += 1
            return None
        if len(payload) < 1 + 2 * self._fingers:
            self.counters["short_slots"] += 1
            return None
        words = tuple(
            decode_word(payload[at : at + 2]) for at in range(1, 1 + 2 * self._fingers, 2)
        )
        for word, counters in zip(words, self.finger_counters, strict=True):
            if word.kind is WordKind.GOOD:
                counters["suspicious"] += word.suspicious
            elif word.kind is WordKind.BIT_ERROR:
                counters["parity_errors"] += 1
            elif word.kind is WordKind.ABSENT:
                counters["absent"] += 1
            elif word.kind is WordKind.DEVICE_ERROR:
                counters[_error_key(word.error)] += 1
        self.counters["slots"] += 1
        return SlotWords(channel, words)


class CanSlotDecoder(SlotDecoder):
    """Slots out of the data frames of a bus; error and remote frames are not for it.

    Args:
        fingers: Words that each frame must have at least, 1..3.
        can_id: Identifier of the frames. The format names none; None takes every frame whose first
            byte is a sampling command with a known index.
    """

    def __init__(self, *, fingers: int, can_id: int | None = None) -> None:
        if fingers > CAN_FINGERS_MAX:
            raise ValueError(f"{fingers} fingers are not in 1..{CAN_FINGERS_MAX} on a CAN bus")
        super().__init__(fingers=fingers)
        self._can_id = can_id
        self.counters["other_ids"] = 0

    def feed(self, can_id: int, data: bytes) -> SlotWords | None:
        """Take one data frame; None if it is no slot."""
        if self._can_id is not None and can_id != self._can_id:
            self.counters["other_ids"] += 1
            return None
        return self.decode(bytes(data))


def _interleaved(electrodes: int, *, pac_first: bool) -> tuple[int, ...]:
    first = ch.FIRST_ELECTRODE
    slow = (*range(first, first + electrodes), ch.PDC, ch.TAC, ch.TDC)
    pairs = ((ch.PAC, one) if pac_first else (one, ch.PAC) for one in slow)
    return tuple(channel for pair in pairs for channel in pair)


SEQUENCES: dict[str, tuple[int, ...]] = {
    "biotac_e1_first": _interleaved(ch.ELECTRODES, pac_first=False),
    "biotac_pac_first": _interleaved(ch.ELECTRODES, pac_first=True),
    "biotac_sp_e1_first": _interleaved(ch.ELECTRODES_SP, pac_first=False),
    "biotac_sp_pac_first": _interleaved(ch.ELECTRODES_SP, pac_first=True),
    "numatac": (ch.PAC, ch.PDC),
}
"""Sequences of sampling by name (hardware reference 1.7). A stream cannot tell whether its frames
begin with E1 or with PAC: as a cycle both are the same."""


class SlotOrder:
    """A cycle of channels, and the way from slot to slot in it.

    Args:
        channels: Channel indices in order of sampling; one at least occurs just once.
    """

    def __init__(self, channels: Sequence[int]) -> None:
        self.channels = tuple(channels)
        size = len(self.channels)
        self.anchors = {c: p for p, c in enumerate(channels) if self.channels.count(c) == 1}
        """Positions of the channels that tell theirs."""
        if not self.anchors:
            raise ValueError("no channel of the sequence occurs exactly once")
        # From the last position back, so that the nearest place of a channel stays.
        self._steps = [
            {self.channels[(p + steps) % size]: steps for steps in range(size, 0, -1)}
            for p in range(size)
        ]

    def __len__(self) -> int:
        return len(self.channels)

    def steps(self, position: int, channel: int) -> int:
        """Slots from a position forward to the next one of a channel of the sequence."""
        return self._steps[position][channel]

    def steps_near(self, position: int, channel: int, expected: float) -> int:
        """Slots forward to that place of a channel of the sequence which is nearest to a number."""
        least, size = self.steps(position, channel), len(self)
        if abs(least - expected) < 1:
            return least
        places = [p for p, one in enumerate(self.channels) if one == channel]
        least_of = [(place - position - 1) % size + 1 for place in places]
        steps = [one + size * max(round((expected - one) / size), 0) for one in least_of]
        return min(steps, key=lambda one: abs(one - expected))


def learn_order(seen: Sequence[int]) -> SlotOrder | None:
    """The shortest cycle that all these channels repeat, from E1 on; None if they do not.

    Args:
        seen: Channel indices of consecutive slots; cycles up to half as long are found.
    """
    for size in range(1, len(seen) // 2 + 1):
        if all(a == b for a, b in zip(seen, seen[size:], strict=False)):
            cycle = tuple(seen[:size])
            once = [c for c in cycle if cycle.count(c) == 1]
            if not once:
                return None
            start = cycle.index(min(once, key=lambda c: (c < ch.FIRST_ELECTRODE, c == ch.PAC, c)))
            return SlotOrder(cycle[start:] + cycle[:start])
    return None
