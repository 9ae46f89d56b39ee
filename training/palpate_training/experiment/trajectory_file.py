"""The trajectory file: what a robot executes, as JSON lines.

Line 1 holds schema, version, frame, units, registrations, names of the joints and the SHA-256 of
all bytes after it. Every other line is a trajectory: what it is, when it starts, and for its start
and the end of each increment the time, the travel, the pose of the tip in sensor and robot frame,
and the joints where kinematics were given. Lengths are in metres, angles in radians, times in
seconds since the start of the plan; a pose is x y z and a unit quaternion w x y z.

The reader checks everything: a changed byte, an unknown key, a missing line, a pose that is not
where target and direction put it, or a time off the schedule is an error.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from palpate.errors import ConfigError, DatasetError
from palpate.files.atomic import written_whole
from palpate.rigid import Floats, Transform
from palpate_training.experiment.plan import (
    DWELL_S,
    INCREMENT_M,
    MOVE_S,
    ArmBase,
    ArmMotion,
    PlannedTrajectory,
    RobotPlan,
)

SCHEMA = "palpate.testbed.trajectories"
VERSION = 1
_SAME = 1e-9  # [m], [rad] and [s]: what is computed again from numbers printed in full

_Pose = tuple[float, float, float, float, float, float, float]
_Point = tuple[float, float, float]


class StrictModel(BaseModel):
    """A part of a JSON file of the testbed: an unknown key or another type is an error."""

    # strict would refuse JSON's lists as tuples; lax floats would take "1.0" for a number
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)


class _TrajectoryFileHeader(StrictModel):
    schema_name: Literal["palpate.testbed.trajectories"] = Field(alias="schema")
    version: int
    frame: Literal["sensor"]
    units: Literal["m, rad, s; quaternions w x y z"]
    increment_m: float
    dwell_s: float
    move_s: float
    sensor_robot: dict[Literal["left", "right"], _Pose]
    joint_names: dict[Literal["left", "right"], tuple[str, ...]]
    trajectories: int
    content_sha256: str


class _TrajectoryIncrement(StrictModel):
    time_s: float
    travel_m: float
    pose_sensor: _Pose
    pose_robot: _Pose
    joints: tuple[float, ...] | None


class _TrajectoryLine(StrictModel):
    trajectory: str
    indenter: str
    arm: Literal["left", "right"]
    target: _Point
    direction: _Point
    contact_m: float
    depth_m: float
    start_s: float
    increments: tuple[_TrajectoryIncrement, ...]


def write_trajectories(plan: RobotPlan, path: Path) -> Path:
    """Write a plan; the file appears whole or not at all.

    Raises:
        ConfigError: The plan is empty.
    """
    if not plan.motions:
        raise ConfigError(f"{path}: the plan is empty", remedy="plan at least one trajectory")
    body = "".join(_line(motion).model_dump_json() + "\n" for motion in plan.motions).encode()
    header = {
        "schema": SCHEMA,
        "version": VERSION,
        "frame": "sensor",
        "units": "m, rad, s; quaternions w x y z",
        "increment_m": INCREMENT_M,
        "dwell_s": DWELL_S,
        "move_s": MOVE_S,
        "sensor_robot": {k: v.sensor_robot.pose.tolist() for k, v in plan.bases.items()},
        "joint_names": {k: v.arm.joint_names for k, v in plan.bases.items() if v.arm},
        "trajectories": len(plan.motions),
        "content_sha256": hashlib.sha256(body).hexdigest(),
    }
    with written_whole(path) as partial:
        partial.write_bytes(json.dumps(header).encode() + b"\n" + body)
    return path


def read_trajectories(path: Path) -> RobotPlan:
    """Read a plan; its bases have no kinematics.

    Raises:
        DatasetError: It cannot be read, is of another schema or version, was changed, or does not
            agree with itself; names the line, trajectory and key.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error}", remedy="check the path") from error
    first, _, body = content.partition(b"\n")
    header = _header(path, first)
    if hashlib.sha256(body).hexdigest() != header.content_sha256:
        raise DatasetError(
            f"{path}: content does not match its hash: it was changed or cut off",
            remedy="copy the file again, or write the plan anew",
        )
    lines = body.decode("utf-8").splitlines()
    if len(lines) != header.trajectories:
        raise DatasetError(
            f"{path}: {len(lines)} trajectories, the header says {header.trajectories}",
            remedy="write the plan anew",
        )
    motions: list[ArmMotion] = []
    seen: set[str] = set()
    end_s = -np.inf
    for number, text in enumerate(lines, 2):
        motion = _motion(f"{path}, line {number}", text, header)
        if motion.trajectory.trajectory in seen:
            raise DatasetError(
                f"{path}, line {number}: {motion.trajectory.trajectory!r} comes twice",
                remedy="write the plan anew, with one id for each trajectory",
            )
        if motion.start_s < end_s:
            raise DatasetError(
                f"{path}, line {number}: starts at {motion.start_s} s, before the one above ends",
                remedy="write the plan anew",
            )
        end_s = float(motion.time_s[-1])
        seen.add(motion.trajectory.trajectory)
        motions.append(motion)
    bases: dict[str, ArmBase] = {
        arm: ArmBase(_transform(pose, f"{path}: sensor_robot.{arm}"))
        for arm, pose in header.sensor_robot.items()
    }
    return RobotPlan(tuple(motions), bases)


