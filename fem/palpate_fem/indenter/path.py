"""Paths of an indenter: their validation, their files, and their words."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from palpate.errors import ConfigError
from palpate.files.bounded import plain_number
from palpate_fem.arrays import Floats

COLUMNS = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
REACH_M = 0.2  # a position farther from the origin is a mistake of units
POSES_MOST = 10_000
"""Most poses of a path: each is a step of about a second."""

FILE_BYTES_MOST = 2**22
"""Largest file of poses: `POSES_MOST` of them, printed in full, need 1.6 MB."""

_DAMAGED = (
    OSError, ValueError, EOFError, KeyError, NotImplementedError, RuntimeError, SyntaxError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What NumPy and zipfile raise at bytes that are no .npz file."""

_UNIT = 1e-6  # deviation of a quaternion's length that rounding may explain


def check_path(path: ArrayLike, *, source: str = "path", first_line: int | None = None) -> Floats:
    """Validate a path.

    Args:
        path: Poses: position [m] and unit quaternion w x y z, sensor frame, shape (K + 1, 7).
        source: Its name in errors.
        first_line: Line of the first pose if it is a file.

    Returns:
        A copy, shape (K + 1, 7), its quaternions of length 1 to the last digits.

    Raises:
        ConfigError: Wrong shape, no step, too many, not finite, far away, or a quaternion that is
            not one.
    """

    def at(row: int) -> str:
        return f"{source}[{row}]" if first_line is None else f"{source}, line {first_line + row}"

    try:
        poses = np.array(path, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{source} is not an array of numbers", remedy="give poses of 7 numbers each"
        ) from error
    if poses.size == 0:
        raise ConfigError(f"{source} has no pose", remedy="give where it starts and where it goes")
    if poses.ndim != 2 or poses.shape[1] != 7:
        raise ConfigError(
            f"{source} has shape {poses.shape}, not (K + 1, 7)",
            remedy=f"give each pose as {', '.join(COLUMNS)}",
        )
    if len(poses) < 2:
        raise ConfigError(
            f"{source} has one pose, where the indenter starts, and no step",
            remedy="add the poses that it moves to",
        )
    if len(poses) > POSES_MOST:
        raise ConfigError(
            f"{source} has {len(poses):,} poses, at most {POSES_MOST:,} are simulated",
            remedy="leave poses out: the solver adds its own where it needs them",
        )
    finite = np.isfinite(poses).all(axis=1)
    if not finite.all():
        raise ConfigError(f"{at(int(finite.argmin()))} is not finite", remedy="correct this pose")
    far = np.abs(poses[:, :3]).max(axis=1)
    if far.max() > REACH_M:
        raise ConfigError(
            f"{at(int((far > REACH_M).argmax()))} is {far.max():.3g} m away from the sensor",
            remedy=f"give positions in metres, within {REACH_M} m",
        )
    length = np.linalg.norm(poses[:, 3:], axis=1)
    wrong = np.abs(length - 1.0) > _UNIT
    if wrong.any():
        row = int(wrong.argmax())
        raise ConfigError(
            f"{at(row)} has a quaternion of length {length[row]:.9g}, not 1",
            remedy="normalise it, and mind the order w x y z",
        )
    poses[:, 3:] /= length[:, None]
    return poses


def read_path(file: str | Path) -> Floats:
    """Read a path from a file with the columns x_m y_m z_m qw qx qy qz.

    By its suffix: ``.json`` holds an object with a list of numbers for each column, ``.npz`` an
    array (K + 1,) for each; anything else is CSV with the columns as its header.

    Returns:
        Position [m] and unit quaternion w x y z, sensor frame, shape (K + 1, 7).

    Raises:
        ConfigError: It cannot be read, or is not such a file; names the line or the column.
    """
    file, header = Path(file), ",".join(COLUMNS)
    try:
        with file.open("rb") as opened:
            content = opened.read(FILE_BYTES_MOST + 1)
    except OSError as error:
        raise ConfigError(
            f"{file}: cannot be read: {error}", remedy=f"give a file with the columns {header}"
        ) from error
    if len(content) > FILE_BYTES_MOST:
        raise ConfigError(
            f"{file} has more than {FILE_BYTES_MOST:,} bytes",
            remedy=f"give a file of at most {POSES_MOST:,} poses",
        )
    if file.suffix == ".npz":
        return check_path(_stacked(_npz_columns(content, file), file), source=str(file))
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{file}: cannot be read: {error}", remedy=f"give a file with the columns {header}"
        ) from error
    if file.suffix == ".json":
        return check_path(_stacked(_json_columns(text, file), file), source=str(file))
    lines = text.splitlines()
    try:
        rows = list(csv.reader(lines, strict=True))
    except csv.Error as error:
        raise ConfigError(f"{file}: not CSV: {error}", remedy="write plain numbers") from error
    if not rows or tuple(cell.strip() for cell in rows[0]) != COLUMNS:
        raise ConfigError(
            f"{file}, line 1: the header is {lines[0][:80] if lines else ''!r}",
            remedy=f"make it {header}",
        )
    poses = []
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(COLUMNS):
            raise ConfigError(
                f"{file}, line {number}: {len(row)} values, not {len(COLUMNS)}",
                remedy=f"give {header} in each line, and no empty lines",
            )
        poses.append(
            [_number(cell, file, number, key) for cell, key in zip(row, COLUMNS, strict=True)]
        )
    return check_path(poses, source=str(file), first_line=2)


