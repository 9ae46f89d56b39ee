"""Records of the PIC32 board."""

from __future__ import annotations

import struct

from tests.fuzz.streams import all_counted, same_in_pieces

from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols.pic32 import (
    LARGEST_LOAD_G,
    RECORD_BYTES,
    Pic32Decoder,
    Pic32Layout,
    Pic32Sample,
)

_RECORD = struct.Struct("<I23Hii")


def check(data: bytes) -> None:
    """Two bytes choose cuts and layout; then comes the stream."""
    how, mode = (*data[:2], 0, 0)[:2]
    stream = data[2:]
    layout = Pic32Layout.ELECTRODES_FIRST if mode & 1 else Pic32Layout.PAC_FIRST
    decoder = Pic32Decoder(layout)

    def make() -> Pic32Decoder:
        nonlocal decoder
        decoder = Pic32Decoder(layout)
        return decoder

    # Once the stream is known to be bad or over, how much was junk does not hang on the cuts.
    whole, records = same_in_pieces(make, stream, how)
    before = None
    for number, record in enumerate(records):
        raw = stream[number * RECORD_BYTES : (number + 1) * RECORD_BYTES]
        stamp, *values, load_g, reference_g = _RECORD.unpack(raw)
        assert record.tick % (1 << 32) == stamp
        assert before is None or before <= record.tick < before + (1 << 32)
        before = record.tick
        assert sorted(_values(record.sample)) == sorted(values)
        assert (record.load_g, record.reference_g) == (load_g, reference_g)
        assert max(abs(load_g), abs(reference_g)) <= LARGEST_LOAD_G
    counters = whole.counters
    assert counters["records"] == len(records)
    assert counters["misaligned"] + counters["end_records"] <= 1
    assert decoder.misaligned == bool(counters["misaligned"])
    assert decoder.ended == bool(counters["end_records"])
    assert whole.pending < RECORD_BYTES
    taken = (len(records) + counters["end_records"]) * RECORD_BYTES
    all_counted(whole, taken, stream)
    assert len(whole.feed(_RECORD.pack(7, *range(23), 0, 0))) == 1


def _values(sample: Pic32Sample) -> tuple[int, ...]:
    values = (sample.pac, sample.pdc, sample.tac, sample.tdc, *sample.electrodes)
    assert len(values) == 23
    assert all(0 <= value <= COUNTS_MAX for value in values)
    return values


def seeds() -> list[bytes]:
    """Runs that end, that are cut, and that lose a byte."""
    values = list(range(100, 123))
    run = b"".join(_RECORD.pack(n * 400_000 % 2**32, *values, n, -n) for n in (1, 2, 10_737, 3))
    return [
        bytes([4, 0]) + run + bytes(RECORD_BYTES) + run,
        bytes([0, 1]) + run[:90] + run[91:],
        bytes([9, 0]) + run[:70],
        bytes([9, 0]) + _RECORD.pack(1, *values, LARGEST_LOAD_G, -LARGEST_LOAD_G - 1),
    ]
