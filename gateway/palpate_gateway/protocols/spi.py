"""Words on the BioTac's SPI bus as pure functions (hardware reference 1.3 to 1.6).

A sampling command is one byte ``1 SSSSSS P``. The answer is 16 bits: data[11:5], parity, data[4:0],
two zero bits, parity. Every byte has an odd number of ones, so any single flipped bit shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX

CHANNEL_MAX = 63
"""Largest channel index that fits the six bits of a sampling command."""

READ_PROPERTY = 0x61
WRITE_PROPERTY = 0x40

_SUSPICIOUS_BITS = 0b110
"""Bits 2 and 1 of byte 1, zero in every 12-bit word (a 14-bit variant is only hinted at)."""

ERROR_BYTE = 0xA5
"""First byte of an error word."""

ERROR_WORDS: dict[int, str] = {
    ord("E"): "command parity wrong",
    ord("?"): "unknown command",
    ord("."): "too little delay",
    ord("-"): "too little sampling delay",
    ord("X"): "channel not recognised",
    ord("_"): "nothing to resend",
    ord("R"): "property is read-only",
    ord("W"): "write failed",
}
"""Meaning of the second byte of an error word ``A5 xx``."""


class WordKind(IntEnum):
    """Kinds of words that a finger may answer with."""

    GOOD = 0
    ABSENT = 1
    DEVICE_ERROR = 2
    BIT_ERROR = 3


class SpiProperty(IntEnum):
    """Property byte that follows ``READ_PROPERTY``."""

    FLEX_VERSION = 0x10
    FIRMWARE_VERSION = 0x13
    SERIAL_NUMBER = 0x15
    CPU_SPEED = 0x61
    SAMPLING_FREQUENCY = 0x70
    SAMPLING_PATTERN = 0x73


@dataclass(frozen=True, slots=True)
class SpiWord:
    """One decoded word.

    Attributes:
        kind: Good, absent, device error or bit error.
        value: Raw counts 0..4095; 0 unless the word is good.
        suspicious: Bits 2,1 of byte 1 are set: counted, but the value is used.
        error: Meaning of a ``DEVICE_ERROR``, else empty.
    """

    kind: WordKind
    value: int
    suspicious: bool
    error: str


@dataclass(frozen=True, slots=True)
class SpiWords:
    """Many decoded words.

    Attributes:
        kind: ``WordKind`` numbers, uint8, shape ``(N,)``.
        value: Raw counts, 0 where not good, uint16, shape ``(N,)``.
        suspicious: Bits 2,1 of byte 1 are set, bool, shape ``(N,)``.
    """

    kind: npt.NDArray[np.uint8]
    value: npt.NDArray[np.uint16]
    suspicious: npt.NDArray[np.bool_]


def with_odd_parity(byte: int) -> int:
    """Set bit 0 so that the byte has an odd number of ones; the given bit 0 is ignored."""
    upper = byte & 0xFE
    return upper | (1 - upper.bit_count() % 2)


def command_byte(channel: int) -> int:
    """Byte 0 of the command that samples a channel.

    Args:
        channel: Channel index 0..63.

    Raises:
        ValueError: The index does not fit six bits.
    """
    if not 0 <= channel <= CHANNEL_MAX:
        raise ValueError(f"channel index {channel} is not in 0..{CHANNEL_MAX}")
    return with_odd_parity(0x80 | channel << 1)


def channel_of_command(byte: int) -> int | None:
    """Channel index of a sampling command; None if parity or kind is wrong."""
    if not byte & 0x80 or byte.bit_count() % 2 == 0:
        return None
    return (byte & 0x7E) >> 1


def encode_word(value: int) -> bytes:
    """The two bytes with which a finger answers.

    Args:
        value: Raw counts 0..4095.

    Raises:
        ValueError: The value does not fit 12 bits.
    """
    if not 0 <= value <= COUNTS_MAX:
        raise ValueError(f"value {value} is not in 0..{COUNTS_MAX} counts")
    return bytes((with_odd_parity(value >> 5 << 1), with_odd_parity((value & 0x1F) << 3)))


def decode_word(word: bytes) -> SpiWord:
    """Decode one word of two bytes."""
    first, second = word
    suspicious = bool(second & _SUSPICIOUS_BITS)
    if first.bit_count() % 2 and second.bit_count() % 2:
        return SpiWord(WordKind.GOOD, (first >> 1) * 32 + (second >> 3), suspicious, "")
    if first == second and first in (0x00, 0xFF):
        return SpiWord(WordKind.ABSENT, 0, False, "")
    if first == ERROR_BYTE and second in ERROR_WORDS:
        return SpiWord(WordKind.DEVICE_ERROR, 0, False, ERROR_WORDS[second])
    return SpiWord(WordKind.BIT_ERROR, 0, suspicious, "")


def decode_words(words: npt.NDArray[np.uint8]) -> SpiWords:
    """Decode many words at once, with the same result as ``decode_word``.

    Args:
        words: Bytes as read, uint8, shape ``(N, 2)``.
    """
    first, second = words[:, 0], words[:, 1]
    # Parity is per byte: a word with one bad byte in each half would pass a 16-bit parity.
    good = (np.bitwise_count(first) & np.bitwise_count(second) & 1).astype(np.bool_)
    absent = (first == second) & ((first == 0x00) | (first == 0xFF))
    error = (first == ERROR_BYTE) & np.isin(second, np.fromiter(ERROR_WORDS, np.uint8))
    kind = np.full(len(words), WordKind.BIT_ERROR, np.uint8)
    kind[error] = WordKind.DEVICE_ERROR
    kind[absent] = WordKind.ABSENT
    kind[good] = WordKind.GOOD
    value = (first >> 1).astype(np.uint16) * np.uint16(32) + (second >> 3)
    return SpiWords(
        kind=kind,
        value=np.where(good, value, 0).astype(np.uint16),
        suspicious=((second & _SUSPICIOUS_BITS) != 0) & ~absent & ~error,
    )


def printable_prefix(raw: bytes) -> str:
    """Text of a property up to its first non-printable byte, stripped.

    Properties carry no parity and real headers hold stray bytes after the serial (00 10 in the
    public capture, hardware reference 1.5).
    """
    for at, byte in enumerate(raw):
        if not 0x20 <= byte < 0x7F:
            return raw[:at].decode("ascii").strip()
    return raw.decode("ascii").strip()
