from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.gateway import spi_words
from tests.gateway.bridge_packets import encode, encode_packet, sealed_packet

from palpate_gateway.protocols.bridge import (
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
from palpate_gateway.protocols.can_slots import SlotDecoder, payload_rows
from palpate_gateway.protocols.channels import SEQUENCES
from palpate_gateway.protocols.framing import crc16_x25, unstuffed
from palpate_gateway.protocols.slot_clock import SlotClock

HELLO = BridgeHello(4400, 44, (BridgeFinger("BT00000000000123", "0205"), BridgeFinger("", "")))
STATUS = BridgeStatus((1, 2, 3), 4, 5)
# The payload is the vector of format A, hardware reference 2.1.
PAC_2040 = bytes.fromhex("80 7F C1 7F C1 7F C1")
SLOTS = BridgeSlots(3, (PAC_2040, bytes.fromhex("A2 7FC1 0000 7FC1")))


def packet(
    sequence: int, time_us: int, body: BridgeBody = STATUS, *, source: int = 0, flags: int = 0
) -> bytes:
    return encode(BridgeHeader(source, flags, sequence % 65536, time_us % 2**32), body)


def counted(decoder: BridgeDecoder) -> dict[str, int]:
    return {key: n for key, n in decoder.counters.items() if n and key != "packets"}


def test_checksum_of_the_reference() -> None:
    assert crc16_x25(b"123456789") == 0x906E


@pytest.mark.parametrize(
    ("body", "kind", "body_hex"),
    [
        (
            HELLO,
            "01",
            "02 3011 2C" + b"BT00000000000123".hex() + b"0205".hex() + "00" * 20,
        ),
        (SLOTS, "02", "02 03 80 7FC1 7FC1 7FC1 A2 7FC1 0000 7FC1"),
        (STATUS, "03", "03 01000000 02000000 03000000 04000000 05000000"),
    ],
)
def test_bytes_of_every_message(body: BridgeBody, kind: str, body_hex: str) -> None:
    data = bytes.fromhex("01" + kind + "07 80 FEFF 40E20100" + body_hex)
    wire = packet(0xFFFE, 123456, body, source=7, flags=0x80)
    assert wire[-1] == 0
    assert unstuffed(wire[:-1]) == data + crc16_x25(data).to_bytes(2, "little")
    decoder = BridgeDecoder()
    assert decoder.feed(wire) == [
        BridgeRecord(BridgeHeader(7, 0x80, 0xFFFE, 123456), body, 0, 0, 123456)
    ]
    assert counted(decoder) == {}


def test_a_status_packet_to_the_byte() -> None:
    wire = packet(1, 2, BridgeStatus((0,), 0, 0))
    assert wire.hex(" ").upper() == (
        "03 01 03 01 02 01 02 02 01 01 02 01 01 01 01 01 01 01 01 01 01 01 01 03 59 59 00"
    )


def test_slots_are_read_as_those_of_a_bus() -> None:
    (record,) = BridgeDecoder().feed(packet(0, 0, SLOTS))
    assert isinstance(record.body, BridgeSlots)
    slots = SlotDecoder(fingers=record.body.fingers)
    assert slots.decode(*payload_rows(record.body.payloads)).channel.tolist() == [0, 17]
    assert slots.finger_counters[1]["absent"] == 1


@pytest.mark.parametrize("name", ["biotac_e1_first", "biotac_pac_first"])
def test_bridge_times_place_slots_without_doubt(name: str) -> None:
    decoder, clock = BridgeDecoder(), SlotClock(sequence=SEQUENCES[name], exact=True)
    words = spi_words.encode_word(2040)
    group = BridgeSlots(
        1,
        tuple(bytes((spi_words.command_byte(c),)) + words for c in SEQUENCES[name]),
    )
    places = []
    for number in [0, 1, 2, 5, 6]:
        for record in decoder.feed(packet(number, number * 10_000, group)):
            assert isinstance(record.body, BridgeSlots)
            decoded = SlotDecoder(fingers=1).decode(*payload_rows(record.body.payloads))
            stamps_s = record.time_us * 1e-6 + np.arange(len(decoded)) / 4400
            places.append(clock.place_all(decoded.channel, stamps_s))
    assert decoder.counters["lost_packets"] == 2
    assert clock.counters["lost_frames"] == 2
    assert clock.counters["lost_slots"] == 0
    told = [frame for place in places for frame in place.frame[place.position == 43].tolist()]
    first = 0 if name == "biotac_e1_first" else 1
    assert told == [n - first for n in (0, 1, 2, 5, 6)[first:]]


HEAD = bytes.fromhex("01 03 00 00 0100 00000000")


@pytest.mark.parametrize(
    ("wire", "counter"),
    [
        (encode_packet(b"short"), "short_packets"),
        (encode_packet(HEAD + b"\x01" + bytes(14)), "crc_errors"),
        (sealed_packet(b"\x02" + HEAD[1:] + bytes(13)), "unknown_versions"),
        (sealed_packet(b"\x01\x04" + HEAD[2:]), "unknown_types"),
        (sealed_packet(HEAD), "bad_bodies"),
        (b"\x09abc\x00", "cobs_errors"),
        (b"a" * 3000 + b"\x00", "overlong"),
    ],
)
def test_bad_packets_are_counted_and_the_next_is_found(wire: bytes, counter: str) -> None:
    decoder = BridgeDecoder()
    start = packet(0, 0)
    assert len(decoder.feed(start + wire + packet(2, 10))) == 2
    assert decoder.counters.pop(counter) == 1
    assert counted(decoder) in (
        {"junk_bytes": len(wire), "lost_packets": 1},
        {"junk_bytes": len(wire)},  # the number of the bad packet was good
    )


def test_the_rest_of_a_packet_after_connecting_is_no_error() -> None:
    wire = packet(0, 0, HELLO)
    for cut in range(1, len(wire)):
        decoder = BridgeDecoder()
        assert len(decoder.feed(wire[cut:] + packet(1, 1))) == 1
        assert counted(decoder) == {"junk_bytes": len(wire) - cut}


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        (1, ""), (1, "00 3011 2C"), (1, "01 3011 2C" + "00" * 19), (1, "06 3011 2C" + "00" * 120),
        (2, ""), (2, "01"), (2, "00 00"), (2, "01 06" + "00" * 13), (2, "02 01 80 7FC1"),
        (3, ""), (3, "00" * 9), (3, "01" + "00" * 11), (4, "00"), (0, ""),
    ],
)  # fmt: skip
def test_bodies_that_do_not_fit(kind: int, body: str) -> None:
    assert decode_body(kind, bytes.fromhex(body)) is None


