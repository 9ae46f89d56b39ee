"""Format of vendor text logs (SynTouch GUI "DataStructure: 2.0", Cheetah library; reference 1.8).

``LineBlocks`` reads the bytes of a plain or gzip file in blocks of whole lines, ``split_header``
the header. ``parse_rows`` makes arrays of rows ``time batch frame channel v1 p1 v2 p2 ...``: a
block of valid lines is parsed by a few NumPy calls. If these find anything unusual, the block is
parsed again line by line, to find the first bad line, to say what is wrong with it, and to keep the
rows before it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import RecordingError
from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols.channels import SLOT_RATE_HZ
from palpate_gateway.protocols.spi import printable_prefix

_GZIP_MAGIC = b"\x1f\x8b"
_READ_BYTES = 1 << 16
_GZIP_WINDOW = 16 + zlib.MAX_WBITS  # "16 +" makes zlib read the gzip wrapper
_LINE_LIMIT = 1 << 16
"""Longest line of a log [bytes]."""


class LineBlocks:
    """Whole lines of a log, block by block.

    gzip is recognised by its magic number, not by the name of the file. zlib is called directly,
    because ``gzip.open`` may withhold decompressed bytes if the end of the file is damaged.

    Args:
        path: The log.
        block_bytes: Smallest size of a block, except of the last [bytes].
    """

    def __init__(self, path: Path, *, block_bytes: int = 1 << 18) -> None:
        self._path = path
        self._block_bytes = block_bytes
        self.unfinished = b""
        """Bytes after the last line end; known once the file has been read."""
        self.damage: RecordingError | None = None
        """Error that ended the bytes early; known once the file has been read."""

    def __iter__(self) -> Iterator[bytes]:
        """Blocks that end in a newline; afterwards ``unfinished`` and ``damage`` are set."""
        parts: list[bytes] = []
        size = 0
        for chunk in self._chunks():
            parts.append(chunk)
            size += len(chunk)
            if size < self._block_bytes:
                continue
            data = b"".join(parts)
            end = data.rfind(b"\n") + 1
            if not end and len(data) > _LINE_LIMIT:
                break
            if end:
                yield data[:end]
            parts = [data[end:]]
            size = len(data) - end
        data = b"".join(parts)
        end = data.rfind(b"\n") + 1
        if end:
            yield data[:end]
        self.unfinished = data[end:]

    def _chunks(self) -> Iterator[bytes]:
        try:
            with self._path.open("rb") as file:
                data = file.read(_READ_BYTES)
                if not data.startswith(_GZIP_MAGIC):
                    while data:
                        yield data
                        data = file.read(_READ_BYTES)
                    return
                inflate = zlib.decompressobj(_GZIP_WINDOW)
                while data:
                    try:
                        plain = inflate.decompress(data)
                    except zlib.error as error:
                        self.damage = RecordingError(
                            f"{self._path}: the gzip data is damaged ({error})",
                            remedy="copy the file again from its source; the frames before the "
                            "damage were delivered",
                        )
                        return
                    if plain:
                        yield plain
                    data = inflate.unused_data or file.read(_READ_BYTES)
                    if inflate.eof and data:
                        inflate = zlib.decompressobj(_GZIP_WINDOW)
                if not inflate.eof:
                    self.damage = RecordingError(
                        f"{self._path}: the gzip file is truncated",
                        remedy="copy the file again from its source; the frames before the cut "
                        "were delivered",
                    )
        except OSError as error:
            raise RecordingError(
                f"{self._path}: cannot be read ({error.strerror or error})",
                remedy="check the path and that this user may read the file",
            ) from error


BEGIN = b"Begin File"
"""Last line of the header."""

HEADER_BYTES = 1 << 14
"""Longest header [bytes]; that of the public log has 750."""


@dataclass(frozen=True, slots=True)
class LogHeader:
    """Header of a log. It may be wrong, so layout and batches are taken from the rows.

    Attributes:
        lines: Number of lines before the first row; 0 = a log without header.
        started_wall_ns: Date and time of the recording, read as UTC because the file names no zone
            [ns since the Unix epoch]; None where it has none.
        serials: Serial number by port, cut at the first non-printable byte.
        sample_rate_hz: Slots per second [Hz].
    """

    lines: int = 0
    started_wall_ns: int | None = None
    serials: tuple[str, ...] = ()
    sample_rate_hz: float = SLOT_RATE_HZ

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
    # A row that the end of the file cuts counts, too; the row parser reports its error.
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
        started_wall_ns=_started(values),
        serials=_by_port(values.get("serial number", b"")),
        sample_rate_hz=rate,
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


PORTS_MAX = 5
"""Value and parity pairs in one row; the larger Cheetah board has five ports."""

_FIXED_COLUMNS = 4
_PLAIN = b"0123456789.- \r\n"


@dataclass(frozen=True, slots=True)
class LogRows:
    """Parsed rows, and the error that stopped the parsing.

    Attributes:
        table: Valid rows, float64, shape ``(N, columns)``.
        damage: Error of the row after them; None = all rows are valid.
    """

    table: npt.NDArray[np.float64]
    damage: RecordingError | None


def count_columns(name: str, line: bytes, line_number: int) -> int:
    """Number of columns of a log, from its first row.

    Raises:
        RecordingError: No log has this number of columns.
    """
    columns = len(line.split())
    ports, odd = divmod(columns - _FIXED_COLUMNS, 2)
    if odd or not 1 <= ports <= PORTS_MAX:
        raise _error(
            name,
            line_number,
            f"the row has {columns} columns",
            "a row is 'time batch frame channel' and 1 to 5 pairs of value and parity",
        )
    return columns


def parse_rows(name: str, data: bytes, columns: int, line_number: int) -> LogRows:
    """Parse a block of whole lines.

    Args:
        name: Name of the file, for errors.
        data: Lines, each with its line end.
        columns: Columns of every row.
        line_number: Number of the first line, from 1.
    """
    table = _parse_fast(data, columns)
    if table is None:
        return _parse_slow(name, data, columns, line_number)
    bad = _bad_rows(table)
    if not bad.any():
        return LogRows(table, None)
    at = int(np.argmax(bad))
    return LogRows(table[:at], _row_error(name, line_number + at, table[at]))


def _parse_fast(data: bytes, columns: int) -> npt.NDArray[np.float64] | None:
    """All rows as numbers, or None if a line has not exactly the form of a valid line."""
    data = data.replace(b" \n", b"\n")  # the maker's library ends its rows so
    if data.translate(None, _PLAIN) or b"  " in data or b" \n" in data or b" \r" in data:
        return None
    # Reject forms in which an additional and a missing column could balance each other.
    if data.count(b"\r") != data.count(b"\r\n") or b"\n " in data or data.startswith(b" "):
        return None
    raw = np.frombuffer(data, np.uint8)
    ends = np.flatnonzero(raw == 0x0A)
    spaces = np.searchsorted(np.flatnonzero(raw == 0x20), ends)
    # Count per line, because a short line and a long line could balance each other.
    if (np.diff(spaces, prepend=0) != columns - 1).any():
        return None
    # Text mode of fromstring is NumPy's fastest parser of numbers, eight times as fast as loadtxt.
    try:
        values = np.fromstring(data.decode("ascii"), np.float64, sep=" ")
    except ValueError:  # signs and points that are not a number
        return None
    if len(values) != len(ends) * columns:
        return None
    return values.reshape(-1, columns)


def _parse_slow(name: str, data: bytes, columns: int, line_number: int) -> LogRows:
    rows: list[list[float]] = []
    damage = None
    for at, line in enumerate(data.split(b"\n")[:-1], line_number):
        fields = line.split()
        if not fields:
            # Empty lines occur at the end of logs that were copied by hand.
            continue
        try:
            # Python would read 1_0 as ten.
            row = [float(field.replace(b"_", b"?")) for field in fields]
        except ValueError:
            shown = line[:40].decode("latin-1")
            damage = _error(name, at, f"not a row of numbers: {shown!r}")
            break
        if len(row) != columns:
            damage = _error(name, at, f"{len(row)} columns where the first row has {columns}")
            break
        if _bad_rows(np.array([row]))[0]:
            damage = _row_error(name, at, np.array(row))
            break
        rows.append(row)
    return LogRows(np.array(rows, np.float64).reshape(-1, columns), damage)


_COUNTER_MAX = 2.0**53
_KNOWN = np.array(sorted(ch.CHANNEL_NAMES), np.float64)


def _bad_rows(table: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    counters, channel = table[:, 1:3], table[:, 3]
    values, parity = table[:, 4::2], table[:, 5::2]
    bad = np.asarray(~np.isfinite(table).all(axis=1))
    bad |= ((counters < 0) | (counters > _COUNTER_MAX) | (counters % 1 != 0)).any(axis=1)
    bad |= ~np.isin(channel, _KNOWN)
    bad |= ((values < 0) | (values > COUNTS_MAX) | (values % 1 != 0)).any(axis=1)
    bad |= ((parity != 0) & (parity != 1)).any(axis=1)
    return bad


def _row_error(name: str, line: int, row: npt.NDArray[np.float64]) -> RecordingError:
    """The error of a row that ``_bad_rows`` found."""
    numbers = row.tolist()
    if not all(math.isfinite(number) for number in numbers):
        return _error(name, line, "a number is not finite")
    for what, counter in (("batch", numbers[1]), ("frame", numbers[2])):
        if not 0 <= counter <= _COUNTER_MAX or counter % 1:
            return _error(name, line, f"{what} index {counter:g} is not a count")
    if numbers[3] not in ch.CHANNEL_NAMES:
        return _error(
            name,
            line,
            f"unknown channel id {numbers[3]:g}",
            "a BioTac has ids 0-3 (PAC, PDC, TAC, TDC), 15 (Hall) and 17-40 (E1-E24); "
            "is this a log of another sensor?",
        )
    for port, (value, parity) in enumerate(zip(numbers[4::2], numbers[5::2], strict=True), 1):
        if not 0 <= value <= COUNTS_MAX or value % 1:
            problem = f"value {value:g} at port {port} is not a 12-bit count (0..{COUNTS_MAX})"
            return _error(name, line, problem)
        if parity not in (0, 1):
            return _error(name, line, f"parity column of port {port} is {parity:g}, not 0 or 1")
    return _error(name, line, "the row is damaged")


def _error(
    name: str,
    line: int,
    problem: str,
    remedy: str = "the line is damaged; copy or export the log again (rows before it were "
    "delivered)",
) -> RecordingError:
    return RecordingError(f"{name}, line {line}: {problem}", remedy=remedy)
