"""Orientation of an indenter: unit quaternions w x y z, indenter frame to sensor frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.errors import ConfigError

Floats = NDArray[np.float64]


def unit(vector: ArrayLike, what: str = "direction") -> Floats:
    """A direction of length 1, shape (3,).

    Raises:
        ConfigError: It is not three finite numbers, or has no length.
    """
    direction = np.asarray(vector, np.float64)
    if direction.shape == (3,) and np.isfinite(direction).all():
        largest = np.abs(direction).max()  # first, lest tiny or huge components square to 0 or inf
        if largest > 0.0:
            direction = direction / largest
            return np.asarray(direction / np.linalg.norm(direction))
    raise ConfigError(
        f"{what} {vector!r} is not a direction", remedy="give three finite numbers, not all zero"
    )


def rotation_matrix(quaternion: Floats) -> Floats:
    """Matrix of a unit quaternion, shape (3, 3)."""
    w, x, y, z = map(float, quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def facing(direction: ArrayLike) -> Floats:
    """Quaternion by which an indenter presses along a direction: the shortest turn from +z.

    It has no twist about +z, so an indenter that presses the pad keeps its x along the finger.
    From the nail side, straight down, where all shortest turns are half turns, it turns about x.

    Args:
        direction: Where to press, sensor frame, shape (3,), of any length.

    Returns:
        Shape (4,), w x y z.
    """
    x, y, z = map(float, unit(direction))
    aside = math.hypot(x, y)
    if z > -0.5:
        quaternion = np.array([1.0 + z, -y, x, 0.0])
    elif aside > 0.0:  # the same over aside, as 1 + z = aside^2 / (1 - z) loses its digits here
        quaternion = np.array([aside / (1.0 - z), -y / aside, x / aside, 0.0])
    else:
        return np.array([0.0, 1.0, 0.0, 0.0])
    return np.asarray(quaternion / np.linalg.norm(quaternion))


def to_indenter(pose: Floats, points: Floats) -> Floats:
    """Points of the sensor frame in the indenter frame [m], shape (N, 3).

    Args:
        pose: Position [m] and unit quaternion w x y z, shape (7,).
        points: Positions [m], sensor frame, shape (N, 3).
    """
    return np.asarray((points - pose[:3]) @ rotation_matrix(pose[3:]))
