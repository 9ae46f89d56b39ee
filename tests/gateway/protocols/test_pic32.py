from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_gateway.protocols import pic32
from palpate_gateway.protocols.pic32 import Pic32Decoder, Pic32Layout, Pic32Record, Pic32Sample

SAMPLE = Pic32Sample(2040, 2650, 2050, 1100, tuple(range(3001, 3020)))
END = bytes(58)


def record_bytes(
    stamp: int,
    sample: Pic32Sample = SAMPLE,
    *,
    load_g: int = 120,
    reference_g: int = -5,
    layout: Pic32Layout = Pic32Layout.PAC_FIRST,
) -> bytes:
    others = [sample.pac, sample.pdc, sample.tac, sample.tdc]
    electrodes = list(sample.electrodes)
    values = others + electrodes if layout is Pic32Layout.PAC_FIRST else electrodes + others
    return struct.pack("<I23Hii", stamp, *values, load_g, reference_g)


def test_sizes_and_units_of_the_reference() -> None:
    assert pic32.RECORD_BYTES == 58
    assert pic32.BAUD == 230400
    assert 2**32 * pic32.TICK_S == pytest.approx(107, abs=0.5)


def test_bytes_of_a_record() -> None:
    raw = "80841E00" + "F807" + "5A0A" + "0208" + "4C04"
    raw += "".join(f"{v & 0xFF:02X}{v >> 8:02X}" for v in range(3001, 3020))
    raw += "78000000" + "FBFFFFFF"
    (record,) = Pic32Decoder().feed(bytes.fromhex(raw))
    assert record == Pic32Record(2_000_000, SAMPLE, 120, -5)
    assert record.tick * pic32.TICK_S == pytest.approx(0.05)


@pytest.mark.parametrize("layout", Pic32Layout)
def test_layouts(layout: Pic32Layout) -> None:
    raw = record_bytes(7, layout=layout)
    assert Pic32Decoder(layout).feed(raw) == [Pic32Record(7, SAMPLE, 120, -5)]
    assert Pic32Decoder(Pic32Layout(str(layout))).feed(raw)[0].sample == SAMPLE


def test_the_stamp_is_unwrapped() -> None:
    stamps = [2**32 - 400_000, 0, 400_000, 2**32 - 1, 5]
    records = Pic32Decoder().feed(b"".join(map(record_bytes, stamps)))
    first = 2**32 - 400_000
    assert [r.tick - first for r in records] == [
        0,
        400_000,
        800_000,
        2**32 + 399_999,
        2**32 + 400_005,
    ]


@pytest.mark.parametrize("missing", [1, 2, 3, 30])
def test_a_lost_byte_stops_the_stream_until_reset(missing: int) -> None:
    good = b"".join(record_bytes(400_000 * k) for k in range(40, 60))
    decoder = Pic32Decoder()
    assert len(decoder.feed(good[: 3 * 58])) == 3
    rest = good[3 * 58 + missing :]
    decoder.feed(rest)
    assert decoder.misaligned
    assert decoder.counters["misaligned"] == 1
    assert decoder.feed(record_bytes(0)) == []
    assert decoder.pending == 0
    counters = decoder.counters
    fed = 3 * 58 + len(rest) + 58
    assert 58 * counters["records"] + counters["junk_bytes"] == fed
    decoder.reset()
    assert not decoder.misaligned
    assert [r.tick for r in decoder.feed(record_bytes(9))] == [9]


@pytest.mark.parametrize(
    "bad",
    [
        record_bytes(1, Pic32Sample(4096, 0, 0, 0, (0,) * 19)),
        record_bytes(1, Pic32Sample(0, 0, 0, 0, (0,) * 18 + (0xFFFF,))),
        record_bytes(1, load_g=1_000_001),
        record_bytes(1, reference_g=-1_000_001),
    ],
)
def test_impossible_values_prove_misalignment(bad: bytes) -> None:
    decoder = Pic32Decoder()
    assert decoder.feed(bad) == []
    assert decoder.misaligned
    assert decoder.counters == {"records": 0, "end_records": 0, "misaligned": 1, "junk_bytes": 58}


def test_extreme_counts_are_good() -> None:
    sample = Pic32Sample(0, 4095, 0, 4095, (4095, 0) * 9 + (4095,))
    assert Pic32Decoder().feed(record_bytes(0, sample))[0].sample == sample


def test_zeros_end_the_run() -> None:
    decoder = Pic32Decoder()
    assert len(decoder.feed(record_bytes(1) + record_bytes(2) + END + b"text")) == 2
    assert decoder.ended
    assert not decoder.misaligned
    assert decoder.counters == {"records": 2, "end_records": 1, "misaligned": 0, "junk_bytes": 4}
    decoder.reset()
    assert not decoder.ended
    assert len(decoder.feed(record_bytes(1))) == 1


def test_reset_forgets_the_record_that_has_begun() -> None:
    decoder = Pic32Decoder()
    decoder.feed(record_bytes(1)[:20])
    assert decoder.pending == 20
    decoder.reset()
    assert (decoder.pending, decoder.counters["junk_bytes"]) == (0, 20)


pieces = st.one_of(
    st.integers(0, 2**32 - 1).map(record_bytes), st.binary(max_size=130), st.just(END)
)


@settings(max_examples=100, deadline=None)
@given(st.lists(pieces, max_size=6).map(b"".join), st.lists(st.integers(0, 400), max_size=8))
def test_chunks_do_not_matter_and_all_bytes_are_accounted_for(
    data: bytes, cuts: Sequence[int]
) -> None:
    whole, parts = Pic32Decoder(), Pic32Decoder()
    expected = whole.feed(data)
    edges = [0, *sorted(cuts), len(data)]
    got = [r for a, b in pairwise(edges) for r in parts.feed(data[a:b])]
    assert got == expected
    assert parts.counters == whole.counters
    counters = parts.counters
    good = 58 * (counters["records"] + counters["end_records"])
    assert good + counters["junk_bytes"] + parts.pending == len(data)
    assert len(got) == counters["records"]
