"""Lines of the Weiss KMS 40."""

from __future__ import annotations

import math
from typing import cast

from tests.fuzz.streams import all_counted, same_in_pieces

from palpate_gateway.protocols.kms40 import (
    LINE_MAX,
    KmsDecoder,
    KmsForceLine,
    KmsLineFault,
    KmsRefusal,
    KmsReply,
    flag_names,
    over_range_axes,
    parse_flags,
)

_GOOD = b"F={1.5,-0.25,1.0,0.02,-0.01,0.005},4711\n"
_SAMPLE = KmsForceLine((1.5, -0.25, 1.0), (0.02, -0.01, 0.005), 4711)


def check(data: bytes) -> None:
    """One byte chooses the cuts, the others are the stream."""
    stream = data[1:]
    decoder, records = same_in_pieces(KmsDecoder, stream, data[0] if data else 0)
    counters = decoder.counters
    assert decoder.pending <= LINE_MAX
    lines = len(records) + sum(counters[fault] for fault in KmsLineFault)
    assert lines - stream.count(b"\n") in (0, 1)  # an overlong line counts before it ends
    for record in records:
        _check_record(record)
    # Whatever came before, the next whole line is read.
    again = cast(KmsDecoder, decoder)
    taken = counters["record_bytes"]
    all_counted(decoder, taken, stream)
    again.feed(b"\n")
    assert again.feed(_GOOD) == [_SAMPLE]


def _check_record(record: object) -> None:
    if isinstance(record, KmsForceLine):
        values = (*record.force, *record.torque)
        assert all(map(math.isfinite, values))
        assert record.timestamp is None or record.timestamp >= 0
        line = f"F={{{','.join(map(repr, values))}}}"
        line += "" if record.timestamp is None else f",{record.timestamp}"
        assert KmsDecoder().feed(line.encode("ascii") + b"\n") == [record]
    elif isinstance(record, KmsReply):
        assert record.name
        assert record.value.isascii()
        flags = parse_flags(record.value)
        if flags is not None:
            assert 0 <= flags < 1 << 32
            assert len(flag_names(flags)) == flags.bit_count()
            assert len(over_range_axes(flags)) <= 6
    else:
        assert isinstance(record, KmsRefusal)
        assert record.code >= 0
        assert record.meaning


def seeds() -> list[bytes]:
    """Every kind of line of the page."""
    lines = [
        _GOOD,
        b"F={1,-2.,.5,0,+4e-3,-5E1}\r\n",
        b"F={1, -2.0, 0.5, 0, 0.004, -50.0}, 12.5\n",
        b"F={nan,0,0,0,0,1e999},1\nF={0,0,0,0,0}\n\n\xff\nwhat\n",
        b'L1\nL0\nTARE=1\nT=25.7\nID="KMS 40"\nLMASK={1,1,1,1,1,1}\nFLT=4\nLDIV=1\nVL=0\n',
        b"FLAGS=0x7c00f3f\nFLAGS=1048576\nFLAGS=99999999999\n",
        b'ERROR(14)\nERROR(24,"LDIV")\nERROR(77)\nERROR\n',
        b"F={0,0,0F={0,0,0,0,0,0},7\n" + b"x" * (LINE_MAX + 3) + b"\nL1\n",
    ]
    return [bytes([how]) + line for how, line in enumerate(lines)]
