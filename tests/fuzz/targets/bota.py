"""Frames and texts of Bota sensors on a serial line."""

from __future__ import annotations

import math
import struct

from tests.fuzz.streams import all_counted, pieces, plain_search, same_in_pieces, sealed

from palpate_gateway.protocols.bota import (
    FRAME_BYTES,
    BotaDecoder,
    BotaTextWait,
    find_ack,
    status_names,
)
from palpate_gateway.protocols.framing import crc16_x25

_GOOD = bytes.fromhex(
    "AA 0000 0000803F 00000040 00004040 CDCCCC3D CDCC4C3E 9A99993E 40E20100 0000CC41 7235"
)


def _crc(data: bytes) -> int:
    """CRC-16/X-25 bit by bit."""
    crc = 0xFFFF
    for byte in data:
        for bit in range(8):
            odd = (crc ^ byte >> bit) & 1
            crc = crc >> 1 ^ (0x8408 if odd else 0)
    return crc ^ 0xFFFF


def _is_good(frame: bytes) -> bool:
    return _crc(frame[1:-2]) == int.from_bytes(frame[-2:], "little")


def _seal(_: int, part: bytes) -> bytes:
    body = part[: FRAME_BYTES - 3].ljust(FRAME_BYTES - 3, b"\0")
    return b"\xaa" + body + crc16_x25(body).to_bytes(2, "little")


def check(data: bytes) -> None:
    """Two bytes choose cuts and what to do; then comes the stream."""
    how, mode = (*data[:2], 0, 0)[:2]
    stream = data[2:]
    if mode & 1:
        _check_texts(stream, how)
        return
    if mode & 2:
        stream = sealed(stream, _seal)
    decoder, frames = same_in_pieces(BotaDecoder, stream, how, key=repr)  # NaN is not NaN
    found = plain_search(stream, {b"\xaa": FRAME_BYTES}, _is_good)
    assert len(frames) == len(found)
    for frame, raw in zip(frames, found, strict=True):
        values = (*frame.wrench, frame.temperature_c)
        told = struct.pack("<H6fIf", frame.status, *frame.wrench, frame.device_time_us, values[-1])
        if all(map(math.isfinite, values)):
            assert told == raw[1:-2]
        assert len(status_names(frame.status)) == frame.status.bit_count()
    assert decoder.pending < FRAME_BYTES
    all_counted(decoder, len(frames) * FRAME_BYTES, stream)
    assert len(decoder.feed(_GOOD)) == 1


def _check_texts(stream: bytes, how: int) -> None:
    """The first of the bytes tells the length of the text that is waited for."""
    size = 1 + (stream[0] if stream else 0) % 64
    text, stream = stream[1 : 1 + size] or b"r", stream[1 + size :]
    whole, cut = BotaTextWait(text), BotaTextWait(text)
    after = whole.feed(stream)
    heard = [cut.feed(piece) for piece in pieces(stream, how)]
    before, found, rest = stream.partition(text)
    assert after == (rest if found else None)
    assert b"".join(one or b"" for one in heard) == (rest if found else b"")
    assert any(one is not None for one in heard) == bool(found)
    for wait in (whole, cut):
        assert before.endswith(wait.before)
        # Of what was remembered, the beginning of the text has to be taken off again.
        assert min(len(before), 256 - len(text)) <= len(wait.before) <= 256
    ack = find_ack(stream)
    if ack is not None:
        assert len(ack.command) == 1
        assert ack.code >= 0


def seeds() -> list[bytes]:
    """The page's frame, whole, cut and in junk; contents to be sealed; texts."""
    fields = _GOOD[1:-2]
    damaged = _GOOD[:9] + b"\x7f" + _GOOD[10:]
    strange = b"\x0f\0" + struct.pack("<6fIf", math.nan, math.inf, 0, -0.0, 1e38, 1, 9, 25.0)
    sealed_parts = [bytes([1 + len(p), 1]) + p for p in (fields, strange, b"\xaa" * 34)]
    text = b"App Init"
    talk = b"\r\nApp Init\r\nr,0,C,0\r\nr,0,c,0\r\nr,1,f,3\r\n"
    return [
        bytes([5, 0]) + _GOOD * 3,
        bytes([0, 0]) + b"\xaa\xaa" + _GOOD[:20] + _GOOD + damaged + _GOOD,
        bytes([9, 2]) + b"".join(sealed_parts) + bytes([4, 0, 0xAA, 1, 2]) + sealed_parts[0],
        bytes([2, 1, len(text) - 1]) + text + talk,
        bytes([2, 1, 6]) + b"r,0,R,0" + talk + b"r,0,R,0" + _GOOD,
    ]
