"""Packets of a bridge as its firmware makes them, without an emulator's clock."""

from __future__ import annotations

import struct

from cobs import cobs

from palpate_gateway.protocols.bridge import (
    VERSION,
    BridgeBody,
    BridgeHeader,
    BridgeHello,
    BridgePacketType,
    BridgeSlots,
)
from palpate_gateway.protocols.framing import crc16_x25


def encode_packet(data: bytes) -> bytes:
    """Stuffed by COBS, with the zero that ends it."""
    return bytes(cobs.encode(data)) + b"\0"


def sealed_packet(data: bytes) -> bytes:
    """With its checksum, stuffed and ended."""
    return encode_packet(data + crc16_x25(data).to_bytes(2, "little"))


def encode(header: BridgeHeader, body: BridgeBody) -> bytes:
    """A packet as it goes over the wire."""
    kind, tail = _encode_body(body)
    head = (VERSION, kind, header.source, header.flags, header.sequence, header.device_time_us)
    return sealed_packet(struct.pack("<BBBBHI", *head) + tail)


def _encode_body(body: BridgeBody) -> tuple[BridgePacketType, bytes]:
    if isinstance(body, BridgeHello):
        head = struct.pack("<BHB", len(body.fingers), body.slot_rate_hz, body.slots_per_frame)
        names = [(one.serial.encode("ascii"), one.firmware.encode("ascii")) for one in body.fingers]
        fingers = [struct.pack("<16s4s", *name) for name in names]
        return BridgePacketType.HELLO, head + b"".join(fingers)
    if isinstance(body, BridgeSlots):
        head = bytes((len(body.payloads), body.fingers))
        return BridgePacketType.SLOTS, head + b"".join(body.payloads)
    counters = (*body.parity_errors, body.error_words, body.overruns)
    count = len(body.parity_errors)
    return BridgePacketType.STATUS, struct.pack(f"<B{len(counters)}I", count, *counters)
