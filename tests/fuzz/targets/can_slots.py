"""Slots as CAN frames and bridges carry them, and the order in which they come."""

from __future__ import annotations

import numpy as np
from tests.fuzz.streams import parts
from tests.gateway.spi_words import decode_word

from palpate_gateway.protocols.can_slots import (
    FINGERS_MAX,
    CanSlotDecoder,
    SlotDecoder,
    payload_rows,
)
from palpate_gateway.protocols.channels import CHANNEL_NAMES, SEQUENCES
from palpate_gateway.protocols.slot_clock import learn_order
from palpate_gateway.protocols.spi import channel_of_command


def check(data: bytes) -> None:
    """One byte chooses the fingers; each part is a payload, and all bytes are channels in a row."""
    fingers = 1 + (data[0] if data else 0) % FINGERS_MAX
    _check_words(parts(data[1:]), fingers)
    _check_order(data[1:])
    for given in (None, data[0] if data else 0):
        _check_identifiers(data, CanSlotDecoder(fingers=1, can_id=given))


def _check_identifiers(data: bytes, bus: CanSlotDecoder) -> None:
    """Each byte is an identifier, and the first byte of its frame."""
    can_id = np.frombuffer(data, np.uint8).astype(np.int64)
    ours = bus.ours(can_id, can_id.astype(np.uint8)[:, None], np.ones(len(data), np.int64))
    told = len(data) if ours is None else int(ours.sum())
    # Of one identifier comes one channel only, which is no round.
    assert told == (data.count(bytes(bus.senders)) if bus.senders else len(data))
    assert bus.counters["other_ids"] == len(data) - told


def _check_words(payloads: list[bytes], fingers: int) -> None:
    many, single = SlotDecoder(fingers=fingers), SlotDecoder(fingers=fingers)
    words = many.decode(*payload_rows(payloads))
    for payload in payloads:
        single.decode(*payload_rows([payload]))
    assert many.counters == single.counters
    assert many.finger_counters == single.finger_counters
    counters = many.counters
    assert sum(counters.values()) == len(payloads)
    assert counters["slots"] == len(words)
    assert words.index.tolist() == sorted(set(words.index.tolist()))
    for row, number in enumerate(words.index.tolist()):
        payload = payloads[number]
        assert int(words.channel[row]) == channel_of_command(payload[0])
        assert int(words.channel[row]) in CHANNEL_NAMES
        for finger in range(fingers):
            word = decode_word(payload[1 + 2 * finger : 3 + 2 * finger])
            told = (int(words.kind[row, finger]), int(words.value[row, finger]))
            assert told == (word.kind, word.value)
    for finger in range(fingers):
        bad = sum(n for key, n in many.finger_counters[finger].items() if key != "suspicious")
        assert bad + int((words.kind[:, finger] == 0).sum()) == len(words)


def _check_order(seen: bytes) -> None:
    order = learn_order(seen)
    if order is None:
        return
    cycle = order.channels
    assert 2 * len(cycle) <= len(seen)
    start = cycle.index(seen[0]) if seen[0] in order.anchors else None
    if start is not None:
        assert all(cycle[(start + k) % len(cycle)] == one for k, one in enumerate(seen))
    for position in range(len(cycle)):
        for channel in set(cycle):
            steps = order.steps(position, channel)
            assert 1 <= steps <= len(cycle)
            assert cycle[(position + steps) % len(cycle)] == channel
            near = order.steps_near(position, channel, 2.5 * len(cycle))
            assert cycle[(position + near) % len(cycle)] == channel


def seeds() -> list[bytes]:
    """Frames with words of every kind, and the known orders twice."""
    payloads = [
        "80 7FC1 7FC1 7FC1", "80 7FC1 0000 7FC1", "A2 A545 FFFF 0107", "9E 0101 0101 0101",
        "81 7FC1 7FC1 7FC1", "A1 7FC1 7FC1 7FC1", "A2 01", "", "C7 FEF8 FEF8 FEF8 FEF8 FEF8 00",
    ]  # fmt: skip
    frames = b"".join(bytes([len(p)]) + p for p in map(bytes.fromhex, payloads))
    orders = [bytes([k]) + bytes(order) * 2 for k, order in enumerate(SEQUENCES.values())]
    return [bytes([fingers]) + frames for fingers in (0, 1, 2, 4)] + orders
