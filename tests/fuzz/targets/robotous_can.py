"""Answers of Robotous RFT sensors in pairs of CAN messages."""

from __future__ import annotations

from tests.fuzz.streams import parts
from tests.fuzz.targets.robotous_serial import check_answer
from tests.gateway.robotous_messages import can_messages

from palpate_gateway.protocols.robotous import (
    FIRST_ID,
    SECOND_ID,
    RobotousCanDecoder,
)


def check(data: bytes) -> None:
    """Each part is a message: its identifier and its data."""
    messages = [(part[0], part[1:]) for part in parts(data) if part]
    decoder = RobotousCanDecoder()
    own: list[tuple[int, bytes]] = []
    answers = 0
    for can_id, payload in messages:
        got = decoder.feed(can_id, payload)
        own += [(can_id, payload)] if can_id in (FIRST_ID, SECOND_ID) else []
        assert len(got) <= 1
        for answer in got:
            # Halves that came directly one after the other, the first one first.
            assert own[-2:] == list(can_messages(answer))
            check_answer(answer)
            answers += 1
    counters = decoder.counters
    halves = 2 * answers + counters["lonely_first"] + counters["lonely_second"] + decoder.pending
    assert counters["other_ids"] + counters["wrong_lengths"] + halves == len(messages)
    assert counters["swapped_pairs"] <= counters["lonely_first"]
    assert decoder.pending in (0, 1)
    decoder.reset()
    assert decoder.pending == 0
    good = bytes(range(16))
    first, second = can_messages(good)
    assert decoder.feed(*first) == []
    assert decoder.feed(*second) == [good]


def seeds() -> list[bytes]:
    """Pairs in order, swapped, with a half missing, of wrong length, and with other traffic."""
    answer = bytes.fromhex("0B 01F4 FF06 03E8 00C8 FF9C 0032 000000")
    first, second = (bytes([9, can_id]) + half for can_id, half in can_messages(answer))
    other = bytes([3, 0x64, 1, 2])
    short = bytes([4, FIRST_ID, 1, 2, 3])
    return [
        (first + second) * 3,
        second + first + second + first,
        first + first + second + second,
        first + other + second,
        first + short + second + bytes([1, 7]),
    ]
