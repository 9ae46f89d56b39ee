"""Meshes of hexahedra made with a few lines of NumPy, the same for every code."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from tests.crosscheck.problem import Floats, Ints

CUBE = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)


def block(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> tuple[Floats, Ints]:
    """Grid of hexahedra with the given ascending coordinates; x fastest in nodes and hexahedra."""
    axes = [np.asarray(a, np.float64) for a in (x, y, z)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    number = np.arange(nodes[..., 0].size).reshape(nodes.shape[:3][::-1]).transpose(2, 1, 0)
    flat = np.empty((number.size, 3))
    flat[number.ravel()] = nodes.reshape(-1, 3)
    counts = [len(a) - 1 for a in axes]
    hexes = np.stack(
        [
            number[i : i + counts[0], j : j + counts[1], k : k + counts[2]].ravel(order="F")
            for i, j, k in CUBE
        ],
        axis=-1,
    )
    return flat, hexes.astype(np.int32)


def sphere_octant(
    inner: float, outer: float, around: int, through: int
) -> tuple[Floats, Ints, Ints]:
    """One octant of a thick sphere: three patches of around x around x through hexahedra.

    Args:
        inner: Inner radius.
        outer: Outer radius.
        around: Elements along a quarter of each great circle's half (45 degrees).
        through: Elements through the thickness, equal.

    Returns:
        Nodes (V, 3), hexahedra (E, 8), faces of the inner surface with normals outward from the
        centre, that is into the solid (F, 4).
    """
    angle = np.tan(np.linspace(0, np.pi / 4, around + 1))
    patch, quads = block(angle, angle, np.linspace(inner, outer, through + 1))
    direction = np.column_stack([np.ones(len(patch)), patch[:, 0], patch[:, 1]])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = direction * patch[:, 2:]
    turned = np.concatenate([np.roll(points, turn, axis=1) for turn in range(3)])
    cells = np.concatenate([quads + turn * len(points) for turn in range(3)])
    _, first, inverse = np.unique(
        np.round(turned / outer, 9), axis=0, return_index=True, return_inverse=True
    )
    nodes, hexes = turned[first], inverse.reshape(-1)[cells].astype(np.int32)
    # what remains of the tangent of 0 and of the seams is made exact
    nodes[np.abs(nodes) < 1e-12 * outer] = 0.0
    on_inner = np.isclose(np.linalg.norm(nodes, axis=1), inner)
    faces = hexes[:, :4][on_inner[hexes[:, :4]].all(axis=1)]
    return nodes, hexes, faces.astype(np.int32)


def geometric(start: float, stop: float, count: int, ratio: float) -> Floats:
    """Coordinates of count elements from start to stop, each ratio times as long as the last."""
    length = ratio ** np.arange(count)
    return start + (stop - start) * np.concatenate([[0.0], np.cumsum(length) / length.sum()])


# The 27 nodes in the order of VTK, on a grid of 3 x 3 x 3: corners, edges, faces, centre.
QUADRATIC = np.concatenate(
    [
        2 * CUBE,
        [[1, 0, 0], [2, 1, 0], [1, 2, 0], [0, 1, 0], [1, 0, 2], [2, 1, 2], [1, 2, 2], [0, 1, 2]],
        [[0, 0, 1], [2, 0, 1], [2, 2, 1], [0, 2, 1]],
        [[0, 1, 1], [2, 1, 1], [1, 0, 1], [1, 2, 1], [1, 1, 0], [1, 1, 2], [1, 1, 1]],
    ]
)


def quadratic(hexes: Ints, grids: tuple[tuple[int, int, int], ...]) -> Ints:
    """Read every 2x2x2 hexahedra of each grid as one hexahedron of 27 nodes, shape (E / 8, 27)."""
    cells, start = [], 0
    for nx, ny, nz in grids:
        if nx % 2 or ny % 2 or nz % 2:
            raise ValueError(f"a grid of {nx} x {ny} x {nz} does not halve")
        grid = hexes[start : start + nx * ny * nz].reshape(nz, ny, nx, 8)
        start += nx * ny * nz
        nodes = np.empty((nz + 1, ny + 1, nx + 1), np.int64)
        for corner, (i, j, k) in enumerate(CUBE):
            nodes[k : k + nz, j : j + ny, i : i + nx] = grid[..., corner]
        cells.append(
            np.stack(
                [
                    nodes[k : k + nz - 1 : 2, j : j + ny - 1 : 2, i : i + nx - 1 : 2].ravel()
                    for i, j, k in QUADRATIC
                ],
                axis=-1,
            )
        )
    return np.concatenate(cells).astype(np.int32)
