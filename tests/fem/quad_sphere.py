"""A sphere of quads, for tests of surfaces."""

from __future__ import annotations

import numpy as np

from palpate_fem.arrays import Floats, Ints


def quad_sphere(count: int) -> tuple[Floats, Ints]:
    """Nodes (V, 3) on the unit sphere and quads (F, 4), that look outwards: a cube blown up.

    Args:
        count: Nodes along an edge of the cube.
    """
    nodes: list[Floats] = []
    faces: list[Ints] = []
    part = np.tan(np.linspace(-np.pi / 4, np.pi / 4, count))
    u, v = (grid.ravel() for grid in np.meshgrid(part, part, indexing="ij"))
    first = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    quads = np.stack([first, first + count, first + count + 1, first + 1], axis=1)
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.empty((len(u), 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, u, v
            outward = quads if side > 0 else quads[:, ::-1]
            faces.append((outward + len(nodes) * len(u)).astype(np.int32))
            nodes.append(face / np.linalg.norm(face, axis=1, keepdims=True))
    return np.concatenate(nodes), np.concatenate(faces)
