from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.gateway import spi_words

from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols import spi
from palpate_gateway.protocols.can_slots import (
    CanSlotDecoder,
    SlotDecoder,
    payload_rows,
)
from palpate_gateway.protocols.slot_clock import learn_order
from palpate_gateway.protocols.spi import WordKind

# Vectors of the hardware reference, 2.1.
PAC_2040 = bytes.fromhex("80 7F C1 7F C1 7F C1")
FINGER_2_ABSENT = bytes.fromhex("80 7F C1 00 00 7F C1")

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


Told = tuple[int, list[int], list[int]]


def decode(decoder: SlotDecoder, *payloads: bytes) -> list[Told]:
    """Channel, values and kinds of each slot."""
    words = decoder.decode(*payload_rows(payloads))
    columns = words.channel.tolist(), words.value.tolist(), words.kind.tolist()
    return list(zip(*columns, strict=True))


def ours(
    decoder: CanSlotDecoder, can_ids: list[int], commands: list[int], sizes: Sequence[int] = ()
) -> list[bool] | None:
    """Which frames with these identifiers and first bytes are ours."""
    size = np.array(sizes or [7] * len(can_ids))
    mask = decoder.ours(np.array(can_ids), np.array(commands, np.uint8)[:, None], size)
    return None if mask is None else mask.tolist()


def slot(channel: int, *words: str) -> bytes:
    return bytes((spi_words.command_byte(channel),)) + bytes.fromhex("".join(words))


def test_vector_of_three_fingers() -> None:
    decoder = CanSlotDecoder(fingers=3)
    assert decode(decoder, PAC_2040) == [(ch.PAC, [2040] * 3, [WordKind.GOOD] * 3)]
    assert decoder.finger_counters == (NO_ERRORS,) * 3


def test_candump_line() -> None:
    line = "(1436509052.249713) can0 001#807FC17FC17FC1"
    can_id, data = line.split()[2].split("#")
    decoder = CanSlotDecoder(fingers=3, can_id=0x001)
    assert ours(decoder, [int(can_id, 16)], [0x80]) is None
    ((_, values, _),) = decode(decoder, bytes.fromhex(data))
    assert values == [2040] * 3


def test_an_absent_finger_keeps_the_others_in_place() -> None:
    decoder = CanSlotDecoder(fingers=3)
    ((_, values, kinds),) = decode(decoder, FINGER_2_ABSENT)
    assert kinds == [WordKind.GOOD, WordKind.ABSENT, WordKind.GOOD]
    assert values == [2040, 0, 2040]
    assert decoder.finger_counters == (NO_ERRORS, NO_ERRORS | {"absent": 1}, NO_ERRORS)


def test_words_are_counted_by_finger_and_kind() -> None:
    decoder = CanSlotDecoder(fingers=3)
    decode(decoder, slot(17, "A52E", "7FC0", "0108"), slot(18, "A52D", "7FC1", "010D"))
    decode(decoder, slot(18, "A52D", "A55A", "FFFF"))
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
    told = decode(decoder, slot(0, "A5", f"{ord(letter):02X}"))
    assert told == [(0, [0], [WordKind.DEVICE_ERROR])]
    counted = [key for key, count in decoder.finger_counters[0].items() if count]
    assert counted == [
        "device_error_" + spi.ERROR_WORDS[ord(letter)].replace(" ", "_").replace("-", "_")
    ]


def test_every_word_is_what_the_rule_says() -> None:
    """All 65,536 of them, by the table and by the rule for one word."""
    decoder = SlotDecoder(fingers=1)
    command = bytes((spi_words.command_byte(17),))
    payloads = [command + bytes(divmod(word, 256)) for word in range(1 << 16)]
    told = decode(decoder, *payloads)
    rules = [spi_words.decode_word(payload[1:]) for payload in payloads]
    assert told == [(17, [rule.value], [rule.kind]) for rule in rules]
    counts = decoder.finger_counters[0]
    assert counts["absent"] == sum(rule.kind is WordKind.ABSENT for rule in rules)
    assert counts["parity_errors"] == sum(rule.kind is WordKind.BIT_ERROR for rule in rules)
    good = [rule for rule in rules if rule.kind is WordKind.GOOD]
    assert counts["suspicious"] == sum(rule.suspicious for rule in good)


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
    good = slot(17, "0101", "0101")
    words = decoder.decode(*payload_rows([good, bytes.fromhex(data), good]))
    assert words.index.tolist() == [0, 2]
    counted = {key: count for key, count in decoder.counters.items() if count}
    assert counted == {counter: 1, "slots": 2}


