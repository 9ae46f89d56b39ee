"""A stand-in for the robot: an open seven-axis arm of our own dimensions, as a URDF.

Of the size of a small two-armed assembly robot: 0.5 m from shoulder to wrist. It is no copy of a
product; anybody with a robot gives its URDF instead. Axes: shoulder yaw, pitch, roll; elbow pitch;
wrist roll, pitch; flange roll, with offsets at shoulder, elbow and wrist so that no two share a
point and the tip depends on all of them. The left arm is the mirror image of the right one.

Two of them stand on the bench on either side of the finger, which lies with its pad up, its tip
towards them and its origin 150 mm above the bench; the plate with the holes is below it
(`palpate_training.experiment.clearance`).
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate.errors import ConfigError
from palpate.files.atomic import written_whole
from palpate.rigid import Transform
from palpate_training.experiment.kinematics import ArmKinematics

SIDES = ("left", "right")
FLANGE = "flange"
"""Frame that carries pin or indenter, z along the tool."""

TOOL_LENGTH_M = 0.06
"""From flange to the tip of pin and indenters [m]; ours."""


@dataclass(frozen=True, slots=True)
class _ArmJoint:
    """Place in the link before [m], axis, limits [rad]; of the right arm."""

    origin: tuple[float, float, float]
    axis: tuple[int, int, int]
    limits: tuple[float, float]


_JOINTS = (
    _ArmJoint((0.0, 0.0, 0.16), (0, 0, 1), (-2.9, 2.9)),
    _ArmJoint((0.03, 0.0, 0.09), (0, 1, 0), (-1.9, 2.3)),
    _ArmJoint((-0.03, 0.0, 0.11), (0, 0, 1), (-2.9, 2.9)),
    _ArmJoint((0.04, 0.0, 0.14), (0, 1, 0), (-0.3, 2.6)),
    _ArmJoint((-0.04, 0.0, 0.12), (0, 0, 1), (-2.9, 2.9)),
    _ArmJoint((0.025, 0.0, 0.13), (0, 1, 0), (-2.2, 2.2)),
    _ArmJoint((0.025, 0.0, 0.05), (0, 0, 1), (-3.1, 3.1)),
)
_FLANGE_M = 0.03  # from the last joint to the flange

HOME = np.array([0.0, 0.45, 0.0, 1.45, 0.0, 1.25, 0.0])
"""Posture over the finger that inverse kinematics starts from [rad], of both arms."""


def arm_urdf(side: str) -> str:
    """URDF of the ``left`` or ``right`` arm.

    Raises:
        ConfigError: Another side.
    """
    mirror = -1.0 if _checked_side(side) == "left" else 1.0
    lines = ['<?xml version="1.0"?>', f'<robot name="palpate_stand_in_{side}">', _link("base")]
    parent = "base"
    for number, joint in enumerate(_JOINTS, 1):
        # Mirrored in the plane y = 0: turns about x and z change sign, about y not.
        axis = (mirror * joint.axis[0], float(joint.axis[1]), mirror * joint.axis[2])
        child = f"link{number}"
        lines += [
            _link(child),
            f'<joint name="{side}_joint{number}" type="revolute">',
            f'  <parent link="{parent}"/><child link="{child}"/>',
            _origin(joint.origin),
            f'  <axis xyz="{axis[0]:g} {axis[1]:g} {axis[2]:g}"/>',
            f'  <limit lower="{joint.limits[0]}" upper="{joint.limits[1]}" effort="50"'
            ' velocity="3"/>',
            "</joint>",
        ]
        parent = child
    lines += [
        _link(FLANGE),
        f'<joint name="{side}_{FLANGE}" type="fixed">',
        f'  <parent link="{parent}"/><child link="{FLANGE}"/>',
        _origin((0.0, 0.0, _FLANGE_M)),
        "</joint>",
        "</robot>",
    ]
    return "\n".join(lines) + "\n"


def write_arm_urdf(side: str, path: Path) -> Path:
    """Write the URDF of an arm; whole or not at all.

    Raises:
        ConfigError: Another side.
        DatasetError: The disk refused.
    """
    with written_whole(path) as partial:
        partial.write_text(arm_urdf(side), encoding="utf-8")
    return path


def stand_in_arm(side: str) -> ArmKinematics:
    """The open stand-in arm of a side, with its tool."""
    with tempfile.TemporaryDirectory() as folder:
        urdf = write_arm_urdf(side, Path(folder) / f"{side}.urdf")
        return ArmKinematics.from_urdf(urdf, FLANGE, tool())


def tool() -> Transform:
    """Pose of the tip of pin or indenter in the flange."""
    return Transform(np.eye(3), np.array([0.0, 0.0, TOOL_LENGTH_M]))


def sensor_robot(side: str) -> Transform:
    """Where an arm stands: pose of its base in the sensor frame, which registration finds.

    Raises:
        ConfigError: Another side.
    """
    lateral = 0.20 if _checked_side(side) == "left" else -0.20
    # Bench to sensor frame: pad up, so z (dorsal) is down; y (lateral) is the robot's left and the
    # fingertip looks at the robot. A half turn about y.
    half_turn = np.diag([-1.0, 1.0, -1.0])
    finger_on_bench = np.array([0.30, -lateral, 0.15])
    return Transform(half_turn, -half_turn @ finger_on_bench)


def _checked_side(side: str) -> str:
    if side not in SIDES:
        raise ConfigError(f"arm {side!r} is unknown", remedy="use left or right")
    return side


def _link(name: str) -> str:
    return f'<link name="{name}"/>'


def _origin(xyz: tuple[float, float, float]) -> str:
    x, y, z = xyz
    return f'  <origin xyz="{x:.15g} {y:.15g} {z:.15g}" rpy="0 -0 0"/>'
