"""From the gap of the mechanics to the film of fluid in it.

Where the skin touches the core, asperities hold a film open.

The skin of the mechanics is the plane through the tips of the inner surface's asperities. Between
them fluid stays, and the less the harder they are pressed (learning notes, section 4.4)::

    h = max(gap, 0) + floor + (asperity - floor) / (1 + p / p0)^m
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.fem.electrodes.unit import UnitParameters

Floats = NDArray[np.float64]

ROUNDING_M = 1e-6  # width over which max(gap, 0) bends; contacts of the mechanics sink in by 0.5e-6

# The public clamp begins here (mesh.parametric: NAIL_X_M); E19's disc ends 0.9 mm behind it.
CLAMP_X_M, CLAMP_BLEND_M = -13.96e-3, 0.7e-3


def opening(points: Floats, unit: UnitParameters) -> Floats:
    """Share of the gap that is open, shape (N,): less behind the clamp's edge, where it squeezes.

    A hypothesis of ours: E19 of a real sensor rests 380 counts below what the film of the public
    skin makes it, closed behind the clamp 243; over all electrodes the misfit falls from 111 to 74.

    Args:
        points: Nodes of the film [m], shape (N, 3), sensor frame.
        unit: The sensor; its `clamp_closing` is used.
    """
    behind = 0.5 * (1 + np.tanh((CLAMP_X_M - points[:, 0]) / (2 * CLAMP_BLEND_M)))
    return np.asarray(1 - unit.clamp_closing * behind)


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
