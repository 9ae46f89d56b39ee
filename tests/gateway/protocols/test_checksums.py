from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_gateway.protocols.framing import FrameFinder, crc16_x25, sum8


def bitwise_crc(data: bytes) -> int:
    """The definition, one bit at a time."""
    crc = 0xFFFF
    for byte in data:
        for bit in range(8):
            feedback = (crc ^ byte >> bit) & 1
            crc = crc >> 1 ^ 0x8408 * feedback
    return crc ^ 0xFFFF


def test_crc_vector() -> None:
    assert crc16_x25(b"123456789") == 0x906E
    assert crc16_x25(b"") == 0


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=80))
def test_crc_agrees_with_its_definition(data: bytes) -> None:
    assert crc16_x25(data) == bitwise_crc(data)


def test_sums_wrap() -> None:
    assert sum8(b"\xff\x02") == 0x01
    assert sum8(b"") == 0


def is_good(frame: bytes) -> bool:
    return frame[-1] == sum8(frame[:-1])


def frame_of(data: bytes) -> bytes:
    return data + bytes((sum8(data),))


LENGTHS = {b"\x01\x01": 4, b"\x01\x02": 6}


def first_good_wins(data: bytes) -> list[bytes]:
    """Every place in turn: the frames that a finder has to find."""
    frames, at = [], 0
    while at < len(data):
        length = LENGTHS.get(data[at : at + 2], 0)
        frame = data[at : at + length]
        if length and len(frame) == length and is_good(frame):
            frames.append(frame)
            at += length
        else:
            at += 1
    return frames


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 4), max_size=60), st.lists(st.integers(1, 9), max_size=20))
def test_finder_finds_what_is_there_however_it_is_cut(small: list[int], cuts: list[int]) -> None:
    # Bytes 0..4 only, so that chance heads and chance sums are frequent.
    data = bytes(small) + bytes(6)
    whole, cut = FrameFinder(LENGTHS, is_good, bytes), FrameFinder(LENGTHS, is_good, bytes)
    frames = whole.feed(data)
    assert frames == first_good_wins(data)
    at, parts = 0, []
    for size in [*cuts, len(data)]:
        parts += cut.feed(data[at : at + size])
        at += size
        assert cut.pending < 6
    assert parts == frames
    assert cut.counters == whole.counters
    taken = sum(map(len, frames)) + whole.counters["junk_bytes"] + whole.pending
    assert taken == len(data)


def test_finder_keeps_a_head_that_is_cut() -> None:
    finder = FrameFinder(LENGTHS, is_good, bytes)
    assert finder.feed(b"\x09\x01") == []
    assert (finder.pending, finder.counters["junk_bytes"]) == (1, 1)
    assert finder.feed(frame_of(b"\x01\x01\x07")[1:]) == [frame_of(b"\x01\x01\x07")]
    assert finder.counters == {"junk_bytes": 1, "failed_checks": 0}


def test_finder_forgets_at_reset_and_counts_it() -> None:
    finder = FrameFinder(LENGTHS, is_good, bytes)
    frame = frame_of(b"\x01\x02\x05\x06\x07")
    finder.feed(frame[:4])
    finder.reset()
    assert finder.pending == 0
    assert finder.feed(frame) == [frame]
    assert finder.counters["junk_bytes"] == 4


def test_finder_wants_one_first_byte() -> None:
    with pytest.raises(ValueError, match="same byte"):
        FrameFinder({b"\x01": 3, b"\x02": 3}, is_good, bytes)
