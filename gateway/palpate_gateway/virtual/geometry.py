"""Shape of the virtual finger: electrodes on the core, inner and outer skin as capsules.

Sensor frame: x to the fingertip, z dorsal, so the ventral side faces -z. The capsules are the
simplest shape that meets the measured profile of the inflated skin within 0.2 mm on the ventral
side and the flanks (learning reference 5.1: ventral outer -8.31, inner -6.69, lateral 7.11 and
5.54, tip +6.65 mm) and about 0.8 mm at the tip's facet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.anatomy import ELECTRODE_POSITIONS

Array = npt.NDArray[np.float64]

OUTER_RADIUS_M = 7.0e-3
INNER_RADIUS_M = 5.4e-3
AXIS_Z_M = -1.31e-3
"""The skin's axis lies this far ventral of the core's [m]."""
TIP_X_M = -0.35e-3
"""Centre of the spherical tip [m]."""

_NEAREST_ON_AXIS = np.stack(
    [
        np.minimum(ELECTRODE_POSITIONS[:, 0], TIP_X_M),
        np.zeros(len(ELECTRODE_POSITIONS)),
        np.full(len(ELECTRODE_POSITIONS), AXIS_Z_M),
    ],
    axis=1,
)
_FROM_AXIS = ELECTRODE_POSITIONS - _NEAREST_ON_AXIS
_DISTANCE = np.linalg.norm(_FROM_AXIS, axis=1)

SKIN_NORMALS: Array = _FROM_AXIS / _DISTANCE[:, None]
"""Outward unit normal of the skin over each electrode, shape ``(19, 3)``."""

SKIN_POINTS_M: Array = _NEAREST_ON_AXIS + SKIN_NORMALS * INNER_RADIUS_M
"""Point of the inner skin over each electrode [m], shape ``(19, 3)``."""

REST_GAPS_M: Array = np.maximum(INNER_RADIUS_M - _DISTANCE, 0.15e-3)
"""Fluid film over each untouched electrode [m], shape ``(19,)``."""


@dataclass(frozen=True, slots=True)
class SkinPoint:
    """A point of the outer skin.

    Attributes:
        position: Where [m], shape ``(3,)``.
        normal: Outward unit normal, shape ``(3,)``.
        along: Unit tangent towards the tip, shape ``(3,)``.
        across: Unit tangent across the finger, shape ``(3,)``.
    """

    position: Array
    normal: Array
    along: Array
    across: Array


def skin_point(arc_m: float, angle_rad: float) -> SkinPoint:
    """A point of the outer skin by its place along and around the finger.

    Args:
        arc_m: Along the ventral meridian from the tip's centre [m]; negative towards the hand,
            positive around the tip.
        angle_rad: Around the axis from ventral towards +y [rad].
    """
    bend = max(arc_m, 0.0) / OUTER_RADIUS_M
    radial = np.array([0.0, np.sin(angle_rad), -np.cos(angle_rad)])
    forward = np.array([1.0, 0.0, 0.0])
    normal = np.cos(bend) * radial + np.sin(bend) * forward
    along = np.cos(bend) * forward - np.sin(bend) * radial
    centre = np.array([TIP_X_M + min(arc_m, 0.0), 0.0, AXIS_Z_M])
    return SkinPoint(centre + normal * OUTER_RADIUS_M, normal, along, np.cross(normal, along))
