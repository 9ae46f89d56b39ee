"""Paths of an indenter: their validation and their CSV files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from palpate.errors import ConfigError
from palpate_fem.arrays import Floats

COLUMNS = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
REACH_M = 0.2  # a position farther from the origin is a mistake of units
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
        ConfigError: Wrong shape, no step, not finite, far away, or a quaternion that is not one.
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


def read_path(file: Path) -> Floats:
    """Read a path from a CSV file with the header x_m,y_m,z_m,qw,qx,qy,qz.

    Returns:
        Position [m] and unit quaternion w x y z, sensor frame, shape (K + 1, 7).

    Raises:
        ConfigError: It cannot be read, or is not such a file; names the line.
    """
    header = ",".join(COLUMNS)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{file}: cannot be read: {error}", remedy=f"give a CSV file with the header {header}"
        ) from error
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
        return float(cell)
    except ValueError as error:
        raise ConfigError(
            f"{file}, line {line}: {column} = {cell[:40]!r} is not a number",
            remedy="write it like -8.31e-3",
        ) from error
