from __future__ import annotations

import math
import struct

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from palpate_gateway.protocols import bota
from palpate_gateway.protocols.framing import crc16_x25

# The vector of the hardware reference, section 3.6.
VECTOR = bytes.fromhex(
    "AA 0000 0000803F 00000040 00004040 CDCCCC3D CDCC4C3E 9A99993E 40E20100 0000CC41 7235"
)

floats7 = st.lists(st.floats(width=32), min_size=7, max_size=7)


def frame_of(status: int, wrench: list[float], time_us: int, temperature_c: float) -> bytes:
    body = struct.pack("<H6fIf", status, *wrench, time_us, temperature_c)
    return b"\xaa" + body + struct.pack("<H", crc16_x25(body))


def test_vector() -> None:
    decoder = bota.BotaDecoder()
    (frame,) = decoder.feed(VECTOR)
    assert frame.wrench == pytest.approx((1, 2, 3, 0.1, 0.2, 0.3))
    assert (frame.status, frame.device_time_us, frame.temperature_c) == (0, 123456, 25.5)
    assert decoder.counters == {"junk_bytes": 0, "failed_checks": 0}
    assert frame_of(0, [1, 2, 3, 0.1, 0.2, 0.3], 123456, 25.5) == VECTOR


def test_status_names() -> None:
    assert bota.status_names(0) == ()
    assert bota.status_names(0b1111) == ("app took too long", "overrange", "invalid", "raw")
    assert bota.status_names(bota.OVERRANGE | bota.INVALID) == ("overrange", "invalid")
    assert bota.status_names(0x8010) == ("bit 4", "bit 15")


def test_status_and_time_are_raw() -> None:
    (frame,) = bota.BotaDecoder().feed(frame_of(0xBEEF, [0] * 6, 0xFFFFFFFF, -3))
    assert (frame.status, frame.device_time_us, frame.temperature_c) == (0xBEEF, 2**32 - 1, -3)


def test_every_damaged_byte_shows() -> None:
    for at in range(len(VECTOR)):
        decoder = bota.BotaDecoder()
        broken = bytearray(VECTOR)
        broken[at] ^= 0x40
        assert len(decoder.feed(bytes(broken) + VECTOR)) == 1
        assert decoder.counters["junk_bytes"] == 37
        assert decoder.counters["failed_checks"] == (at > 0)


def test_head_inside_data_does_not_hide_the_frame() -> None:
    # Every data byte is a head; the stream begins in the middle of a frame.
    frame = frame_of(0xAAAA, list(struct.unpack("<6f", b"\xaa" * 24)), 0xAAAAAAAA, 20)
    decoder = bota.BotaDecoder()
    assert len(decoder.feed(frame[5:] + frame + frame)) == 2
    assert decoder.counters["junk_bytes"] == 32


def test_text_before_frames_is_junk() -> None:
    decoder = bota.BotaDecoder()
    assert len(decoder.feed(b"r,0,R,0\r\n" + VECTOR)) == 1
    assert decoder.counters["junk_bytes"] == 9


def test_values_that_are_no_numbers_are_kept() -> None:
    decoder = bota.BotaDecoder()
    (frame,) = decoder.feed(frame_of(4, [math.nan, math.inf, 0, 0, 0, 0], 1, 20))
    assert math.isnan(frame.wrench[0])


def test_reset_forgets_partial_bytes() -> None:
    decoder = bota.BotaDecoder()
    decoder.feed(VECTOR[:20])
    assert decoder.pending == 20
    decoder.reset()
    assert decoder.feed(VECTOR[20:]) == []
    assert len(decoder.feed(VECTOR)) == 1
    assert decoder.counters["junk_bytes"] == 37


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.binary(max_size=50), floats7, st.integers(0, 2**32 - 1)), max_size=4),
    st.lists(st.integers(1, 50), max_size=20),
)
def test_junk_and_cuts_lose_nothing(
    parts: list[tuple[bytes, list[float], int]], cuts: list[int]
) -> None:
    stream, starts = b"", []
    for junk, values, time_us in parts:
        stream += junk + b"\xaa"  # a false head directly before the true one
        starts.append(len(stream))
        stream += frame_of(0, values[:6], time_us, values[6])
    for at in range(len(stream) - 36):  # a right CRC by chance: once in 65536 false heads
        good = int.from_bytes(stream[at + 35 : at + 37], "little") == crc16_x25(
            stream[at + 1 : at + 35]
        )
        assume(at in starts or stream[at] != 0xAA or not good)
    whole, cut = bota.BotaDecoder(), bota.BotaDecoder()
    frames = whole.feed(stream)
    assert [frame.device_time_us for frame in frames] == [part[2] for part in parts]
    assert whole.counters["junk_bytes"] + 37 * len(frames) + whole.pending == len(stream)
    at, again = 0, []
    for size in [*cuts, len(stream)]:
        again += cut.feed(stream[at : at + size])
        at += size
    assert repr(again) == repr(frames)  # NaN does not equal itself
    assert cut.counters == whole.counters


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=80)))
def test_any_bytes_are_accepted(chunks: list[bytes]) -> None:
    decoder = bota.BotaDecoder()
    frames = 0
    for chunk in chunks:
        frames += len(decoder.feed(chunk))
        assert decoder.pending < 37
    decoder.reset()
    assert decoder.counters["junk_bytes"] + 37 * frames == sum(map(len, chunks))


