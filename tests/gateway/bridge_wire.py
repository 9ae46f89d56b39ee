"""A bridge's line, read byte for byte and without the gateway's decoder."""

from __future__ import annotations

import struct
import time
from typing import NamedTuple

import serial

from palpate_gateway.emulators.lines import crc16_x25

PATIENCE_S = 20.0
HELLO, SLOTS, STATUS = 1, 2, 3


class Packet(NamedTuple):
    kind: int
    sequence: int
    time_us: int
    body: bytes


def unstuffed(wire: bytes) -> bytes:
    """COBS backwards: each code stands where a zero was, 255 where none was."""
    out, at = b"", 0
    while at < len(wire):
        code = wire[at]
        out += wire[at + 1 : at + code]
        at += code
        if code < 255 and at < len(wire):
            out += b"\0"
    return out


class Wire:
    """A line that is read byte for byte."""

    def __init__(self, path: str) -> None:
        self.line = serial.Serial(path, 460800, timeout=PATIENCE_S)

    def raw(self) -> bytes:
        """All up to the next zero."""
        got = self.line.read_until(b"\0")
        assert got.endswith(b"\0"), "nothing came"
        return bytes(got[:-1])

    def packet(self) -> Packet | None:
        """The next one, None where its sum is wrong."""
        data = unstuffed(self.raw())
        if len(data) < 12 or crc16_x25(data[:-2]).to_bytes(2, "little") != data[-2:]:
            return None
        version, kind, _source, flags, sequence, time_us = struct.unpack_from("<4BHI", data)
        assert (version, flags) == (1, 0)
        return Packet(kind, sequence, time_us, data[10:-2])

    def packets(self, count: int, kind: int = SLOTS) -> list[Packet]:
        """The next good ones of a kind."""
        out: list[Packet] = []
        deadline = time.monotonic() + PATIENCE_S
        while len(out) < count:
            assert time.monotonic() < deadline
            packet = self.packet()
            if packet is not None and packet.kind == kind:
                out.append(packet)
        return out


def slots(packet: Packet) -> list[bytes]:
    count, fingers = packet.body[:2]
    width = 1 + 2 * fingers
    assert len(packet.body) == 2 + count * width
    return [packet.body[at : at + width] for at in range(2, len(packet.body), width)]
