"""How far the skin stands off the core at each node of the film, with gradients.

Along the core's normal from a node of the film to the skin's inner surface; which triangle is met,
and where, is found anew for every state, starting from the unpressurised one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.errors import SimulationError
from palpate_fem.electrodes.film import FilmMesh
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.mesh.surface import face_vectors
from palpate_fem.result import IndentationStep

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

OUTSIDE = -1e-9  # a barycentric coordinate below is outside
MOST_STEPS = 60  # from triangle to triangle; an indentation of 3 mm needs fewer than 20
TRIED = 256  # nearest triangles that are tried where that does not end
# Where the core is cut back below the skin's own edge a line may meet the surface far away.
REACH_M = 4.0e-3


@dataclass(frozen=True)
class Gap:
    """Gap between core and skin in one state.

    Attributes:
        gap: Along the core's normal [m], shape (N,); negative where the skin is in the core.
        nodes: Skin nodes of the triangle that each normal meets, shape (N, 3).
        weights: Its barycentric coordinates there, shape (N, 3).
        slope: d gap / d (point of the skin), shape (N, 3): the triangle's normal over its part
            along the core's.
        pressure: Of the core on the skin there, above the fluid's [Pa], shape (N,).
    """

    gap: Floats
    nodes: Ints
    weights: Floats
    slope: Floats
    pressure: Floats

    def to_skin(self, gradient: Floats, count: int) -> Floats:
        """Transpose of the derivative: of a scalar by gaps to the same by nodal positions.

        Args:
            gradient: d scalar / d gap [1/m], shape (N,).
            count: Nodes of the skin V.

        Returns:
            d scalar / d position [1/m], shape (V, 3).
        """
        parts = (gradient[:, None] * self.weights)[:, :, None] * self.slope[:, None]
        total = np.zeros((count, 3))
        for i in range(3):
            total[:, i] = np.bincount(self.nodes.ravel(), parts[:, :, i].ravel(), count)
        return total

    def along(self, motion: Floats) -> Floats:
        """Change of the gap [m], shape (N,), with small nodal displacements (V, 3) [m]."""
        moved = np.einsum("nk,nki->ni", self.weights, motion[self.nodes])
        return np.asarray(np.einsum("ni,ni->n", moved, self.slope))


class GapFinder:
    """From states of a skin to gaps at the nodes of a film."""

    def __init__(self, film: FilmMesh, skin: SolidMesh) -> None:
        """Find where the core's normals meet the unpressurised skin.

        Args:
            film: The film.
            skin: The skin, in the same frame.

        Raises:
            SimulationError: They do not belong together: a normal misses the skin.
        """
        faces = skin.inner_faces
        if faces.shape[1] == 4:
            faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
        self.film, self.faces, self.count = film, faces, len(skin.nodes)
        self._beside = _neighbours(faces)
        self._start = self._search(skin.nodes, np.arange(len(film.nodes)))

    def measure(self, position: Floats, core_force: Floats | None = None) -> Gap:
        """Gaps of one state.

        Args:
            position: Nodal positions of the skin [m], shape (V, 3), sensor frame.
            core_force: Nodal forces of the core on the skin [N], shape (V, 3); None = no contact.

        Raises:
            SimulationError: A normal of the core misses the skin: it is folded or torn.
        """
        position = np.asarray(position, np.float64)
        face = self._start.copy()
        active = np.arange(len(face))
        for _ in range(MOST_STEPS):
            weights, _ = self._meet(position, active, face[active])
            worst = weights.argmin(axis=1)
            out = weights[np.arange(len(active)), worst] < OUTSIDE
            active = active[out]
            if not len(active):
                break
            face[active] = self._beside[face[active], worst[out]]
        if len(active):
            face[active] = self._search(position, active)
        weights, normal = self._meet(position, np.arange(len(face)), face)
        nodes = self.faces[face]
        foot = np.einsum("nk,nki->ni", weights, position[nodes])
        gap = np.einsum("ni,ni->n", foot - self.film.nodes, self.film.normals)
        along = np.einsum("ni,ni->n", normal, self.film.normals)
        pressure = np.zeros(len(gap))
        if core_force is not None:
            nodal = self._pressure(position, np.asarray(core_force, np.float64))
            pressure = np.einsum("nk,nk->n", weights, nodal[nodes])
        return Gap(gap, nodes, weights, normal / along[:, None], pressure)

    def of_step(self, rest: Floats, step: IndentationStep) -> Gap:
        """Gaps of a simulated step.

        Args:
            rest: Nodal positions of the pressurised, untouched skin [m], shape (V, 3).
            step: Its displacement and core forces are used.
        """
        return self.measure(rest + step.displacement, step.core_force)

    def _pressure(self, position: Floats, force: Floats) -> Floats:
        """Nodal force along the surface's normal over the node's area [Pa], shape (V,)."""
        share = face_vectors(position, self.faces) / 3
        vector = np.zeros((self.count, 3))
        for i in range(3):
            vector[:, i] = np.bincount(self.faces.ravel(), np.repeat(share[:, i], 3), self.count)
        square = np.maximum(np.einsum("ni,ni->n", vector, vector), 1e-24)
        return np.asarray(np.maximum(np.einsum("ni,ni->n", force, vector) / square, 0.0))

    def _meet(self, position: Floats, rays: NDArray[np.int64], face: Ints) -> tuple[Floats, Floats]:
        """Barycentric coordinates where normals meet the planes of triangles, and area vectors."""
        corner = position[self.faces[face]] - self.film.nodes[rays][:, None]
        along = self.film.normals[rays]
        a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
        parts = [np.einsum("ni,ni->n", along, np.cross(*pair)) for pair in ((b, c), (c, a), (a, b))]
        share = np.stack(parts, axis=1)
        total = share.sum(axis=1)
        safe = np.where(np.abs(total) > 1e-30, total, np.inf)
        return share / safe[:, None], np.cross(b - a, c - a)

    def _search(self, position: Floats, rays: NDArray[np.int64]) -> Ints:
        """Nearest triangle that each of some normals meets from inside, by trying many."""
        tree = cKDTree(position[self.faces].mean(axis=1))
        tried = min(TRIED, len(self.faces))
        _, near = tree.query(self.film.nodes[rays], k=tried)
        flat, again = near.ravel(), np.repeat(rays, tried)
        weights, normal = self._meet(position, again, flat)
        foot = np.einsum("nk,nki->ni", weights, position[self.faces[flat]])
        along = self.film.normals[again]
        gap = np.einsum("ni,ni->n", foot - self.film.nodes[again], along)
        fits = (weights.min(axis=1) > -1e-6) & (np.einsum("ni,ni->n", normal, along) > 0)
        cost = np.where(fits, np.abs(gap), np.inf).reshape(-1, tried)
        if not (cost.min(axis=1) < REACH_M).all():
            missed = rays[~(cost.min(axis=1) < REACH_M)]
            raise SimulationError(
                f"{len(missed)} normals of the core miss the skin, the first at "
                f"{np.round(self.film.nodes[missed[0]] * 1e3, 2)} mm",
                remedy="check that skin and core belong together and the skin is not folded",
            )
        return np.asarray(near[np.arange(len(rays)), cost.argmin(axis=1)], np.int32)


def _neighbours(faces: Ints) -> Ints:
    """Triangle across the edge opposite to each corner, shape (F, 3)."""
    pairs = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=2)
    count = int(faces.max()) + 1
    key = (pairs.min(axis=2).astype(np.int64) * count + pairs.max(axis=2)).ravel()
    order = np.argsort(key, kind="stable")
    twice = np.flatnonzero(np.diff(key[order]) == 0)
    beside = np.repeat(np.arange(len(faces), dtype=np.int32), 3)  # at an open edge: stay
    one, other = order[twice], order[twice + 1]
    beside[one], beside[other] = other // 3, one // 3
    return beside.reshape(-1, 3)
