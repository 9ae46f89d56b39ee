"""Header of a vendor text log (SynTouch GUI, "DataStructure: 2.0"; hardware reference 1.8)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from palpate.errors import RecordingError
from palpate_gateway.protocols.channels import SLOT_RATE_HZ
from palpate_gateway.protocols.spi import printable_prefix

BEGIN = b"Begin File"
"""The line after which the rows start."""

HEADER_BYTES = 1 << 14
"""A header is never longer than this [bytes]; the public one has 750."""


@dataclass(frozen=True, slots=True)
class LogHeader:
    """What a log says of itself. It can lie: layout and batches are taken from the rows.

    Attributes:
        lines: Number of lines before the first row; 0 = a log without header.
        data_structure: Version of the format, e.g. ``"2.0"``.
        operator: Who recorded.
        started_wall_ns: Date and time of the recording, read as UTC because the file names no zone
            [ns since the Unix epoch]; None where it has none.
        flex_versions: Flex circuit version by port; empty = slot not used.
        firmware_versions: Firmware version by port.
        serials: Serial number by port, cut at the first non-printable byte.
        structure: Names of the channels in order of sampling.
        sample_rate_hz: Slots per second [Hz].
        frames_in_batch: As claimed (the public capture claims 7 and holds 4).
    """

    lines: int = 0
    data_structure: str = ""
    operator: str = ""
    started_wall_ns: int | None = None
    flex_versions: tuple[str, ...] = ()
    firmware_versions: tuple[str, ...] = ()
    serials: tuple[str, ...] = ()
    structure: tuple[str, ...] = ()
    sample_rate_hz: float = SLOT_RATE_HZ
    frames_in_batch: int = 0

    def serial(self, port: int) -> str:
        """Serial number at a port counted from 1; empty where the header has none."""
        return self.serials[port - 1] if port <= len(self.serials) else ""


def split_header(name: str, data: bytes) -> tuple[LogHeader, int]:
    """Read the header at the start of a log.

    Args:
        name: Name of the file, for errors.
        data: First block of the file.

    Returns:
        The header and the offset of the first row.

    Raises:
        RecordingError: Neither a header nor a row is at the start.
    """
    at = data[:HEADER_BYTES].find(BEGIN)
    if at >= 0:
        newline = data.find(b"\n", at)
        end = len(data) if newline < 0 else newline + 1
        lines = data[:end].splitlines()
        return _parse(name, lines), end
    first = data.split(b"\n", 1)[0]
    if first.lower().startswith(b"datastructure"):
        raise RecordingError(
            f"{name}: the header does not end in a 'Begin File' line",
            remedy="the file is cut or edited; export it again",
        )
    if not _looks_like_row(first):
        shown = first[:40].decode("latin-1")
        raise RecordingError(
            f"{name}: line 1 is neither a log header nor a row: {shown!r}",
            remedy="give a SynTouch text log, plain or .gz: a 'DataStructure' header and "
            "'Begin File', or rows of 'time batch frame channel value parity ...'",
        )
    return LogHeader(), 0


def _looks_like_row(line: bytes) -> bool:
    # A row cut by the end of the file still is one; the row parser names what is wrong with it.
    fields = line.split()
    try:
        return len(fields) >= 2 and all(float(field) == float(field) for field in fields)
    except ValueError:
        return False


def _parse(name: str, lines: list[bytes]) -> LogHeader:
    values: dict[str, bytes] = {}
    for line in lines:
        key, separator, value = line.partition(b":")
        if separator:
            values[key.decode("latin-1").strip().lower()] = value
    rate = _number(name, values, "samprate", SLOT_RATE_HZ)
    if not 0.0 < rate < 1e6:
        raise RecordingError(
            f"{name}: SampRate {rate:g} Hz in the header is not a slot rate",
            remedy="correct the header; SynTouch records 4400 slots a second",
        )
    return LogHeader(
        lines=len(lines),
        data_structure=printable_prefix(values.get("datastructure", b"").strip()),
        operator=printable_prefix(values.get("operator", b"").strip()),
        started_wall_ns=_started(values),
        flex_versions=_by_port(values.get("flex version", b"")),
        firmware_versions=_by_port(values.get("firmware version", b"")),
        serials=_by_port(values.get("serial number", b"")),
        structure=_by_port(values.get("sampstructure", b"")),
        sample_rate_hz=rate,
        frames_in_batch=int(_number(name, values, "framesinbatch", 0.0)),
    )


def _number(name: str, values: dict[str, bytes], key: str, default: float) -> float:
    text = values.get(key, b"").strip()
    if not text:
        return default
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise RecordingError(
            f"{name}: header key {key!r} is {text[:40].decode('latin-1')!r}, not a number",
            remedy="correct the header or export the log again",
        )
    return number


def _by_port(value: bytes) -> tuple[str, ...]:
    value = value.strip(b" \r\n")
    return tuple(printable_prefix(item.strip(b" ")) for item in value.split(b",")) if value else ()


def _started(values: dict[str, bytes]) -> int | None:
    date = values.get("date", b"").decode("latin-1").strip()
    time = values.get("time", b"").decode("latin-1").strip()
    for form in ("%Y/%m/%d %H:%M", "%Y/%m/%d %H:%M:%S"):
        try:
            started = datetime.strptime(f"{date} {time}", form).replace(tzinfo=UTC)
        except ValueError:
            continue
        return int(started.timestamp()) * 1_000_000_000
    return None