def test_nothing_makes_nothing() -> None:
    words = SlotDecoder(fingers=2).decode(*payload_rows([]))
    assert (words.value.shape, words.kind.shape, len(words)) == ((0, 2), (0, 2), 0)


def test_longer_frames_are_taken() -> None:
    told = decode(CanSlotDecoder(fingers=2), PAC_2040 + b"\x55")
    assert told == [(0, [2040] * 2, [WordKind.GOOD] * 2)]


def test_identifier() -> None:
    decoder = CanSlotDecoder(fingers=3, can_id=0x123)
    assert ours(decoder, [0x124, 0x123], [0x80, 0x80]) == [False, True]
    assert decoder.counters["other_ids"] == 1
    assert decoder.senders == [0x123]


ROUND = [spi_words.command_byte(one) for one in ch.SEQUENCES["biotac_e1_first"]]


def test_the_identifier_of_the_frames_that_repeat_a_round_is_found() -> None:
    decoder = CanSlotDecoder(fingers=1)
    noise = np.random.default_rng(0)
    for k in range(400):
        # Another device's measurements, now and then commands by chance; one that never changes;
        # frames without a byte.
        others = [int(noise.integers(256)), 0x80, 0xA2]
        mask = ours(decoder, [1, 2, 3, 0x101], [*others, ROUND[k % 44]], [8, 8, 0, 3])
        assert mask == (None if k < 127 else [False, False, False, True])
        assert decoder.senders == ([] if k < 127 else [0x101])
    assert decoder.counters["other_ids"] == (400 - 127) * 3


@pytest.mark.parametrize("later", [0, 1000])
def test_two_identifiers_that_repeat_a_round_are_both_named(later: int) -> None:
    decoder = CanSlotDecoder(fingers=1)
    for k in range(later):
        ours(decoder, [7], [ROUND[k % 44]])
    for k in range(200):
        ours(decoder, [7, 9], [ROUND[(later + k) % 44], ROUND[(k + 5) % 44]])
    assert decoder.senders == [7, 9]


def test_a_sender_that_loses_slots_is_found() -> None:
    decoder = CanSlotDecoder(fingers=1)
    for k in range(3000):
        if k < 2000 and k % 100 == 0:
            continue
        ours(decoder, [7], [ROUND[k % 44]])
    assert decoder.senders == [7]


def test_fingers_in_range() -> None:
    with pytest.raises(ValueError, match=r"4 fingers are not in 1\.\.3"):
        CanSlotDecoder(fingers=4)
    with pytest.raises(ValueError, match=r"0 fingers are not in 1\.\.5"):
        SlotDecoder(fingers=0)
    assert decode(SlotDecoder(fingers=5), slot(1, *["0101"] * 5)) == [(1, [0] * 5, [0] * 5)]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=8), max_size=30), st.integers(1, 5))
def test_every_frame_is_accounted_for(frames: list[bytes], at_once: int) -> None:
    decoder, alone = SlotDecoder(fingers=2), SlotDecoder(fingers=2)
    told = [
        one
        for k in range(0, len(frames), at_once)
        for one in decode(decoder, *frames[k : k + at_once])
    ]
    assert told == [one for frame in frames for one in decode(alone, frame)]
    assert (decoder.counters, decoder.finger_counters) == (alone.counters, alone.finger_counters)
    assert sum(decoder.counters.values()) == len(frames)
    assert decoder.counters["slots"] == len(told)


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(ch.CHANNEL_NAMES)),
    st.lists(st.integers(0, 4095), min_size=3, max_size=3),
)
def test_words_of_a_finger_survive(channel: int, values: list[int]) -> None:
    data = slot(channel) + b"".join(map(spi_words.encode_word, values))
    assert decode(CanSlotDecoder(fingers=3), data) == [(channel, values, [WordKind.GOOD] * 3)]


def test_no_order_in_noise_or_without_an_anchor() -> None:
    assert learn_order([0, 1, 0, 2, 0, 1, 0, 3]) is None
    assert learn_order([0, 0, 1, 1] * 4) is None
    order = learn_order([0, 3, 0, 17, 0, 18] * 3)
    assert order is not None
    assert order.channels == (17, 0, 18, 0, 3, 0)
