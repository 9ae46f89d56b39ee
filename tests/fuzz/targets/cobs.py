"""Byte stuffing, and packets out of a stream of it."""

from __future__ import annotations

from cobs.cobs import encode
from tests.fuzz.streams import all_counted, same_in_pieces
from tests.gateway.bridge_packets import encode_packet

from palpate_gateway.protocols.framing import DELIMITER, PacketSplitter, unstuffed

LONGEST = 300
_LONGEST_BLOCK = LONGEST + 3
"""Two full pieces of 254 bytes cannot be in 300, so two codes and one more are room enough."""


def check(data: bytes) -> None:
    """One byte chooses the cuts; then comes the stream, which is also a packet to be sent."""
    how, stream = (data[0] if data else 0), data[1:]
    block = encode(stream)
    assert 0 not in block
    assert unstuffed(block) == stream
    assert len(stream) + 1 <= len(block) <= len(stream) + 1 + len(stream) // 254

    decoder, packets = same_in_pieces(lambda: PacketSplitter(LONGEST), stream, how)
    assert decoder.pending <= _LONGEST_BLOCK
    *ended, _ = stream.split(DELIMITER)
    expected = []
    for number, one in enumerate(ended):
        packet = unstuffed(one) if len(one) <= _LONGEST_BLOCK else None
        if packet is not None and len(packet) <= LONGEST:
            expected.append((packet, len(one) + 1, number == 0))
    assert [(p.data, p.wire_bytes, p.first) for p in packets] == expected
    all_counted(decoder, sum(packet.wire_bytes for packet in packets), stream)
    decoder.feed(DELIMITER)
    (good,) = decoder.feed(encode_packet(stream[:LONGEST]))
    assert good.data == stream[:LONGEST]


def seeds() -> list[bytes]:
    """Packets of all lengths where codes change, damaged ones, and ones that are too long."""
    runs = [
        b"",
        b"\0",
        b"\0\0",
        b"a",
        bytes(range(1, 255)),
        bytes(range(1, 256)),
        b"x" * 254 + b"\0",
    ]
    wire = [encode_packet(run) for run in runs]
    return [
        *(bytes([how]) + run for how, run in enumerate(runs)),
        b"\x05" + b"".join(wire),
        b"\x03" + b"\x09abc\0" + wire[3] + b"\xff\xff\0" + wire[2] + b"\0\0",
        b"\x3f" + b"z" * (LONGEST + 10) + b"\0" + wire[3],
    ]
