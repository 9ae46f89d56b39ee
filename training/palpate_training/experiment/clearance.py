"""How far a registered robot is off at the finger: pins, liners, repeatability and the arm itself.

The paper gives the worst clearance of pin and liner (0.3 mm), the repeatability (0.02 mm) and the
outcome: 0.5 to 1.5 mm "over the full range of robot joint configurations and end-effector positions
traversed during testing". Clearance alone explains a tenth of that; the rest is the arm, whose
links and joints differ from its kinematic model. Such an error
is smooth in the joint angles. Registration removes what pin and indenter have in common and leaves
what differs between the plate, with the pin upright, and the finger, with the indenter turned.

Not from the paper, which leaves it open: the geometry of the plate and the errors of the links.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError
from palpate.rigid import Floats, Transform
from palpate_training.experiment.kinematics import ArmKinematics
from palpate_training.experiment.plan import facing
from palpate_training.experiment.registration import register

PLATE_CENTRE_M = np.array([-0.005, 0.0, 0.055])
"""Centre of the plate's upper face [m], sensor frame: 55 mm below the finger, which lies with its
pad up, under the middle of the sampled region."""

HOLE_CIRCLE_M = 0.076
"""Diameter of the circle of holes [m]; the plate has 90 mm."""

HOLE_ANGLES_DEG = (35.0, 115.0, 215.0, 305.0)
"""Unevenly spaced, so that no two holes can be swapped unseen (see `register`)."""


@dataclass(frozen=True, slots=True)
class RegistrationErrorModel:
    """How far a real arm and plate are from the drawing.

    Attributes:
        clearance_m: Diameter of liner minus diameter of pin, at worst (paper: 0.3 mm) [m]. The pin
            stands anywhere in the liner, evenly over the disc that this leaves its axis.
        shoulder_sd_m: How far the shoulder is from flush, standard deviation [m].
        repeatability_m: Root mean square distance by which an arm misses its own pose [m] (paper:
            0.02 mm).
        link_sd_m: Of the place of each link's far end, per axis, standard deviation [m].
        joint_sd_rad: Of the orientation of each link's far end, per axis; along the axis of the
            joint it is the error of its zero.
    """

    clearance_m: float = 0.3e-3
    shoulder_sd_m: float = 0.02e-3
    repeatability_m: float = 0.02e-3
    link_sd_m: float = 0.2e-3
    joint_sd_rad: float = 1.5e-3

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ConfigError(f"{name} = {value}", remedy="give a finite number, 0 or more")


@dataclass(frozen=True, slots=True)
class RegistrationErrors:
    """Monte Carlo of registrations of one arm.

    Attributes:
        error: Tip by kinematics and registration minus the true tip [m], sensor frame, shape
            (D, P, 3): D registrations, P poses.
        residual_m: Residual at each hole [m], shape (D, H).
    """

    error: Floats
    residual_m: Floats

    @property
    def constant(self) -> Floats:
        """Part of the error that all poses share [m], shape (D, 3): an arm's constant offset."""
        return np.asarray(self.error.mean(axis=1))


def plate_holes() -> Floats:
    """Centres of the four holes by the drawing [m], sensor frame, shape (4, 3)."""
    angle = np.radians(HOLE_ANGLES_DEG)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    return np.asarray(PLATE_CENTRE_M + HOLE_CIRCLE_M / 2 * circle)


def pin_poses(holes: Floats) -> Floats:
    """Poses of an upright pin in holes, sensor frame, shape (H, 7): its z points down, dorsally."""
    return np.hstack([holes, np.tile([1.0, 0.0, 0.0, 0.0], (len(holes), 1))])


def link_sensitivity(arm: ArmKinematics, joints: npt.ArrayLike) -> Floats:
    """How errors of the links move the tip at joints (T, n): shape (T, 3, 6 n), robot frame.

    Error j of n, displacement [m] and rotation vector [rad] of the far end of link j in the frame
    that moves with its joint, moves the tip by ``R_j (d + w x r)`` where ``r`` leads from that
    frame to the tip; to first order, which is exact to 1 um for errors of a milliradian.
    """
    tips, _ = arm.tip(joints)
    origins, rotations = arm.link_frames(joints)
    lever = tips[:, None] - origins
    # R (w x r) = (R w) x (R r), so the columns for w are those of R, crossed with the lever
    turned = np.cross(np.swapaxes(rotations, -1, -2), lever[:, :, None], axis=-1)
    both = np.concatenate([rotations, np.swapaxes(turned, -1, -2)], axis=-1)
    return np.asarray(np.moveaxis(both, 1, 2).reshape(len(tips), 3, -1))