def _number(cell: str, file: Path, line: int, column: str) -> float:
    try:
        return plain_number(cell)
    except ValueError as error:
        raise ConfigError(
            f"{file}, line {line}: {column} = {cell[:40]!r} is not a number",
            remedy="write it like -8.31e-3",
        ) from error


def _json_columns(text: str, file: Path) -> Mapping[str, object]:
    try:
        columns = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(
            f"{file}: not JSON: {str(error)[:80]}", remedy='begin with {"x_m": [...'
        ) from error
    if not isinstance(columns, dict):
        raise ConfigError(
            f"{file} holds no object", remedy=f"give a list for each of {', '.join(COLUMNS)}"
        )
    return columns


def _npz_columns(content: bytes, file: Path) -> Mapping[str, object]:
    try:
        # Sizes are looked at before anything is unpacked: a few kilobytes may claim gigabytes.
        with zipfile.ZipFile(io.BytesIO(content)) as parts:
            unpacked = sum(part.file_size for part in parts.infolist())
        if unpacked <= FILE_BYTES_MOST:
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
    except _DAMAGED as error:
        raise ConfigError(
            f"{file}: not an .npz file: {str(error)[:80]}", remedy="write it with numpy.savez"
        ) from error
    raise ConfigError(
        f"{file} unpacks to {unpacked:,} bytes", remedy=f"give at most {POSES_MOST:,} poses"
    )


def _stacked(columns: Mapping[str, object], file: Path) -> Floats:
    """Poses of named columns, shape (K + 1, 7)."""
    if set(columns) != set(COLUMNS):
        odd = sorted(set(columns) ^ set(COLUMNS))
        raise ConfigError(
            f"{file}: {odd[0][:40]!r} is {'not a column' if odd[0] in columns else 'missing'}",
            remedy=f"give exactly {', '.join(COLUMNS)}",
        )
    arrays = []
    for name in COLUMNS:
        try:
            column = np.asarray(columns[name])
        except ValueError:
            column = np.empty(0, object)
        if column.ndim != 1 or column.dtype.kind not in "fiu":
            if column.shape == (0,) and column.dtype.kind == "f":
                raise ConfigError(f"{file} has no pose", remedy="give where it starts and goes")
            raise ConfigError(
                f"{file}: {name} is not a list of numbers", remedy="give one number for each pose"
            )
        arrays.append(column.astype(np.float64))
    if len({len(column) for column in arrays}) > 1:
        lengths = ", ".join(
            f"{len(column)} {key}" for column, key in zip(arrays, COLUMNS, strict=True)
        )
        raise ConfigError(
            f"{file}: the columns differ in length: {lengths}",
            remedy="give one number for each pose",
        )
    return np.stack(arrays, axis=1)


KINDS = ("press", "slide", "twist", "roll", "unload")
AZIMUTH_DEG = {"distal": 0.0, "+y": 90.0, "proximal": 180.0, "-y": 270.0}
LONGEST_M, LARGEST_RAD = 20e-3, 2.0 * math.pi
"""A move or turn of more than this is a mistake of units: a finger is 14 mm wide."""

SEGMENTS_MOST = 200

_SEGMENT = re.compile(
    r"(?P<kind>[a-z]+)"
    r"(?:\s+(?P<amount>\S+)\s+(?P<unit>mm|deg))?"
    r"(?:\s+at\s+(?P<angle>\S+)\s+deg)?"
    r"(?:\s+towards\s+(?P<azimuth>\S+)(?P<degrees>\s+deg)?)?"
    r"(?:\s+turned\s+(?P<turn>\S+)\s+deg)?"
)
_USE = 'write like "press 2 mm, slide 1.5 mm towards distal, twist 20 deg, roll 10 deg towards '
_USE += '90 deg, unload"'


@dataclass(frozen=True, slots=True)
class PathSegment:
    """One move of an indenter; `segment_path` chains them to poses.

    Attributes:
        kind: One of `KINDS`.
        amount: How far it goes [m], or turns [rad]; None = unload until it is clear of the skin.
        angle_rad: Of a press: its angle to the inward normal.
        azimuth_rad: Along the skin, where a slide, a roll or a press at an angle leads: 0 distal,
            a quarter turn towards +y.
        turn_rad: How far the indenter is turned about its own axis before the path begins; the
            first segment says it.
    """

    kind: str
    amount: float | None = None
    angle_rad: float = 0.0
    azimuth_rad: float = 0.0
    turn_rad: float = 0.0


