from __future__ import annotations

from itertools import pairwise

import pytest
from cobs.cobs import encode
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.gateway.bridge_packets import encode_packet

from palpate_gateway.protocols.framing import PacketSplitter, unstuffed

RISING = bytes(range(1, 256))

# The algorithm's published examples.
VECTORS = {
    b"": "01",
    b"\x00": "01 01",
    b"\x00\x00": "01 01 01",
    b"\x00\x11\x00": "01 02 11 01",
    b"\x11\x22\x00\x33": "03 11 22 02 33",
    b"\x11\x22\x33\x44": "05 11 22 33 44",
    b"\x11\x00\x00\x00": "02 11 01 01 01",
    RISING[:254]: "FF" + RISING[:254].hex(),
    b"\x00" + RISING[:254]: "01 FF" + RISING[:254].hex(),
    RISING: "FF" + RISING[:254].hex() + "02 FF",
    RISING[1:] + b"\x00": "FF" + RISING[1:].hex() + "01 01",
    RISING[2:] + b"\x00\x01": "FE" + RISING[2:].hex() + "02 01",
}


@pytest.mark.parametrize(("data", "block"), VECTORS.items())
def test_vectors(data: bytes, block: str) -> None:
    assert encode(data) == bytes.fromhex(block)
    assert unstuffed(bytes.fromhex(block)) == data


def test_a_full_piece_may_end_with_a_code_of_its_own() -> None:
    assert unstuffed(encode(RISING[:254]) + b"\x01") == RISING[:254]


@pytest.mark.parametrize("block", ["", "02", "05 11 22", "01 03 11", "02 00"])
def test_broken_blocks(block: str) -> None:
    assert unstuffed(bytes.fromhex(block)) is None


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=20).map(lambda part: part * 60))
def test_stuffing_has_no_zero_and_little_overhead(data: bytes) -> None:
    block = encode(data)
    assert 0 not in block
    assert len(block) <= len(data) + len(data) // 254 + 1
    assert unstuffed(block) == data


def test_packets_of_a_stream() -> None:
    splitter = PacketSplitter(10)
    packets = splitter.feed(encode_packet(b"one") + encode_packet(b"") + b"\x04t")
    assert [(p.data, p.wire_bytes, p.first) for p in packets] == [
        (b"one", 5, True),
        (b"", 2, False),
    ]
    assert splitter.pending == 2
    assert [p.data for p in splitter.feed(b"wo\x00")] == [b"two"]
    assert splitter.counters == {"cobs_errors": 0, "overlong": 0, "junk_bytes": 0}


def test_the_rest_of_a_packet_after_connecting_is_no_error() -> None:
    splitter = PacketSplitter(10)
    data = encode_packet(b"cut here")[4:] + encode_packet(b"whole")
    assert [p.data for p in splitter.feed(data)] == [b"whole"]
    assert splitter.counters == {"cobs_errors": 0, "overlong": 0, "junk_bytes": 6}
    splitter.feed(b"\x09ab\x00")
    assert splitter.counters == {"cobs_errors": 1, "overlong": 0, "junk_bytes": 10}


def test_lone_delimiters_are_junk_and_no_errors() -> None:
    splitter = PacketSplitter(10)
    packets = splitter.feed(b"\x00\x00" + encode_packet(b"a"))
    assert [(p.data, p.first) for p in packets] == [(b"a", False)]
    assert splitter.counters == {"cobs_errors": 0, "overlong": 0, "junk_bytes": 2}


@pytest.mark.parametrize("size", [254, 255, 508])
def test_longest_packet_passes_and_one_more_does_not(size: int) -> None:
    data = (RISING * 2)[:size]
    assert [p.data for p in PacketSplitter(size).feed(encode_packet(data))] == [data]
    splitter = PacketSplitter(size - 1)
    assert splitter.feed(encode_packet(data)) == []
    assert splitter.counters["overlong"] == 1


def test_endless_packet_holds_no_memory() -> None:
    splitter = PacketSplitter(100)
    for _ in range(1000):
        assert splitter.feed(b"\x07" * 100) == []
        assert splitter.pending <= 102
    assert splitter.counters == {"cobs_errors": 0, "overlong": 1, "junk_bytes": 100_000}
    assert [p.data for p in splitter.feed(b"\x00" + encode_packet(b"back"))] == [b"back"]


def test_longest_packet_is_at_least_a_byte() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        PacketSplitter(0)


wire = st.lists(
    st.one_of(st.binary(max_size=30), st.binary(max_size=30).map(encode_packet)), max_size=12
).map(b"".join)


@settings(max_examples=100, deadline=None)
@given(wire, st.lists(st.integers(0, 200), max_size=8))
def test_chunks_do_not_matter_and_all_bytes_are_accounted_for(data: bytes, cuts: list[int]) -> None:
    whole, parts = PacketSplitter(20), PacketSplitter(20)
    expected = whole.feed(data)
    edges = [0, *sorted(cuts), len(data)]
    got = [p for a, b in pairwise(edges) for p in parts.feed(data[a:b])]
    assert got == expected
    assert parts.counters == whole.counters
    good = sum(packet.wire_bytes for packet in got)
    assert good + parts.counters["junk_bytes"] + parts.pending == len(data)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(min_size=1, max_size=20), max_size=6), st.binary(max_size=60))
def test_every_packet_behind_junk_is_found(good: list[bytes], junk: bytes) -> None:
    splitter = PacketSplitter(20)
    splitter.feed(junk + b"\x00")
    assert [p.data for p in splitter.feed(b"".join(map(encode_packet, good)))] == good
