"""From a state of the skin to the thickness of the fluid film on the core, with gradients.

First the gap: along the core's normal, from each node of the film to the skin's inner surface. Then
the film in that gap: where skin and core touch, asperities of the skin hold a residual film open.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.errors import SimulationError
from palpate_fem.device import indices, launch, scalars, truths, vec3s
from palpate_fem.electrodes.film import FilmMesh
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.mesh.surface import face_vectors
from palpate_fem.result import IndentationStep

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

wp.set_module_options({"enable_backward": False})

OUTSIDE = -1e-9  # a barycentric coordinate below this is outside of its triangle
MOST_STEPS = 60  # of the walk from triangle to triangle; 3 mm of indentation need fewer than 20
TRIED = 256  # nearest triangles that are tried where the walk does not end
# Where the core is cut back below the skin's own edge, a normal may meet the surface far away; such
# a hit is not a film.
REACH_M = 4.0e-3


@wp.kernel
@no_type_check  # Warp's annotations are not types
def walk(
    outside: wp.float64,
    most_steps: int,
    # Film: a point and the core's normal for each thread.
    points: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    # Skin: triangles, and those across the edge opposite to each corner.
    faces: wp.array2d(dtype=wp.int32),
    beside: wp.array2d(dtype=wp.int32),
    position: wp.array(dtype=wp.vec3d),
    # In: triangle to start from. Out: triangle that the normal meets, or where the walk gave up.
    face: wp.array(dtype=wp.int32),
    arrived_out: wp.array(dtype=wp.bool),
    weights_out: wp.array(dtype=wp.vec3d),
    gap_out: wp.array(dtype=wp.float64),
    slope_out: wp.array(dtype=wp.vec3d),
) -> None:
    """Walk from triangle to triangle over the edge with the most negative barycentric coordinate.

    Without a step, the triangles that are given are measured as they are.
    """
    i = wp.tid()
    point, along = points[i], normals[i]
    at = face[i]
    arrived = most_steps == 0
    weights = wp.vec3d()
    a, b, c = wp.vec3d(), wp.vec3d(), wp.vec3d()
    for step in range(most_steps + 1):
        a = position[faces[at, 0]] - point
        b = position[faces[at, 1]] - point
        c = position[faces[at, 2]] - point
        weights = wp.vec3d(
            wp.dot(along, wp.cross(b, c)),
            wp.dot(along, wp.cross(c, a)),
            wp.dot(along, wp.cross(a, b)),
        )
        total = weights[0] + weights[1] + weights[2]
        if wp.abs(total) > wp.float64(1e-30):
            weights = weights / total
        else:
            weights = wp.vec3d()
        if step < most_steps and not arrived:
            worst = wp.argmin(weights)
            if weights[worst] < outside:
                at = beside[at, int(worst)]
            else:
                arrived = True
        if arrived:
            break
    normal = wp.cross(b - a, c - a)
    face[i] = at
    arrived_out[i] = arrived
    weights_out[i] = weights
    gap_out[i] = wp.dot(weights[0] * a + weights[1] * b + weights[2] * c, along)
    slope_out[i] = normal / wp.dot(normal, along)


@dataclass(frozen=True)
class CorePressure:
    """Pressures of the core on the nodes of the skin, and what they were computed from.

    Attributes:
        position: Nodal positions of the skin [m], shape (V, 3).
        force: Nodal forces of the core on the skin [N], shape (V, 3).
        faces: Triangles with a node that carries a force, shape (L, 3).
        area: Area vectors of the nodes that carry a force [m^2], shape (V, 3).
        pressure: Force along the area vector over the area [Pa], shape (V,); not negative.
    """

    position: Floats
    force: Floats
    faces: Ints
    area: Floats
    pressure: Floats

    @classmethod
    def of(cls, position: Floats, force: Floats, faces: Ints) -> CorePressure:
        """Pressures from positions, forces and all triangles of the skin's inner surface."""
        # Only around nodes that carry a force: elsewhere there is no pressure.
        loaded = (force[:, 0] != 0) | (force[:, 1] != 0) | (force[:, 2] != 0)
        one, two, three = loaded[faces].T
        faces = faces[one | two | three]
        share = face_vectors(position, faces) / 3
        area = _summed(faces, np.repeat(share[:, None], 3, axis=1), len(position))
        square = np.maximum(np.einsum("ni,ni->n", area, area), 1e-24)
        pressure = np.maximum(np.einsum("ni,ni->n", force, area) / square, 0.0)
        return cls(position, force, faces, area, pressure)

    def to_force(self, gradient: Floats) -> Floats:
        """Gradient of a scalar by forces [1/N], (V, 3), from that by pressures [1/Pa], (V,)."""
        return self._per_square(gradient)[:, None] * self.area

    def to_skin(self, gradient: Floats) -> Floats:
        """Gradient of a scalar by positions [1/m], (V, 3), from that by pressures [1/Pa], (V,).

        Forces are held, and spread over areas that change.
        """
        by_area = self.force - 2 * self.pressure[:, None] * self.area
        by_area *= self._per_square(gradient)[:, None]
        by_face = by_area[self.faces].sum(axis=1)[:, None] / 6
        corner = self.position[self.faces]
        opposite = np.roll(corner, -1, axis=1) - np.roll(corner, -2, axis=1)
        return _summed(self.faces, np.cross(opposite, by_face), len(self.position))

    def _per_square(self, gradient: Floats) -> Floats:
        square = np.maximum(np.einsum("ni,ni->n", self.area, self.area), 1e-24)
        return np.asarray(np.where(self.pressure > 0, gradient, 0.0) / square)


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
        normals: The core's normals, shape (N, 3).
        contact: Pressures of the skin's nodes, of which `pressure` is interpolated; None = no
            contact, or a gap `for_counts`.
    """

    gap: Floats
    nodes: Ints
    weights: Floats
    slope: Floats
    pressure: Floats
    normals: Floats
    contact: CorePressure | None = None

    def for_counts(self) -> Gap:
        """Without what only derivatives by the skin need: 80 bytes for each of its nodes."""
        return replace(self, contact=None)

    def to_skin(self, by_gap: Floats, count: int, by_pressure: Floats | None = None) -> Floats:
        """Transpose of the derivative: of a scalar by gaps to the same by nodal positions.

        Args:
            by_gap: d scalar / d gap [1/m], shape (N,).
            count: Nodes of the skin V.
            by_pressure: d scalar / d pressure [1/Pa], shape (N,); None = pressures are held.

        Returns:
            d scalar / d position [1/m], shape (V, 3), with the core's nodal forces held.
        """
        # A point of the skin that moves by u changes the gap by slope . u.
        by_point = by_gap[:, None] * self.slope
        contact = self.contact
        if contact is None or by_pressure is None:
            return _summed(self.nodes, self.weights[:, :, None] * by_point[:, None], count)
        # Pressures are linear in a triangle, and the normal meets another point of it: the place
        # moves by slope . u along the normal, and the triangle by u.
        pressed = np.flatnonzero(contact.pressure[self.nodes].any(axis=1) & (by_pressure != 0))
        rise = self._rise(contact, pressed)
        along = np.einsum("ni,ni->n", rise, self.normals[pressed])
        by_point[pressed] += by_pressure[pressed, None] * (
            along[:, None] * self.slope[pressed] - rise
        )
        moved = _summed(self.nodes, self.weights[:, :, None] * by_point[:, None], count)
        return moved + contact.to_skin(self._to_nodes(by_pressure, count))

    def to_core_force(self, by_pressure: Floats, count: int) -> Floats:
        """Gradient of a scalar by the core's nodal forces, with positions held.

        Args:
            by_pressure: d scalar / d pressure [1/Pa], shape (N,).
            count: Nodes of the skin V.

        Returns:
            d scalar / d force [1/N], shape (V, 3); zero where there is no force, because contact
            does not begin there.
        """
        if self.contact is None:
            return np.zeros((count, 3))
        return self.contact.to_force(self._to_nodes(by_pressure, count))

    def _to_nodes(self, by_pressure: Floats, count: int) -> Floats:
        shares = (self.weights * by_pressure[:, None]).ravel()
        return np.asarray(np.bincount(self.nodes.ravel(), shares, count), np.float64)

    def _rise(self, contact: CorePressure, some: NDArray[np.int64]) -> Floats:
        """Gradient of the pressure within the triangles of some film nodes [Pa/m], shape (S, 3)."""
        corner = contact.position[self.nodes[some]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        opposite = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)
        across = np.einsum("nk,nki->ni", contact.pressure[self.nodes[some]], opposite)
        return np.asarray(np.cross(normal, across) / (normal**2).sum(axis=1)[:, None])


def _summed(nodes: Ints, parts: Floats, count: int) -> Floats:
    """Sums of vectors by node, shape (V, 3).

    Args:
        nodes: Node of each vector, shape (N, 3).
        parts: Vectors, shape (N, 3, 3).
        count: Nodes V.
    """
    total = np.empty((count, 3))
    for i in range(3):
        total[:, i] = np.bincount(nodes.ravel(), parts[:, :, i].ravel(), count)
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
        position = np.ascontiguousarray(position, np.float64)
        face, count = self._start.copy(), len(self._start)
        arrived = np.empty(count, np.bool_)
        weights, gap, slope = np.empty((count, 3)), np.empty(count), np.empty((count, 3))

        def measure(most_steps: int) -> None:
            film = (vec3s(self.film.nodes), vec3s(self.film.normals))
            skin = (indices(self.faces), indices(self._beside), vec3s(position))
            out = [indices(face), truths(arrived), vec3s(weights), scalars(gap), vec3s(slope)]
            launch(walk, count, [OUTSIDE, most_steps, *film, *skin], out)

        measure(MOST_STEPS)
        if not arrived.all():
            lost = np.flatnonzero(~arrived)
            face[lost] = self._search(position, lost)
            measure(0)
        nodes = self.faces[face]
        pressure, contact = np.zeros(count), None
        if core_force is not None and np.any(core_force):
            contact = CorePressure.of(position, np.asarray(core_force, np.float64), self.faces)
            pressure = np.einsum("nk,nk->n", weights, contact.pressure[nodes])
        return Gap(gap, nodes, weights, slope, pressure, self.film.normals, contact)

    def of_step(self, rest: Floats, step: IndentationStep) -> Gap:
        """Gaps of a simulated step.

        Args:
            rest: Nodal positions of the pressurised, untouched skin [m], shape (V, 3).
            step: Its displacement and core forces are used.
        """
        return self.measure(rest + step.displacement, step.core_force)

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


def gap_adjustment(
    points: Floats, normals: Floats, specimen: SpecimenParameters
) -> tuple[Floats, Floats]:
    """How a specimen's gap differs from that of the mechanics, which all specimens share.

    Behind the clamp's edge skin and core are anchored together, as in the paper's model ("Finite
    element model configuration", boundary condition 1), which closes the film there. At the sides
    specimens differ: real ones rise by up to 0.17 of full scale where the skin bulges, which needs
    films of 0.05-0.2 mm at rest (learning notes, section 4.4). Under the pad the fill decides.

    A core that sits elsewhere in the skin (`core_offset_m`) is nearer to it by the part of its
    offset along the normal, and the clamp holds both behind its edge. Real sensors differ in it:
    on one E1 rests 260 counts above its mirror image E11, on its neighbour as much below.

    Args:
        points: Nodes of the film [m], shape (N, 3), sensor frame.
        normals: Of the core there, shape (N, 3).
        specimen: Its `clamp_closing`, `side_closing_m` and `core_offset_m` are used.

    Returns:
        The share of the gap that stays open [1], and how much closer to the core the specimen's
        skin is [m], both of shape (N,): its gap is share * gap - closer.
    """
    behind, sides = gap_profiles(points)
    share = 1 - specimen.clamp_closing * behind
    nearer = specimen.side_closing_m * sides
    return share, nearer + share * (normals @ np.array(specimen.core_offset_m))


def gap_profiles(points: Floats) -> tuple[Floats, Floats]:
    """How far points are behind the clamp's edge and to the sides, 0 to 1, both of shape (N,)."""
    x, y, z = points.T
    behind = 0.5 * (1 + np.tanh((CLAMP_X_M - x) / (2 * CLAMP_BLEND_M)))
    angle = np.arctan2(np.abs(y), -z)
    low, high = SIDES_RAD
    t = np.clip((angle - low) / (high - low), 0.0, 1.0)
    return behind, t * t * (3 - 2 * t)


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
