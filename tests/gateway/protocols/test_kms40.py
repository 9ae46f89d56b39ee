from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_gateway.protocols import kms40 as ask
from palpate_gateway.protocols.kms40 import (
    AXES,
    FAULTS,
    LINE_MAX,
    REFUSALS,
    KmsDecoder,
    KmsFlags,
    KmsForceLine,
    KmsLineFault,
    KmsRefusal,
    KmsReply,
    flag_names,
    over_range_axes,
    parse_flags,
    parse_line,
)

GOOD = b"F={1.5,-0.25,1.0,0.02,-0.01,0.005},4711"
SAMPLE = KmsForceLine((1.5, -0.25, 1.0), (0.02, -0.01, 0.005), 4711)

number = st.floats(allow_nan=False, allow_infinity=False)


def fed(decoder: KmsDecoder) -> int:
    counters = decoder.counters
    return counters["record_bytes"] + counters["junk_bytes"] + decoder.pending


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b" \r\n"])
def test_data_line(end: bytes) -> None:
    decoder = KmsDecoder()
    assert decoder.feed(GOOD + end) == [SAMPLE]
    expected = {"data_lines": 1, "record_bytes": len(GOOD + end)}
    assert decoder.counters == KmsDecoder().counters | expected


@pytest.mark.parametrize(
    ("line", "timestamp"),
    [
        (b"F={1,-2.,.5,0,+4e-3,-5E1}", None),
        (b"F={1, -2.0, 0.5, 0, 0.004, -50.0}, 12", 12),
        (b"F={1,-2,0.5,0,0.004,-50},18446744073709551615", 2**64 - 1),
        (b"F={1,-2,0.5,0,0.004,-50},12.5", None),
        (b"F={1,-2,0.5,0,0.004,-50},-3", None),
    ],
)
def test_data_lines_with_and_without_time_stamp(line: bytes, timestamp: int | None) -> None:
    decoder = KmsDecoder()
    expected = KmsForceLine((1.0, -2.0, 0.5), (0.0, 0.004, -50.0), timestamp)
    assert decoder.feed(line + b"\n") == [expected]
    assert decoder.counters["untimed_lines"] == (timestamp is None)


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        (b"L1", KmsReply("L1", "")),
        (b"L0\r", KmsReply("L0", "")),
        (b"TARE=1", KmsReply("TARE", "1")),
        (b"T=25.7", KmsReply("T", "25.7")),
        (b'ID="KMS 40"', KmsReply("ID", "KMS 40")),
        (b'SN="', KmsReply("SN", '"')),
        (b"LMASK={1,1,1,1,1,1}", KmsReply("LMASK", "{1,1,1,1,1,1}")),
        (b"D=", KmsReply("D", "")),
    ],
)
def test_replies(line: bytes, reply: KmsReply) -> None:
    assert parse_line(line) == reply


@pytest.mark.parametrize(
    ("line", "refusal"),
    [
        (b"ERROR(14)", KmsRefusal(14, "unknown command")),
        (b'ERROR(24,"LDIV")', KmsRefusal(24, "invalid parameter")),
        (b"ERROR(0)", KmsRefusal(0, "success")),
        (b"ERROR(77)", KmsRefusal(77, "unknown error 77")),
    ],
)
def test_refusals(line: bytes, refusal: KmsRefusal) -> None:
    assert parse_line(line) == refusal


