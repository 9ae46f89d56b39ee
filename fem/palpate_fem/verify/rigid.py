"""Indenters of the verification: plane, ball, punch and roll, and where they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate_fem.indenter.shape import Indenter, Kind, Primitive

Floats = NDArray[np.float64]

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def plane(half_m: float = 0.1) -> Indenter:
    """A box so large that its top is a plane."""
    edge = 1e-4
    inner = half_m - edge
    box = Primitive(Kind.BOX, (0.0, 0.0, -half_m), (inner, inner, inner, 0.0), edge)
    return Indenter("plane", (box,))


def ball(radius_m: float) -> Indenter:
    """A sphere."""
    at = (0.0, 0.0, -radius_m)
    return Indenter("ball", (Primitive(Kind.REVOLVED, at, (0.0, 0.0, 0.0, 0.0), radius_m),))


def roll(radius_m: float, half_length_m: float) -> Indenter:
    """A cylinder along y."""
    at, sizes = (0.0, 0.0, -radius_m), (0.0, 0.0, -half_length_m, half_length_m)
    return Indenter("roll", (Primitive(Kind.REVOLVED, at, sizes, radius_m, axis=1),))


def punch(radius_m: float, edge_m: float) -> Indenter:
    """A flat-ended cylinder along z with a rounded rim."""
    sizes = (0.0, radius_m - edge_m, -4 * radius_m, -edge_m)
    return Indenter("punch", (Primitive(Kind.REVOLVED, (0.0, 0.0, 0.0), sizes, edge_m),))


def pose(position: ArrayLike, quaternion: ArrayLike = UPRIGHT) -> Floats:
    """Position [m] and unit quaternion w x y z as one row, (7,)."""
    return np.concatenate([np.asarray(position, np.float64), np.asarray(quaternion, np.float64)])


def about_y(angle: float) -> Floats:
    """Quaternion of a turn about y by an angle [rad]."""
    return np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
