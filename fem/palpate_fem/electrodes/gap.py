"""From a state of the skin to the thickness of the fluid film on the core, with gradients.

First the gap: along the core's normal, from each node of the film to the skin's inner surface. Then
the film in that gap: where skin and core touch, asperities of the skin hold a residual film open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.errors import SimulationError
from palpate_fem.electrodes.film import FilmMesh
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.mesh.surface import face_vectors
from palpate_fem.result import IndentationStep

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

OUTSIDE = -1e-9  # a barycentric coordinate below this is outside of its triangle
MOST_STEPS = 60  # of the walk from triangle to triangle; 3 mm of indentation need fewer than 20
TRIED = 256  # nearest triangles that are tried where the walk does not end
# Where the core is cut back below the skin's own edge, a normal may meet the surface far away; such
# a hit is not a film.
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


class GapFinder:
    """Measures gaps of a skin at the nodes of a film.

    A film node keeps its normal, but the skin slides along it: which triangle the normal meets is
    found anew for every state, by a walk over neighbours from the triangle of the unpressurised
    skin.
    """

    def __init__(self, film: FilmMesh, skin: SolidMesh) -> None:
        """Find where the core's normals meet the unpressurised skin.

        Args:
            film: The film.
            skin: The skin, in the same frame.

        Raises:
            SimulationError: A normal misses the skin: film and skin do not belong together.
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
            SimulationError: A normal of the core misses the skin: the skin is folded or torn.
        """
        position = np.asarray(position, np.float64)
        face = self._start.copy()
        # Walk from triangle to triangle over the edge with the most negative barycentric
        # coordinate.
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
        """The nearest triangle that each of these normals meets from inside, by trying many."""
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
    beside = np.repeat(np.arange(len(faces), dtype=np.int32), 3)  # at an open edge the walk stays
    one, other = order[twice], order[twice + 1]
    beside[one], beside[other] = other // 3, one // 3
    return beside.reshape(-1, 3)


# Width over which max(gap, 0) is rounded: contacts of the mechanics penetrate by 0.5e-6 m, so a
# sharp bend would make counts jump there.
ROUNDING_M = 1e-6

# The public clamp begins here (mesh.parametric: NAIL_X_M); E19's disc ends 0.9 mm behind it.
CLAMP_X_M, CLAMP_BLEND_M = -13.96e-3, 0.7e-3
# Angle about the core's axis from the ventral midline between which the sides begin: E2..E5 lie at
# 44 degrees, E1, E4, E6 at 77.
SIDES_RAD = (0.85, 1.25)


def gap_adjustment(points: Floats, specimen: SpecimenParameters) -> tuple[Floats, Floats]:
    """How a specimen's gap differs from that of the mechanics, which all specimens share.

    Behind the clamp's edge skin and core are anchored together, as in the paper's model ("Finite
    element model configuration", boundary condition 1), which closes the film there. At the sides
    specimens differ: real ones rise by up to 0.17 of full scale where the skin bulges, which needs
    films of 0.05-0.2 mm at rest (learning notes, section 4.4). Under the pad the fill decides.

    Args:
        points: Nodes of the film [m], shape (N, 3), sensor frame.
        specimen: Its `clamp_closing` and `side_closing_m` are used.

    Returns:
        The share of the gap that stays open [1], and how much closer to the core the specimen's
        skin is [m], both of shape (N,): its gap is share * gap - closer.
    """
    x, y, z = points.T
    behind = 0.5 * (1 + np.tanh((CLAMP_X_M - x) / (2 * CLAMP_BLEND_M)))
    angle = np.arctan2(np.abs(y), -z)
    low, high = SIDES_RAD
    t = np.clip((angle - low) / (high - low), 0.0, 1.0)
    return 1 - specimen.clamp_closing * behind, specimen.side_closing_m * t * t * (3 - 2 * t)


def thickness(
    gap: Floats, pressure: Floats, specimen: SpecimenParameters
) -> tuple[Floats, Floats, Floats]:
    """Thickness of the film in a gap.

    The skin of the mechanics is the plane through the tips of the inner surface's asperities.
    Between them fluid stays, and the less the harder they are pressed (learning notes, section
    4.4)::

        h = max(gap, 0) + floor + (asperity - floor) / (1 + p / p0)^m

    Args:
        gap: Between core and skin [m], shape (...); negative where they are in contact.
        pressure: Of the core on the skin [Pa], same shape, not negative.
        specimen: Its asperity, floor and squeeze parameters are used.

    Returns:
        Thickness h [m], dh/d gap and dh/d pressure [m/Pa], each of the same shape.
    """
    # A softplus instead of max(gap, 0): its slope is needed for gradients, and is continuous.
    t = gap / ROUNDING_M
    above, slope = ROUNDING_M * np.logaddexp(0.0, t), 0.5 * (1 + np.tanh(t / 2))
    squeezed = 1 + pressure / specimen.squeeze_pa
    left = (specimen.asperity_m - specimen.floor_m) * squeezed**-specimen.squeeze_exponent
    by_pressure = -specimen.squeeze_exponent * left / (squeezed * specimen.squeeze_pa)
    return above + specimen.floor_m + left, slope, by_pressure
