"""The skin's law: isochoric neo-Hooke; energy, first Piola stress and tangent at points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NeoHooke:
    """W = mu/2 (J^(-2/3) tr(F^T F) - 3); the volume is the element's affair.

    For J = 1 this is the paper's equation "neo_hookean" up to a constant. The arguments ``f`` are
    deformation gradients, shape (..., 3, 3).

    Attributes:
        mu: Shear modulus [Pa].
    """

    mu: float

    def function(self, f: Floats) -> Floats:
        """Energy per unit of undeformed volume [J/m^3], shape (...)."""
        j = np.linalg.det(f)
        return np.asarray(self.mu / 2 * (j ** (-2 / 3) * np.sum(f * f, axis=(-2, -1)) - 3))

    def gradient(self, f: Floats) -> Floats:
        """First Piola stress dW/dF [Pa], shape (..., 3, 3)."""
        scale, trace, inverse_t = self._parts(f)
        return np.asarray(scale * (f - trace / 3 * inverse_t))

    def hessian(self, f: Floats) -> Floats:
        """d^2 W / dF_ij dF_kl [Pa], shape (..., 3, 3, 3, 3)."""
        scale, trace, g = self._parts(f)
        eye = np.eye(3)
        scale, trace = scale[..., None, None], trace[..., None, None]
        fg = np.einsum("...ij,...kl->...ijkl", f, g) + np.einsum("...ij,...kl->...ijkl", g, f)
        gg = np.einsum("...ij,...kl->...ijkl", g, g)
        swapped = np.einsum("...il,...kj->...ijkl", g, g)
        identity = np.einsum("ik,jl->ijkl", eye, eye)
        return np.asarray(
            scale * (identity - 2 / 3 * fg + 2 / 9 * trace * gg + trace / 3 * swapped)
        )

    def _parts(self, f: Floats) -> tuple[Floats, Floats, Floats]:
        j = np.linalg.det(f)[..., None, None]
        trace = np.sum(f * f, axis=(-2, -1))[..., None, None]
        inverse_t = np.asarray(np.linalg.inv(f).swapaxes(-1, -2), np.float64)
        return np.asarray(self.mu * j ** (-2 / 3)), np.asarray(trace), inverse_t
