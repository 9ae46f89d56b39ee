from __future__ import annotations

import struct

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tests.gateway.robotous_messages import can_messages

from palpate_gateway.protocols import robotous as framing
from palpate_gateway.protocols import robotous as rft

# Every vector of the hardware reference, section 3.5.
REQUESTS = {
    "55 0B 00 00 00 00 00 00 00 0B AA": rft.START_REQUEST,
    "55 0C 00 00 00 00 00 00 00 0C AA": rft.STOP_REQUEST,
    "55 11 01 00 00 00 00 00 00 12 AA": rft.BIAS_REQUEST,
    "55 0F 05 00 00 00 00 00 00 14 AA": rft.rate_request(200),
}
DATA_FRAME = bytes.fromhex("55 0B 01F4 FF06 03E8 00C8 FF9C 0032 00 00 00 85 AA")
DATA = DATA_FRAME[1:-2]

counts6 = st.lists(st.integers(-32768, 32767), min_size=6, max_size=6)


def reply(*data: int) -> bytes:
    return bytes(data).ljust(16, b"\0")


def payload_of(counts: list[int], overload: int = 0) -> bytes:
    return struct.pack(">B6hBxx", 11, *counts, overload)


@pytest.mark.parametrize(("wire", "request_bytes"), REQUESTS.items())
def test_request_vectors(wire: str, request_bytes: bytes) -> None:
    assert framing.serial_frame(request_bytes) == bytes.fromhex(wire)
    decoder = framing.RobotousSerialDecoder(rft.REQUEST_BYTES)
    assert decoder.feed(bytes.fromhex(wire)) == [request_bytes]


def test_data_vector() -> None:
    decoder = framing.RobotousSerialDecoder()
    assert decoder.feed(DATA_FRAME) == [DATA]
    record = rft.decode(DATA)
    assert record == rft.RobotousData(
        rft.RobotousCommand.START, (500, -250, 1000, 200, -100, 50), 0
    )
    wrench = rft.scale_of("RFT40-SA01").wrench(record.counts)
    assert wrench == pytest.approx((10, -5, 20, 0.1, -0.05, 0.025))
    assert framing.serial_frame(DATA) == DATA_FRAME
    assert (decoder.pending, set(decoder.counters.values())) == (0, {0})


def test_one_sample_is_told_from_the_stream() -> None:
    record = rft.decode(b"\x0a" + DATA[1:])
    assert isinstance(record, rft.RobotousData)
    assert record.command is rft.RobotousCommand.SAMPLE


@pytest.mark.parametrize(
    ("status", "axes"),
    [
        (0, ()),
        (0b100000, ("Fx",)),
        (0b000001, ("Tz",)),
        (0b011010, ("Fy", "Fz", "Ty")),
        (0b11000000, ()),
    ],
)
def test_overloads(status: int, axes: tuple[str, ...]) -> None:
    record = rft.decode(payload_of([0] * 6, status))
    assert isinstance(record, rft.RobotousData)
    assert record.overload == status
    assert rft.overloaded_axes(status) == axes


@pytest.mark.parametrize("command", [1, 2, 3])
def test_identity_is_text_up_to_its_end(command: int) -> None:
    record = rft.decode(reply(command, *b"RFT40-SA01"))
    assert record == rft.RobotousText(rft.RobotousCommand(command), "RFT40-SA01")
    full = rft.decode(bytes((command,)) + b"ABCDEFGHIJKLMNO")
    assert full == rft.RobotousText(rft.RobotousCommand(command), "ABCDEFGHIJKLMNO")


@pytest.mark.parametrize("command", [6, 8, 15])
def test_set_replies(command: int) -> None:
    assert rft.decode(reply(command, 1)) == rft.RobotousResult(
        rft.RobotousCommand(command), True, 0
    )
    for error, name in ((1, "unsupported"), (2, "out of range"), (3, "failed")):
        refused = rft.decode(reply(command, 0, error))
        assert refused == rft.RobotousResult(rft.RobotousCommand(command), False, error)
        assert rft.ERRORS[error] == name


@pytest.mark.parametrize("payload", [b"", DATA[:15], DATA + b"\0", reply(12), reply(18), reply(99)])
def test_what_cannot_be_read_is_kept(payload: bytes) -> None:
    assert rft.decode(payload) == rft.RobotousUnknown(payload)


