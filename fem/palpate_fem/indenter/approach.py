"""First contact of a moving indenter with a surface, and the check that it starts outside."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.errors import SimulationError
from palpate.rigid import rotation_matrices, to_local, unit
from palpate_fem.arrays import Floats, Ints
from palpate_fem.indenter.distance import TOUCH_M, first_touch, signed_distance
from palpate_fem.indenter.shape import Indenter, PrimitiveKind

_LARGE_M = 1.5e-3  # a face from this size on may be touched far from its corners
_LEVELS = (3, 9, 25)  # points along a face's edge


@dataclass(frozen=True)
class OuterSurface:
    """The outer surface of a fingertip.

    Attributes:
        nodes: Positions [m], shape (V, 3), sensor frame.
        faces: Triangles or bilinear quadrilaterals, normals outwards, shape (F, 3) or (F, 4).
    """

    nodes: Floats
    faces: Ints

    def samples(self, count: int, faces: NDArray[np.intp] | None = None) -> Floats:
        """Points on the faces, their edges included, (F, S, 3); count of them along an edge."""
        chosen = self.faces if faces is None else self.faces[faces]
        part = np.linspace(0.0, 1.0, count)
        u, v = np.tile(part, count), np.repeat(part, count)
        if self.faces.shape[1] == 3:
            keep = u + v <= 1.0 + 1e-12
            u, v = u[keep], v[keep]
            weights = np.stack([1.0 - u - v, u, v])
        else:
            weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])
        return np.asarray(np.einsum("ks,fki->fsi", weights, self.nodes[chosen]))

    @cached_property
    def triangles(self) -> Ints:
        """Corners of the faces, each quadrilateral as two triangles, shape (N, 3)."""
        if self.faces.shape[1] == 3:
            return self.faces
        return np.concatenate([self.faces[:, :3], self.faces[:, [0, 2, 3]]])

    @cached_property
    def used(self) -> NDArray[np.integer]:
        """Numbers of the nodes that are a face's corner, ascending."""
        return np.unique(self.faces)

    def at_corners(self, values: Floats) -> Floats:
        """Values of the nodes in ``used``, (N,), at each face's corners, (F, 3) or (F, 4)."""
        at_nodes = np.empty(len(self.nodes))
        at_nodes[self.used] = values
        return at_nodes[self.faces]

    @cached_property
    def sizes(self) -> Floats:
        """Of each face the largest distance between opposite corners [m], shape (F,)."""
        corner = self.nodes[self.faces]
        across = corner - np.roll(corner, -2, axis=1)
        return np.asarray(np.linalg.norm(across, axis=2).max(axis=1))


