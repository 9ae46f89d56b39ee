"""Layouts of ROS and their bytes, against published sums and an independent library of CDR."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycdr2 import IdlStruct
from tests.protos.ros_idl import (
    Biotac,
    BiotacAll,
    BioTacData,
    BioTacHand,
    BioTacTime,
    Header,
    Time,
    Vector3,
    Wrench,
    WrenchStamped,
)

from palpate.errors import WireError
from palpate.ros.layouts import (
    BIOTAC_ALL,
    BIOTAC_HAND,
    MD5,
    POINT_STAMPED,
    WRENCH_STAMPED,
    decode,
    encode,
    stamp_of,
    time_of,
    type_hash,
    typestore,
)

DIALECTS = ("cdr", "ros1")


@pytest.mark.parametrize("layout", MD5)
def test_a_layout_is_the_published_version(layout: str) -> None:
    assert typestore("ros1").generate_msgdef(layout)[1] == MD5[layout]


def test_type_hashes_are_those_of_ros_2() -> None:
    # Published with the message packages of ROS 2 Jazzy, and in keys of rmw_zenoh.
    known = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert type_hash("std_msgs/msg/String") == known


stamps = st.builds(Time, st.integers(0, 2**31 - 1), st.integers(0, 999_999_999))
names = st.text(st.characters(min_codepoint=1, max_codepoint=0x24F), max_size=20)
headers = st.builds(Header, stamps, names)
shorts = st.integers(-(2**15), 2**15 - 1)
counts = st.integers(0, 2**16 - 1)
offsets = st.integers(0, 2**32 - 1)
fingers = st.builds(Biotac, shorts, shorts, shorts, shorts, shorts, st.lists(shorts, max_size=24))
hands = st.builds(BiotacAll, headers, st.lists(fingers, min_size=5, max_size=5))
data = st.builds(
    BioTacData, names, counts, counts, counts, counts,
    st.lists(counts, min_size=22, max_size=22), st.lists(counts, min_size=19, max_size=19),
)  # fmt: skip
times = st.builds(
    BioTacTime, stamps, stamps, offsets, offsets, offsets,
    st.lists(offsets, min_size=22, max_size=22), st.lists(offsets, min_size=19, max_size=19),
)  # fmt: skip
frames = st.builds(BioTacHand, headers, names, st.lists(data, max_size=5), times)
numbers = st.floats(allow_nan=False)
vectors = st.builds(Vector3, numbers, numbers, numbers)
wrenches = st.builds(WrenchStamped, headers, st.builds(Wrench, vectors, vectors))


def same(ours: object, theirs: object) -> bool:
    """Whether a message of ours holds the values of an independent library's."""
    if isinstance(theirs, IdlStruct):
        return all(same(getattr(ours, name), getattr(theirs, name)) for name in vars(theirs))
    if isinstance(theirs, list):
        assert isinstance(ours, list | np.ndarray)
        return len(ours) == len(theirs) and all(map(same, list(ours), theirs))
    return bool(ours == theirs)


@settings(max_examples=40, deadline=None)
@given(st.one_of(hands.map(lambda m: (BIOTAC_ALL, m)), frames.map(lambda m: (BIOTAC_HAND, m)),
                 wrenches.map(lambda m: (WRENCH_STAMPED, m))))  # fmt: skip
def test_bytes_of_an_independent_library_are_read(case: tuple[str, object]) -> None:
    layout, message = case
    payload = message.serialize()  # type: ignore[attr-defined]
    assert same(decode(payload, layout), message)


@settings(max_examples=40, deadline=None)
@given(numbers, numbers, numbers, st.integers(0, 2**31 * 10**9 - 1))
def test_an_independent_library_reads_our_bytes(x: float, y: float, z: float, at: int) -> None:
    fields = {
        "header": {"stamp": stamp_of(at), "frame_id": "finger"},
        "wrench": {"force": {"x": x, "y": y, "z": z}, "torque": {"x": z, "y": x, "z": y}},
    }
    read = WrenchStamped.deserialize(encode(fields, WRENCH_STAMPED))
    assert read.wrench == Wrench(Vector3(x, y, z), Vector3(z, x, y))
    assert read.header == Header(Time(at // 10**9, at % 10**9), "finger")
    assert time_of(decode(encode(fields, WRENCH_STAMPED), WRENCH_STAMPED).header.stamp) == at


@pytest.mark.parametrize("dialect", DIALECTS)
@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(MD5)), st.binary(max_size=600))
def test_garbage_is_a_typed_error(dialect: str, layout: str, payload: bytes) -> None:
    head = b"\x00\x01\x00\x00" if dialect == "cdr" else b""
    refused = ("parse", layout)
    try:
        decode(head + payload, layout, dialect)  # type: ignore[arg-type]
    except WireError as error:
        refused = (error.reason, error.problem)
    assert refused[0] == "parse"
    assert layout in refused[1]


@settings(max_examples=60, deadline=None)
@given(frames, st.integers(1, 400))
def test_a_cut_message_is_refused(message: BioTacHand, cut: int) -> None:
    payload = message.serialize()
    cut = min(4 + cut, len(payload))
    with pytest.raises(WireError, match="bytes are no biotac_sensors"):
        decode(payload[: len(payload) - cut], BIOTAC_HAND)


def test_a_wrong_length_reserves_no_memory() -> None:
    hand = BioTacHand(Header(Time(0, 0), ""), "", [], BioTacTime(
        Time(0, 0), Time(0, 0), 0, 0, 0, [0] * 22, [0] * 19))  # fmt: skip
    payload = bytearray(hand.serialize())
    at = payload.index(bytes(4), 20)
    payload[at : at + 4] = b"\xff\xff\xff\x7f"
    with pytest.raises(WireError):
        decode(bytes(payload), BIOTAC_HAND)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({}, "header"),
        ({"header": {"stamp": stamp_of(0), "frame_id": ""}}, "point"),
        (
            {
                "header": {"stamp": stamp_of(0), "frame_id": ""},
                "point": {"x": 0.0, "y": 0.0, "z": "far"},
            },
            "PointStamped",
        ),
        (
            {
                "header": {"stamp": stamp_of(0), "frame_id": "", "seq": 1},
                "point": {"x": 0.0, "y": 0.0, "z": 0.0},
            },
            "seq",
        ),
    ],
)
def test_wrong_fields_are_refused_by_name(fields: dict[str, object], named: str) -> None:
    with pytest.raises(WireError, match=named) as caught:
        encode(fields, POINT_STAMPED)
    assert caught.value.reason == "field"
