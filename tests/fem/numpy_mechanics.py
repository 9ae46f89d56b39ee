"""NumPy twins of the kernels of elements, fluid and contact: short, slow, and their definition.

Each computes what a kernel of `palpate_fem.mechanics` computes, in the words of its formula.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mechanics.element_kernels import BARRIER_FROM, VOLUME_BARRIER
from palpate_fem.mechanics.reference_element import face_element, rest_gradients
from palpate_fem.mechanics.skin import energy_density
from palpate_fem.mesh.solid import SolidMesh

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rubber:
    """Energy, first Piola stress and tangent; ``f`` are deformation gradients, (..., 3, 3).

    Attributes:
        mu: Shear modulus [Pa].
        barrier: Stiffness against a change of volume at a single point, in shear moduli; 0 = none.
        stiffening: See `FingertipParameters`; 0 = neo-Hooke.
    """

    mu: float
    barrier: float = VOLUME_BARRIER
    stiffening: float = 0.0

    def function(self, f: Floats) -> Floats:
        """Energy per unit of undeformed volume [J/m^3], shape (...)."""
        return energy_density(f, self.mu, self.barrier, self.stiffening)

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
        power = np.linalg.det(f)[..., None, None] ** (-2 / 3)
        slope = 2 * power * (f - np.sum(f * f, axis=(-2, -1))[..., None, None] / 3 * g)
        growth = self.mu * self.stiffening * self._stretch(f)[..., None, None, None, None]
        return np.asarray(
            scale * (identity - 2 / 3 * fg + 2 / 9 * trace * gg + trace / 3 * swapped)
            + growth * np.einsum("...ij,...kl->...ijkl", slope, slope)
            + self.mu * self.barrier * volumetric
        )

    @staticmethod
    def _stretch(f: Floats) -> Floats:
        """M = J^(-2/3) tr(F^T F) - 3, shape (...)."""
        return np.asarray(np.linalg.det(f) ** (-2 / 3) * np.sum(f * f, axis=(-2, -1)) - 3)

    @staticmethod
    def _beyond(j: Floats) -> tuple[Floats, Floats]:
        """Excess of |ln J| over where the barrier begins, at least 0, and the sign of ln J."""
        logarithm = np.log(j)
        beyond = np.maximum(0.0, np.abs(logarithm) - BARRIER_FROM)
        return np.asarray(beyond), np.asarray(np.sign(logarithm))

    def _parts(self, f: Floats) -> tuple[Floats, Floats, Floats]:
        """Return mu J^(-2/3) (1 + stiffening m^2), tr(F^T F) and F^-T."""
        j = np.linalg.det(f)[..., None, None]
        trace = np.sum(f * f, axis=(-2, -1))[..., None, None]
        inverse_t = np.asarray(np.linalg.inv(f).swapaxes(-1, -2), np.float64)
        stiff = 1 + self.stiffening * self._stretch(f)[..., None, None] ** 2
        return np.asarray(self.mu * stiff * j ** (-2 / 3)), np.asarray(trace), inverse_t


@dataclass(frozen=True, slots=True)
class Elements:
    """Contributions of the elements of a mesh at one state.

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
    mesh: SolidMesh, material: Rubber, bulk: float, position: Floats, pressure: Floats
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


@dataclass(frozen=True, slots=True)
class Cavity:
    """Volume under faces of k corners.

    Attributes:
        volume: Under each face, seen from the origin [m^3], (F,).
        gradient: Derivative of their sum by the nodes [m^2], (V, 3).
        hessian: Second derivative of each by the face's corners [m], (F, k, 3, k, 3).
    """

    volume: Floats
    gradient: Floats
    hessian: Floats


def cavity(faces: NDArray[np.int32], position: Floats) -> Cavity:
    """A third of the integral of x . (dx/dr x dx/ds) over each face, by quadrature.

    Args:
        faces: Node ids, normals out of the cavity, (F, k).
        position: Nodal positions [m], (V, 3).
    """
    element = face_element(faces.shape[1])
    corners = position[faces]
    at, by_r, by_s = element.shape, element.gradient[..., 0], element.gradient[..., 1]
    x, r, s = (np.einsum("qa,fai->fqi", weights, corners) for weights in (at, by_r, by_s))
    weight = element.weight / 3
    volume = np.einsum("q,fqi,fqi->f", weight, x, np.cross(r, s))
    # x . (r x s) is cyclic: each factor's derivative is the cross product of the next two.
    parts = ((at, r, s, by_r, by_s), (by_r, s, x, by_s, at), (by_s, x, r, at, by_r))
    nodal = np.zeros_like(corners)
    hessian = np.zeros((len(faces), *corners.shape[1:], *corners.shape[1:]))
    for own, first, second, by_first, by_second in parts:
        nodal += np.einsum("q,qa,fqi->fai", weight, own, np.cross(first, second))
        turned = np.einsum("qa,qb,fqij->fqaibj", own, by_second, _skew(first))
        turned -= np.einsum("qa,qb,fqij->fqaibj", own, by_first, _skew(second))
        hessian += np.einsum("q,fqaibj->faibj", weight, turned)
    gradient = np.zeros_like(position)
    np.add.at(gradient, faces, nodal)
    return Cavity(volume, gradient, hessian)