def first_contact(
    indenter: Indenter,
    quaternion: Floats,
    target: ArrayLike,
    direction: ArrayLike,
    surface: OuterSurface,
) -> float:
    """Travel of the tip beyond a target at which the indenter first touches the surface.

    Args:
        indenter: The indenter, coming from far away.
        quaternion: Its orientation w x y z, shape (4,).
        target: Point of the sensor frame through which the tip's line goes [m], shape (3,).
        direction: Where it moves, sensor frame, shape (3,).
        surface: What it touches; faces are used, not only their corners.

    Returns:
        Travel [m], negative where it touches before its tip reaches the target.

    Raises:
        SimulationError: It passes the surface without contact.
    """
    turn = rotation_matrices(quaternion)
    target = np.asarray(target, np.float64)
    move = turn.T @ unit(direction)  # per metre, indenter frame
    sizes = surface.sizes
    large = np.flatnonzero(sizes > _LARGE_M)
    points = surface.nodes[surface.used]
    if len(large):
        count = min(2 + int(sizes.max() / _LARGE_M), 33)
        points = np.concatenate([points, surface.samples(count, large).reshape(-1, 3)])
    points = (points - target) @ turn
    along = points @ move
    start = float(along.min()) - _reach(indenter)
    end = float(along.max()) + _reach(indenter)

    # A few points give an upper limit of the travel, with which most of the others are dropped.
    limit = first_touch(indenter, points[:: max(1, len(points) // 200)], move, start, end)
    limit = first_touch(indenter, points, move, start, limit)
    # A face may be touched between its samples. There the gap is smaller than at the nearest sample
    # by at most their distance, so only faces with a gap below the spacing are sampled more finely.
    faces, spacing = np.arange(len(surface.faces)), 2.0 * sizes
    on_skin = points[: len(surface.used)] - limit * move
    gap = surface.at_corners(signed_distance(indenter, on_skin, spacing.max()))
    for count in _LEVELS:
        near = gap.min(axis=1) < spacing
        faces, spacing = faces[near], sizes[faces[near]] / (count - 1)
        samples = (surface.samples(count, faces) - target) @ turn
        limit = first_touch(indenter, samples.reshape(-1, 3), move, start, limit)
        if count == _LEVELS[-1]:
            break
        shifted = (samples - limit * move).reshape(-1, 3)
        gap = signed_distance(indenter, shifted, spacing.max(initial=0.0))
        gap = gap.reshape(samples.shape[:2])
    if limit >= end:
        raise SimulationError(
            f"indenter {indenter.name!r} passes the fingertip without touching it",
            remedy="aim at a point of the skin, along a direction that leads into it",
        )
    return limit


def check_clear(indenter: Indenter, pose: Floats, surface: OuterSurface) -> float:
    """Check that an indenter is outside the fingertip and does not touch it.

    Args:
        indenter: The indenter.
        pose: Position [m] and unit quaternion w x y z, sensor frame, shape (7,).
        surface: Outer surface of the pressurised skin.

    Returns:
        Smallest gap [m] at corners, middles and edge middles of faces: a little too large.

    Raises:
        SimulationError: It touches or is inside; says by how much.
    """
    on_skin = to_local(pose, surface.nodes[surface.used])
    at_corners = surface.at_corners(signed_distance(indenter, on_skin)).min(axis=1)
    # Nowhere on a face is the gap smaller than at its corners by more than its size.
    near = np.flatnonzero(at_corners - surface.sizes <= at_corners.min())
    points = surface.samples(_LEVELS[0], near).reshape(-1, 3)
    gap = float(signed_distance(indenter, to_local(pose, points)).min())
    if gap <= 0.0:
        raise SimulationError(
            f"at the first pose indenter {indenter.name!r} is {-gap * 1e3:.3f} mm inside the skin"
            if gap < 0.0
            else f"at the first pose indenter {indenter.name!r} touches the skin",
            remedy=f"begin the path at least {-gap * 1e3 + 0.05:.2f} mm further out",
        )
    # It is clear of the skin, so all of it is on one side: test one of its points.
    inner = rotation_matrices(pose[3:]) @ _point_of(indenter) + pose[:3]
    corner = surface.nodes[surface.faces]
    away = inner - corner.mean(axis=1)
    nearest = int(np.einsum("fi,fi->f", away, away).argmin())
    normal = np.cross(
        corner[nearest, 2] - corner[nearest, 0], corner[nearest, -1] - corner[nearest, 1]
    )
    if normal @ away[nearest] < 0.0:
        raise SimulationError(
            f"at the first pose all of indenter {indenter.name!r} is inside the finger",
            remedy="begin the path outside; positions are in metres, sensor frame",
        )
    return gap


def _point_of(indenter: Indenter) -> Floats:
    """A point inside the indenter [m], indenter frame (the tip of a ring lies outside)."""
    part = indenter.primitives[0]
    point = np.array(part.centre)
    if part.kind == PrimitiveKind.REVOLVED:
        point[part.axis] += (part.sizes[2] + part.sizes[3]) / 2
        point[(part.axis + 1) % 3] += (part.sizes[0] + part.sizes[1]) / 2
    return point


def _reach(indenter: Indenter) -> float:
    """Radius of a ball about the tip that holds the indenter [m]."""
    far = []
    for part in indenter.primitives:
        if part.kind == PrimitiveKind.BOX:
            size = float(np.linalg.norm(part.sizes[:3]))
        else:
            size = float(np.hypot(part.sizes[1], max(abs(part.sizes[2]), abs(part.sizes[3]))))
        far.append(float(np.linalg.norm(part.centre)) + size + part.rounding)
    return max(far) + TOUCH_M
