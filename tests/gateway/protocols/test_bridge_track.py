from __future__ import annotations

import pytest
from tests.gateway.bridge_packets import encode

from palpate_gateway.protocols.bridge import (
    BridgeBody,
    BridgeDecoder,
    BridgeFinger,
    BridgeHeader,
    BridgeHello,
    BridgeSlots,
    BridgeStatus,
)

HELLO = BridgeHello(4400, 44, (BridgeFinger("BT00000000000123", "0205"),))
SLOTS = BridgeSlots(3, (bytes.fromhex("80 7F C1 7F C1 7F C1"),))
STATUS = BridgeStatus((1, 2, 3), 4, 5)


def packet(sequence: int, time_us: int, body: BridgeBody = STATUS, *, source: int = 0) -> bytes:
    return encode(BridgeHeader(source, 0, sequence, time_us), body)


def counted(decoder: BridgeDecoder) -> dict[str, int]:
    return {key: n for key, n in decoder.counters.items() if n and key != "packets"}


def test_gaps_and_repetitions() -> None:
    decoder = BridgeDecoder()
    numbers = [65533, 65534, 65534, 1, 2]
    data = b"".join(packet(n, 1000 * k) for k, n in enumerate(numbers))
    records = decoder.feed(data)
    assert [(r.header.sequence, r.lost_before) for r in records] == [
        (65533, 0), (65534, 0), (1, 2), (2, 0),
    ]  # fmt: skip
    again = len(packet(65534, 2000))
    assert counted(decoder) == {"lost_packets": 2, "repeated_packets": 1, "junk_bytes": again}


def test_every_source_has_its_own_numbers() -> None:
    decoder = BridgeDecoder()
    data = b"".join(packet(n, 9, source=s) for n, s in [(5, 1), (900, 2), (6, 1), (902, 2)])
    records = decoder.feed(data)
    assert [r.lost_before for r in records] == [0, 0, 0, 1]
    assert counted(decoder) == {"lost_packets": 1}


def test_device_time_is_unwrapped() -> None:
    decoder = BridgeDecoder()
    times = list(range(2**32 - 10_000, 2 * 2**32 + 20_000_000, 8_000_000))
    data = b"".join(packet(n, t % 2**32) for n, t in enumerate(times))
    records = decoder.feed(data)
    assert [r.time_us for r in records] == times
    assert {r.epoch for r in records} == {0}


def test_slots_behind_a_hello_may_be_a_little_earlier() -> None:
    decoder = BridgeDecoder()
    decoder.feed(packet(10, 500_000, HELLO))
    (record,) = decoder.feed(packet(12, 490_000, SLOTS))
    assert (record.epoch, record.time_us, record.lost_before) == (0, 490_000, 1)
    assert counted(decoder) == {"lost_packets": 1}


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (packet(500, 9_000_000, SLOTS), packet(0, 1000, HELLO)),
        (packet(500, 9_000_000, SLOTS), packet(3, 40_000, SLOTS)),  # its HELLO was lost
        (packet(2, 9_000_000, SLOTS), packet(3, 40_000, SLOTS)),  # and the number goes on by chance
        (packet(500, 500_000, SLOTS), packet(501, 400_000, HELLO)),
        (packet(500, 3_000_000_000, SLOTS), packet(0, 1000, HELLO)),  # after 50 minutes
        (packet(500, 3_000_000_000, SLOTS), packet(3, 40_000, SLOTS)),  # and its HELLO was lost
        (packet(500, 4_200_000_000, SLOTS), packet(3, 40_000, SLOTS)),  # shortly before the wrap
    ],
)
def test_restarts_begin_an_epoch(before: bytes, after: bytes) -> None:
    decoder = BridgeDecoder()
    records = decoder.feed(before + after)
    assert [(r.epoch, r.lost_before) for r in records] == [(0, 0), (1, 0)]
    assert records[1].time_us == records[1].header.device_time_us
    assert counted(decoder) == {"restarts": 1}


def test_a_hello_at_the_wrap_is_no_restart() -> None:
    decoder = BridgeDecoder()
    decoder.feed(packet(65535, 2**32 - 5, SLOTS))
    (record,) = decoder.feed(packet(0, 9_995, HELLO))
    assert (record.epoch, record.time_us) == (0, 2**32 + 9_995)
    assert counted(decoder) == {}
