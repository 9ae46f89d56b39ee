"""The skin's material: isochoric neo-Hooke; energy, first Piola stress and tangent at points.

The pressure of an element keeps its *mean* volume, but not the volume at each of its quadrature
points. Where skin is pinched between a hard indenter and the core, the points of one element may
go to J = 0.3 beside J = 2, an hourglass mode that Q1-P0 does not resist, and Newton's method finds
no equilibrium. A barrier resists it; for J within 0.78..1.28 it is exactly zero (ADR 0013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate_fem.arrays import Floats

VOLUME_BARRIER = 60.0
"""Stiffness of the barrier in shear moduli; ADR 0013 says how little it changes forces."""

BARRIER_FROM = 0.25
"""|ln J| at which the barrier begins."""


@dataclass(frozen=True, slots=True)
class NeoHooke:
    """W = mu/2 (J^(-2/3) tr(F^T F) - 3 + barrier max(0, |ln J| - 0.25)^2).

    For J = 1 this is the paper's equation "neo_hookean" up to a constant; the volumetric part
    belongs to the element and its pressure. ``f`` are deformation gradients, shape (..., 3, 3).

    Attributes:
        mu: Shear modulus [Pa].
        barrier: Stiffness against a change of volume at a single point, in shear moduli; 0 = none.
    """

    mu: float
    barrier: float = VOLUME_BARRIER

    def function(self, f: Floats) -> Floats:
        """Energy per unit of undeformed volume [J/m^3], shape (...)."""
        j = np.linalg.det(f)
        isochoric = j ** (-2 / 3) * np.sum(f * f, axis=(-2, -1)) - 3
        beyond, _ = self._beyond(j)
        return np.asarray(self.mu / 2 * (isochoric + self.barrier * beyond**2))

    def gradient(self, f: Floats) -> Floats:
        """First Piola stress dW/dF [Pa], shape (..., 3, 3)."""
        scale, trace, inverse_t = self._parts(f)
        beyond, sign = self._beyond(np.linalg.det(f)[..., None, None])
        volumetric = self.mu * self.barrier * sign * beyond * inverse_t
        return np.asarray(scale * (f - trace / 3 * inverse_t) + volumetric)

    def hessian(self, f: Floats) -> Floats:
        """d^2 W / dF_ij dF_kl [Pa], shape (..., 3, 3, 3, 3)."""
        scale, trace, g = self._parts(f)
        eye = np.eye(3)
        scale, trace = scale[..., None, None], trace[..., None, None]
        fg = np.einsum("...ij,...kl->...ijkl", f, g) + np.einsum("...ij,...kl->...ijkl", g, f)
        gg = np.einsum("...ij,...kl->...ijkl", g, g)
        swapped = np.einsum("...il,...kj->...ijkl", g, g)
        identity = np.einsum("ik,jl->ijkl", eye, eye)
        beyond, sign = self._beyond(np.linalg.det(f)[..., None, None, None, None])
        volumetric = (beyond > 0.0) * gg - sign * beyond * swapped
        return np.asarray(
            scale * (identity - 2 / 3 * fg + 2 / 9 * trace * gg + trace / 3 * swapped)
            + self.mu * self.barrier * volumetric
        )

    @staticmethod
    def _beyond(j: Floats) -> tuple[Floats, Floats]:
        """Excess of |ln J| over where the barrier begins, at least 0, and the sign of ln J."""
        logarithm = np.log(j)
        beyond = np.maximum(0.0, np.abs(logarithm) - BARRIER_FROM)
        return np.asarray(beyond), np.asarray(np.sign(logarithm))

    def _parts(self, f: Floats) -> tuple[Floats, Floats, Floats]:
        """Return mu J^(-2/3), tr(F^T F) and F^-T."""
        j = np.linalg.det(f)[..., None, None]
        trace = np.sum(f * f, axis=(-2, -1))[..., None, None]
        inverse_t = np.asarray(np.linalg.inv(f).swapaxes(-1, -2), np.float64)
        return np.asarray(self.mu * j ** (-2 / 3)), np.asarray(trace), inverse_t
