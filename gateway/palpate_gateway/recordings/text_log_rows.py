"""Rows of a vendor text log: ``time batch frame channel v1 p1 v2 p2 ...`` to arrays.

A block of good lines is parsed by a few NumPy calls. Where those find anything odd, the block is
read again line by line, which finds the first bad line, says what is wrong with it, and keeps the
rows before it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import RecordingError
from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols import channels as ch

PORTS_MAX = 5
"""Value and parity pairs in one row; the larger Cheetah board has five ports."""

_FIXED_COLUMNS = 4
_PLAIN = b"0123456789.- \r\n"


@dataclass(frozen=True, slots=True)
class Rows:
    """Parsed rows and what stopped the parsing.

    Attributes:
        table: Good rows, float64, shape ``(N, columns)``.
        damage: What is wrong with the row after them; None = nothing.
    """

    table: npt.NDArray[np.float64]
    damage: RecordingError | None


def count_columns(name: str, line: bytes, line_number: int) -> int:
    """Number of columns of a log by its first row.

    Raises:
        RecordingError: No log has that many.
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


def parse_rows(name: str, data: bytes, columns: int, line_number: int) -> Rows:
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
        return Rows(table, None)
    at = int(np.argmax(bad))
    return Rows(table[:at], _row_error(name, line_number + at, table[at]))


def _parse_fast(data: bytes, columns: int) -> npt.NDArray[np.float64] | None:
    """All rows as numbers, or None where a line is not exactly what a good line is."""
    data = data.replace(b" \n", b"\n")  # so the maker's library ends its rows
    if data.translate(None, _PLAIN) or b"  " in data or b" \n" in data or b" \r" in data:
        return None
    # A column too many and one that is missing could make up for each other.
    if data.count(b"\r") != data.count(b"\r\n") or b"\n " in data or data.startswith(b" "):
        return None
    raw = np.frombuffer(data, np.uint8)
    ends = np.flatnonzero(raw == 0x0A)
    spaces = np.searchsorted(np.flatnonzero(raw == 0x20), ends)
    # Per line, because a short line and a long one could make up for each other.
    if (np.diff(spaces, prepend=0) != columns - 1).any():
        return None
    # Text mode of fromstring: the fastest parser of numbers in NumPy, eight times loadtxt.
    try:
        values = np.fromstring(data.decode("ascii"), np.float64, sep=" ")
    except ValueError:  # signs and points that make no number
        return None
    if len(values) != len(ends) * columns:
        return None
    return values.reshape(-1, columns)


def _parse_slow(name: str, data: bytes, columns: int, line_number: int) -> Rows:
    rows: list[list[float]] = []
    damage = None
    for at, line in enumerate(data.split(b"\n")[:-1], line_number):
        fields = line.split()
        if not fields:
            # Empty lines occur at the end of hand-copied logs; they hold nothing to lose.
            continue
        try:
            # Python would take 1_0 for ten.
            row = [float(field.replace(b"_", b"?")) for field in fields]
        except ValueError:
            shown = line[:40].decode("latin-1")
            damage = _error(name, at, f"not a row of numbers: {shown!r}", _REMEDY)
            break
        if len(row) != columns:
            damage = _error(
                name, at, f"{len(row)} columns where the first row has {columns}", _REMEDY
            )
            break
        if _bad_rows(np.array([row]))[0]:
            damage = _row_error(name, at, np.array(row))
            break
        rows.append(row)
    return Rows(np.array(rows, np.float64).reshape(-1, columns), damage)


_REMEDY = "the line is damaged; copy or export the log again (rows before it were delivered)"
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
    """Say what is wrong with one row that ``_bad_rows`` found."""
    numbers = row.tolist()
    if not all(math.isfinite(number) for number in numbers):
        return _error(name, line, "a number is not finite", _REMEDY)
    for what, counter in (("batch", numbers[1]), ("frame", numbers[2])):
        if not 0 <= counter <= _COUNTER_MAX or counter % 1:
            return _error(name, line, f"{what} index {counter:g} is not a count", _REMEDY)
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
            return _error(
                name,
                line,
                f"value {value:g} at port {port} is not a 12-bit count (0..{COUNTS_MAX})",
                _REMEDY,
            )
        if parity not in (0, 1):
            return _error(
                name, line, f"parity column of port {port} is {parity:g}, not 0 or 1", _REMEDY
            )
    return _error(name, line, "the row is damaged", _REMEDY)


def _error(name: str, line: int, problem: str, remedy: str) -> RecordingError:
    return RecordingError(f"{name}, line {line}: {problem}", remedy=remedy)
