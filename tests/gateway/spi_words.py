"""Words on the SPI bus one by one: what an encoder sends, and a plain decoder to compare with."""

from __future__ import annotations

from dataclasses import dataclass

from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols.spi import ERROR_BYTE, ERROR_WORDS, SUSPICIOUS_BITS, WordKind

CHANNEL_MAX = 63
"""Largest channel index that fits the six bits of a sampling command."""


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
    suspicious = bool(second & SUSPICIOUS_BITS)
    if first.bit_count() % 2 and second.bit_count() % 2:
        return SpiWord(WordKind.GOOD, (first >> 1) * 32 + (second >> 3), suspicious, "")
    if first == second and first in (0x00, 0xFF):
        return SpiWord(WordKind.ABSENT, 0, False, "")
    if first == ERROR_BYTE and second in ERROR_WORDS:
        return SpiWord(WordKind.DEVICE_ERROR, 0, False, ERROR_WORDS[second])
    return SpiWord(WordKind.BIT_ERROR, 0, suspicious, "")
