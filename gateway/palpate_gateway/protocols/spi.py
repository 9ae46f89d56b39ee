"""Words on the BioTac's SPI bus as pure functions (hardware reference 1.3 to 1.6).

A sampling command is one byte ``1 SSSSSS P``. The answer is 16 bits: data[11:5], parity, data[4:0],
two zero bits, parity. Every byte has an odd number of ones, so any single flipped bit shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

SUSPICIOUS_BITS = 0b110
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


def channel_of_command(byte: int) -> int | None:
    """Channel index of a sampling command; None if parity or kind is wrong."""
    if not byte & 0x80 or byte.bit_count() % 2 == 0:
        return None
    return (byte & 0x7E) >> 1


def decode_words(words: npt.NDArray[np.uint8]) -> SpiWords:
    """Decode many words at once, each by itself.

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
        suspicious=((second & SUSPICIOUS_BITS) != 0) & ~absent & ~error,
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