def _skew(v: Floats) -> Floats:
    """Matrices of v x, (..., 3, 3)."""
    return np.asarray(np.cross(v[..., None, :], np.eye(3)).swapaxes(-1, -2))


Ints = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class ContactLaw:
    """Constants of the contact laws; see ``contact_laws``.

    Attributes:
        stiffness: e of the normal law [Pa/m].
        friction: Coulomb coefficient.
        tangential_stiffness: k of a sticking point [Pa/m].
        complement: c that decides between sticking and sliding [Pa/m].
    """

    stiffness: float
    friction: float
    tangential_stiffness: float
    complement: float


@dataclass(frozen=True, slots=True)
class Friction:
    """Linearised friction.

    Attributes:
        sticks: Whether a point sticks, (N,).
        wanted: Traction on the indenter by the linearised law [Pa], (N, 3).
        by_position: Its derivative by the point's position [Pa/m], (N, 3, 3).
        by_pressure: Its derivative by the pressure, (N, 3).
    """

    sticks: NDArray[np.bool_]
    wanted: Floats
    by_position: Floats
    by_pressure: Floats


@dataclass(frozen=True, slots=True)
class Contact:
    """Contributions of contact points, per undeformed area.

    Attributes:
        status: 0 apart, 1 touches without friction, 2 sticks, 3 slides, (N,).
        wanted: Pressure by the linearised law [Pa], (N,).
        slope: Minus its derivative by the point's position [Pa/m], (N, 3).
        wanted_traction: Friction by the linearised law at the wanted pressure [Pa], (N, 3).
        traction_slope: Its derivative by the point's position [Pa/m], (N, 3, 3).
        force: On the skin at the state's own pressure and traction [Pa], (N, 3).
        misfit: What the force lacks to that by the law, but ``coupled`` [Pa], (N, 3).
        coupled: What it lacks because friction follows the wanted pressure, negative [Pa], (N, 3).
        tangent: Symmetric approximation of minus the derivative of the law's force, (N, 3, 3).
        rest: Its unsymmetric rest, (N, 3, 3).
    """

    status: Ints
    wanted: Floats
    slope: Floats
    wanted_traction: Floats
    traction_slope: Floats
    force: Floats
    misfit: Floats
    coupled: Floats
    tangent: Floats
    rest: Floats


def normal_law(law: ContactLaw, pressure: Floats, gap: Floats) -> tuple[Floats, Floats]:
    """Wanted pressure [Pa] and minus its derivative by the gap [Pa/m], each (N,).

    Args:
        law: Constants.
        pressure: Of the state [Pa], (N,).
        gap: [m], (N,).
    """
    touches = (gap < 0.0) | (pressure > 0.0)
    return np.where(touches, -law.stiffness * gap, 0.0), np.where(touches, law.stiffness, 0.0)


def friction_law(
    law: ContactLaw,
    pressure: Floats,
    traction: Floats,
    normal: Floats,
    curvature: Floats,
    arm: Floats,
) -> Friction:
    """Linearised friction of touching points.

    Args:
        law: Constants.
        pressure: Of the state [Pa], (N,).
        traction: Of the state, on the indenter [Pa], (N, 3).
        normal: Unit normals out of the indenter, (N, 3).
        curvature: Their derivative by the position [1/m], (N, 3, 3).
        arm: Way of the points from their anchors [m], (N, 3).
    """
    k, c = law.tangential_stiffness, law.complement
    along = _dot(normal, arm)
    way = arm - along * normal
    turn = (
        np.eye(3)
        - _outer(normal, normal)
        - along[..., None] * curvature
        - _outer(normal, np.einsum("nij,nj->ni", curvature, arm))
    )
    now = traction - _dot(normal, traction) * normal
    trial = now + c * (way - now / k)
    size = np.linalg.norm(trial, axis=1, keepdims=True)
    limit = law.friction * pressure[:, None]
    sticks = size <= limit

    size = np.where(sticks, 1.0, size)  # not needed there, and may be zero
    t, share = trial / size, limit / size
    across = now - _dot(t, now) * t
    left = 1.0 - share * (1.0 - c / k)
    wanted = limit * t + across - across / left
    rolled = turn - _outer(t, np.einsum("nji,nj->ni", turn, t))
    by_position = (share * c / left)[..., None] * rolled
    return Friction(
        sticks[:, 0],
        np.where(sticks, k * way, wanted),
        np.where(sticks[..., None], k * turn, by_position),
        np.where(sticks, 0.0, law.friction * t),
    )


