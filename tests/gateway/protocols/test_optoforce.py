from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_gateway.protocols import optoforce
from palpate_gateway.protocols.framing import sum16
from palpate_gateway.protocols.optoforce import OptoForceData, OptoForceDecoder, OptoForceReply

# Every vector of the hardware reference, section 3.4.
CONFIGURE = bytes.fromhex("AA 00 32 03 0A 04 FF 01 EC")
REPLY = bytes.fromhex("AA 00 50 01 00 00 FB")
REAL_FRAME = bytes.fromhex("AA 07 08 0A 2D 6A 00 00 FF F7 FF FB 00 07 05 51")

SIZES = {3: 16, 6: 22, 12: 34}
HEADS = {3: 0x0A, 6: 0x10, 12: 0x1C}

samples = st.sampled_from([3, 6, 12]).flatmap(
    lambda size: st.lists(st.integers(-32768, 32767), min_size=size, max_size=size)
)


def data_frame(count: int, status: int, counts: list[int]) -> bytes:
    head = bytes((0xAA, 7, 8, HEADS[len(counts)]))
    body = head + struct.pack(f">HH{len(counts)}h", count, status, *counts)
    return body + struct.pack(">H", sum16(body))


def test_configure_vector() -> None:
    assert optoforce.configure_request(rate_hz=100, cutoff_hz=15, zero=True) == CONFIGURE


def test_reply_vector() -> None:
    assert OptoForceDecoder().feed(REPLY) == [OptoForceReply(0)]


def test_real_frame() -> None:
    decoder = OptoForceDecoder()
    assert decoder.feed(REAL_FRAME) == [OptoForceData(11626, 0, (-9, -5, 7))]
    assert decoder.counters == {"junk_bytes": 0, "failed_checks": 0}
    assert data_frame(11626, 0, [-9, -5, 7]) == REAL_FRAME


@pytest.mark.parametrize(("values", "size"), SIZES.items())
def test_data_frames(values: int, size: int) -> None:
    counts = [(-1) ** k * (30000 + k) for k in range(values)]
    frame = data_frame(65535, 0x8001, counts)
    assert len(frame) == size
    assert OptoForceDecoder().feed(frame) == [OptoForceData(65535, 0x8001, tuple(counts))]


@pytest.mark.parametrize(
    ("rate_hz", "code"), [(0, 0), (1000, 1), (333, 3), (100, 10), (30, 33), (10, 100)]
)
def test_rates(rate_hz: int, code: int) -> None:
    request = optoforce.configure_request(rate_hz=rate_hz, cutoff_hz=None, zero=False)
    assert request[4:7] == bytes((code, 0, 0))
    assert int.from_bytes(request[7:], "big") == sum16(request[:7])


@pytest.mark.parametrize(
    ("cutoff_hz", "code"), [(None, 0), (500, 1), (150, 2), (50, 3), (15, 4), (5, 5), (1.5, 6)]
)
def test_filters(cutoff_hz: float | None, code: int) -> None:
    request = optoforce.configure_request(rate_hz=1000, cutoff_hz=cutoff_hz, zero=True)
    assert request[4:7] == bytes((1, code, 255))


def test_requests_out_of_range() -> None:
    with pytest.raises(ValueError, match=r"rate \[Hz\] 200 is not one of 0, 1000"):
        optoforce.configure_request(rate_hz=200, cutoff_hz=15, zero=False)
    with pytest.raises(ValueError, match=r"cutoff \[Hz\] 0 is not one of None, 500"):
        optoforce.configure_request(rate_hz=100, cutoff_hz=0, zero=False)


def test_every_damaged_byte_shows() -> None:
    for at in range(len(REAL_FRAME)):
        decoder = OptoForceDecoder()
        broken = bytearray(REAL_FRAME)
        broken[at] ^= 0x04
        assert decoder.feed(bytes(broken) + REAL_FRAME * 3)[-1] == OptoForceData(
            11626, 0, (-9, -5, 7)
        )
        assert decoder.counters["junk_bytes"] == 16
        assert decoder.counters["failed_checks"] == (at > 3)


def test_longer_head_does_not_swallow_shorter_frames() -> None:
    # A damaged 34-byte frame of which only the head came: its 34 bytes hold two whole frames.
    decoder = OptoForceDecoder()
    stream = bytes.fromhex("AA 07 08 1C") + REAL_FRAME * 2
    assert len(decoder.feed(stream)) == 2
    assert decoder.counters == {"junk_bytes": 4, "failed_checks": 1}


def test_reset_forgets_partial_bytes() -> None:
    decoder = OptoForceDecoder()
    decoder.feed(REAL_FRAME[:3])
    assert decoder.pending == 3
    decoder.reset()
    assert decoder.feed(REAL_FRAME) == [OptoForceData(11626, 0, (-9, -5, 7))]
    assert decoder.counters["junk_bytes"] == 3


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.binary(max_size=40), st.integers(0, 65535), samples), max_size=5),
    st.lists(st.integers(1, 40), max_size=20),
)
def test_junk_and_cuts_lose_nothing(
    parts: list[tuple[bytes, int, list[int]]], cuts: list[int]
) -> None:
    stream, wanted = b"", []
    for junk, count, counts in parts:
        # False heads that end in each length; a right sum behind one is a matter of 1 in 65536.
        stream += junk + bytes.fromhex("AA 07 08 AA 07") + data_frame(count, 0, counts)
        wanted.append(OptoForceData(count, 0, tuple(counts)))
    stream += bytes(40)
    whole, cut = OptoForceDecoder(), OptoForceDecoder()
    assert whole.feed(stream) == wanted
    taken = sum(SIZES[len(counts)] for _, _, counts in parts)
    assert whole.counters["junk_bytes"] + taken + whole.pending == len(stream)
    at, records = 0, []
    for size in [*cuts, len(stream)]:
        records += cut.feed(stream[at : at + size])
        at += size
    assert records == wanted
    assert cut.counters == whole.counters


@settings(max_examples=100, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=80), st.sampled_from([REPLY, REAL_FRAME[:9]]))))
def test_any_bytes_are_accepted(chunks: list[bytes]) -> None:
    decoder = OptoForceDecoder()
    taken = 0
    for chunk in chunks:
        for record in decoder.feed(chunk):
            taken += 7 if isinstance(record, OptoForceReply) else SIZES[len(record.counts)]
        assert decoder.pending < 34
        done = taken + decoder.counters["junk_bytes"] + decoder.pending
    assert not chunks or done == sum(map(len, chunks))


def test_scale() -> None:
    scale = optoforce.OptoForceScale(counts=(1000, 2000, 8000), loads=(10, 10, 40))
    assert scale.values((-100, 200, 80)) == pytest.approx((-1, 1, 0.4))
    with pytest.raises(ValueError, match="6 counts do not fit a scale of 3"):
        scale.values((0,) * 6)


@pytest.mark.parametrize(
    ("counts", "loads", "message"),
    [
        ((1, 1), (1, 1), "not 3, 6 or 12"),
        ((1, 1, 1), (1,) * 6, "not 3, 6 or 12"),
        ((1, 0, 1), (1, 1, 1), "zero or not finite"),
        ((1, 1, 1), (1, 1, float("nan")), "zero or not finite"),
    ],
)
def test_wrong_scales(counts: tuple[float, ...], loads: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        optoforce.OptoForceScale(counts, loads)
