"""NumPy twin of the element kernels: short, slow, and the definition of what they compute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mechanics.material import NeoHooke
from palpate_fem.mechanics.reference_element import rest_gradients
from palpate_fem.mesh.solid import SolidMesh

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Elements:
    """What the elements of a mesh contribute at one state.

    Attributes:
        energy: Stored energy of the isochoric part [J].
        rest_volume: Of each element, undeformed [m^3], (E,).
        volume: Of each element [m^3], (E,).
        volume_gradient: Its derivative by the element's nodes, (E, n, 3).
        force: Derivative of energy + sum p (v - v0) by the nodes [N], (V, 3).
        smallest_jacobian: Of all quadrature points.
        tangent: Condensed tangent of each element, (E, n, 3, n, 3).
    """

    energy: float
    rest_volume: Floats
    volume: Floats
    volume_gradient: Floats
    force: Floats
    smallest_jacobian: float
    tangent: Floats


def elements(
    mesh: SolidMesh, material: NeoHooke, bulk: float, position: Floats, pressure: Floats
) -> Elements:
    """Evaluate all elements.

    Args:
        mesh: Solid mesh.
        material: Law of the isochoric part.
        bulk: Bulk modulus kappa [Pa].
        position: Nodal positions [m], (V, 3).
        pressure: Element pressures, positive in tension [Pa], (E,).
    """
    gradient, weight = rest_gradients(mesh)
    f = np.einsum("eai,eqaj->eqij", position[mesh.elements], gradient)
    j = np.linalg.det(f)
    inverse_t = np.linalg.inv(f).swapaxes(-1, -2)
    rest_volume = weight.sum(axis=1)
    volume = (weight * j).sum(axis=1)
    cofactor = j[..., None, None] * inverse_t
    volume_gradient = np.einsum("eq,eqij,eqaj->eai", weight, cofactor, gradient)
    stress = material.gradient(f) + pressure[:, None, None, None] * cofactor
    nodal = np.einsum("eq,eqij,eqaj->eai", weight, stress, gradient)
    force = np.zeros_like(position)
    np.add.at(force, mesh.elements, nodal)
    # d^2 J / dF dF = J (g x g - swapped), with g = F^-T
    second = np.einsum("eqij,eqkl->eqijkl", cofactor, inverse_t) - np.einsum(
        "eqil,eqkj->eqijkl", cofactor, inverse_t
    )
    moduli = material.hessian(f) + pressure[:, None, None, None, None, None] * second
    tangent = np.einsum(
        "eq,eqijkl,eqaj,eqbl->eaibk", weight, moduli, gradient, gradient, optimize=True
    )
    tangent += np.einsum("e,eai,ebk->eaibk", bulk / rest_volume, volume_gradient, volume_gradient)
    energy = float((weight * material.function(f)).sum())
    return Elements(energy, rest_volume, volume, volume_gradient, force, float(j.min()), tangent)
