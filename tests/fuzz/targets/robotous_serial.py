"""Frames of Robotous RFT sensors on a serial line, and the answers in them."""

from __future__ import annotations

from tests.fuzz.streams import all_counted, plain_search, same_in_pieces, sealed

from palpate_gateway.protocols.robotous import (
    REPLY_BYTES,
    REQUEST_BYTES,
    RobotousData,
    RobotousResult,
    RobotousSerialDecoder,
    RobotousText,
    RobotousUnknown,
    decode,
    overloaded_axes,
    serial_frame,
)


def _is_good(frame: bytes) -> bool:
    return frame[-1] == 0xAA and sum(frame[1:-2]) % 256 == frame[-2]


def check(data: bytes) -> None:
    """Two bytes choose cuts, length of the frames, and whether to seal; then comes the stream."""
    how, mode = data[:1], data[1:2]
    size = REQUEST_BYTES if mode and mode[0] & 1 else REPLY_BYTES
    stream = data[2:]
    if mode and mode[0] & 2:
        stream = sealed(stream, lambda _, part: serial_frame(part[:size].ljust(size, b"\0")))
    decoder, payloads = same_in_pieces(
        lambda: RobotousSerialDecoder(size), stream, how[0] if how else 0
    )
    expected = plain_search(stream, {b"\x55": size + 3}, _is_good)
    assert payloads == [frame[1:-2] for frame in expected]
    assert decoder.pending < size + 3
    for payload in payloads:
        check_answer(payload)
    all_counted(decoder, len(payloads) * (size + 3), stream)
    good = bytes(range(1, 1 + size))
    assert decoder.feed(serial_frame(good)) == [good]


def check_answer(payload: bytes) -> None:
    """An answer of 16 bytes, or of another length, is read without loss of what it says."""
    record = decode(payload)
    if isinstance(record, RobotousData):
        assert len(record.counts) == 6
        assert all(-(1 << 15) <= count < 1 << 15 for count in record.counts)
        assert len(overloaded_axes(record.overload)) == (record.overload & 0x3F).bit_count()
    elif isinstance(record, RobotousText):
        assert "\0" not in record.text
    elif isinstance(record, RobotousResult):
        assert record.ok == (record.error == 0 and payload[1] == 1) or not record.ok
    else:
        assert isinstance(record, RobotousUnknown)
        assert record.payload == payload


def seeds() -> list[bytes]:
    """The page's frames, plain and among junk, and the contents of frames to be sealed."""
    frames = [
        bytes.fromhex("55 0B 01F4 FF06 03E8 00C8 FF9C 0032 000000 85 AA"),
        bytes.fromhex("55 0B 00 00 00 00 00 00 00 0B AA"),
        bytes.fromhex("55 11 01 00 00 00 00 00 00 12 AA"),
    ]
    contents = [
        b"\x01RFT40-SA01-C\0\0\0", b"\x08\x00\x02", b"\x09\x01\x06", b"\x10\x08",
        b"\x0a" + bytes(15), b"\x0b" + b"\x7f\xff\x80\x00" * 3 + b"\x3f\0\0",
        b"\x12\1\2\3\4\5\6", b"\x05\x64\1\2\x64\3\4",
    ]  # fmt: skip
    parts = b"".join(bytes([1 + len(c), 1]) + c for c in contents)
    junk = bytes([4, 0, 0x55, 0x55, 0x0B])
    return [
        bytes([7, 0]) + frames[0] * 3,
        bytes([0, 1]) + frames[1] + b"\x55\x55" + frames[2],
        bytes([9, 0]) + b"\x55" + frames[0] + frames[0][:9] + frames[0],
        bytes([3, 2]) + parts,
        bytes([5, 2]) + junk + parts + junk,
        bytes([5, 3]) + junk + parts,
    ]