def return_map(law: ContactLaw, pressure: Floats, normal: Floats, arm: Floats) -> Floats:
    """Friction that `friction_law` iterates to: a spring, capped at the Coulomb limit [Pa], (N, 3).

    The arguments are those of `friction_law`.
    """
    trial = law.tangential_stiffness * (arm - _dot(normal, arm) * normal)
    size = np.linalg.norm(trial, axis=1, keepdims=True)
    limit = law.friction * pressure[:, None]
    return np.asarray(np.where(size > limit, limit / np.where(size > 0.0, size, 1.0), 1.0) * trial)


def contact(
    law: ContactLaw,
    gap: Floats,
    normal: Floats,
    curvature: Floats,
    pressure: Floats,
    traction: Floats,
    arm: Floats,
) -> Contact:
    """Twin of the kernels' loop bodies; the core is a body without friction.

    Args:
        law: Constants.
        gap: Distance to the body [m], (N,).
        normal: Its derivative by the position, (N, 3).
        curvature: Its second derivative [1/m], (N, 3, 3).
        pressure: Of the state [Pa], (N,).
        traction: Of the state, on the body [Pa], (N, 3).
        arm: Way of the points from their anchors [m], (N, 3).
    """
    wanted, stiffness = normal_law(law, pressure, gap)
    touches = stiffness > 0.0
    slope = stiffness[:, None] * normal
    grown = np.zeros_like(normal)
    traction_slope, rest = np.zeros_like(curvature), np.zeros_like(curvature)
    status = touches.astype(np.int32)
    force, misfit = pressure[:, None] * normal, (wanted - pressure)[:, None] * normal
    tangent = _outer(slope, normal) - pressure[:, None, None] * curvature
    wanted_traction = np.zeros_like(normal)
    if law.friction > 0.0:
        rub = friction_law(law, pressure, traction, normal, curvature, arm)
        status += np.where(touches, np.where(rub.sticks, 1, 2), 0).astype(np.int32)
        grown = (wanted - pressure)[:, None] * rub.by_pressure
        wanted_traction = rub.wanted + grown
        follows = _outer(rub.by_pressure, slope)
        traction_slope = rub.by_position - follows
        force = force - traction
        misfit = misfit - (rub.wanted - traction)
        symmetric = (rub.by_position + rub.by_position.swapaxes(1, 2)) / 2
        tangent = tangent + symmetric
        rest = traction_slope - symmetric

    def there(array: Floats) -> Floats:
        return np.asarray(np.where(touches.reshape(-1, *[1] * (array.ndim - 1)), array, 0.0))

    return Contact(
        status=status,
        wanted=wanted,
        slope=slope,
        wanted_traction=there(wanted_traction),
        traction_slope=there(traction_slope),
        force=there(force),
        misfit=there(misfit),
        coupled=there(-grown),
        tangent=there(tangent),
        rest=there(rest),
    )


def mortar(
    nodes: Floats,
    faces: Ints,
    position: Floats,
    pressure: Floats,
    distance: Callable[[Floats], tuple[Floats, Floats]],
) -> tuple[Floats, Floats]:
    """Weighted gaps and nodal forces of frictionless mortar contact, face by face.

    Args:
        nodes: Undeformed positions [m], (V, 3).
        faces: Node ids, (F, k).
        position: Deformed positions [m], (V, 3).
        pressure: Of each node [Pa], (V,).
        distance: Gap [m] and its gradient at points (N, 3).

    Returns:
        Gap of each node [m], NaN off the faces, (V,); force of the other body [N], (V, 3).
    """
    element = face_element(faces.shape[1])
    gap, area, force = np.zeros(len(nodes)), np.zeros(len(nodes)), np.zeros_like(nodes)
    for face in faces:
        values, normals = distance(element.shape @ position[face])
        mass, sizes = np.zeros((len(face), len(face))), []
        for shape, slope, weight in zip(
            element.shape, element.gradient, element.weight, strict=True
        ):
            by_r, by_s = slope.T @ nodes[face]
            sizes.append(weight * np.linalg.norm(np.cross(by_r, by_s)))
            mass += sizes[-1] * np.outer(shape, shape)
        dual = np.diag(mass.sum(axis=1)) @ np.linalg.inv(mass)
        for shape, size, value, normal in zip(element.shape, sizes, values, normals, strict=True):
            phi = dual @ shape
            gap[face] += size * value * phi
            force[face] += size * (phi @ pressure[face]) * np.outer(shape, normal)
        area[face] += mass.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return gap / area, force


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.sum(a * b, axis=1, keepdims=True))


def _outer(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[:, :, None] * b[:, None, :])
