"""Shape functions and quadrature of the two solid elements and their faces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np

from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.solid import SolidMesh

_GAUSS = 1.0 / np.sqrt(3.0)
_CORNERS = np.array(
    [(-1, -1), (1, -1), (1, 1), (-1, 1)], np.float64
)  # corners of a quadrilateral, counter-clockwise
# Three points inside a triangle (degree 2) and their weights; Strang and Fix.
_TRIANGLE_POINTS = np.array([(1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3)])


@dataclass(frozen=True, slots=True)
class ReferenceElement:
    """Values at quadrature points on the reference element.

    Attributes:
        shape: Shape functions, (Q, n).
        gradient: Their derivatives by the reference coordinates, (Q, n, d).
        weight: Quadrature weights, (Q,).
    """

    shape: Floats
    gradient: Floats
    weight: Floats


def quadrilateral_at(points: Floats) -> tuple[Floats, Floats]:
    """Bilinear shape functions (Q, 4) and their derivatives (Q, 4, 2) at points (Q, 2)."""
    xi, eta = points[:, :1], points[:, 1:]
    a, b = _CORNERS[:, 0], _CORNERS[:, 1]
    shape = (1 + a * xi) * (1 + b * eta) / 4
    return shape, np.stack([a * (1 + b * eta) / 4, b * (1 + a * xi) / 4], axis=-1)


def triangle_at(points: Floats) -> tuple[Floats, Floats]:
    """Linear shape functions (Q, 3) and their derivatives (Q, 3, 2) at points (Q, 2)."""
    r, s = points[:, 0], points[:, 1]
    shape = np.stack([1 - r - s, r, s], axis=-1)
    gradient = np.array([(-1.0, -1.0), (1.0, 0.0), (0.0, 1.0)])
    return shape, np.broadcast_to(gradient, (len(points), 3, 2)).copy()


@cache
def face_element(nodes: int) -> ReferenceElement:
    """Quadrilateral (2 x 2 Gauss) or triangle (3 points): degree 3 and 2, exact for both."""
    if nodes == 4:
        points = np.array([(a, b) for b, a in product((-_GAUSS, _GAUSS), repeat=2)])
        return ReferenceElement(*quadrilateral_at(points), np.ones(4))
    if nodes == 3:
        return ReferenceElement(*triangle_at(_TRIANGLE_POINTS), np.full(3, 1 / 6))
    raise ValueError(f"no face with {nodes} nodes")


def point_areas(position: Floats, faces: Ints) -> Floats:
    """Area that each quadrature point of a face stands for [m^2], (F, Q).

    Args:
        position: Of the nodes [m], (V, 3).
        faces: Node ids, (F, k).
    """
    element = face_element(faces.shape[1])
    edges = np.einsum("qad,fai->fqdi", element.gradient, position[faces])
    size = np.linalg.norm(np.cross(edges[:, :, 0], edges[:, :, 1]), axis=2)
    return np.asarray(element.weight * size)


@cache
def solid_element(nodes: int) -> ReferenceElement:
    """Hexahedron (2 x 2 x 2 Gauss) or wedge (3 x 2): integrate the element volume exactly."""
    if nodes not in (8, 6):
        raise ValueError(f"no solid element with {nodes} nodes")
    face = face_element(nodes // 2)
    shape, gradient, weight = [], [], []
    for zeta in (-_GAUSS, _GAUSS):
        below, above = (1 - zeta) / 2, (1 + zeta) / 2
        shape.append(np.concatenate([face.shape * below, face.shape * above], axis=1))
        along = np.concatenate([-face.shape / 2, face.shape / 2], axis=1)
        across = np.concatenate([face.gradient * below, face.gradient * above], axis=1)
        gradient.append(np.concatenate([across, along[:, :, None]], axis=2))
        weight.append(face.weight)
    return ReferenceElement(np.concatenate(shape), np.concatenate(gradient), np.concatenate(weight))


@cache
def volume_form(nodes: int) -> Floats:
    """Form C of the volume under a face, V = sum_abc C_abc x_a . (x_b x x_c), (k, k, k).

    By the divergence theorem V is one third of the integral of x . n dA; exact for triangles and
    bilinear quadrilaterals. C is fully antisymmetric, so dV/dx_a = 3 sum_bc C_abc x_b x x_c, and
    the second derivative is skew.
    """
    face = face_element(nodes)
    shape, gradient = face.shape, face.gradient
    raw = np.einsum("q,qa,qb,qc->abc", face.weight, shape, gradient[..., 0], gradient[..., 1]) / 3
    signs = (
        raw - raw.transpose(0, 2, 1) + raw.transpose(1, 2, 0)
        - raw.transpose(1, 0, 2) + raw.transpose(2, 0, 1) - raw.transpose(2, 1, 0)
    )  # fmt: skip
    return np.asarray(signs / 6)


@cache
def corner_element(nodes: int) -> ReferenceElement:
    """Face with its corners as quadrature points, for contact (Lobatto 2 x 2; vertex rule)."""
    if nodes == 4:
        return ReferenceElement(*quadrilateral_at(_CORNERS), np.ones(4))
    points = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
    return ReferenceElement(*triangle_at(points), np.full(3, 1 / 6))


def rest_gradients(mesh: SolidMesh) -> tuple[Floats, Floats]:
    """Gradients of the shape functions on the undeformed mesh, (E, Q, n, 3), and w detJ, (E, Q)."""
    element = solid_element(mesh.elements.shape[1])
    corners = mesh.nodes[mesh.elements]
    jacobian = np.einsum("eai,qad->eqid", corners, element.gradient)
    determinant = np.linalg.det(jacobian)
    gradient = np.einsum("qad,eqdi->eqai", element.gradient, np.linalg.inv(jacobian))
    return np.ascontiguousarray(gradient), element.weight * determinant
