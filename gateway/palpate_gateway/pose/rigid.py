"""Rigid transforms as seven numbers: position [m] and unit quaternion w x y z.

Plain Python, for it is done for one pose at a time, up to a thousand times a second: there NumPy
takes longer.
"""

from __future__ import annotations

import math

from palpate.messages import Pose

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

UNIT_TOLERANCE = 1e-3
"""How far from 1 the length of a quaternion may be: it was printed with few digits."""


def length_of(quaternion: Quaternion) -> float:
    """Its length; 1 is a rotation."""
    return math.sqrt(sum(part * part for part in quaternion))


def is_unit(quaternion: Quaternion) -> bool:
    """Whether it is a rotation but for rounding; False for NaN."""
    return abs(length_of(quaternion) - 1.0) <= UNIT_TOLERANCE


def normalised(pose: Pose) -> Pose:
    """The pose with a quaternion of length 1 to the last digit."""
    length = length_of(pose.orientation)
    w, x, y, z = pose.orientation
    return Pose(pose.position, (w / length, x / length, y / length, z / length))


def compose(a: Pose, b: Pose) -> Pose:
    """``pose_x_z`` from ``pose_x_y`` and ``pose_y_z``."""
    x, y, z = _turned(a.orientation, b.position)
    ax, ay, az = a.position
    return Pose((ax + x, ay + y, az + z), _product(a.orientation, b.orientation))


def inverse(pose: Pose) -> Pose:
    """``pose_y_x`` from ``pose_x_y``."""
    w, x, y, z = pose.orientation
    back = (w, -x, -y, -z)
    px, py, pz = _turned(back, pose.position)
    return Pose((-px, -py, -pz), back)


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _turned(q: Quaternion, v: Vector) -> Vector:
    """``v`` turned by the unit quaternion ``q``: v + 2 w (u x v) + 2 u x (u x v)."""
    w, ux, uy, uz = q
    vx, vy, vz = v
    tx = 2.0 * (uy * vz - uz * vy)
    ty = 2.0 * (uz * vx - ux * vz)
    tz = 2.0 * (ux * vy - uy * vx)
    return (
        vx + w * tx + uy * tz - uz * ty,
        vy + w * ty + uz * tx - ux * tz,
        vz + w * tz + ux * ty - uy * tx,
    )