def _header(path: Path, text: bytes) -> _TrajectoryFileHeader:
    try:
        raw = json.loads(text)
    except ValueError as error:
        raise DatasetError(
            f"{path}: line 1 is not JSON", remedy="give a trajectory file of palpate"
        ) from error
    if not isinstance(raw, dict) or raw.get("schema") != SCHEMA:
        raise DatasetError(
            f"{path}: schema is not {SCHEMA!r}", remedy="give a trajectory file of palpate"
        )
    if raw.get("version") != VERSION:
        raise DatasetError(
            f"{path}: version {raw.get('version')!r}, this palpate reads {VERSION}",
            remedy="upgrade palpate, or write the plan anew",
        )
    try:
        header = _TrajectoryFileHeader.model_validate_json(text)
    except ValidationError as error:
        raise _invalid(f"{path}, line 1", error) from error
    for key, wanted in (("increment_m", INCREMENT_M), ("dwell_s", DWELL_S), ("move_s", MOVE_S)):
        if getattr(header, key) != wanted:
            raise DatasetError(
                f"{path}: {key} is {getattr(header, key)}, not {wanted}",
                remedy="write the plan with this palpate",
            )
    return header


def _motion(where: str, text: str, header: _TrajectoryFileHeader) -> ArmMotion:
    try:
        line = _TrajectoryLine.model_validate_json(text)
        item = PlannedTrajectory(
            trajectory=line.trajectory,
            indenter=line.indenter,
            arm=line.arm,
            target=np.array(line.target),
            direction=np.array(line.direction),
            contact_m=line.contact_m,
            depth_m=line.depth_m,
        )
    except ValidationError as error:
        raise _invalid(where, error) from error
    except ConfigError as error:
        raise DatasetError(f"{where}: {error.problem}", remedy=error.remedy) from error
    if line.arm not in header.sensor_robot:
        raise DatasetError(
            f"{where}: no registration of the {line.arm} arm in line 1",
            remedy="write the plan anew, with both arms registered",
        )
    sensor_robot = _transform(header.sensor_robot[line.arm], f"{where}: sensor_robot.{line.arm}")
    rows = line.increments
    poses_robot = sensor_robot.inverse().apply_poses(item.poses)
    motion = ArmMotion(item, line.start_s, poses_robot, _joints(where, line, header))
    for key, wanted in (
        ("time_s", motion.time_s),
        ("travel_m", item.travel_m),
        ("pose_sensor", item.poses),
        ("pose_robot", poses_robot),
    ):
        given = np.array([getattr(row, key) for row in rows])
        if given.shape != wanted.shape or not _same(given, wanted):
            raise DatasetError(
                f"{where}: {key} of {item.trajectory!r} does not follow from its target, direction,"
                " start and registration",
                remedy="change the plan and write it anew, never the file",
            )
    return motion


def _same(given: Floats, wanted: Floats) -> bool:
    if given.ndim == 2:  # a quaternion and its negative are the same turn
        flip = np.sign(np.sum(given[:, 3:] * wanted[:, 3:], axis=1, keepdims=True))
        given = np.hstack([given[:, :3], given[:, 3:] * flip])
    return bool(np.abs(given - wanted).max() <= _SAME)


def _joints(where: str, line: _TrajectoryLine, header: _TrajectoryFileHeader) -> Floats | None:
    names = header.joint_names.get(line.arm)
    if names is None:
        if all(row.joints is None for row in line.increments):
            return None
    elif all(row.joints is not None and len(row.joints) == len(names) for row in line.increments):
        return np.array([row.joints for row in line.increments])
    raise DatasetError(
        f"{where}: joints of {line.trajectory!r} are not those that line 1 names",
        remedy="write the plan anew",
    )


def _line(motion: ArmMotion) -> _TrajectoryLine:
    item = motion.trajectory
    joints = [None] * len(motion.poses_robot) if motion.joints is None else motion.joints.tolist()
    return _TrajectoryLine(
        trajectory=item.trajectory,
        indenter=item.indenter,
        arm="left" if item.arm == "left" else "right",
        target=_point(item.target),
        direction=_point(item.direction),
        contact_m=float(item.contact_m),
        depth_m=float(item.depth_m),
        start_s=motion.start_s,
        increments=tuple(
            _TrajectoryIncrement(
                time_s=time_s,
                travel_m=travel_m,
                pose_sensor=tuple(pose_sensor),
                pose_robot=tuple(pose_robot),
                joints=None if row is None else tuple(row),
            )
            for time_s, travel_m, pose_sensor, pose_robot, row in zip(
                motion.time_s.tolist(),
                item.travel_m.tolist(),
                item.poses.tolist(),
                motion.poses_robot.tolist(),
                joints,
                strict=True,
            )
        ),
    )


def _point(vector: Floats) -> _Point:
    x, y, z = map(float, vector)
    return x, y, z


def _transform(pose: _Pose, what: str) -> Transform:
    try:
        return Transform.from_pose(pose, what)
    except ConfigError as error:
        raise DatasetError(error.problem, remedy=error.remedy) from error


def _invalid(where: str, error: ValidationError) -> DatasetError:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"]) or "the line"
    return DatasetError(
        f"{where}: {key}: {first['msg']}", remedy="write the plan anew with this palpate"
    )
