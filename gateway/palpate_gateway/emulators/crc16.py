"""CRC-16/X-25 as emulators reckon it, apart from the decoders' own."""

from __future__ import annotations


def _of_byte(byte: int) -> int:
    """Bit by bit as it is defined: the lowest first, polynomial 1021 reflected."""
    for _ in range(8):
        byte = byte >> 1 ^ (0x8408 if byte & 1 else 0)
    return byte


_OF_BYTES = [_of_byte(byte) for byte in range(256)]


def crc16_x25(data: bytes | bytearray) -> int:
    """The sum: "123456789" gives 906E."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _OF_BYTES[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFF
