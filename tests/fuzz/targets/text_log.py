"""A vendor text log from file to frames."""

from __future__ import annotations

import gzip
import tempfile
from pathlib import Path

from tests.fuzz.streams import has_remedy
from tests.fuzz.targets import text_log_rows

from palpate.errors import ConfigError, RecordingError
from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols.channels import FIRST_ELECTRODE, SLOTS_PER_FRAME
from palpate_gateway.readings import ElectrodeReading
from palpate_gateway.recordings.text_log import TextLog, TextLogOptions

_FOLDER = tempfile.TemporaryDirectory(prefix="fuzz-text-log-")
_PATH = Path(_FOLDER.name, "a.log")


def check(data: bytes) -> None:
    """One byte chooses the port; the others are the file."""
    _PATH.write_bytes(data[1:])
    device = TextLog(TextLogOptions(path=_PATH, port=data[0] % 6 if data else 0))
    try:
        device.open()
    except (RecordingError, ConfigError) as error:
        has_remedy(error)
        return
    readings: list[ElectrodeReading] = []
    for _ in range(2):  # damage is told once, and only after all that came before it
        try:
            while got := device.read(1.0):
                readings += [one for one in got if isinstance(one, ElectrodeReading)]
            break
        except RecordingError as error:
            has_remedy(error)
    assert device.read(1.0) == []
    counters = device.counters
    device.close()
    assert counters["frames"] == len(readings)
    assert counters["samples"] >= len(readings)
    assert min(counters.values()) >= 0
    ticks = [one.tick for one in readings]
    assert ticks == sorted(set(ticks))
    assert sum(one.missed_before for one in readings) == counters["missing_frames"]
    for one in readings:
        assert 0 <= one.validity < 1 << 44
        assert max(*one.electrodes, *one.pac, one.pdc, one.tac, one.tdc) <= COUNTS_MAX


def _frames(numbers: list[int], *, time: bool, ports: int) -> bytes:
    slow = [*range(FIRST_ELECTRODE, FIRST_ELECTRODE + 19), 1, 2, 3]
    cycle = [channel for one in slow for channel in (one, 0)]
    lines = []
    for k, number in enumerate(numbers):
        for slot, channel in enumerate(cycle):
            time_s = (k * SLOTS_PER_FRAME + slot) / 4400 if time else 0.0
            pairs = " ".join(f"{1000 + slot} 0" for _ in range(ports))
            lines.append(f"{time_s:.6f} 0 {number} {channel} {pairs}\n")
    return "".join(lines).encode("ascii")


def seeds() -> list[bytes]:
    """Short logs of both styles, whole and damaged, plain and packed."""
    two = _frames([5, 6], time=True, ports=1)
    gap = _frames([5, 9], time=False, ports=1)
    three = _frames([1], time=False, ports=3)
    header = text_log_rows.seeds()[0].partition(b"Begin File\r\n")
    return [
        b"\0" + two,
        b"\0" + gap[:-30],
        b"\2" + three,
        b"\0" + three,
        b"\0" + b"".join(header[:2]) + two,
        b"\1" + two.replace(b" 1003 0", b" 1003 1").replace(b"5 17", b"5 99", 1),
        b"\0" + gzip.compress(two, mtime=0),
        *(b"\0" + one for one in text_log_rows.seeds()[:3]),
    ]
