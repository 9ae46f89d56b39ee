"""The surface of an indenter as triangles, for pictures; contact uses the exact distance."""

from __future__ import annotations

import numpy as np
import warp as wp
from warp.geometry import IsoSurfaceMarchingCubes

from palpate_fem.arrays import Floats, Ints
from palpate_fem.device import DEVICE
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.distance import distance, signed_distance
from palpate_fem.indenter.shape import Indenter, PrimitiveKind

SPACING_M = 0.4e-3
"""Spacing of the grid: the smallest tip, 3.5 mm wide, looks round, and the largest indenter has
18,000 triangles, about 100 kB in a store."""

# Grid planes must not lie in flat faces, which would give triangles without area.
_OFF_ROUND = np.array([0.37, 0.41, 0.43])
_MARGIN = 2  # cells between the box and the surface


def outline_of(name: str) -> tuple[Floats, Ints]:
    """The closed surface of an indenter of the catalogue, in its own frame.

    Vertices lie on the exact surface; edges that are sharper than the grid are cut off by it.

    Args:
        name: As `make_indenter` takes it.

    Returns:
        Vertices [m], shape (V, 3), and triangles, shape (T, 3), their normals outward.

    Raises:
        ConfigError: There is none of that name.
    """
    indenter = make_indenter(name)
    low, high = _box(indenter)
    start = low - (_MARGIN + _OFF_ROUND) * SPACING_M
    counts = np.ceil((high - start) / SPACING_M).astype(int) + 1 + _MARGIN
    grid = np.indices(tuple(counts.tolist())).reshape(3, -1).T
    gaps = signed_distance(indenter, start + SPACING_M * grid) / SPACING_M
    field = wp.array(gaps.reshape(counts).astype(np.float32), dtype=wp.float32, device=DEVICE)
    places, corners = IsoSurfaceMarchingCubes.extract(field, 0.0)
    vertices = start + SPACING_M * places.numpy().astype(np.float64)
    gap, normal, _ = distance(indenter, vertices)
    vertices -= gap[:, None] * normal
    return vertices, corners.numpy().reshape(-1, 3)


def _box(indenter: Indenter) -> tuple[Floats, Floats]:
    """Corners of a box around it [m]."""
    halves = []
    for part in indenter.primitives:
        if part.kind == PrimitiveKind.BOX:
            low, high = -np.array(part.sizes[:3]), np.array(part.sizes[:3])
        else:
            low, high = np.full(3, -part.sizes[1]), np.full(3, part.sizes[1])
            low[part.axis], high[part.axis] = part.sizes[2:]
        halves.append(part.centre + np.stack([low - part.rounding, high + part.rounding]))
    return np.min(halves, axis=(0, 1)), np.max(halves, axis=(0, 1))
