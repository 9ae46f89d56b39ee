"""Rigid-body geometry: quaternions, rotation matrices, poses and transforms.

A quaternion is w x y z, of length 1. A pose is a position [m] and a quaternion: either an array of
seven numbers, or a ``Pose`` message for code that handles one pose up to a thousand times a second,
where plain Python is faster than NumPy. ``pose_x_y`` is the pose of frame y in frame x, and maps
coordinates of y to coordinates of x.

SciPy's ``Rotation`` does much of this, but a robot's client must not need SciPy. The formulas here
reach stored data: a change of the order of operations changes the last bit of stored numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.errors import ConfigError
from palpate.messages import Pose

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

UNIT_TOLERANCE = 1e-3
"""How far from 1 the length of a quaternion of a log may be: it was printed with few digits."""

LEVER_M = 3.5e-3
"""`path_lengths` counts a turn as the arc of a point this far away: the radius of the 7 mm
indenters [m]."""

_ORTHONORMAL = 1e-6  # a pose printed with seven digits passes, a scaled or mirrored one does not
_STRAIGHT = 1.0 - 1e-12
"""Quaternions with a larger product are so near each other that the chord is the arc."""


def unit(vector: ArrayLike, what: str = "direction") -> Floats:
    """A direction of length 1, shape (3,).

    Raises:
        ConfigError: It is not three finite numbers, or its length is 0; names ``what``.
    """
    direction = np.asarray(vector, np.float64)
    if direction.shape == (3,) and np.isfinite(direction).all():
        # The largest component becomes 1 first, else squares of tiny or huge ones are 0 or inf.
        largest = np.abs(direction).max()
        if largest > 0.0:
            direction = direction / largest
            return np.asarray(direction / np.linalg.norm(direction))
    raise ConfigError(
        f"{what} {vector!r} is not a direction", remedy="give three finite numbers, not all zero"
    )


def rotation_matrices(quaternions: Floats) -> Floats:
    """Rotation matrices of unit quaternions, shape (..., 3, 3) from (..., 4)."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions_of(rotations: Floats) -> Floats:
    """Unit quaternions with w >= 0, shape (..., 4), of rotation matrices (..., 3, 3).

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix
    (Bar-Itzhack 2000): one formula for every angle, half turns included.
    """
    r = rotations
    k = np.empty((*r.shape[:-2], 4, 4))
    k[..., 0, 0] = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    for i in range(3):
        for j in range(3):
            k[..., i + 1, j + 1] = r[..., i, j] + r[..., j, i]
        k[..., i + 1, i + 1] -= k[..., 0, 0]
        a, b = (i + 1) % 3, (i + 2) % 3
        k[..., 0, i + 1] = k[..., i + 1, 0] = r[..., b, a] - r[..., a, b]
    largest = np.linalg.eigh(k)[1][..., :, -1]
    return np.asarray(np.where(largest[..., :1] < 0.0, -largest, largest))


def facing(direction: ArrayLike) -> Floats:
    """Quaternion of an indenter that presses along a direction (3,) of any length, shape (4,).

    An indenter presses along its own +z. The quaternion is the shortest turn from +z to the
    direction. It has no twist about +z, so an indenter that presses the pad keeps its x along the
    finger. For a direction of exactly -z, where all shortest turns are half turns, it turns about
    x.
    """
    return shortest_turn(unit(direction))


def shortest_turn(direction: Floats) -> Floats:
    """``facing`` of a direction whose length is 1 already, which is not normalised again."""
    x, y, z = map(float, direction)
    aside = math.hypot(x, y)
    if z > -0.5:
        quaternion = np.array([1.0 + z, -y, x, 0.0])
    elif aside > 0.0:
        # The same divided by `aside`: 1 + z = aside^2 / (1 - z) loses its digits near z = -1.
        quaternion = np.array([aside / (1.0 - z), -y / aside, x / aside, 0.0])
    else:
        return np.array([0.0, 1.0, 0.0, 0.0])
    return np.asarray(quaternion / np.linalg.norm(quaternion))


def slerp(first: Floats, second: Floats, share: ArrayLike) -> Floats:
    """Unit quaternions between pairs (..., 4), with constant speed along the shorter arc.

    ``share`` says how far from the first to the second, 0 to 1, shape (...). Either sign of a
    quaternion means the same rotation.
    """
    share = np.asarray(share, np.float64)[..., None]
    cosine = np.vecdot(first, second)[..., None]
    second = np.where(cosine < 0.0, -second, second)
    cosine = np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, 1.0))
    arc = np.sin((1 - share) * angle) * first + np.sin(share * angle) * second
    chord = first + share * (second - first)
    turned = np.where(cosine > _STRAIGHT, chord, arc)
    return np.asarray(turned / np.sqrt(np.vecdot(turned, turned))[..., None])