def test_requests() -> None:
    assert bota.communication_request(baud=460800) == b"c,0,1,0,4"
    assert bota.communication_request(baud=230400, temperature_compensation=True) == b"c,1,1,0,3"
    assert bota.filter_request(512) == b"f,512,0,0,1"
    assert bota.filter_request(51, chop=True, fast=True, fir=True) == b"f,51,1,1,0"
    assert bota.offsets_request([1, -2, 0.5, 0, 0, -0.0625]) == (
        b"b,1.000,-2.000,0.500,0.000,0.000,-0.062"
    )


def test_requests_out_of_range() -> None:
    with pytest.raises(ValueError, match="baud 1000000 is not one of 9600, 57600"):
        bota.communication_request(baud=1_000_000)
    for sinc in (4, 8, 0, 513):
        with pytest.raises(ValueError, match="not one of 51, 64, 128, 205, 256, 512"):
            bota.filter_request(sinc)
        with pytest.raises(ValueError, match="not one of 51"):
            bota.period_s(sinc)
    for values in ([0] * 5, [0] * 5 + [math.nan]):
        with pytest.raises(ValueError, match="six finite"):
            bota.offsets_request(values)


@pytest.mark.parametrize(
    ("sinc", "period_ms"), [(51, 1.0), (64, 1.25), (128, 2.5), (205, 4.0), (256, 5.0), (512, 10.0)]
)
def test_periods(sinc: int, period_ms: float) -> None:
    assert bota.period_s(sinc) == pytest.approx(period_ms * 1e-3, rel=5e-3)


def test_baud_codes() -> None:
    assert bota.BAUD_CODES == {9600: 0, 57600: 1, 115200: 2, 230400: 3, 460800: 4}
    assert bota.BAUDS_TO_PROBE == (460800, 230400)


def test_expected_replies() -> None:
    assert bota.expected_reply(b"C") == b"r,0,C,0"
    assert bota.expected_reply(bota.communication_request(baud=460800)) == b"r,0,c,0"
    assert bota.expected_reply(bota.filter_request(64)) == b"r,0,f,0"
    assert bota.expected_reply(bota.offsets_request([0] * 6)) == b"r,0,b,0"
    assert bota.expected_reply(b"R") == b"r,0,R,0"


def test_refusal_is_told() -> None:
    assert bota.find_ack(b"\r\nr,0,f,0\r\n") == bota.BotaAck("f", 0)
    assert bota.find_ack(b"xr,0,c,17") == bota.BotaAck("c", 17)
    assert bota.find_ack(b"App Init") is None


@pytest.mark.parametrize("size", [1, 2, 5, 100])
def test_wait_hands_on_what_follows(size: int) -> None:
    wait, decoder = bota.BotaTextWait(b"r,0,R,0"), bota.BotaDecoder()
    stream = b"noise r,0,R" + b"r,0,R,0" + VECTOR * 2
    frames = []
    for at in range(0, len(stream), size):
        rest = wait.feed(stream[at : at + size])
        frames += decoder.feed(rest or b"")
    assert len(frames) == 2
    assert decoder.counters["junk_bytes"] == 0
    assert wait.before == b"noise r,0,R"


def test_boot_text() -> None:
    wait = bota.BotaTextWait(bota.BOOT_TEXT)
    assert wait.feed(b"\x00garbage App In") is None
    assert wait.feed(b"it\r\n") == b"\r\n"


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=400)))
def test_wait_is_bounded(chunks: list[bytes]) -> None:
    wait = bota.BotaTextWait(b"App Init")
    for chunk in chunks:
        wait.feed(chunk)
        assert len(wait.before) <= 256
    bota.find_ack(b"".join(chunks))
