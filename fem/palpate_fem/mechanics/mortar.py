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

Distance = Callable[[Floats, float], tuple[Floats, Floats]]
"""Gaps [m], (N,), and their gradients, (N, 3), at points [m], (N, 3).

The second argument is a margin [m]: a gap above it may be any value above it, of any gradient.
"""


class MortarWeights:
    """Dual mortar weights of one surface, on its undeformed faces.

    Attributes:
        nodes: Node ids of the surface, (N,).
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
        self.nodes = np.unique(faces)
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
        gap[self.nodes], normal[self.nodes] = distance(position[self.nodes], near_m)
        touchable = gap < near_m
        near = np.flatnonzero(touchable[faces.T].any(axis=0))
        # One product for all faces is faster than one for each, so points come first: (Q, F', ...).
        faces, weight = faces[near], self.weight[near].transpose(1, 0, 2)
        corners, (points, _) = faces.shape[1], self.shape.shape
        at = (self.shape @ position[faces.T].reshape(corners, -1)).reshape(-1, 3)
        inside, outward = distance(at, np.inf)
        shares = (weight * inside.reshape(points, -1, 1)).sum(axis=0)
        mean = np.bincount(faces.ravel(), shares.ravel(), minlength=len(position))
        offset[touchable] = mean[touchable] / self.area[touchable] - gap[touchable]
        # Force on corner b for a pressure at corner a: at the points, less that at the corner.
        loads = weight[..., None] * outward.reshape(points, -1, 1, 3)
        spread = (self.shape.T @ loads.reshape(points, -1)).reshape(corners, *loads.shape[1:])
        corner = np.arange(corners)
        spread[corner, :, corner] -= (self.corner_area[near][..., None] * normal[faces]).swapaxes(
            0, 1
        )
        held = np.zeros((len(self._faces), points, 3))
        outward[inside < hanging_m] = 0.0
        held[near] = outward.reshape(points, -1, 3).swapaxes(0, 1)
        return MortarCorrection(
            offset[self._faces], self._matrix(spread, near, len(position)), held
        )

    def _matrix(self, spread: Floats, near: NDArray[np.intp], nodes: int) -> sparse.csc_array:
        """`MortarCorrection.spread` of blocks (corner b, F', corner a, 3) of the faces ``near``."""
        corners = self._faces.shape[1]
        entries = np.zeros(self._faces.shape, np.int32)  # of each column
        entries[near] = 3 * corners
        begins = np.concatenate(([0], entries.ravel().cumsum(dtype=np.int32)))
        rows = 3 * self._faces[near].astype(np.int32)[..., None] + np.arange(3, dtype=np.int32)
        rows = np.broadcast_to(rows[:, None], (len(near), corners, corners, 3))
        shape = (3 * nodes, self._faces.size)
        values = spread.transpose(1, 2, 0, 3)
        return sparse.csc_array((values.ravel(), rows.ravel(), begins), shape=shape)
