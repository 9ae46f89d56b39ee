"""From the gap of the mechanics to the film of fluid in it.

Where the skin touches the core, asperities hold a film open.

The skin of the mechanics is the plane through the tips of the inner surface's asperities. Between
them fluid stays, and the less the harder they are pressed (learning notes, section 4.4)::

    h = max(gap, 0) + floor + (asperity - floor) / (1 + p / p0)^m
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_fem.electrodes.unit import UnitParameters

Floats = NDArray[np.float64]

ROUNDING_M = 1e-6  # width over which max(gap, 0) bends; contacts of the mechanics sink in by 0.5e-6

# The public clamp begins here (mesh.parametric: NAIL_X_M); E19's disc ends 0.9 mm behind it.
CLAMP_X_M, CLAMP_BLEND_M = -13.96e-3, 0.7e-3
# Angle about the core's axis from the ventral midline between which the sides begin: E2..E5 lie at
# 44 degrees, E1, E4, E6 at 77.
SIDES_RAD = (0.85, 1.25)


@dataclass(frozen=True)
class Fit:
    """How a unit's skin stands to that of the mechanics, at each node of the film.

    Attributes:
        share: Of the gap that is open [1], shape (N,): less behind the clamp's edge.
        nearer_m: How much nearer to the core the unit's skin stands [m], shape (N,).
    """

    share: Floats
    nearer_m: Floats

    def gap(self, gap: Floats) -> Floats:
        """The unit's gap [m] from that of the mechanics, same shape."""
        return np.asarray(self.share * gap - self.nearer_m)


def fit_of(points: Floats, unit: UnitParameters) -> Fit:
    """Where a unit's skin differs from that of the mechanics, which all units share.

    Behind the clamp's edge skin and core are anchored together, as in the paper's model ("Finite
    element model configuration", boundary condition 1), which closes the film there. At the sides
    units differ: real ones rise by up to 0.17 of full scale where the skin bulges, which takes
    films of 0.05-0.2 mm at rest (learning notes, section 4.4); under the pad the fill decides.

    Args:
        points: Nodes of the film [m], shape (N, 3), sensor frame.
        unit: The sensor; its `clamp_closing` and `side_closing_m` are used.
    """
    x, y, z = points.T
    behind = 0.5 * (1 + np.tanh((CLAMP_X_M - x) / (2 * CLAMP_BLEND_M)))
    angle = np.arctan2(np.abs(y), -z)
    low, high = SIDES_RAD
    t = np.clip((angle - low) / (high - low), 0.0, 1.0)
    return Fit(1 - unit.clamp_closing * behind, unit.side_closing_m * t * t * (3 - 2 * t))


def thickness(gap: Floats, pressure: Floats, unit: UnitParameters) -> tuple[Floats, Floats, Floats]:
    """Thickness of the film.

    Args:
        gap: Between core and skin [m], shape (...); negative where they are in contact.
        pressure: Of the core on the skin [Pa], same shape, not negative.
        unit: The sensor; its asperity, floor and squeeze parameters are used.

    Returns:
        Thickness h [m], dh/d gap and dh/d pressure [m/Pa], each of the same shape.
    """
    t = gap / ROUNDING_M
    above, slope = ROUNDING_M * np.logaddexp(0.0, t), 0.5 * (1 + np.tanh(t / 2))
    squeezed = 1 + pressure / unit.squeeze_pa
    left = (unit.asperity_m - unit.floor_m) * squeezed**-unit.squeeze_exponent
    by_pressure = -unit.squeeze_exponent * left / (squeezed * unit.squeeze_pa)
    return above + unit.floor_m + left, slope, by_pressure
