"""The plan of the experiment: where the tip is commanded to be, when, and by which arm.

Paper, "Experimental testing procedure": each trajectory begins 3 mm away from the skin and ends
3 mm (normal) or 1.5 mm (angled) past first contact, in increments of 0.1 mm with 5 s for each;
points on the side of an arm are that arm's; trajectories whose joint commands miss the tip by more
than 0.01 mm are eliminated. Collisions with the mount are not looked for here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError
from palpate.rigid import Floats, Transform
from palpate_training.experiment.kinematics import ACCURACY_M, ANGLE_ACCURACY_RAD, ArmKinematics

APPROACH_M = 3.0e-3
"""Travel from the start to first contact as planned [m]; paper."""

INCREMENT_M = 1.0e-4
"""Travel of one increment [m]; paper."""

DWELL_S = 5.0
"""Time of one increment, its move included [s]; paper."""

MOVE_S = 0.2
"""Time in which the tip moves at the start of an increment [s]; ours, 0.5 mm/s."""

TRANSIT_S = 10.0
"""Time from the end of a trajectory to the start of the next [s]; ours."""

ARMS = ("left", "right")


@dataclass(frozen=True, slots=True)
class PlannedTrajectory:
    """One planned trajectory, sensor frame.

    Attributes:
        trajectory: Id, ``<indenter>/<point>/<normal|angled-k>``.
        indenter: Name of the indenter.
        arm: ``left`` or ``right``.
        target: Point of the skin that it aims at [m], shape (3,).
        direction: Where the tip moves, unit, shape (3,).
        contact_m: Travel of the tip beyond the target at first contact [m]; mostly negative.
        depth_m: Planned travel from first contact to the end [m].
    """

    trajectory: str
    indenter: str
    arm: str
    target: Floats
    direction: Floats
    contact_m: float
    depth_m: float

    def __post_init__(self) -> None:
        if self.arm not in ARMS:
            raise ConfigError(
                f"trajectory {self.trajectory!r}: arm {self.arm!r}", remedy="use left or right"
            )
        if not (np.shape(self.target) == (3,) and np.isfinite(self.target).all()):
            raise ConfigError(
                f"trajectory {self.trajectory!r}: target {self.target!r} is not a point",
                remedy="give three finite numbers [m]",
            )
        direction = unit(self.direction, f"trajectory {self.trajectory!r}: direction")
        # as it is where it is a unit vector, so that a file read back holds the same bits
        if abs(float(np.linalg.norm(self.direction)) - 1.0) > 1e-12:
            object.__setattr__(self, "direction", direction)
        if not (np.isfinite(self.contact_m) and 0.0 < self.depth_m < 0.02):
            raise ConfigError(
                f"trajectory {self.trajectory!r}: contact_m {self.contact_m}, depth_m"
                f" {self.depth_m}",
                remedy="give metres: a finite contact, and a depth above 0 and below 20 mm",
            )

    @property
    def travel_m(self) -> Floats:
        """Commanded travel at the start and at the end of each increment [m], shape (I + 1,)."""
        return increments_of(APPROACH_M + self.depth_m)

    @property
    def duration_s(self) -> float:
        """From the start to the end of the last increment [s]."""
        return DWELL_S * (len(self.travel_m) - 1)

    @property
    def poses(self) -> Floats:
        """Commanded poses of the tip, one for each of ``travel_m``, shape (I + 1, 7)."""
        along = self.contact_m - APPROACH_M + self.travel_m
        positions = self.target + along[:, None] * self.direction
        return np.hstack([positions, np.tile(facing(self.direction), (len(positions), 1))])


@dataclass(frozen=True, slots=True)
class PlannedManipulation:
    """A planned path of the twin that is no straight press: it slides, turns or goes back.

    Its poses are in the simulation. A real robot does not execute it yet.

    Attributes:
        trajectory: Id, ``<indenter>/<point>/path-<k>``.
        indenter: Name of the indenter.
        arm: ``left`` or ``right``.
        direction: Where the tip moves at first, unit, shape (3,).
    """

    trajectory: str
    indenter: str
    arm: str
    direction: Floats


def increments_of(length_m: float) -> Floats:
    """Travel at the start and after each whole increment within a length [m], shape (I + 1,).

    Raises:
        ConfigError: Less than one increment.
    """
    count = int(np.floor(length_m / INCREMENT_M + 1e-6)) if np.isfinite(length_m) else 0
    if count < 1:
        raise ConfigError(
            f"a path of {length_m} m has no increment", remedy="give at least 0.1 mm, in metres"
        )
    return np.asarray(INCREMENT_M * np.arange(count + 1), np.float64)


def commanded_travel(time_s: Floats, travel_m: Floats) -> Floats:
    """Travel that is commanded at times since the start of a trajectory [m], shape (T,).

    Within ``MOVE_S`` from the start of an increment the tip moves, smoothly (zero speed at both
    ends), then it dwells.

    Args:
        time_s: Since the start [s], shape (T,).
        travel_m: At the start and after each increment [m], shape (I + 1,).
    """
    increment = np.clip((time_s // DWELL_S).astype(np.int64), 0, len(travel_m) - 2)
    part = np.clip((time_s - increment * DWELL_S) / MOVE_S, 0.0, 1.0)
    smooth = part * part * (3.0 - 2.0 * part)
    before, after = travel_m[increment], travel_m[increment + 1]
    return np.asarray(before + smooth * (after - before))


def assign_arm(target: npt.ArrayLike) -> str:
    """The arm on whose side of the finger's long axis a point lies: left for y >= 0."""
    return "left" if float(np.asarray(target)[1]) >= 0.0 else "right"


