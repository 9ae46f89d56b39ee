"""The skin's material: isochoric neo-Hooke; its energy, and the barrier of the volume.

The pressure of an element keeps its *mean* volume, but not the volume at each of its quadrature
points. Where skin is pinched between a hard indenter and the core, the points of one element may
go to J = 0.3 beside J = 2, an hourglass mode that Q1-P0 does not resist, and Newton's method finds
no equilibrium. A barrier resists it; for J within 0.78..1.28 it is exactly zero (ADR 0013).
"""

from __future__ import annotations

import numpy as np

from palpate_fem.arrays import Floats

VOLUME_BARRIER = 60.0
"""Stiffness of the barrier in shear moduli; ADR 0013 says how little it changes forces."""

BARRIER_FROM = 0.25
"""|ln J| at which the barrier begins."""


def energy_density(f: Floats, mu: float, barrier: float = VOLUME_BARRIER) -> Floats:
    """W = mu/2 (J^(-2/3) tr(F^T F) - 3 + barrier max(0, |ln J| - 0.25)^2) [J/m^3], shape (...).

    Per unit of undeformed volume. For J = 1 this is the paper's equation "neo_hookean" up to a
    constant; the volumetric part belongs to the element and its pressure.

    Args:
        f: Deformation gradients, shape (..., 3, 3).
        mu: Shear modulus [Pa].
        barrier: Stiffness against a change of volume at a single point, in shear moduli; 0 = none.
    """
    j = np.linalg.det(f)
    isochoric = j ** (-2 / 3) * np.sum(f * f, axis=(-2, -1)) - 3
    beyond = np.maximum(0.0, np.abs(np.log(j)) - BARRIER_FROM)
    return np.asarray(mu / 2 * (isochoric + barrier * beyond**2))
