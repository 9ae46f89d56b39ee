"""Datagrams of RDT, the sequence of their records, and what the products read in them."""

from __future__ import annotations

import struct

import numpy as np
from tests.fuzz.streams import parts

from palpate_gateway.protocols.rdt import (
    BELIEVABLE_LOSS,
    PROFILES,
    RECORD_BYTES,
    U32,
    RdtDecoder,
    RdtRecord,
    RdtScale,
    RdtSequence,
    hex_sensor_number,
    unwrap,
)

_RECORD = struct.Struct(">3I6i")
_SCALE = RdtScale(1e6, 1e6)


def check(data: bytes) -> None:
    """The first byte chooses: datagrams as they are, or records by small steps of their numbers."""
    if data[:1] < b"\x80":
        _check_datagrams(parts(data[1:]))
    else:
        _check_sequence(_walk(data[1:]))


def _check_datagrams(datagrams: list[bytes]) -> None:
    decoder, singly = RdtDecoder(), RdtDecoder()
    numbers: list[tuple[int, int]] = []
    for datagram in datagrams:
        records = decoder.feed(datagram)
        whole = len(datagram) % RECORD_BYTES == 0
        assert len(records) == (len(datagram) // RECORD_BYTES if whole else 0)
        for at, record in enumerate(records):
            raw = datagram[at * RECORD_BYTES : (at + 1) * RECORD_BYTES]
            assert singly.feed(raw) == [record]  # one at a time takes another way
            _check_record(record, raw)
            numbers.append((record.rdt_sequence, record.ft_sequence))
    counters = decoder.counters
    assert counters["datagrams"] == len(datagrams)
    fed = sum(map(len, datagrams))
    assert counters["records"] * RECORD_BYTES + counters["junk_bytes"] == fed
    _check_sequence(numbers)


def _check_record(record: RdtRecord, raw: bytes) -> None:
    fields = (record.rdt_sequence, record.ft_sequence, record.status, *record.counts)
    assert fields == _RECORD.unpack(raw)
    assert np.isfinite(_SCALE.wrench(record.counts)).all()
    assert 0 <= hex_sensor_number(record.status) <= 7
    for profile in PROFILES.values():
        names = profile.status_names(record.status)
        assert bool(names) == bool(record.status & profile.status_mask)
        assert profile.valid(record.status) or names
        profile.overloaded(record.status)


def _walk(data: bytes) -> list[tuple[int, int]]:
    """Steps of both numbers: signed bytes, but the largest is a leap and the least a restart."""
    rdt = ft = 0
    numbers = []
    for step, sampled in zip(data[::2], data[1::2], strict=False):
        if step == 0x80:
            rdt = 1
        elif step == 0x7F:
            rdt += 1 << sampled % 33
        else:
            rdt += step - 256 if step > 0x80 else step
        ft += sampled - 256 if sampled > 0x80 else sampled
        numbers.append((rdt % U32, ft % U32))
    return numbers


def _check_sequence(numbers: list[tuple[int, int]]) -> None:
    sequence = RdtSequence()
    tick, lost, epochs, dropped = -1, 0, 0, 0
    last = sampled = 0
    for rdt, ft in numbers:
        step = sequence.step(rdt, ft)
        last = unwrap(rdt, last)
        assert last % U32 == rdt
        if step.keep:
            assert 0 <= step.lost < U32 // 2
            assert not step.new_epoch or step.lost <= BELIEVABLE_LOSS
            # Time does not go back but at a restart.
            assert step.new_epoch or (ft - sampled) % U32 <= U32 // 2
            sampled = ft
            tick += 1 + step.lost
            lost += step.lost
            epochs += step.new_epoch
        else:
            assert step.lost == 0
            assert not step.new_epoch
            dropped += 1
        assert step.tick == tick
    counters = sequence.counters
    assert counters["lost_records"] == lost
    assert counters["restarts"] == max(epochs - 1, 0)
    assert counters["repeated_records"] + counters["late_records"] == dropped
    if numbers and step.keep:  # a stream that goes on is taken, whatever came before
        rdt, ft = numbers[-1]
        after = sequence.step((rdt + 1) % U32, (ft + 1) % U32)
        assert after.keep
        assert after.lost == 0


def seeds() -> list[bytes]:
    """The page's record, several in a datagram, cut ones, and walks with faults in them."""
    record = bytes.fromhex(
        "00000001 00001B58 00000000 0016E360 FFFC2F70 000F4240 00004E20 FFFFD8F0 00001388"
    )
    packs = [
        [record],
        [record * 3, record[:20], b"", record + b"\0"],
        [_RECORD.pack(n, 7 * n, status, *range(6)) for n, status in ((1, 0), (2, 0x80010000))],
        [_RECORD.pack(n, n, 0x1F8, *range(-3, 3)) for n in (U32 - 2, U32 - 1, 0, 1)],
    ]
    datagrams = [b"\0" + b"".join(bytes([len(d)]) + d for d in pack) for pack in packs]
    walks = [
        b"\x01\x07" * 9,
        b"\x01\x07\x00\x00\xff\xf9\x03\x15\x80\x07\x01\x07",
        b"\x7f\x20\x01\x01",
    ]
    return datagrams + [b"\xff" + walk for walk in walks]
