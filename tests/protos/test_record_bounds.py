"""Palpate's own records that are long, or hold nearly nothing, are within the bounds of reading."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from palpate.bus.topics import sensor_key
from palpate.codec import ELECTRODE_FRAME, FIELD_FRAME
from palpate.errors import RecordingError
from palpate.files import mcap_stream
from palpate.files.record import check_readable, summarise
from palpate.files.record_writer import RecordWriter
from palpate.messages import FieldFrame, Origin, Stamp


def test_the_index_of_a_record_of_many_hours_is_read(tmp_path: Path) -> None:
    """At ten chunks a second and six streams it has 32 MiB after six hours."""
    path = tmp_path / "run.mcap"
    with RecordWriter(path) as writer:
        key = sensor_key("lab", "finger", "electrodes")
        writer.write(key, ELECTRODE_FRAME.schema, b"x", log_time_ns=1)
    content = path.read_bytes()
    footer = len(content) - 8 - 20 - 9
    start = int.from_bytes(content[footer + 9 : footer + 17], "little")
    # One record of a private kind stands for 40 MiB of indices.
    private = struct.pack("<BQ", 0x80, 40 << 20) + bytes(40 << 20)
    summed = content[start:footer] + private + content[footer : footer + 25]
    content = content[:start] + summed + struct.pack("<I", zlib.crc32(summed)) + content[-8:]
    path.write_bytes(content)
    assert summarise(path).counts == {key: 1}
    check_readable(path)
    changed = bytearray(content)
    changed[-1000] ^= 1
    path.write_bytes(changed)
    with pytest.raises(RecordingError, match="the checksum of its index"):
        check_readable(path)


@pytest.mark.parametrize("rate_hz", [20, 100])
def test_true_fields_of_an_untouched_finger_are_read(
    tmp_path: Path, rate_hz: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All zeros, which Zstandard packs to next to nothing."""
    monkeypatch.setattr(mcap_stream, "_FREE_BYTES", 0)  # as of a record of hours
    path, key = tmp_path / "run.mcap", sensor_key("lab", "finger", "field_truth")
    zeros = np.zeros((6900, 3), np.float32)
    with RecordWriter(path) as writer:
        for n in range(1, 101):
            now_ns = n * 10**9 // rate_hz
            stamp = Stamp(n, 7 * n, 10**12 + now_ns, 10**18 + now_ns, 77, Origin.SIMULATED, 0, 7)
            frame = FieldFrame(stamp, "VIRTUAL1", bytes(range(32)), zeros)
            writer.write(
                key, FIELD_FRAME.schema, FIELD_FRAME.encode(frame), log_time_ns=stamp.wall_ns
            )
            if n % (rate_hz // 10) == 0:
                writer.flush()
    assert summarise(path).counts == {key: 100}
