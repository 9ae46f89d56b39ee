"""Robot poses in a CSV file: a header that names columns and units, then one row for each pose.

Columns: ``time_s``, ``x_m y_m z_m`` or ``x_mm y_mm z_mm``, ``qw qx qy qz``, and optionally
``wall_ns``, in any order; others are ignored. The file is streamed. An error names line and column,
and comes after all rows before it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from palpate.errors import RecordingError
from palpate.files.bounded import plain_number
from palpate.messages import Pose
from palpate.rigid import is_rotation, quaternion_length
from palpate_gateway.pose.placement import REACH_M

_LINE_LIMIT = 1 << 16
"""A longer line is not a line of such a file [bytes]."""

_WALL_DIGITS = 19
_TIME, _WALL = "time_s", "wall_ns"
_POSITIONS = {("x_m", "y_m", "z_m"): 1.0, ("x_mm", "y_mm", "z_mm"): 1e-3}
_QUATERNION = ("qw", "qx", "qy", "qz")
_COLUMNS = (
    "name the columns time_s, x_m y_m z_m (or x_mm y_mm z_mm), qw qx qy qz, and optionally "
    "wall_ns, separated by commas"
)
_REPAIR = "repair or delete the line; all rows before it were delivered"


@dataclass(frozen=True, slots=True)
class PoseRow:
    """One pose of the flange in the robot's base.

    Attributes:
        tick: Number of the row, or the sequence number of the robot's program.
        time_s: Time of the pose [s], from any origin.
        pose: Position [m] and unit quaternion w x y z, up to rounding.
        missed_before: Poses that were lost directly before this one.
    """

    tick: int
    time_s: float
    pose: Pose
    missed_before: int = 0


class PoseTable:
    """Rows of one file; can be read once.

    ``counters``: ``repeated_poses``: dropped rows with the time of the row before.

    Raises:
        RecordingError: It cannot be read, is empty, or its header lacks or repeats a column.
    """

    def __init__(self, path: Path) -> None:
        self.counters = {"repeated_poses": 0}
        self.start_wall_ns: int | None = None
        """Wall clock at the first row [ns], if the file has it; known once that has been read."""
        self._path = path
        self._line = 0
        try:
            self._file: IO[bytes] = path.open("rb")
        except OSError as error:
            raise self._unreadable(error) from error
        try:
            self._read_header()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def rows(self) -> Iterator[PoseRow]:
        """Poses in order of time.

        Raises:
            RecordingError: The file is broken here; names line and column.
        """
        last_s: float | None = None
        tick = 0
        while True:
            cells = self._cells()
            if cells is None:
                break
            row = self._row(cells, tick)
            if last_s is not None and row.time_s < last_s:
                raise self._wrong(
                    f"column {_TIME!r}: time goes back from {last_s:g} to {row.time_s:g} s"
                )
            if row.time_s == last_s:
                self.counters["repeated_poses"] += 1
                continue
            last_s = row.time_s
            tick += 1
            yield row
        if last_s is None:
            raise RecordingError(
                f"{self._path}: a header and no rows", remedy="record or copy the file again"
            )

    def _read_header(self) -> None:
        names = self._cells()
        if names is None:
            raise RecordingError(
                f"{self._path}: the file is empty", remedy="record or copy the file again"
            )
        self._width = len(names)
        if self._width == 1:
            for separator, name in ((";", "semicolons"), ("\t", "tabs"), (None, "blanks")):
                if len(names[0].split(separator)) > 1:
                    raise self._wrong(f"columns are separated by {name}", _COLUMNS)
        if all(_number(name) is not None for name in names):
            raise self._wrong("there is no header, only numbers", _COLUMNS)
        for name in (_TIME, _WALL, *_QUATERNION, *(n for names in _POSITIONS for n in names)):
            if names.count(name) > 1:
                raise self._wrong(f"column {name!r} is there twice", _COLUMNS)
        given = [group for group in _POSITIONS if any(name in names for name in group)]
        if len(given) > 1:
            raise self._wrong("positions are there in m and in mm", "keep one of the two")
        positions = given[0] if given else next(iter(_POSITIONS))
        for name in (_TIME, *positions, *_QUATERNION):
            if name not in names:
                raise self._wrong(f"column {name!r} is missing", _COLUMNS)
        self._scale = _POSITIONS[positions]
        self._time = names.index(_TIME)
        self._position = [(names.index(name), name) for name in positions]
        self._quaternion = [(names.index(name), name) for name in _QUATERNION]
        self._wall = names.index(_WALL) if _WALL in names else None

    def _row(self, cells: list[str], tick: int) -> PoseRow:
        if len(cells) != self._width:
            raise self._wrong(f"{len(cells)} columns, the header has {self._width}")
        time_s = self._value(cells, self._time, _TIME)
        most = REACH_M / self._scale
        x, y, z = (self._scale * self._value(cells, *column, most) for column in self._position)
        w, qx, qy, qz = (self._value(cells, *column) for column in self._quaternion)
        if not is_rotation((w, qx, qy, qz)):
            raise self._wrong(
                "columns qw qx qy qz: the quaternion has length "
                f"{quaternion_length((w, qx, qy, qz)):.4g}, not 1"
            )
        if self._wall is not None and self.start_wall_ns is None:
            text = cells[self._wall]
            whole = text.isdecimal() and text.isascii() and len(text) <= _WALL_DIGITS
            if not (whole and int(text) >> 63 == 0):
                raise self._wrong(
                    f"column {_WALL!r}: {text[:40]!r} is not a whole number of ns since 1970"
                )
            self.start_wall_ns = int(text)
        return PoseRow(tick, time_s, Pose((x, y, z), (w, qx, qy, qz)))

    def _value(self, cells: list[str], at: int, name: str, most: float = math.inf) -> float:
        value = _number(cells[at])
        if value is None:
            raise self._wrong(f"column {name!r}: {cells[at][:40]!r} is not a number")
        if not math.isfinite(value):
            raise self._wrong(f"column {name!r}: {cells[at][:40]!r} is not finite")
        if abs(value) > most:
            raise self._wrong(
                f"column {name!r}: {cells[at][:40]!r} is out of any robot's reach",
                "repair or delete the line; positions in mm have the columns x_mm y_mm z_mm",
            )
        return value

    def _cells(self) -> list[str] | None:
        """Cells of the next line that is not blank; None = the file has ended."""
        while True:
            try:
                line = self._file.readline(_LINE_LIMIT)
            except OSError as error:
                raise self._unreadable(error) from error
            if not line:
                return None
            self._line += 1
            if not line.endswith(b"\n"):
                if len(line) == _LINE_LIMIT:
                    raise self._wrong("the line is too long for a table of poses", _COLUMNS)
                # Half a number is a number, too, so such a line may be incomplete.
                raise self._wrong(
                    f"the last line is cut: {line[-40:].decode('latin-1')!r} has no line end",
                    "the file is truncated: copy it again (all rows before the cut were "
                    "delivered); if the line is whole, end it",
                )
            try:
                # Some spreadsheets write a byte order mark first.
                text = line.decode("utf-8-sig" if self._line == 1 else "utf-8")
            except UnicodeDecodeError as error:
                raise self._wrong(
                    f"byte {error.start + 1} of the line is not text", "give a CSV file in UTF-8"
                ) from error
            if text.strip():
                return [cell.strip(' \t\r\n"') for cell in text.split(",")]

    def _wrong(self, problem: str, remedy: str = _REPAIR) -> RecordingError:
        return RecordingError(f"{self._path}, line {self._line}: {problem}", remedy=remedy)

    def _unreadable(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"{self._path}: cannot be read ({error.strerror or error})",
            remedy="check the path and that this user may read the file",
        )


def _number(text: str) -> float | None:
    try:
        return plain_number(text)
    except ValueError:
        return None
