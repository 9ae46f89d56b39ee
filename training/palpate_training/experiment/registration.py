"""Where the robot stands: the paper's mechanical registration from holes of a plate.

Paper, "Mechanical registration procedure": an alignment pin is led into holes of the plate that
carries the finger; each hole's centre is then known in the robot's frame R, by forward kinematics,
and in the sensor frame B, by the drawing. Three holes span an intermediate frame I in R and in B
(Marvel: vectors, then sequences of cross products), and B_R H = B_I H (R_I H)^-1. This is done for
every three of the holes and the transforms are averaged: translations by their mean, rotations by
``scipy.spatial.transform.Rotation.mean``, the rotation whose summed squared (chordal) distance to
all is least; the paper names no formula for that average.

Registrations on disk: measured holes as a CSV file in, registrations of the arms as JSON out.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from palpate.errors import ConfigError
from palpate.files.atomic import written_whole
from palpate.process import require
from palpate.rigid import Floats, Transform
from palpate_training.datasets.container import csv_rows
from palpate_training.experiment.plan import ARMS
from palpate_training.experiment.trajectory_file import StrictModel

CONGRUENCE_M = 2.0e-3
"""How much the distance of two holes may differ between robot and drawing [m]: twice the worst
clearance of the paper (0.3 mm) and about 1 mm of error of an uncalibrated arm across the plate."""

COLLINEAR = 0.1
"""Height of a triangle of holes over its longest side below which it spans no frame: the error of
a pin turns the frame by ten times as much as with a good triangle."""

HOLES_MAX = 7
"""Every order of the holes is tried for confusion; 7 holes have 5,040."""


@dataclass(frozen=True, slots=True)
class ArmRegistration:
    """Result of a registration.

    Attributes:
        sensor_robot: Pose of the robot frame in the sensor frame; maps robot to sensor coordinates.
        holes: Names of the holes.
        residual_m: Distance of each hole, as mapped, from its place by the drawing [m], shape (N,).
        triples: How many three-hole transforms were averaged.
    """

    sensor_robot: Transform
    holes: tuple[str, ...]
    residual_m: Floats
    triples: int


def register(
    holes_robot: npt.ArrayLike,
    holes_sensor: npt.ArrayLike,
    *,
    names: Sequence[str] | None = None,
    tolerance_m: float = CONGRUENCE_M,
    allow_symmetric: bool = False,
) -> ArmRegistration:
    """Register a robot by the holes that its pin was led into.

    Args:
        holes_robot: Pin in each hole by forward kinematics [m], shape (N, 3), robot frame.
        holes_sensor: The same holes by the drawing [m], shape (N, 3), sensor frame.
        names: Of the holes, for messages; ``hole 1``... where None.
        tolerance_m: How much distances between holes may differ between the two sets [m]; infinite
            = whatever they do, for studies of error.
        allow_symmetric: Accept a plate on which holes can be confused unseen, such as a square.

    Raises:
        ConfigError: Fewer than 3 holes, other shapes, NaN, three holes on a line, sets that are
            not congruent (the hole or pair is named), or a plate whose holes can be confused.
        MissingExtraError: SciPy is not installed.
    """
    in_robot = _points(holes_robot, "holes_robot")
    in_sensor = _points(holes_sensor, "holes_sensor")
    if in_robot.shape != in_sensor.shape:
        raise ConfigError(
            f"{len(in_robot)} holes by the robot, {len(in_sensor)} by the drawing",
            remedy="give the same holes in the same order in both frames",
        )
    labels = _labels(names, len(in_robot))
    triples = list(itertools.combinations(range(len(in_robot)), 3))
    for triple in triples:
        _check_triangle(in_sensor, triple, labels, "by the drawing")
    _check_congruent(in_robot, in_sensor, labels, tolerance_m)
    if not allow_symmetric and np.isfinite(tolerance_m):
        _check_order_shows(in_sensor, labels, tolerance_m)
    for triple in triples:
        _check_triangle(in_robot, triple, labels, "by the robot")

    found = [
        frame_of(in_sensor[list(triple)]) @ frame_of(in_robot[list(triple)]).inverse()
        for triple in triples
    ]
    mean = average(found)
    residual = np.linalg.norm(mean.apply(in_robot) - in_sensor, axis=1)
    worst = int(residual.argmax())
    if residual[worst] > tolerance_m:  # distances agree: mirrored, or an axis turned round
        raise ConfigError(
            f"{labels[worst]} lies {residual[worst] * 1e3:.2f} mm off although distances agree:"
            " one set of holes is the mirror image of the other",
            remedy="check the signs of the axes in the drawing's coordinates",
        )
    return ArmRegistration(mean, labels, residual, len(triples))


def frame_of(holes: Floats) -> Transform:
    """Frame of three holes after Marvel: pose of I in the frame of the points.

    Origin in the first hole, x towards the second, z along the cross product of the vectors to the
    second and third, y = z cross x.

    Args:
        holes: Not on a line [m], shape (3, 3).
    """
    first, second = holes[1] - holes[0], holes[2] - holes[0]
    x = first / np.linalg.norm(first)
    z = np.cross(first, second)
    z = z / np.linalg.norm(z)
    return Transform(np.stack([x, np.cross(z, x), z], axis=1), holes[0].copy())


def average(transforms: Sequence[Transform]) -> Transform:
    """Mean translation and mean rotation (chordal, of SciPy); see the module.

    The two are averaged apart, as in the paper. For rotations that differ by an angle t and an
    origin a metre away, this bends the result by about t^2 metres: 0.02 mm for 5 mrad.
    """
    rotation = require("scipy.spatial.transform", extra="training").Rotation
    matrices = np.stack([item.rotation for item in transforms])
    return Transform(
        np.asarray(rotation.from_matrix(matrices).mean().as_matrix(), np.float64),
        np.mean([item.translation for item in transforms], axis=0),
    )


def _points(values: npt.ArrayLike, what: str) -> Floats:
    points = np.asarray(values, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ConfigError(f"{what} has shape {points.shape}", remedy="give shape (N, 3), metres")
    if not 3 <= len(points) <= HOLES_MAX:
        raise ConfigError(
            f"{what}: {len(points)} holes",
            remedy=f"use 3 to {HOLES_MAX} holes; the paper uses 4",
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise ConfigError(
            f"{what}: hole {bad[0] + 1} is {points[bad[0]].tolist()}",
            remedy="lead the pin into that hole again",
        )
    return points


def _labels(names: Sequence[str] | None, count: int) -> tuple[str, ...]:
    labels = tuple(f"hole {i + 1}" for i in range(count)) if names is None else tuple(names)
    if len(labels) != count or len(set(labels)) != count:
        raise ConfigError(
            f"names {list(labels)} for {count} holes", remedy="give each hole a name of its own"
        )
    return labels


def _check_triangle(
    points: Floats, triple: tuple[int, int, int], labels: tuple[str, ...], where: str
) -> None:
    corners = points[list(triple)]
    longest = max(float(np.linalg.norm(corners[i] - corners[i - 1])) for i in range(3))
    area = float(np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))
    if longest == 0.0 or area < COLLINEAR * longest**2:
        raise ConfigError(
            f"{', '.join(labels[i] for i in triple)} lie on a line {where}",
            remedy="choose holes of which no three are on a line",
        )


def _distances(points: Floats) -> Floats:
    return np.asarray(np.linalg.norm(points[:, None] - points[None], axis=-1))


def _check_congruent(
    in_robot: Floats, in_sensor: Floats, labels: tuple[str, ...], tolerance_m: float
) -> None:
    by_robot, by_drawing = _distances(in_robot), _distances(in_sensor)
    off = np.abs(by_robot - by_drawing)
    if off.max() <= tolerance_m:
        return
    i, j = (int(index) for index in np.unravel_index(off.argmax(), off.shape))
    problem = (
        f"{labels[i]} and {labels[j]} are {by_robot[i, j] * 1e3:.2f} mm apart by the robot,"
        f" {by_drawing[i, j] * 1e3:.2f} mm by the drawing"
    )
    for first, second in itertools.combinations(range(len(labels)), 2):
        order = list(range(len(labels)))
        order[first], order[second] = second, first
        if np.abs(by_robot[np.ix_(order, order)] - by_drawing).max() <= tolerance_m:
            raise ConfigError(
                f"{problem}; {labels[first]} and {labels[second]} seem to be swapped",
                remedy=f"exchange {labels[first]} and {labels[second]}, or lead the pin in again",
            )
    raise ConfigError(problem, remedy="lead the pin into these two again; check the units (metres)")


def _check_order_shows(in_sensor: Floats, labels: tuple[str, ...], tolerance_m: float) -> None:
    """Refuse a plate on which another order of the holes fits within the tolerance."""
    distance = _distances(in_sensor)
    identity = tuple(range(len(labels)))
    orders = np.array([p for p in itertools.permutations(identity) if p != identity])
    off = np.abs(distance[orders[:, :, None], orders[:, None, :]] - distance).max(axis=(1, 2))
    least = int(off.argmin())
    if off[least] <= tolerance_m:
        taken = ", ".join(labels[i] for i in orders[least])
        raise ConfigError(
            f"taking {', '.join(labels)} as {taken} changes no distance by more than"
            f" {off[least] * 1e3:.2f} mm: confused holes would go unseen",
            remedy="space the holes unevenly, or pass allow_symmetric=True and check by hand",
        )


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
class MeasuredHoles:
    """Holes that one arm led its pin into.

    Attributes:
        names: Of the holes.
        robot: By forward kinematics [m], shape (N, 3), robot frame.
        sensor: By the drawing [m], shape (N, 3), sensor frame.
    """

    names: tuple[str, ...]
    robot: Floats
    sensor: Floats


class _RegisteredArm(StrictModel):
    sensor_robot: _Pose
    holes: tuple[str, ...]
    residual_m: tuple[float, ...]
    triples: int


class _RegistrationFile(StrictModel):
    schema_name: Literal["palpate.testbed.registration"] = Field(alias="schema")
    version: Literal[1]
    frame: Literal["sensor"]
    units: Literal["m; quaternions w x y z"]
    arms: dict[_Side, _RegisteredArm]


def read_holes(path: Path) -> dict[str, MeasuredHoles]:
    """Measured holes of each arm, from a CSV file with the header ``COLUMNS``.

    Raises:
        ConfigError: It cannot be read, has other columns, or a line that is not an arm, a hole and
            six finite numbers; names the line.
    """
    rows = csv_rows(path, ConfigError)
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
        arm: MeasuredHoles(
            names=tuple(hole for hole, _ in lines),
            robot=np.array([values[:3] for _, values in lines]),
            sensor=np.array([values[3:] for _, values in lines]),
        )
        for arm, lines in found.items()
    }


def write_registrations(path: Path, found: Mapping[str, ArmRegistration]) -> Path:
    """Write registrations by arm; the file appears whole or not at all.

    Raises:
        ConfigError: There is none.
        DatasetError: The disk refuses.
    """
    if not found:
        raise ConfigError(f"{path}: no arm is registered", remedy="measure holes of at least one")
    content = _RegistrationFile(
        schema="palpate.testbed.registration",
        version=1,
        frame="sensor",
        units="m; quaternions w x y z",
        arms={
            "left" if arm == "left" else "right": _RegisteredArm(
                sensor_robot=_pose(item.sensor_robot),
                holes=item.holes,
                residual_m=tuple(item.residual_m.tolist()),
                triples=item.triples,
            )
            for arm, item in found.items()
        },
    )
    with written_whole(path) as part:
        part.write_text(content.model_dump_json(by_alias=True, indent=1) + "\n", encoding="utf-8")
    return path


def read_registrations(path: Path) -> dict[str, ArmRegistration]:
    """Registrations by arm.

    Raises:
        ConfigError: It cannot be read, is of another schema, or holds something else than it must;
            names file and key.
    """
    try:
        content = _RegistrationFile.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error}", remedy="check the path") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the file"
        raise ConfigError(
            f"{path}: {key}: {first['msg']}", remedy="make it with: palpate data register"
        ) from error
    return {
        arm: ArmRegistration(
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
