"""Joint angles that a robot logged, as a CSV file."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.testbed.kinematics import Arm
from palpate_training.testbed.transform import Floats, Transform

Times = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class JointLog:
    """Joint angles of an arm instead of poses.

    Attributes:
        path: CSV with a header ``time_s,<joint>,...``: wall clock [s since the Unix epoch], then
            the joints [rad or m] in the order of the arm's.
        arm: Its kinematics, with the tool that was used.
        sensor_robot: Its registration; None = the one in the trajectory file.
    """

    path: Path
    arm: Arm
    sensor_robot: Transform | None = None


def read_joint_log(path: Path, arm: Arm) -> tuple[Times, Floats]:
    """Wall clock [ns], shape (T,), and joints [rad or m], shape (T, n), of a CSV file.

    Raises:
        DatasetError: It cannot be read, or its columns are not time_s and the arm's joints; names
            the line.
    """
    n = len(arm.joint_names)
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path} cannot be read: {error}", remedy="check the path") from error
    if len(rows) < 2 or rows[0][:1] != ["time_s"] or len(rows[0]) != n + 1:
        raise DatasetError(
            f"{path}: columns {', '.join(rows[0]) if rows else 'none'}",
            remedy=f"write time_s and {n} joints of {arm.name}, a header first",
        )
    values = np.empty((len(rows) - 1, n + 1))
    for number, row in enumerate(rows[1:], 2):
        try:
            values[number - 2] = [float(cell) for cell in row]
        except ValueError as error:
            raise DatasetError(
                f"{path}, line {number}: {error}", remedy=f"write {n + 1} numbers"
            ) from error
    if not np.isfinite(values).all() or (np.diff(values[:, 0]) <= 0.0).any():
        raise DatasetError(
            f"{path}: times do not increase, or a value is not finite",
            remedy="leave such lines out of the log",
        )
    return np.round(values[:, 0] * 1e9).astype(np.int64), values[:, 1:]