@pytest.mark.parametrize(
    ("model", "divisor"),
    [
        ("RFT40-SA01", 2000), ("RFT44-SB01", 2000), ("RFT60-HA01", 2000), ("RFT64-SB01", 2000),
        ("RFT76-HA01", 2000), ("RFT80-6A01", 1000), ("RFT82-HA02", 1000), ("rft80-6a01-d ", 1000),
    ],
)  # fmt: skip
def test_scales(model: str, divisor: int) -> None:
    assert rft.scale_of(model) == rft.RobotousScale(divisor)


def test_scale_is_a_setting() -> None:
    assert rft.scale_of("RFT40-SA01", torque_divisor=1000).torque_divisor == 1000
    assert rft.scale_of("", torque_divisor=1500).torque_divisor == 1500
    with pytest.raises(ValueError, match="not in RFT40-SA01"):
        rft.scale_of("RFT99-XX01")
    for wrong in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="above 0"):
            rft.scale_of("RFT40-SA01", torque_divisor=wrong)


def test_filter_codes_follow_the_manuals_unless_told() -> None:
    manuals = [rft.filter_request(cutoff)[:3] for cutoff in rft.CUTOFFS_HZ]
    assert manuals == [bytes((8, 1, code)) for code in range(1, 15)]
    header = rft.RobotousFilterOrder.SAMPLE_HEADER
    assert rft.filter_request(500, order=header)[:3] == bytes((8, 1, 14))
    assert rft.filter_request(1, order=header)[:3] == bytes((8, 1, 1))
    assert rft.filter_request(None) == reply(8)[:8]
    with pytest.raises(ValueError, match=r"cutoff \[Hz\] 7 is not one of 1, 2, 3"):
        rft.filter_request(7)


def test_requests() -> None:
    assert rft.request(rft.RobotousCommand.MODEL) == reply(1)[:8]
    assert rft.baud_request(921600) == reply(6, 1)[:8]
    rates = {rate: rft.rate_request(rate)[1] for rate in (10, 20, 50, 100, 200, 333, 500, 1000)}
    assert rates == {10: 1, 20: 2, 50: 3, 100: 4, 200: 5, 333: 6, 500: 7, 1000: 8}


def test_requests_out_of_range() -> None:
    with pytest.raises(ValueError, match=r"rate \[Hz\] 300 is not one of 10, 20"):
        rft.rate_request(300)
    with pytest.raises(ValueError, match="baud 9600 is not one of 57600"):
        rft.baud_request(9600)


def test_rates_fit_the_line() -> None:
    assert rft.HIGHEST_RATE_HZ.keys() == rft.BAUD_CODES.keys()
    for baud, rate_hz in rft.HIGHEST_RATE_HZ.items():
        assert 19 * 10 * rate_hz <= baud


@pytest.mark.parametrize("size", [0, 7, 15, 17])
def test_framing_wants_8_or_16_bytes(size: int) -> None:
    with pytest.raises(ValueError, match="neither 8 nor 16"):
        framing.serial_frame(bytes(size))


def test_damaged_frame_is_dropped_and_the_next_found() -> None:
    for at in range(len(DATA_FRAME)):
        decoder = framing.RobotousSerialDecoder()
        broken = bytearray(DATA_FRAME)
        broken[at] ^= 0x10
        assert decoder.feed(bytes(broken) + DATA_FRAME) == [DATA]
        assert decoder.counters["junk_bytes"] == 19
        assert decoder.counters["failed_checks"] == (at > 0)


def test_cut_frame_does_not_hide_the_next() -> None:
    decoder = framing.RobotousSerialDecoder()
    assert decoder.feed(DATA_FRAME[:9] + DATA_FRAME + DATA_FRAME) == [DATA, DATA]
    assert decoder.counters == {"junk_bytes": 9, "failed_checks": 1}


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.binary(max_size=12), counts6), max_size=5),
    st.lists(st.integers(1, 30), max_size=20),
)
def test_junk_and_cuts_lose_nothing(parts: list[tuple[bytes, list[int]]], cuts: list[int]) -> None:
    stream, wanted, starts = b"", [], []
    for junk, counts in parts:
        stream += junk + b"\x55"  # a false head directly before the true one
        starts.append(len(stream))
        wanted.append(payload_of(counts))
        stream += framing.serial_frame(wanted[-1])
    for at in range(len(stream) - 18):  # a right sum and end by chance: once in 65536 false heads
        candidate = stream[at : at + 19]
        assume(at in starts or candidate != framing.serial_frame(candidate[1:-2]))
    whole, cut = framing.RobotousSerialDecoder(), framing.RobotousSerialDecoder()
    assert whole.feed(stream) == wanted
    assert whole.counters["junk_bytes"] + 19 * len(wanted) + whole.pending == len(stream)
    at, payloads = 0, []
    for size in [*cuts, len(stream)]:
        payloads += cut.feed(stream[at : at + size])
        at += size
    assert payloads == wanted
    assert cut.counters == whole.counters


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=60)), st.binary(min_size=16, max_size=16))
def test_any_bytes_are_accepted(chunks: list[bytes], payload: bytes) -> None:
    decoder = framing.RobotousSerialDecoder()
    frames = sum(len(decoder.feed(chunk)) for chunk in chunks)
    decoder.reset()
    assert decoder.counters["junk_bytes"] + 19 * frames == sum(map(len, chunks))
    rft.decode(payload)


