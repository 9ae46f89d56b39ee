"""Frames of the OptoForce DAQ."""

from __future__ import annotations

from tests.fuzz.streams import all_counted, plain_search, same_in_pieces, sealed

from palpate_gateway.protocols.framing import sum16
from palpate_gateway.protocols.optoforce import (
    OptoForceData,
    OptoForceDecoder,
    OptoForceReply,
    OptoForceScale,
)

_LENGTHS = {
    bytes.fromhex("AA005001"): 7,
    bytes.fromhex("AA07080A"): 16,
    bytes.fromhex("AA070810"): 22,
    bytes.fromhex("AA07081C"): 34,
}
_REAL = bytes.fromhex("AA 07 08 0A 2D 6A 00 00 FF F7 FF FB 00 07 05 51")


def _is_good(frame: bytes) -> bool:
    return sum(frame[:-2]) % 65536 == int.from_bytes(frame[-2:], "big")


def _seal(kind: int, part: bytes) -> bytes:
    head, length = list(_LENGTHS.items())[kind // 2 % len(_LENGTHS)]
    frame = head + part[: length - 6].ljust(length - 6, b"\0")
    return frame + sum16(frame).to_bytes(2, "big")


def check(data: bytes) -> None:
    """Two bytes choose the cuts and whether to seal; then comes the stream."""
    how, mode = (*data[:2], 0, 0)[:2]
    stream = sealed(data[2:], _seal) if mode & 1 else data[2:]
    decoder, records = same_in_pieces(OptoForceDecoder, stream, how)
    frames = plain_search(stream, _LENGTHS, _is_good)
    assert len(records) == len(frames)
    for record, frame in zip(records, frames, strict=True):
        if isinstance(record, OptoForceReply):
            assert record.status == frame[4]
            continue
        assert isinstance(record, OptoForceData)
        count = len(record.counts)
        numbers = (record.count, record.status, *record.counts)
        assert b"".join(n.to_bytes(2, "big", signed=n < 0) for n in numbers) == frame[4:-2]
        scale = OptoForceScale((1000.0,) * count, (10.0,) * count)
        assert len(scale.values(record.counts)) == count
    assert decoder.pending < max(_LENGTHS.values())
    all_counted(decoder, sum(map(len, frames)), stream)
    assert len(decoder.feed(_REAL)) == 1


def seeds() -> list[bytes]:
    """The page's frames, among junk, and contents to be sealed."""
    reply = bytes.fromhex("AA 00 50 01 00 00 FB")
    contents = [bytes(range(k, k + 30)) for k in range(4)]
    parts = b"".join(bytes([31, 2 * k + 1]) + part for k, part in enumerate(contents))
    return [
        bytes([3, 0]) + reply + _REAL * 3,
        bytes([0, 0]) + b"\xaa\x07\xaa" + _REAL[:11] + _REAL + b"\xaa\x07\x08\x1c" + _REAL,
        bytes([8, 1]) + parts,
        bytes([8, 1]) + parts[:64] + bytes([5, 0, 0xAA, 7, 8, 0x10]) + parts,
    ]
