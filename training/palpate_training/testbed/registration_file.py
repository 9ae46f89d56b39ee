"""Registrations on disk: measured holes as a CSV file in, registrations of the arms as JSON out."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from palpate.errors import ConfigError
from palpate_training.testbed.plan import ARMS
from palpate_training.testbed.registration import Registration
from palpate_training.testbed.transform import Floats, Transform

COLUMNS = (
    "arm",
    "hole",
    "robot_x_m",
    "robot_y_m",
    "robot_z_m",
    "sensor_x_m",
    "sensor_y_m",
    "sensor_z_m",
)
"""Header of the CSV file: where the pin was by forward kinematics (robot frame), and where the hole
is by the drawing (sensor frame)."""

_Side = Literal["left", "right"]
_Pose = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Holes:
    """Holes that one arm led its pin into.

    Attributes:
        names: Of the holes.
        robot: By forward kinematics [m], shape (N, 3), robot frame.
        sensor: By the drawing [m], shape (N, 3), sensor frame.
    """

    names: tuple[str, ...]
    robot: Floats
    sensor: Floats


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)


class _Arm(_Strict):
    sensor_robot: _Pose
    holes: tuple[str, ...]
    residual_m: tuple[float, ...]
    triples: int


class _File(_Strict):
    schema_name: Literal["palpate.testbed.registration"] = Field(alias="schema")
    version: Literal[1]
    frame: Literal["sensor"]
    units: Literal["m; quaternions w x y z"]
    arms: dict[_Side, _Arm]


def read_holes(path: Path) -> dict[str, Holes]:
    """Measured holes of each arm, from a CSV file with the header ``COLUMNS``.

    Raises:
        ConfigError: It cannot be read, has other columns, or a line that is not an arm, a hole and
            six finite numbers; names the line.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path} cannot be read: {error}", remedy="check the path") from error
    if len(rows) < 2 or tuple(word.strip() for word in rows[0]) != COLUMNS:
        raise ConfigError(
            f"{path}: columns {', '.join(rows[0]) if rows else 'none'}",
            remedy=f"write the header {','.join(COLUMNS)} and a line for each arm and hole",
        )
    found: dict[str, list[tuple[str, list[float]]]] = {}
    for number, row in enumerate(rows[1:], 2):
        if not row:  # an empty last line
            continue
        try:
            arm, hole, values = row[0].strip(), row[1].strip(), [float(cell) for cell in row[2:]]
        except (ValueError, IndexError) as error:
            raise ConfigError(
                f"{path}, line {number}: {error}", remedy="write arm, hole and six numbers [m]"
            ) from error
        if arm not in ARMS or len(values) != 6 or not np.isfinite(values).all():
            raise ConfigError(
                f"{path}, line {number}: arm {arm!r} with {len(values)} numbers",
                remedy="write left or right, a hole, and six finite numbers [m]",
            )
        found.setdefault(arm, []).append((hole, values))
    return {
        arm: Holes(
            names=tuple(hole for hole, _ in lines),
            robot=np.array([values[:3] for _, values in lines]),
            sensor=np.array([values[3:] for _, values in lines]),
        )
        for arm, lines in found.items()
    }


def write_registrations(path: Path, found: Mapping[str, Registration]) -> Path:
    """Write registrations by arm; the file appears whole or not at all.

    Raises:
        ConfigError: There is none, or the disk refuses.
    """
    if not found:
        raise ConfigError(f"{path}: no arm is registered", remedy="measure holes of at least one")
    content = _File(
        schema="palpate.testbed.registration",
        version=1,
        frame="sensor",
        units="m; quaternions w x y z",
        arms={
            "left" if arm == "left" else "right": _Arm(
                sensor_robot=_pose(item.sensor_robot),
                holes=item.holes,
                residual_m=tuple(item.residual_m.tolist()),
                triples=item.triples,
            )
            for arm, item in found.items()
        },
    )
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(content.model_dump_json(by_alias=True, indent=1) + "\n", encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        raise ConfigError(
            f"cannot write {path}: {error}", remedy="check the folder's rights and free space"
        ) from error
    return path


def read_registrations(path: Path) -> dict[str, Registration]:
    """Registrations by arm.

    Raises:
        ConfigError: It cannot be read, is of another schema, or holds something else than it must;
            names file and key.
    """
    try:
        content = _File.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error}", remedy="check the path") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the file"
        raise ConfigError(
            f"{path}: {key}: {first['msg']}", remedy="make it with: palpate data register"
        ) from error
    return {
        arm: Registration(
            sensor_robot=Transform.from_pose(item.sensor_robot, f"{path}: {arm}.sensor_robot"),
            holes=item.holes,
            residual_m=np.array(item.residual_m),
            triples=item.triples,
        )
        for arm, item in content.arms.items()
    }


def _pose(transform: Transform) -> _Pose:
    x, y, z, qw, qx, qy, qz = map(float, transform.pose)
    return x, y, z, qw, qx, qy, qz