@dataclass(frozen=True, slots=True)
class ArmBase:
    """An arm as it stands.

    Attributes:
        sensor_robot: Pose of its frame in the sensor frame, by registration.
        arm: Its kinematics; None = plan poses only, the robot's controller finds the joints.
        home: Posture that inverse kinematics starts from [rad or m], shape (n,).
    """

    sensor_robot: Transform
    arm: ArmKinematics | None = None
    home: Floats | None = None


@dataclass(frozen=True, slots=True)
class ArmMotion:
    """A trajectory as a robot executes it.

    Attributes:
        trajectory: What is meant.
        start_s: When it starts, since the start of the whole plan [s]; at ``start_s`` the tip
            stands at the first pose.
        poses_robot: Of the tip, robot frame of the trajectory's arm, shape (I + 1, 7).
        joints: That bring it there [rad or m], shape (I + 1, n), or None.
    """

    trajectory: PlannedTrajectory
    start_s: float
    poses_robot: Floats
    joints: Floats | None

    @property
    def time_s(self) -> Floats:
        """Start, then the end of each increment, since the start of the plan [s], (I + 1,)."""
        return np.asarray(self.start_s + DWELL_S * np.arange(len(self.poses_robot)), np.float64)


@dataclass(frozen=True, slots=True)
class EliminatedTrajectory:
    """A trajectory that an arm cannot follow.

    Attributes:
        trajectory: Its id.
        reason: What is missed, by how much.
    """

    trajectory: str
    reason: str


@dataclass(frozen=True, slots=True)
class RobotPlan:
    """What a robot executes, in order.

    Attributes:
        motions: All of them.
        bases: By arm; those that execute something.
    """

    motions: tuple[ArmMotion, ...]
    bases: Mapping[str, ArmBase]


def make_plan(
    trajectories: Iterable[PlannedTrajectory], bases: Mapping[str, ArmBase]
) -> tuple[RobotPlan, list[EliminatedTrajectory]]:
    """Turn trajectories into motions of the arms; eliminate what an arm cannot follow.

    Returns:
        The plan, and what was eliminated from it (nothing where no kinematics are given).

    Raises:
        ConfigError: An arm is not registered, or an id comes twice.
    """
    motions: list[ArmMotion] = []
    eliminated: list[EliminatedTrajectory] = []
    seen: set[str] = set()
    start_s = 0.0
    for item in trajectories:
        if item.trajectory in seen:
            raise ConfigError(
                f"trajectory {item.trajectory!r} is planned twice", remedy="give each its own id"
            )
        seen.add(item.trajectory)
        base = bases.get(item.arm)
        if base is None:
            raise ConfigError(
                f"trajectory {item.trajectory!r} needs the {item.arm} arm, which is not registered",
                remedy="register that arm: palpate data register",
            )
        poses = base.sensor_robot.inverse().apply_poses(item.poses)
        joints = None
        if base.arm is not None:
            found = base.arm.solve(poses, start=base.home)
            if not found.reached:
                eliminated.append(
                    EliminatedTrajectory(
                        item.trajectory,
                        f"the {item.arm} arm misses by"
                        f" {found.position_error_m.max() * 1e3:.3g} mm and"
                        f" {found.angle_error_rad.max():.3g} rad; allowed are"
                        f" {ACCURACY_M * 1e3:g} mm and {ANGLE_ACCURACY_RAD:g} rad",
                    )
                )
                continue
            joints = found.joints
        motions.append(ArmMotion(item, start_s, poses, joints))
        start_s += item.duration_s + TRANSIT_S
    used = {motion.trajectory.arm for motion in motions}
    return RobotPlan(tuple(motions), {k: v for k, v in bases.items() if k in used}), eliminated


# `unit` and `facing` of `palpate.rigid` differ from these in the last bit. Stored plans and their
# simulations are reproduced bit for bit, so the formulas of the first plans stay.


def unit(vector: npt.ArrayLike, what: str = "direction") -> Floats:
    """A direction of length 1, shape (3,).

    Raises:
        ConfigError: Not three finite numbers, or all of them zero.
    """
    values = np.asarray(vector, np.float64)
    if values.shape == (3,) and np.isfinite(values).all():
        length = float(np.linalg.norm(values))
        if length > 0.0:
            return values / length
    raise ConfigError(
        f"{what} {vector!r} is not a direction", remedy="give three finite numbers, not all zero"
    )


def facing(direction: npt.ArrayLike) -> Floats:
    """Quaternion w x y z of an indenter that presses along a direction, shape (4,).

    The indenter presses along its own +z; of all turns that bring +z there it is the shortest, so
    that on the pad, which is pressed along about +z of the sensor frame, its x stays along the
    finger. Straight down (-z) it is the half turn about x.
    """
    x, y, z = map(float, unit(direction))
    aside = math.hypot(x, y)
    if z < 0.0 and aside < 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    # cos and sin of half the angle to +z, by the half-angle formula that keeps its digits
    angle = math.atan2(aside, z)
    half_sin, half_cos = math.sin(angle / 2), math.cos(angle / 2)
    if aside == 0.0:
        return np.array([1.0, 0.0, 0.0, 0.0])
    return np.array([half_cos, -half_sin * y / aside, half_sin * x / aside, 0.0])
