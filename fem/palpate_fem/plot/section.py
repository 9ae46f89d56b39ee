"""Plane cuts through solids and surfaces, and the outline of a patch of faces."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_fem.arrays import Floats

Ints = NDArray[Any]

# A wedge as three tetrahedra, a hexahedron as two wedges; node order of `SolidMesh`.
_WEDGE = np.array([[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])
_HEXAHEDRON = np.concatenate(
    [np.array(wedge)[_WEDGE] for wedge in ((0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7))]
)
_WEDGE_SIDES = ((0, 1, 2, 2), (3, 4, 5, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5))
_HEXAHEDRON_SIDES = (
    (0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7),
)  # fmt: skip
_CORNERS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])

_OFF_PLANE_M = 1e-10
"""Nodes on the plane are moved this far behind it, which avoids special cases: a symmetric mesh has
many of them."""


@dataclass(frozen=True, slots=True)
class PlaneCut:
    """Intersection of a plane with a solid.

    Attributes:
        ends: The two nodes between which each point lies, shape (P, 2).
        share: Position from the first (0) to the second (1), shape (P,).
        triangles: Ids of points, shape (T, 3).
        elements: Element that each triangle is cut from, shape (T,).
    """

    ends: Ints
    share: Floats
    triangles: Ints
    elements: Ints

    def at(self, nodal: Floats) -> Floats:
        """Nodal values, shape (V,) or (V, C), at the points."""
        share = self.share.reshape(-1, *[1] * (nodal.ndim - 1))
        found: Floats = (1.0 - share) * nodal[self.ends[:, 0]] + share * nodal[self.ends[:, 1]]
        return found


def cut_solid(nodes: Floats, elements: Ints, *, axis: int, at_m: float) -> PlaneCut:
    """Cut hexahedra or wedges with a plane across an axis.

    Args:
        nodes: Positions [m], shape (V, 3).
        elements: Node ids, shape (E, 8) or (E, 6).
        axis: 0..2 for a plane across x, y, z.
        at_m: Position of the plane on that axis [m].
    """
    kinds = _HEXAHEDRON if elements.shape[1] == 8 else _WEDGE
    tetrahedra = elements[:, kinds].reshape(-1, 4)
    owner = np.repeat(np.arange(len(elements)), len(kinds))
    distance = _distance(nodes, axis, at_m)
    behind = distance[tetrahedra] < 0
    count = behind.sum(axis=1)
    ends, elements_cut, triangles = [], [], []
    points = 0
    for corners, order in ((3, ((0, 1, 2),)), (4, ((0, 1, 2), (1, 2, 3)))):
        chosen = np.flatnonzero(count == 2 if corners == 4 else (count == 1) | (count == 3))
        edges = tetrahedra[chosen][:, _CORNERS]  # (n, 6, 2)
        crossed = (distance[edges] < 0).sum(axis=2) == 1
        # With the four crossed edges in table order, 0-1-2 and 1-2-3 are the halves of the quad.
        ends.append(edges[crossed])
        base = points + corners * np.arange(len(chosen))
        for three in order:
            triangles.append(base[:, None] + np.array(three))
            elements_cut.append(owner[chosen])
        points += corners * len(chosen)
    between = np.concatenate(ends)
    first, second = distance[between[:, 0]], distance[between[:, 1]]
    return PlaneCut(
        between, first / (first - second), np.concatenate(triangles), np.concatenate(elements_cut)
    )


def cut_sides(nodes: Floats, elements: Ints, *, axis: int, at_m: float) -> Floats:
    """Intersection of a plane with the faces of elements: segments [m], shape (S, 2, 3).

    Args:
        nodes: Positions [m], shape (V, 3).
        elements: Node ids, shape (E, 8) or (E, 6).
        axis: 0..2 for a plane across x, y, z.
        at_m: Position of the plane on that axis [m].
    """
    sides = _HEXAHEDRON_SIDES if elements.shape[1] == 8 else _WEDGE_SIDES
    faces = elements[:, np.array(sides)].reshape(-1, 4)
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[once]
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    crossed, edges = _crossed(_distance(nodes, axis, at_m), triangles)
    return _points(nodes, edges[crossed], axis, at_m).reshape(-1, 2, 3)


def cut_surface(vertices: Floats, triangles: Ints, *, axis: int, at_m: float) -> list[Floats]:
    """Intersection of a plane with a triangle mesh: polylines [m], each (N, 3), closed if it is.

    Args:
        vertices: Positions [m], shape (C, 3).
        triangles: Vertex ids, shape (T, 3).
        axis: 0..2 for a plane across x, y, z.
        at_m: Position of the plane on that axis [m].
    """
    crossed, edges = _crossed(_distance(vertices, axis, at_m), triangles)
    pairs = [tuple(map(tuple, pair)) for pair in np.sort(edges[crossed], 1).reshape(-1, 2, 2)]
    chains = _chains([(one, other) for one, other in pairs])
    return [_points(vertices, np.array(chain), axis, at_m) for chain in chains]


def outline(faces: Ints) -> Ints:
    """Edges that belong to only one of the faces: node ids, shape (B, 2)."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    edges = edges[edges[:, 0] != edges[:, 1]]
    _, first, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    border: Ints = edges[first[count == 1]]
    return border


def _distance(points: Floats, axis: int, at_m: float) -> Floats:
    distance = points[:, axis] - at_m
    return np.where(np.abs(distance) < _OFF_PLANE_M, -_OFF_PLANE_M, distance)


def _crossed(distance: Floats, triangles: Ints) -> tuple[NDArray[np.bool_], Ints]:
    """Whether edges of triangles cross the plane, shape (T, 3), and their ends, shape (T, 3, 2)."""
    edges = triangles[:, np.array([[0, 1], [1, 2], [2, 0]])]
    return (distance[edges] < 0).sum(axis=2) == 1, edges


def _points(points: Floats, edges: Ints, axis: int, at_m: float) -> Floats:
    distance = _distance(points, axis, at_m)
    first, second = distance[edges[:, 0]], distance[edges[:, 1]]
    share = (first / (first - second))[:, None]
    found: Floats = (1 - share) * points[edges[:, 0]] + share * points[edges[:, 1]]
    return found


def _chains(pairs: list[tuple[Any, Any]]) -> list[list[Any]]:
    """Join segments, given as pairs of ends, to chains; a closed chain ends where it began."""
    at: dict[Any, list[int]] = defaultdict(list)
    for number, pair in enumerate(pairs):
        for end in pair:
            at[end].append(number)
    used = [False] * len(pairs)
    # Start at loose ends, so that an open chain is not started in its middle.
    order = sorted(range(len(pairs)), key=lambda number: min(len(at[end]) for end in pairs[number]))
    chains = []
    for number in order:
        if used[number]:
            continue
        used[number] = True
        first, last = pairs[number]
        chain = [last, first] if len(at[last]) == 1 else [first, last]
        while (
            following := next((link for link in at[chain[-1]] if not used[link]), None)
        ) is not None:
            used[following] = True
            one, other = pairs[following]
            chain.append(other if one == chain[-1] else one)
        chains.append(chain)
    return chains
