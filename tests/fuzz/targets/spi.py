"""Words and commands of the BioTac's SPI bus."""

from __future__ import annotations

import numpy as np
from tests.gateway.spi_words import CHANNEL_MAX, command_byte, decode_word, encode_word

from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols.spi import (
    ERROR_WORDS,
    WordKind,
    channel_of_command,
    decode_words,
    printable_prefix,
)


def check(data: bytes) -> None:
    """All bytes are words, commands and a property."""
    raw = np.frombuffer(data[: len(data) // 2 * 2], np.uint8).reshape(-1, 2)
    many = decode_words(raw)
    for at, (first, second) in enumerate(raw.tolist()):
        word = decode_word(bytes((first, second)))
        told = (int(many.kind[at]), int(many.value[at]), bool(many.suspicious[at]))
        assert told == (word.kind, word.value, word.suspicious)
        odd = first.bit_count() % 2 == second.bit_count() % 2 == 1
        assert (word.kind is WordKind.GOOD) == odd
        assert 0 <= word.value <= (COUNTS_MAX if odd else 0)
        if odd and not word.suspicious:
            assert encode_word(word.value) == bytes((first, second))
        assert bool(word.error) == (word.kind is WordKind.DEVICE_ERROR)
        assert (word.kind is WordKind.ABSENT) == (first == second and first in (0, 255))
        if word.error:
            assert (first, ERROR_WORDS[second]) == (0xA5, word.error)
    for byte in data:
        channel = channel_of_command(byte)
        if channel is not None:
            assert 0 <= channel <= CHANNEL_MAX
            assert command_byte(channel) == byte
        else:
            assert byte < 0x80 or byte.bit_count() % 2 == 0
    text = printable_prefix(data)
    assert text.isascii()
    assert text.isprintable()
    assert data.lstrip(b" ").startswith(text.encode("ascii"))


def seeds() -> list[bytes]:
    """The page's words, commands and error words, and a serial with what follows it."""
    return [
        bytes.fromhex("0101 0108 01F8 0201 4001 7FC1 A4C1 FEF8"),
        bytes.fromhex("0000 FFFF 0001 0100 0107 A545 A53F A52E A52D A558 A55F A552 A557 A541"),
        bytes.fromhex("80 83 85 86 9E A2 A4 A7 C7 D0 61 40 50 20"),
        b"BTSP0123456789AB\x00\x10",
        b"  BT 7 \xff",
    ]
