"""Checksums of the serial devices (hardware reference 2.6, 3.4, 3.5, 3.6)."""

from __future__ import annotations

_X25_REFLECTED = 0x8408
"""Polynomial 0x1021 with its bits in reverse, for data that arrives lowest bit first."""


def _x25_entry(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ _X25_REFLECTED if byte & 1 else byte >> 1
    return byte


_X25_TABLE = tuple(_x25_entry(byte) for byte in range(256))


def crc16_x25(data: bytes) -> int:
    """CRC-16/X-25: polynomial 0x1021 reflected, initial value FFFF, final xor FFFF.

    The ASCII digits ``123456789`` give 0x906E.
    """
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _X25_TABLE[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFF


def sum8(data: bytes) -> int:
    """Sum of all bytes modulo 256."""
    return sum(data) & 0xFF


def sum16(data: bytes) -> int:
    """Sum of all bytes modulo 65536."""
    return sum(data) & 0xFFFF