def simulate_registrations(
    arm: ArmKinematics,
    sensor_robot: Transform,
    poses: Floats,
    *,
    model: RegistrationErrorModel | None = None,
    draws: int = 200,
    seed: int = 0,
    start: npt.ArrayLike | None = None,
) -> RegistrationErrors:
    """Register again and again with drawn errors, and see how far the tip is off.

    Each draw is another arm of the same make at the same place, registered by `register` with the
    pin upright in the four holes of `plate_holes`.

    Args:
        arm: By its kinematic model; pin and indenters have the same tip.
        sensor_robot: True pose of the robot frame in the sensor frame.
        poses: Of the tip at which the error is computed, sensor frame, shape (P, 7).
        model: What is off; None = the defaults.
        draws: Number D of registrations.
        seed: Of the draws.
        start: Posture that inverse kinematics starts from, shape (n,).

    Raises:
        ConfigError: The arm does not reach a hole or a pose.
    """
    model = RegistrationErrorModel() if model is None else model
    random = np.random.default_rng(seed)
    holes = plate_holes()
    robot_sensor = sensor_robot.inverse()

    def sensitivity(of: Floats, what: str) -> Floats:
        """In the sensor frame, shape (len(of), 3, 6 n)."""
        joints = [_reach(arm, pose, start, what) for pose in robot_sensor.apply_poses(of)]
        return np.asarray(sensor_robot.rotation @ link_sensitivity(arm, np.array(joints)))

    at_holes = sensitivity(pin_poses(holes), "hole")
    at_poses = sensitivity(poses, "pose")
    count = len(arm.joint_names)
    sd = np.tile(np.repeat([model.link_sd_m, model.joint_sd_rad], 3), count)
    links = random.normal(size=(draws, 6 * count)) * sd

    # The pin is truly at hole + play; the kinematic model lacks the links' errors.
    # What inverse kinematics would change of the joints for that is of second order.
    play = _play(random, model, (draws, len(holes)))
    in_sensor = holes + play - np.einsum("hik,dk->dhi", at_holes, links)
    in_sensor += _missed(random, model, (draws, len(holes)))
    errors = np.empty((draws, len(poses), 3))
    residuals = np.empty((draws, len(holes)))
    modelled = poses[None, :, :3] - np.einsum("pik,dk->dpi", at_poses, links)
    modelled += _missed(random, model, (draws, len(poses)))
    for i in range(draws):
        # a large error is to be measured here, not refused
        found = register(robot_sensor.apply(in_sensor[i]), holes, tolerance_m=math.inf)
        by_registration = found.sensor_robot.apply(robot_sensor.apply(modelled[i]))
        errors[i], residuals[i] = by_registration - poses[:, :3], found.residual_m
    return RegistrationErrors(errors, residuals)


def pad_poses(lateral: float) -> Floats:
    """Poses of an indenter all over one side of the pad, sensor frame, shape (75, 7).

    Five places along the finger from -11 to 1 mm, three round it from the middle to 30 degrees,
    on a cylinder of 8 mm about the finger's axis; at each, along the inward normal and at 30
    degrees to it in four directions, as in the experiment.

    Args:
        lateral: +1 for the side of the left arm, -1 for that of the right one.
    """
    poses = []
    for x in np.linspace(-11e-3, 1e-3, 5):
        for angle in np.radians([0.0, 15.0, 30.0]) * lateral:
            out = np.array([0.0, math.sin(angle), -math.cos(angle)])
            for direction in _press_directions(out):
                poses.append(np.concatenate([[x, 0.0, 0.0] + 8e-3 * out, facing(direction)]))
    return np.array(poses)


def _press_directions(out: Floats) -> list[Floats]:
    """Along the inward normal, and at 30 degrees to it distally, laterally, and back."""
    tilt = math.radians(30.0)
    distal = np.array([1.0, 0.0, 0.0])
    around = np.cross(distal, out)
    aside = (distal, around, -distal, -around)
    return [-out, *(-math.cos(tilt) * out + math.sin(tilt) * way for way in aside)]


def _reach(arm: ArmKinematics, pose: Floats, start: npt.ArrayLike | None, what: str) -> Floats:
    found = arm.solve(pose[None], start=start)
    if not found.reached:
        raise ConfigError(
            f"{arm.name} does not reach {what} {np.round(pose[:3], 4).tolist()} of its own frame",
            remedy="check where the robot stands, its limits and the length of the tool",
        )
    return np.asarray(found.joints[0])


def _play(
    random: np.random.Generator, model: RegistrationErrorModel, shape: tuple[int, int]
) -> Floats:
    """Where the pin stands in its liner [m], shape (*shape, 3): x and y along the plate."""
    radius = model.clearance_m / 2 * np.sqrt(random.uniform(size=shape))
    angle = random.uniform(0.0, 2.0 * np.pi, size=shape)
    lift = random.normal(0.0, model.shoulder_sd_m, size=shape)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), lift], axis=-1)


def _missed(
    random: np.random.Generator, model: RegistrationErrorModel, shape: tuple[int, int]
) -> Floats:
    return random.normal(0.0, model.repeatability_m / math.sqrt(3.0), size=(*shape, 3))
