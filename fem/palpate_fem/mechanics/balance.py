"""The equations at one state: what does not cancel, and how far each law is missed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FORCE_FLOOR_N = 1e-6
"""Scale of force where nothing presses [N]: rounding alone is far below."""

TRACTION_FLOOR_PA = 100.0
"""Scale of tractions where nothing rubs [Pa]: a thousandth of what a light press makes."""


@dataclass(slots=True)
class Balance:
    """The equations at one state.

    Attributes:
        internal: Nodal forces of the skin's stress (a residual: sum of all four is zero), (V, 3).
        indenter: Minus the nodal forces of the indenter on the skin, (V, 3).
        core: Minus those of the core.
        volume_gradient: Derivative of the cavity's volume by the nodes [m^2], (V, 3).
        volume: Of the cavity [m^3].
        unbalanced: The sum over the free unknowns, fluid pressure included [N], (n,).
        scale: Norm of the nodal forces that have to cancel [N].
        strain_error: Largest |v - v0 - v0 p / kappa| / v0.
        gap_error_m: By how much the gap of the worst contact point misses its law [m].
        traction_error: By how much friction's worst traction misses its law, over the largest.
        smallest_jacobian: Of all quadrature points.
    """

    internal: Floats
    indenter: Floats
    core: Floats
    volume_gradient: Floats
    volume: float
    unbalanced: Floats
    scale: float
    strain_error: float
    gap_error_m: float
    traction_error: float
    smallest_jacobian: float

    @property
    def residual(self) -> float:
        """Unbalanced force over the scale of the forces that cancel."""
        return float(np.linalg.norm(self.unbalanced)) / max(self.scale, FORCE_FLOOR_N)