def interpolate_pose(first: Floats, second: Floats, share: float) -> Floats:
    """Pose (7,) between two poses: straight line, and the shortest turn."""
    position = first[:3] + share * (second[:3] - first[:3])
    return np.concatenate([position, slerp(first[3:], second[3:], share)])


def path_lengths(path: Floats) -> Floats:
    """Travel up to each pose [m], (K,): the tip's way, and the arc of its turns at `LEVER_M`.

    From pose to pose it is the root of the sum of both squares. So the noise of measured
    orientations hardly counts beside a move, and a turn on the spot is travel too.
    """
    moves = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1)
    before, after = path[:-1, 3:], path[1:, 3:]
    # Either sign of a quaternion is the same turn. The chord keeps the digits of small angles.
    chords = np.minimum(
        np.linalg.norm(after - before, axis=1), np.linalg.norm(after + before, axis=1)
    )
    turns = 4.0 * np.arcsin(np.minimum(0.5 * chords, 1.0))
    return np.concatenate([[0.0], np.cumsum(np.hypot(moves, LEVER_M * turns))])


def to_local(pose: Floats, points: Floats) -> Floats:
    """Points (N, 3) in the frame whose pose (7,) in the frame of the points is given [m]."""
    return np.asarray((points - pose[:3]) @ rotation_matrices(pose[3:]))


@dataclass(frozen=True, slots=True)
class Transform:
    """A pose of one frame in another, which maps coordinates of the first into the second.

    ``sensor_robot`` is the pose of the robot frame in the sensor frame and takes points of the
    robot frame to the sensor frame: the paper's matrix "from the robot-fixed coordinate frame to
    the BioTac-fixed coordinate frame".

    Attributes:
        rotation: Proper rotation, shape (3, 3).
        translation: Origin of the first frame in the second [m], shape (3,).
    """

    rotation: Floats
    translation: Floats

    @classmethod
    def identity(cls) -> Transform:
        """The transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_pose(cls, pose: ArrayLike, what: str = "pose") -> Transform:
        """From position [m] and unit quaternion, shape (7,).

        Raises:
            ConfigError: Not seven finite numbers with a unit quaternion; names ``what``.
        """
        values = np.asarray(pose, np.float64)
        if values.shape != (7,) or not np.isfinite(values).all():
            raise ConfigError(
                f"{what} is not seven finite numbers",
                remedy="give x y z [m] and a quaternion w x y z",
            )
        if abs(float(np.linalg.norm(values[3:])) - 1.0) > _ORTHONORMAL:
            raise ConfigError(
                f"{what}: quaternion {values[3:].tolist()} has not length 1",
                remedy="give a unit quaternion, w first",
            )
        return cls(rotation_matrices(values[3:]), values[:3].copy())

    def __matmul__(self, other: Transform) -> Transform:
        return Transform(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )

    def inverse(self) -> Transform:
        """The pose of the second frame in the first."""
        return Transform(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: Floats) -> Floats:
        """Coordinates in the second frame [m] of points of the first, shape (..., 3)."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def apply_poses(self, poses: Floats) -> Floats:
        """Poses in the second frame, shape (N, 7), of poses in the first."""
        turned = self.rotation @ rotation_matrices(poses[:, 3:])
        return np.hstack([self.apply(poses[:, :3]), quaternions_of(turned)])

    @property
    def pose(self) -> Floats:
        """Position [m] and unit quaternion, shape (7,)."""
        return np.concatenate([self.translation, quaternions_of(self.rotation)])


def quaternion_length(quaternion: Quaternion) -> float:
    """Length of a quaternion; that of a rotation is 1."""
    return math.sqrt(sum(part * part for part in quaternion))


def is_rotation(quaternion: Quaternion) -> bool:
    """Whether the length is 1 except for rounding; False for NaN."""
    return abs(quaternion_length(quaternion) - 1.0) <= UNIT_TOLERANCE


def normalised(pose: Pose) -> Pose:
    """The pose with a quaternion of length 1 to the last digit."""
    length = quaternion_length(pose.orientation)
    w, x, y, z = pose.orientation
    return Pose(pose.position, (w / length, x / length, y / length, z / length))


def compose(a: Pose, b: Pose) -> Pose:
    """``pose_x_z`` from ``pose_x_y`` and ``pose_y_z``."""
    x, y, z = _rotated(a.orientation, b.position)
    ax, ay, az = a.position
    return Pose((ax + x, ay + y, az + z), _product(a.orientation, b.orientation))


def inverse(pose: Pose) -> Pose:
    """``pose_y_x`` from ``pose_x_y``."""
    w, x, y, z = pose.orientation
    back = (w, -x, -y, -z)
    px, py, pz = _rotated(back, pose.position)
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


def _rotated(q: Quaternion, v: Vector) -> Vector:
    """``v`` rotated by the unit quaternion ``q``: v + 2 w (u x v) + 2 u x (u x v)."""
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
