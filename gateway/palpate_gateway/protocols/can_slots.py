"""BioTac slots on a CAN bus (format A, hardware reference 2.1): a frame per sampled channel.

Byte 0 is the sampling command, then comes one word per finger exactly as clocked from SPI. The
public driver that shows this format is for the NumaTac; that a BioTac sends the same is a
well-founded inference, never confirmed by a public capture. Frames carry no number:
``slot_clock.SlotClock`` finds their place by the order of the channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols.slot_clock import LEARNT_FROM, learn_order
from palpate_gateway.protocols.spi import (
    ERROR_BYTE,
    ERROR_WORDS,
    WordKind,
    channel_of_command,
    decode_words,
)

CAN_FINGERS_MAX = 3
"""Words that fit a classic CAN frame behind the command."""

FINGERS_MAX = 5
"""Ports of the maker's larger board (hardware reference 1.8)."""

Bytes = npt.NDArray[np.uint8]
Ints = npt.NDArray[np.int64]

_UNKNOWN, _NO_COMMAND = -1, -2
_VALUE_BITS, _KIND_AT, _COUNTED_AT = 0xFFF, 12, 14


def _error_key(meaning: str) -> str:
    return "device_error_" + meaning.replace(" ", "_").replace("-", "_")


_FINGER_KEYS = ("parity_errors", "absent", "suspicious", *map(_error_key, ERROR_WORDS.values()))


@dataclass(frozen=True, slots=True)
class SlotWords:
    """Sampled channels of all fingers, N of them.

    Attributes:
        index: Which of the payloads each was, int64, shape ``(N,)``.
        channel: Channel indices, keys of ``channels.CHANNEL_NAMES``, int64, shape ``(N,)``.
        value: Raw counts of each finger in order of the ports, 0 where not good, uint16, shape
            ``(N, fingers)``.
        kind: ``WordKind`` numbers, uint8, shape ``(N, fingers)``.
    """

    index: npt.NDArray[np.int64]
    channel: npt.NDArray[np.int64]
    value: npt.NDArray[np.uint16]
    kind: npt.NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.index)