def parse_segments(text: str) -> tuple[PathSegment, ...]:
    """Segments of a path from words, such as ``press 2 mm, slide 1 mm towards +y, unload``.

    * ``press D mm [at A deg [towards B]] [turned T deg]``: D mm further in; the first counts from
      first contact, and only it may turn the indenter about its axis beforehand, as ``twist`` does.
    * ``slide D mm towards B``: along the plane that touches the skin at the target.
    * ``twist A deg``: about the indenter's axis, right-handed about the direction in which it
      presses.
    * ``roll A deg towards B``: without slipping, about the middle of the tip's curvature.
    * ``unload [D mm]``: back out along the normal, without D until it is clear of the skin.

    B is ``distal``, ``proximal``, ``+y``, ``-y`` or an angle such as ``45 deg``.

    Raises:
        ConfigError: It is none; names the segment.
    """
    parts = [" ".join(part.split()) for part in text.split(",")]
    if len(parts) > SEGMENTS_MOST:
        raise ConfigError(
            f"a path of {len(parts)} segments, at most {SEGMENTS_MOST}", remedy="make it shorter"
        )
    segments = tuple(_segment(part) for part in parts)
    if segments[0].kind != "press":
        raise ConfigError(
            f"the path begins with {parts[0]!r}, clear of the skin", remedy="press first"
        )
    for part, segment in zip(parts[1:], segments[1:], strict=True):
        if segment.turn_rad:
            raise ConfigError(
                f"{part!r} turns the indenter on the way", remedy="turn the first press, or twist"
            )
    return segments


def _segment(words: str) -> PathSegment:
    found = _SEGMENT.fullmatch(words)
    if found is None or found["kind"] not in KINDS:
        raise ConfigError(f"{words[:60]!r} is no segment of a path", remedy=_USE)
    kind, turns = found["kind"], found["kind"] in ("twist", "roll")
    if found["amount"] is None and kind != "unload":
        raise ConfigError(f"{words!r} does not say how far", remedy=_USE)
    if found["amount"] is not None and found["unit"] != ("deg" if turns else "mm"):
        raise ConfigError(
            f"{words!r} is in {found['unit']}", remedy=f"give {'deg' if turns else 'mm'}"
        )
    if found["angle"] is not None and kind != "press":
        raise ConfigError(f"{words!r}: only a press has an angle to the normal", remedy=_USE)
    leads = kind in ("slide", "roll") or found["angle"] is not None
    if found["azimuth"] is not None and not leads:
        raise ConfigError(f"{words!r} leads nowhere along the skin", remedy=_USE)
    if found["azimuth"] is None and kind in ("slide", "roll"):
        raise ConfigError(f"{words!r} does not say where to", remedy=_USE)
    azimuth = AZIMUTH_DEG.get(found["azimuth"] or "distal")
    if azimuth is None or found["degrees"]:
        if not found["degrees"]:
            raise ConfigError(
                f"{words!r}: {found['azimuth']!r} is no direction",
                remedy=f"use {', '.join(AZIMUTH_DEG)} or an angle such as 45 deg",
            )
        azimuth = _finite(found["azimuth"], words)
    angle = 0.0 if found["angle"] is None else _finite(found["angle"], words)
    if not 0.0 <= angle < 90.0:
        raise ConfigError(
            f"{words!r}: {angle:g} deg does not lead into the skin", remedy="give 0 to 89"
        )
    turn = 0.0 if found["turn"] is None else math.radians(_finite(found["turn"], words))
    if found["turn"] is not None and (kind != "press" or abs(turn) > LARGEST_RAD):
        raise ConfigError(f"{words!r} cannot be turned so", remedy="turn a press, by up to 360 deg")
    amount = None
    if found["amount"] is not None:
        amount = _finite(found["amount"], words)
        amount = math.radians(amount) if turns else 1e-3 * amount
        most = LARGEST_RAD if turns else LONGEST_M
        if abs(amount) > most or amount == 0.0 or (amount < 0.0 and not turns):
            raise ConfigError(
                f"{words!r}: {found['amount']} {found['unit']} is no such way",
                remedy="give up to 360 deg, not 0" if turns else "give more than 0 and up to 20 mm",
            )
    return PathSegment(kind, amount, math.radians(angle), math.radians(azimuth), turn)


def _finite(word: str, words: str) -> float:
    try:
        value = plain_number(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{words!r}: {word[:20]!r} is not a number", remedy=_USE)
    return value


def show_segments(segments: Sequence[PathSegment]) -> str:
    """Segments as `parse_segments` reads them."""
    shown = []
    for one in segments:
        words = one.kind
        if one.amount is not None:
            turns = one.kind in ("twist", "roll")
            words += f" {math.degrees(one.amount) if turns else 1e3 * one.amount:.6g}"
            words += " deg" if turns else " mm"
        if one.angle_rad:
            words += f" at {math.degrees(one.angle_rad):.6g} deg"
        if one.kind in ("slide", "roll") or one.angle_rad:
            words += f" towards {math.degrees(one.azimuth_rad):.6g} deg"
        if one.turn_rad:
            words += f" turned {math.degrees(one.turn_rad):.6g} deg"
        shown.append(words)
    return ", ".join(shown)
