"""Packets of the microcontroller bridge."""

from __future__ import annotations

import itertools
from collections import defaultdict

from tests.fuzz.streams import all_counted, same_in_pieces, sealed
from tests.gateway.bridge_packets import encode, sealed_packet

from palpate_gateway.protocols.bridge import (
    SLOTS_MAX,
    BridgeBody,
    BridgeDecoder,
    BridgeFinger,
    BridgeHeader,
    BridgeHello,
    BridgeRecord,
    BridgeSlots,
    BridgeStatus,
    decode_body,
)
from palpate_gateway.protocols.framing import DELIMITER, PacketSplitter, unstuffed

_LONGEST = 12 + 2 + SLOTS_MAX * 11
_HELLO = BridgeHello(4400, 44, (BridgeFinger("BT1", "0602"),))


def _seal(_: int, part: bytes) -> bytes:
    return sealed_packet(part)


def check(data: bytes) -> None:
    """Two bytes choose the cuts and whether to seal; then comes the stream."""
    how, mode = (*data[:2], 0, 0)[:2]
    stream = sealed(data[2:], _seal) if mode & 1 else data[2:]
    decoder, records = same_in_pieces(BridgeDecoder, stream, how)
    counters = decoder.counters

    splitter = PacketSplitter(_LONGEST)
    packets = splitter.feed(stream)
    wire = sum(packet.wire_bytes for packet in packets)
    taken = wire - (counters["junk_bytes"] - splitter.counters["junk_bytes"])
    assert decoder.pending == splitter.pending <= _LONGEST + _LONGEST // 254 + 2
    assert counters["packets"] == len(records)
    refused = ("short_packets", "crc_errors", "unknown_versions", "unknown_types", "bad_bodies",
               "repeated_packets")  # fmt: skip
    # The first packet since connecting may be cut, so its damage is no error.
    silent = len(packets) - len(records) - sum(counters[one] for one in refused)
    assert silent in (0, 1)
    _check_order(records, counters)
    for record in records:
        _check_body(record)
    all_counted(decoder, taken, stream)
    sources = {packet.data[2] for packet in packets if len(packet.data) > 2}
    other = min(set(range(256)) - sources, default=None)
    if other is not None:
        decoder.feed(DELIMITER)
        assert len(decoder.feed(encode(BridgeHeader(other, 0, 0, 0), _HELLO))) == 1


def _check_order(records: list[BridgeRecord], counters: dict[str, int]) -> None:
    by_source: dict[int, list[BridgeRecord]] = defaultdict(list)
    for record in records:
        by_source[record.header.source].append(record)
    for ours in by_source.values():
        for before, record in itertools.pairwise(ours):
            assert record.epoch >= before.epoch
            if record.epoch == before.epoch:
                assert (record.time_us - record.header.device_time_us) % (1 << 32) == 0
    assert counters["lost_packets"] >= sum(record.lost_before for record in records)
    assert all(0 <= record.lost_before < 0xFFFF for record in records)


def _check_body(record: BridgeRecord) -> None:
    """What was read can be sent again and says the same."""
    body = record.body
    packet = unstuffed(encode(record.header, body)[:-1])
    assert packet is not None
    assert decode_body(packet[1], packet[10:-2]) == body
    if isinstance(body, BridgeSlots):
        assert {len(payload) for payload in body.payloads} <= {1 + 2 * body.fingers}
    elif isinstance(body, BridgeStatus):
        assert 1 <= len(body.parity_errors) <= 5
    else:
        assert 1 <= len(body.fingers) <= 5


def seeds() -> list[bytes]:
    """Packets of all kinds, in order and not, and the contents of packets to be sealed."""
    slots = BridgeSlots(3, (bytes.fromhex("80 7FC1 0000 7FC1"), bytes.fromhex("A2 0101 FEF8 A540")))
    bodies: list[BridgeBody] = [_HELLO, slots, slots, BridgeStatus((1, 0, 2**32 - 1), 5, 0), slots]
    wire = [encode(BridgeHeader(7, 0, n, 1000 * n), body) for n, body in enumerate(bodies)]
    late = encode(BridgeHeader(7, 0, 1, 10), _HELLO)
    wrap = [encode(BridgeHeader(8, 0, 65535 + n & 0xFFFF, 2**32 - 9 + 8 * n & 2**32 - 1), slots)
            for n in range(3)]  # fmt: skip
    plain = [unstuffed(one[:-1]) for one in (*wire, late, *wrap)]
    contents = b"".join(bytes([len(p) - 1, 1]) + p[:-2] for p in plain if p is not None)
    return [
        bytes([9, 0]) + b"\0" + b"".join(wire),
        bytes([0, 0]) + wire[1][5:] + wire[2] + wire[2] + wire[4] + late + wire[1],
        bytes([5, 0]) + b"".join(wrap) + wire[0][:9] + b"\x01" + wire[0][10:],
        bytes([5, 1]) + contents,
        bytes([5, 1]) + bytes([3, 0, 0, 9]) + contents + bytes([4, 1, 1, 2, 7]),
    ]