def test_an_empty_group_of_slots_is_good() -> None:
    assert decode_body(2, bytes((0, 3))) == BridgeSlots(3, ())


def test_the_largest_packet_passes() -> None:
    group = BridgeSlots(5, (b"\x80" + b"\x7f\xc1" * 5,) * 255)
    (record,) = BridgeDecoder().feed(packet(0, 0, group))
    assert record.body == group


text = st.text(st.characters(min_codepoint=0x21, max_codepoint=0x7E), max_size=4)
payload = st.binary(min_size=5, max_size=5)
bodies: st.SearchStrategy[BridgeBody] = st.one_of(
    st.builds(
        BridgeHello,
        st.integers(0, 65535),
        st.integers(0, 255),
        st.lists(st.builds(BridgeFinger, text, text), min_size=1, max_size=5).map(tuple),
    ),
    st.builds(BridgeSlots, st.just(2), st.lists(payload, max_size=60).map(tuple)),
    st.builds(
        BridgeStatus,
        st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=5).map(tuple),
        st.integers(0, 2**32 - 1),
        st.integers(0, 2**32 - 1),
    ),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(bodies, max_size=5), st.lists(st.binary(max_size=40), min_size=5, max_size=5))
def test_every_packet_survives_junk_between(sent: list[BridgeBody], junk: list[bytes]) -> None:
    decoder = BridgeDecoder()
    wire = b""
    good = 0
    for number, (body, before) in enumerate(zip(sent, junk, strict=False)):
        one = packet(number, 10_000 * number, body)
        good += len(one)
        wire += before + b"\x00" + one
    records = decoder.feed(wire)
    assert [record.body for record in records] == sent
    assert decoder.counters["lost_packets"] == 0
    assert good + decoder.counters["junk_bytes"] + decoder.pending == len(wire)


pieces = st.one_of(
    st.binary(max_size=30),
    st.builds(packet, st.integers(0, 9), st.integers(0, 2**32 - 1), bodies),
    st.binary(max_size=30).map(sealed_packet),
    st.binary(max_size=30).map(lambda body: sealed_packet(HEAD + body)),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(pieces, max_size=8).map(b"".join), st.lists(st.integers(0, 300), max_size=8))
def test_chunks_do_not_matter(data: bytes, cuts: list[int]) -> None:
    whole, parts = BridgeDecoder(), BridgeDecoder()
    expected = whole.feed(data)
    edges = [0, *sorted(cuts), len(data)]
    got = [r for a, b in pairwise(edges) for r in parts.feed(data[a:b])]
    assert got == expected
    assert parts.counters == whole.counters
    assert parts.counters["packets"] == len(got)
    assert parts.pending == whole.pending


@settings(max_examples=100, deadline=None)
@given(bodies, st.integers(0, 10_000), st.integers(0, 7))
def test_a_flipped_bit_never_passes(body: BridgeBody, at: int, bit: int) -> None:
    wire = bytearray(packet(1, 1, body))
    wire[at % len(wire)] ^= 1 << bit
    records = BridgeDecoder().feed(bytes(wire) + b"\x00")
    assert records == []