# Letters: f, s = halves of the k-th sample, in order of arrival.
CAN_ORDERS = {
    "f0 s0 f1 s1": ([0, 1], 0, 0, 0),
    "s0 f1 s1": ([1], 0, 1, 0),
    "f0 f1 s1": ([1], 1, 0, 0),
    "f0 s0 s1 f1 f2 s2": ([0, 2], 1, 1, 1),
    "s0 f1 s1 f2 f3 s3": ([1, 3], 1, 1, 0),
    "s0 s1 f2 s2": ([2], 0, 2, 0),
    "f0 s0 f2 s2": ([0, 2], 0, 0, 0),
}


def can_message(name: str) -> tuple[int, bytes]:
    payload = payload_of([int(name[1])] * 6)
    return can_messages(payload)[name[0] == "s"]


@pytest.mark.parametrize(("order", "wanted"), CAN_ORDERS.items())
def test_can_halves(order: str, wanted: tuple[list[int], int, int, int]) -> None:
    decoder = framing.RobotousCanDecoder()
    payloads = [p for name in order.split() for p in decoder.feed(*can_message(name))]
    samples, lonely_first, lonely_second, swapped = wanted
    assert payloads == [payload_of([sample] * 6) for sample in samples]
    assert decoder.counters == {
        "other_ids": 0,
        "wrong_lengths": 0,
        "lonely_first": lonely_first,
        "lonely_second": lonely_second,
        "swapped_pairs": swapped,
    }


def test_can_ids_are_settings() -> None:
    decoder = framing.RobotousCanDecoder(first_id=0x21, second_id=0x20)
    first, second = can_messages(DATA, 0x21, 0x20)
    assert framing.REQUEST_ID == 0x64
    assert decoder.feed(1, b"12345678") == []
    assert decoder.feed(*first) == []
    assert decoder.feed(*second) == [DATA]
    assert decoder.counters["other_ids"] == 1
    for ids in ((1, 1), (0, 1), (1, 256)):
        with pytest.raises(ValueError, match=r"1\.\.255"):
            framing.RobotousCanDecoder(*ids)
    with pytest.raises(ValueError, match="not 16"):
        can_messages(DATA[:8])


def test_can_message_of_wrong_length_takes_its_sample_with_it() -> None:
    decoder = framing.RobotousCanDecoder()
    decoder.feed(1, DATA[:8])
    assert decoder.feed(2, DATA[8:15]) == []
    assert decoder.feed(2, DATA[8:]) == []
    assert decoder.counters["wrong_lengths"] == 1
    assert (decoder.counters["lonely_first"], decoder.counters["lonely_second"]) == (1, 1)


def test_can_reset_forgets_the_half_that_waits() -> None:
    decoder = framing.RobotousCanDecoder()
    decoder.feed(1, DATA[:8])
    assert decoder.pending == 1
    decoder.reset()
    assert decoder.feed(2, DATA[8:]) == []
    assert decoder.pending == 0
    assert (decoder.counters["lonely_first"], decoder.counters["lonely_second"]) == (1, 1)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.binary(min_size=6, max_size=9))))
def test_every_can_message_is_accounted_for(messages: list[tuple[int, bytes]]) -> None:
    decoder = framing.RobotousCanDecoder()
    answers = [payload for message in messages for payload in decoder.feed(*message)]
    dropped = sum(decoder.counters.values()) - decoder.counters["swapped_pairs"]
    assert 2 * len(answers) + dropped + decoder.pending == len(messages)
