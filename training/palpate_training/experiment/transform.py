"""Rigid transforms, and the pose in which an indenter presses along a direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError

Floats = npt.NDArray[np.float64]

_ORTHONORMAL = 1e-6  # a pose printed with seven digits passes, a scaled or mirrored one does not


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
        """The frame itself."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_pose(cls, pose: npt.ArrayLike, what: str = "pose") -> Transform:
        """From position [m] and unit quaternion w x y z, shape (7,).

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
        return np.hstack([self.apply(poses[:, :3]), quaternions(turned)])

    @property
    def pose(self) -> Floats:
        """Position [m] and unit quaternion w x y z, shape (7,)."""
        return np.concatenate([self.translation, quaternions(self.rotation)])


def rotation_matrices(unit_quaternions: Floats) -> Floats:
    """Matrices of unit quaternions w x y z, shape (..., 3, 3) from (..., 4)."""
    w, x, y, z = np.moveaxis(unit_quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions(rotations: Floats) -> Floats:
    """Unit quaternions w x y z with w >= 0, shape (..., 4), of rotations (..., 3, 3).

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
