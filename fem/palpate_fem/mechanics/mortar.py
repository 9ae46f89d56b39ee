"""Mortar contact: what the faces between the nodes add to contact at the nodes.

Nodes that touch a curved indenter put the faces between them *inside* it, so too little skin is
pushed aside: with elements of the usual size, a ball that squeezes a layer meets 5 % too little
force, one that pinches the finger 14 %. The gap that must not become negative is therefore a
weighted mean over the faces around a node::

    g^_I = int Phi_I g dA / A_I ,   A_I = int N_I dA

with dual shape functions Phi (Wohlmuth 2000: int Phi_I N_J dA = delta_IJ int N_I dA, face by face),
and its pressure loads the skin where the faces are, as the derivative of g^ says::

    f_J = sum_I p_I int Phi_I n N_J dA

The forces are evaluated where the faces are (``contact_kernels``); at constant pressures their
derivative couples the nodes of one face. The rest of the derivative would couple nodes that are two
faces apart, which the tangent's pattern does not. So contact at the nodes has a *correction*,
evaluated at the start of an increment and again near its solution
(`NewtonSettings.mortar_updates`): an offset of each node's gap, and a matrix by which linear
solutions tell how forces follow the pressures and, transposed, how the offsets follow a change of
the nodes (ADR 0023).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate_fem.arrays import Floats, Ints
from palpate_fem.mechanics.reference_element import face_element, point_areas
from palpate_fem.mechanics.state import MortarCorrection

HANGING_M = 0.3e-3
"""Gap from which on the direction at a quadrature point is held over an increment [m].

So far above a valley between two grains of `texture`, the direction of the distance jumps from one
side to the other where the point moves by a micrometre, and with it the forces: Newton's method
would cycle. Where there is no valley, holding would only make corrections converge slowly.
"""

Distance = Callable[[Floats], tuple[Floats, Floats]]
"""Gaps [m], (N,), and their gradients, (N, 3), at points [m], (N, 3)."""


class MortarWeights:
    """Dual mortar weights of one surface, on its undeformed faces.

    Attributes:
        shape: Shape functions of a face at its quadrature points, (Q, k).
        weight: Dual shape function of each corner times the area of each quadrature point [m^2],
            (F, Q, k).
        corner_area: Integral of each corner's shape function [m^2], (F, k).
        area: The same of each node, over its faces [m^2], (V,).
    """

    def __init__(self, nodes: Floats, faces: Ints) -> None:
        """Integrate over the faces.

        Args:
            nodes: Undeformed positions [m], (V, 3).
            faces: Node ids, (F, k).
        """
        element = face_element(faces.shape[1])
        self._faces, self.shape = faces, element.shape
        size = point_areas(nodes, faces)
        self.corner_area = np.einsum("fq,qa->fa", size, element.shape)
        mass = np.einsum("fq,qa,qb->fab", size, element.shape, element.shape)
        dual = self.corner_area[:, :, None] * np.linalg.inv(mass)
        self.weight = np.einsum("fq,fab,qb->fqa", size, dual, element.shape)
        self._nodes = np.unique(faces)
        self.area = np.zeros(len(nodes))
        np.add.at(self.area, faces, self.corner_area)

    def correction(
        self, position: Floats, distance: Distance, near_m: float, hanging_m: float = np.inf
    ) -> MortarCorrection:
        """What mortar contact adds to contact at the nodes.

        Args:
            position: Of all nodes [m], (V, 3).
            distance: To the other body.
            near_m: Gap from which on a node cannot touch [m].
            hanging_m: Gap from which on the direction at a quadrature point is held [m].
        """
        faces = self._faces
        offset = np.zeros(len(position))
        gap, normal = np.full(len(position), np.inf), np.zeros(position.shape)
        gap[self._nodes], normal[self._nodes] = distance(position[self._nodes])
        touchable = gap < near_m
        near = np.flatnonzero(touchable[faces].any(axis=1))
        faces, weight = faces[near], self.weight[near]
        points = np.einsum("qa,fai->fqi", self.shape, position[faces])
        inside, outward = distance(points.reshape(-1, 3))
        mean = np.zeros(len(position))
        np.add.at(mean, faces, np.einsum("fqa,fq->fa", weight, inside.reshape(points.shape[:2])))
        offset[touchable] = mean[touchable] / self.area[touchable] - gap[touchable]
        # Force on corner b for a pressure at corner a: at the points, less that at the corner.
        spread = np.einsum("fqa,qb,fqi->fabi", weight, self.shape, outward.reshape(points.shape))
        corner = np.arange(faces.shape[1])
        spread[:, corner, corner] -= self.corner_area[near][..., None] * normal[faces]
        held = np.zeros((len(self._faces), *points.shape[1:]))
        outward[inside < hanging_m] = 0.0
        held[near] = outward.reshape(points.shape)
        return MortarCorrection(
            offset[self._faces], self._matrix(spread, near, len(position)), held
        )

    def _matrix(self, spread: Floats, near: NDArray[np.intp], nodes: int) -> sparse.csr_array:
        """`MortarCorrection.spread` of blocks (F', k, k, 3) of the faces ``near``, (F',)."""
        corners = self._faces.shape[1]
        row = 3 * self._faces[near][:, None, :, None] + np.arange(3)
        column = corners * near[:, None] + np.arange(corners)
        places = (
            np.broadcast_to(row, spread.shape).ravel(),
            np.broadcast_to(column[:, :, None, None], spread.shape).ravel(),
        )
        shape = (3 * nodes, self._faces.size)
        return sparse.coo_array((spread.ravel(), places), shape=shape).tocsr()