def test_every_refusal_of_the_reference_has_a_name() -> None:
    assert sorted(REFUSALS) == list(range(31))
    assert REFUSALS[11] == "checksum error"
    assert REFUSALS[30] == "file exists"


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        (b"", KmsLineFault.BLANK),
        (b"\r", KmsLineFault.BLANK),
        (b"F={nan,0,0,0,0,0},1", KmsLineFault.BAD_NUMBER),
        (b"F={0,inf,0,0,0,0}", KmsLineFault.BAD_NUMBER),
        (b"F={0,0,-Infinity,0,0,0}", KmsLineFault.BAD_NUMBER),
        (b"F={0,0,0,1e999,0,0}", KmsLineFault.BAD_NUMBER),
        (b"F={0,0,0,0,1_0,0}", KmsLineFault.BAD_NUMBER),
        (b"F={0,0,0,0,,0}", KmsLineFault.BAD_NUMBER),
        (b"F={0,0,0,0,0}", KmsLineFault.WRONG_COUNT),
        (b"F={0,0,0,0,0,0,0}", KmsLineFault.WRONG_COUNT),
        (b"F={}", KmsLineFault.WRONG_COUNT),
        (b"F={0,0,0,0,0,0", KmsLineFault.MALFORMED),
        (b"F=0,0,0,0,0,0", KmsLineFault.MALFORMED),
        (b"F={0,0,0,0,0,0}7", KmsLineFault.MALFORMED),
        (b"F={0,0,0,0,0,0},", KmsLineFault.MALFORMED),
        (b"F={0,0,0,0,0,0},later", KmsLineFault.MALFORMED),
        (b"F={0,0,0F={0,0,0,0,0,0},7", KmsLineFault.MALFORMED),
        (b"ERROR", KmsLineFault.MALFORMED),
        (b"ERROR(1234567890)", KmsLineFault.MALFORMED),
        (b",0.5,0.25},12", KmsLineFault.UNKNOWN),
        (b"L2", KmsLineFault.UNKNOWN),
        (b"tare=1", KmsLineFault.UNKNOWN),
        (b"F={0,0,0,0,0,\xb2}", KmsLineFault.NON_ASCII),
        (b"TARE=\x001", KmsLineFault.NON_ASCII),
        (b"X" * (LINE_MAX + 1), KmsLineFault.OVERLONG),
    ],
)
def test_faults_are_counted_by_kind_and_do_not_touch_neighbours(
    line: bytes, fault: KmsLineFault
) -> None:
    assert parse_line(line) is fault
    decoder = KmsDecoder()
    assert decoder.feed(GOOD + b"\n" + line + b"\n" + GOOD + b"\n") == [SAMPLE, SAMPLE]
    assert decoder.counters[fault] == 1
    assert sum(decoder.counters[kind] for kind in KmsLineFault) == 1
    assert decoder.counters["junk_bytes"] == len(line) + 1


def test_endless_line_takes_no_memory_and_is_one_fault() -> None:
    decoder = KmsDecoder()
    for _ in range(1000):
        assert decoder.feed(b"x" * 1000) == []
        assert decoder.pending <= LINE_MAX
    assert decoder.feed(b"x\n" + GOOD + b"\n") == [SAMPLE]
    assert decoder.counters["overlong_lines"] == 1
    assert decoder.counters["junk_bytes"] == 1_000_002


def test_longest_line() -> None:
    line = b"PRINT=" + b"7" * (LINE_MAX - 6)
    assert KmsDecoder().feed(line + b"\n") == [KmsReply("PRINT", "7" * (LINE_MAX - 6))]


def test_stopping_drains_samples_before_the_echo() -> None:
    decoder = KmsDecoder()
    records = decoder.feed(GOOD + b"\n" + GOOD + b"\nL0\nTARE=1\n")
    assert records == [SAMPLE, SAMPLE, KmsReply("L0", ""), KmsReply("TARE", "1")]


def in_pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    places = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[a:b] for a, b in pairwise(places)]


lines = st.lists(
    st.one_of(
        st.sampled_from([GOOD, b"L1", b"TARE=1", b"ERROR(3)", b"F={nan}", b"", b"y" * 5000]),
        st.binary(max_size=40),
    ),
    max_size=12,
).map(b"\n".join)


@settings(max_examples=100, deadline=None)
@given(lines, st.lists(st.integers(0, 1 << 16), max_size=12))
def test_splitting_changes_nothing_and_every_byte_is_accounted_for(
    data: bytes, cuts: list[int]
) -> None:
    whole, split = KmsDecoder(), KmsDecoder()
    records = whole.feed(data)
    assert [record for piece in in_pieces(data, cuts) for record in split.feed(piece)] == records
    assert split.counters == whole.counters
    assert split.pending == whole.pending
    assert fed(whole) == len(data)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=200)))
