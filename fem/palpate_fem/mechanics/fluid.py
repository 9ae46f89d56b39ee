"""NumPy twin of the fluid kernels: the volume that a surface encloses, and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mechanics.reference_element import face_element

Floats = NDArray[np.float64]


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
