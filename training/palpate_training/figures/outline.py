"""Outlines of a fingertip to draw on where there is no mesh, and the unwrapped core.

Core radius as in the electrode table (docs/conventions.md); the skin's profile is the one of the
electrode map, rounded: it only shows where the skin is, nothing is measured against it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from palpate.anatomy import CORE_RADIUS_M

Floats = npt.NDArray[np.float64]

_BACK, _SKIN_TIP, _SKIN_SIDE = -20e-3, 6.65e-3, 7.11e-3
_SKIN_BELOW = -8.14e-3
_TIP_BEGINS, _TIP_POWER = -1e-3, 2.5
"""Seen from the side the tip is a superellipse, within 0.1 mm of the electrode map's points."""

_UNWRAPPED_HALF = np.radians(100.0)
"""How far the skin reaches round the core to either side of the pad [rad]."""


def ventral() -> tuple[Floats, Floats]:
    """Skin and core seen from below: (x, y) [m], shape (M, 2) each."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 90)
    bow = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    skin = bow * (_SKIN_TIP, _SKIN_SIDE)
    core = CORE_RADIUS_M * bow
    return (
        np.vstack([[_BACK, -_SKIN_SIDE], skin, [_BACK, _SKIN_SIDE]]),
        np.vstack([[_BACK, -CORE_RADIUS_M], core, [_BACK, CORE_RADIUS_M]]),
    )


def lateral() -> tuple[Floats, Floats]:
    """Ventral half of skin and core seen from the side: (x, z) [m], shape (M, 2) each."""
    turn = np.linspace(-np.pi / 2, 0, 45)
    quarter = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    core = CORE_RADIUS_M * quarter
    bow = np.sign(quarter) * np.abs(quarter) ** (2 / _TIP_POWER)
    skin = bow * (_SKIN_TIP - _TIP_BEGINS, -_SKIN_BELOW) + (_TIP_BEGINS, 0.0)
    return (
        np.vstack([[_BACK, _SKIN_BELOW], skin, [_BACK, 0.0]]),
        np.vstack([[_BACK, -CORE_RADIUS_M], core, [_BACK, 0.0]]),
    )


def unwrap(points: Floats) -> Floats:
    """Lay the core flat: way along it, (distal, lateral) [m], shape (N, 2), from below the origin.

    The cylinder is rolled out about x; the spherical tip is laid out by its arc from the point
    below the origin, which meets the cylinder at x = 0 without a step.

    Args:
        points: Points on the core [m], shape (N, 3), sensor frame.
    """
    x, y, z = np.asarray(points, np.float64).T
    beside = np.where(x > 0, np.hypot(x, y), np.abs(y))
    arc = CORE_RADIUS_M * np.arctan2(beside, -z)
    share = arc / np.where(beside > 0, beside, 1.0)
    return np.stack([np.where(x > 0, x * share, x), y * share], axis=1)


def unwrapped() -> Floats:
    """Rounded outline of the unwrapped skin: (distal, lateral) [m], shape (M, 2)."""
    half = CORE_RADIUS_M * _UNWRAPPED_HALF
    turn = np.linspace(-np.pi / 2, np.pi / 2, 90)
    bow = half * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.vstack([[_BACK, -half], bow, [_BACK, half]])