def test_no_bytes_raise(chunks: list[bytes]) -> None:
    decoder = KmsDecoder()
    for chunk in chunks:
        decoder.feed(chunk)
    assert fed(decoder) == sum(map(len, chunks))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.binary(max_size=60), st.lists(number, min_size=6, max_size=6))))
def test_good_lines_are_found_among_junk(parts: list[tuple[bytes, list[float]]]) -> None:
    decoder = KmsDecoder()
    data = b""
    for junk, values in parts:
        # "@" begins no line of the protocol, so the junk itself gives no record.
        data += b"@" + junk.replace(b"\n", b"@") + b"\nF={"
        data += ",".join(map(repr, values)).encode() + b"},1\n"
    found = decoder.feed(data)
    assert found == [KmsForceLine((a, b, c), (d, e, f), 1) for _, (a, b, c, d, e, f) in parts]


@pytest.mark.parametrize(
    ("value", "flags"),
    [
        ("0", 0),
        ("19", KmsFlags.CALIBRATION_VALID | KmsFlags.STABLE | 16),
        ("007", 7),
        ("0x00100000", KmsFlags.OVER_RANGE_FX),
        ("4294967295", 0xFFFFFFFF),
        ("4294967296", None),
        ("-1", None),
        ("", None),
    ],
)
def test_status_word(value: str, flags: int | None) -> None:
    assert parse_flags(value) == flags


@pytest.mark.parametrize(
    ("bit", "name"),
    [
        (0, "calibration valid"), (1, "stable"), (2, "tare on"), (3, "filter on"),
        (4, "acquisition running"), (5, "script running"), (10, "calibration expired"),
        (11, "temperature warning"), (20, "over range fx"), (21, "over range fy"),
        (22, "over range fz"), (23, "over range mx"), (24, "over range my"),
        (25, "over range mz"), (26, "calibration fault"), (27, "temperature fault"),
        (28, "power fault"), (29, "command failed"), (30, "script failure"), (7, "bit 7"),
        (31, "bit 31"),
    ],
)  # fmt: skip
def test_flags_are_named(bit: int, name: str) -> None:
    assert flag_names(KmsFlags(1 << bit)) == (name,)


def test_over_range_is_told_per_axis() -> None:
    every = KmsFlags(0x3F << 20)
    assert over_range_axes(every) == AXES
    assert over_range_axes(KmsFlags.OVER_RANGE_FZ | KmsFlags.OVER_RANGE_MX) == ("fz", "mx")
    assert over_range_axes(KmsFlags(~(0x3F << 20) & 0xFFFFFFFF)) == ()
    assert flag_names(FAULTS) == ("calibration fault", "temperature fault", "power fault")


def test_requests() -> None:
    assert ask.divider_request(5) == b"LDIV(5)\n"
    assert ask.filter_request(0) == b"FLT(0)\n"
    assert ask.query_request(ask.KmsQuery.FLAGS) == b"FLAGS()\n"


def test_arguments_out_of_range() -> None:
    for divider in (0, -1, 501):
        with pytest.raises(ValueError, match=r"divider -?\d+ is not in 1\.\.500"):
            ask.divider_request(divider)
        with pytest.raises(ValueError, match="divider"):
            ask.rate_of_divider(divider)
    for filter_number in (-1, 256):
        with pytest.raises(ValueError, match=r"not in 0\.\.255"):
            ask.filter_request(filter_number)
    for rate_hz in (0.0, 0.99, 500.1, float("nan")):
        with pytest.raises(ValueError, match=r"1\.\.500 Hz"):
            ask.divider_of_rate(rate_hz)


def test_rate_and_divider_agree() -> None:
    for divider in range(1, ask.DIVIDER_MAX + 1):
        assert ask.divider_of_rate(ask.rate_of_divider(divider)) == divider
    assert ask.divider_of_rate(400.0) == 1
    assert ask.divider_of_rate(249.0) == 2
