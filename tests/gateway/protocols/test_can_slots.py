from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.gateway.protocols import channels as ch
from palpate.gateway.protocols import spi
from palpate.gateway.protocols.can_slots import CanSlotDecoder, SlotDecoder, learn_order
from palpate.gateway.protocols.spi import Word, WordKind

# Vectors of the hardware reference, 2.1.
PAC_2040 = bytes.fromhex("80 7F C1 7F C1 7F C1")
FINGER_2_ABSENT = bytes.fromhex("80 7F C1 00 00 7F C1")

GOOD_2040 = Word(WordKind.GOOD, 2040, False, "")
NO_ERRORS = {
    "parity_errors": 0,
    "absent": 0,
    "suspicious": 0,
    "device_error_command_parity_wrong": 0,
    "device_error_unknown_command": 0,
    "device_error_too_little_delay": 0,
    "device_error_too_little_sampling_delay": 0,
    "device_error_channel_not_recognised": 0,
    "device_error_nothing_to_resend": 0,
    "device_error_property_is_read_only": 0,
    "device_error_write_failed": 0,
}


def slot(channel: int, *words: str) -> bytes:
    return bytes((spi.command_byte(channel),)) + bytes.fromhex("".join(words))


def test_vector_of_three_fingers() -> None:
    decoder = CanSlotDecoder(fingers=3)
    record = decoder.feed(0x001, PAC_2040)
    assert record is not None
    assert (record.channel, record.words) == (ch.PAC, (GOOD_2040,) * 3)
    assert decoder.finger_counters == (NO_ERRORS,) * 3


def test_candump_line() -> None:
    line = "(1436509052.249713) can0 001#807FC17FC17FC1"
    can_id, data = line.split()[2].split("#")
    record = CanSlotDecoder(fingers=3, can_id=0x001).feed(int(can_id, 16), bytes.fromhex(data))
    assert record is not None
    assert [word.value for word in record.words] == [2040] * 3


def test_an_absent_finger_keeps_the_others_in_place() -> None:
    decoder = CanSlotDecoder(fingers=3)
    record = decoder.feed(0x001, FINGER_2_ABSENT)
    assert record is not None
    assert [word.kind for word in record.words] == [WordKind.GOOD, WordKind.ABSENT, WordKind.GOOD]
    assert decoder.finger_counters == (NO_ERRORS, NO_ERRORS | {"absent": 1}, NO_ERRORS)


def test_words_are_counted_by_finger_and_kind() -> None:
    decoder = CanSlotDecoder(fingers=3)
    decoder.feed(1, slot(17, "A52E", "7FC0", "0108"))
    decoder.feed(1, slot(18, "A52D", "7FC1", "010D"))
    decoder.feed(1, slot(18, "A52D", "A55A", "FFFF"))
    delay = {"device_error_too_little_delay": 1, "device_error_too_little_sampling_delay": 2}
    assert decoder.finger_counters == (
        NO_ERRORS | delay,
        NO_ERRORS | {"parity_errors": 2},
        NO_ERRORS | {"suspicious": 1, "absent": 1},
    )
    assert decoder.counters["slots"] == 3


@pytest.mark.parametrize("letter", "E?.-X_RW")
def test_every_error_word_has_its_counter(letter: str) -> None:
    decoder = CanSlotDecoder(fingers=1)
    record = decoder.feed(1, slot(0, "A5", f"{ord(letter):02X}"))
    assert record is not None
    assert record.words[0].kind is WordKind.DEVICE_ERROR
    counted = [key for key, count in decoder.finger_counters[0].items() if count]
    assert len(counted) == 1
    assert counted[0].startswith("device_error_")


@pytest.mark.parametrize(
    ("data", "counter"),
    [
        ("", "bad_commands"),
        ("81 7FC1 7FC1", "bad_commands"),  # even parity
        ("01 7FC1 7FC1", "bad_commands"),  # no sampling command
        ("A1 7FC1 7FC1", "unknown_channels"),  # index 16, the old streaming mode
        ("80", "short_slots"),
        ("80 7FC1 7F", "short_slots"),
    ],
)
def test_what_is_no_slot_is_counted(data: str, counter: str) -> None:
    decoder = CanSlotDecoder(fingers=2)
    assert decoder.feed(1, bytes.fromhex(data)) is None
    assert {key for key, count in decoder.counters.items() if count} == {counter}


def test_longer_frames_are_taken() -> None:
    record = CanSlotDecoder(fingers=2).feed(1, PAC_2040 + b"\x55")
    assert record is not None
    assert record.words == (GOOD_2040,) * 2


def test_identifier() -> None:
    decoder = CanSlotDecoder(fingers=3, can_id=0x123)
    assert decoder.feed(0x124, PAC_2040) is None
    assert decoder.feed(0x123, PAC_2040) is not None
    assert (decoder.counters["other_ids"], decoder.counters["slots"]) == (1, 1)
    anything = CanSlotDecoder(fingers=3)
    assert all(anything.feed(can_id, PAC_2040) for can_id in (0, 0x7FF, 0x1FFFFFFF))


def test_fingers_in_range() -> None:
    with pytest.raises(ValueError, match=r"4 fingers are not in 1\.\.3"):
        CanSlotDecoder(fingers=4)
    with pytest.raises(ValueError, match=r"0 fingers are not in 1\.\.5"):
        SlotDecoder(fingers=0)
    assert SlotDecoder(fingers=5).decode(slot(1, *["0101"] * 5)) is not None


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 5), st.binary(max_size=8)), max_size=30))
def test_every_frame_is_accounted_for(frames: list[tuple[int, bytes]]) -> None:
    decoder = CanSlotDecoder(fingers=2, can_id=3)
    records = [decoder.feed(can_id, data) for can_id, data in frames]
    assert sum(decoder.counters.values()) == len(frames)
    assert decoder.counters["slots"] == sum(record is not None for record in records)


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(ch.CHANNEL_NAMES)),
    st.lists(st.integers(0, 4095), min_size=3, max_size=3),
)
def test_words_of_a_finger_survive(channel: int, values: list[int]) -> None:
    data = slot(channel) + b"".join(map(spi.encode_word, values))
    record = CanSlotDecoder(fingers=3).feed(0, data)
    assert record is not None
    assert (record.channel, [word.value for word in record.words]) == (channel, values)


def test_no_order_in_noise_or_without_an_anchor() -> None:
    assert learn_order([0, 1, 0, 2, 0, 1, 0, 3]) is None
    assert learn_order([0, 0, 1, 1] * 4) is None
    order = learn_order([0, 3, 0, 17, 0, 18] * 3)
    assert order is not None
    assert order.channels == (17, 0, 18, 0, 3, 0)