class SlotDecoder:
    """Decodes the command and the words of slots, which CAN frames and our own bridge carry alike.

    ``counters`` counts slots, and payloads that were dropped whole; ``finger_counters`` has one
    dictionary for each finger, in order of the ports, with its bad and its suspicious words.

    Args:
        fingers: Words in each slot, 1..5.
    """

    def __init__(self, *, fingers: int) -> None:
        if not 1 <= fingers <= FINGERS_MAX:
            raise ValueError(f"{fingers} fingers are not in 1..{FINGERS_MAX}")
        self._size = 1 + 2 * fingers
        self._table = _word_table()
        self.counters: dict[str, int] = dict.fromkeys(
            ("slots", "bad_commands", "unknown_channels", "short_slots"), 0
        )
        self.finger_counters: tuple[dict[str, int], ...] = tuple(
            dict.fromkeys(_FINGER_KEYS, 0) for _ in range(fingers)
        )

    def decode(self, payloads: Bytes, sizes: Ints) -> SlotWords:
        """Decode slots; drops payloads that are none, and ignores bytes behind the last finger's.

        Args:
            payloads: Command and words of each, zeros behind them, uint8, shape ``(N, M)``, M at
                least 1; see ``payload_rows``.
            sizes: Bytes of each, int64, shape ``(N,)``.
        """
        channel = _CHANNEL_OF[payloads[:, 0]]
        channel = np.where(sizes > 0, channel, _NO_COMMAND)
        good = (channel >= 0) & (sizes >= self._size)
        counters = self.counters
        if good.all():
            index = np.arange(len(sizes))
        else:
            index = np.flatnonzero(good)
            counters["bad_commands"] += int((channel == _NO_COMMAND).sum())
            counters["unknown_channels"] += int((channel == _UNKNOWN).sum())
            counters["short_slots"] += int(((channel >= 0) & ~good).sum())
            payloads, channel = payloads[index], channel[index]
        counters["slots"] += len(index)
        if not len(index):  # then rows may be shorter than a slot
            payloads = np.zeros((0, self._size), np.uint8)
        raw = np.ascontiguousarray(payloads[:, 1 : self._size]).view(">u2")
        # One table look-up instead of a dozen tests: a hand of five sends 22,000 words a second.
        words = self._table[raw.reshape(len(index), (self._size - 1) // 2)]
        if words.max(initial=0) >= 1 << _KIND_AT:
            self._count(words)
        return SlotWords(
            index,
            channel,
            (words & _VALUE_BITS).astype(np.uint16),
            (words >> _KIND_AT & 3).astype(np.uint8),
        )

    def _count(self, words: npt.NDArray[np.uint32]) -> None:
        counted = words >> _COUNTED_AT
        for finger, counters in enumerate(self.finger_counters):
            times = np.bincount(counted[:, finger], minlength=1 + len(_FINGER_KEYS))
            for key, more in zip(_FINGER_KEYS, times[1:].tolist(), strict=True):
                counters[key] += more


@cache
def _word_table() -> npt.NDArray[np.uint32]:
    """For each of 65,536 words: value, kind << 12, and number of its counter << 14 (0 = none)."""
    raw = np.arange(1 << 16, dtype=np.uint16)
    words = decode_words(np.stack([raw >> 8, raw & 0xFF], axis=1).astype(np.uint8))
    counted = np.zeros(1 << 16, np.uint32)
    good = words.kind == WordKind.GOOD
    counted[words.kind == WordKind.BIT_ERROR] = 1 + _FINGER_KEYS.index("parity_errors")
    counted[words.kind == WordKind.ABSENT] = 1 + _FINGER_KEYS.index("absent")
    counted[good & words.suspicious] = 1 + _FINGER_KEYS.index("suspicious")
    for letter, meaning in ERROR_WORDS.items():
        counted[ERROR_BYTE << 8 | letter] = 1 + _FINGER_KEYS.index(_error_key(meaning))
    kind = words.kind.astype(np.uint32)
    table: npt.NDArray[np.uint32] = words.value | kind << np.uint32(_KIND_AT)
    return table | counted << np.uint32(_COUNTED_AT)


def _channel_of(byte: int) -> int:
    channel = channel_of_command(byte)
    if channel is None:
        return _NO_COMMAND
    return channel if channel in ch.CHANNEL_NAMES else _UNKNOWN


_CHANNEL_OF = np.array([_channel_of(byte) for byte in range(256)], np.int64)


def payload_rows(payloads: Sequence[bytes]) -> tuple[Bytes, Ints]:
    """Payloads as rows of one array, zeros behind them, and their sizes."""
    sizes = np.array([len(payload) for payload in payloads], np.int64)
    width = int(sizes.max(initial=1))
    data = b"".join(payload.ljust(width, b"\0") for payload in payloads)
    return np.frombuffer(data, np.uint8).reshape(len(payloads), width), sizes


class SlotSenders:
    """Finds the identifiers of a bus that send slots: their commands repeat a round.

    A single frame does not tell: the first byte of any device's may be a sampling command.
    """

    def __init__(self) -> None:
        self.found: list[int] = []
        """Those that have shown a round, the first one first."""
        self._seen: dict[int, list[int]] = {}

    def look(self, can_id: Ints, payloads: Bytes, sizes: Ints) -> None:
        """Look at data frames; see ``CanSlotDecoder.ours``."""
        channel = _CHANNEL_OF[payloads[:, 0]]
        new = (channel >= 0) & (sizes > 0)
        for found in self.found:
            new &= can_id != found
        for sender, one in zip(can_id[new].tolist(), channel[new].tolist(), strict=True):
            if sender in self.found:
                continue
            seen = self._seen.setdefault(sender, [])
            seen.append(one)
            if len(seen) < LEARNT_FROM:
                continue
            order = learn_order(seen)
            # A device whose first byte is always the same repeats a cycle of one.
            if order is not None and order.size > 1:
                self.found.append(sender)
            del seen[: LEARNT_FROM // 2]


class CanSlotDecoder(SlotDecoder):
    """Slots out of the data frames of a CAN bus; takes no error and no remote frames.

    Args:
        fingers: Words that each frame must have at least, 1..3.
        can_id: Identifier of the frames. The format names none; None takes that of the first
            frames that repeat a round, see ``SlotSenders``.
    """

    def __init__(self, *, fingers: int, can_id: int | None = None) -> None:
        if fingers > CAN_FINGERS_MAX:
            raise ValueError(f"{fingers} fingers are not in 1..{CAN_FINGERS_MAX} on a CAN bus")
        super().__init__(fingers=fingers)
        self._named = [] if can_id is None else [can_id]
        self._senders = SlotSenders()
        self.counters["other_ids"] = 0

    @property
    def senders(self) -> Sequence[int]:
        """The given identifier, or those found; none while nobody has shown a round."""
        return self._named or self._senders.found

    def ours(self, can_id: Ints, payloads: Bytes, sizes: Ints) -> npt.NDArray[np.bool_] | None:
        """Which data frames have our identifier; None = all, or not known yet. Counts the others.

        Args:
            can_id: Identifiers, shape ``(N,)``.
            payloads: See ``decode``.
            sizes: See ``decode``.
        """
        if not self._named:
            self._senders.look(can_id, payloads, sizes)
        if not self.senders:
            return None
        ours: npt.NDArray[np.bool_] = can_id == self.senders[0]
        others = int(len(ours) - np.count_nonzero(ours))
        self.counters["other_ids"] += others
        return ours if others else None
