"""NumPy twin of the contact kernels: the laws at points, as short as they can be said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ContactLaw:
    """Softened augmented Lagrangian, and Coulomb friction by return mapping.

    Attributes:
        stiffness: Penalty e [Pa/m].
        softness_m: Rounding d of its corner [m].
        friction: Coulomb coefficient.
        tangential_stiffness: Of a sticking point k [Pa/m].
    """

    stiffness: float
    softness_m: float
    friction: float
    tangential_stiffness: float

    def energy(self, multiplier: Floats, gap: Floats) -> Floats:
        """Potential of the pressure per area [J/m^2]: its derivative by the gap is -p."""
        from scipy.special import spence

        z = (multiplier / self.stiffness - gap) / self.softness_m
        # Integral of log(1 + e^z) is -Li2(-e^z); Li2(x) = spence(1 - x). For large z by reflection.
        small = np.minimum(z, 0.0)
        large = np.maximum(z, 0.0)
        tail = -spence(1 + np.exp(-np.abs(z)))
        value = np.where(z > 0, large**2 / 2 + np.pi**2 / 6 - tail, tail) + 0.0 * small
        return np.asarray(self.stiffness * self.softness_m**2 * value)

    def pressure(self, multiplier: Floats, gap: Floats) -> Floats:
        """Contact pressure p [Pa]."""
        z = (multiplier / self.stiffness - gap) / self.softness_m
        return np.asarray(self.stiffness * self.softness_m * np.logaddexp(0.0, z))

    def traction(self, pressure: Floats, normal: Floats, arm: Floats) -> Floats:
        """Friction that the skin exerts on the indenter per area [Pa].

        Args:
            pressure: Contact pressure [Pa], (N,).
            normal: Unit normals out of the indenter, (N, 3).
            arm: Way of the points from their anchors [m], (N, 3).
        """
        along = np.sum(normal * arm, axis=1, keepdims=True)
        trial = self.tangential_stiffness * (arm - along * normal)
        size = np.linalg.norm(trial, axis=1)
        limit = self.friction * pressure
        factor = np.where(size > limit, limit / np.where(size > 0, size, 1.0), 1.0)
        return np.asarray(factor[:, None] * trial)
