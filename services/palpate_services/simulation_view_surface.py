"""Colours, normals and borders of triangulated surfaces."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from palpate_services.simulation_view_file import Floats, Ints

_COLOURS = np.array(
    [[150, 156, 166], [62, 116, 178], [33, 165, 150], [94, 201, 98], [253, 231, 37]], np.float64
)
"""From unmoved, a grey that shows the shape on a dark ground, to most moved."""


def shades(share: Floats) -> npt.NDArray[np.uint32]:
    """Colours of shares of the longest displacement: packed RGBA, the same shape."""
    at = np.clip(share, 0.0, 1.0) * (len(_COLOURS) - 1)
    low = np.minimum(at.astype(int), len(_COLOURS) - 2)
    part = (at - low)[..., None]
    rgb = ((1 - part) * _COLOURS[low] + part * _COLOURS[low + 1]).round().astype(np.uint32)
    packed: npt.NDArray[np.uint32] = (
        (rgb[..., 0] << 24) | (rgb[..., 1] << 16) | (rgb[..., 2] << 8) | 255
    ).astype(np.uint32)
    return packed


def normals_of(positions: Floats, faces: Ints) -> Floats:
    """Normals at vertices: those of their triangles, weighted by area; shape (V, 3)."""
    corners = positions[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(total, faces[:, corner], across)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals: Floats = (total / np.where(length > 0, length, 1.0)).astype(np.float32)
    return normals


def border_of(triangles: Ints) -> npt.NDArray[np.intp]:
    """Edges that belong to one triangle only, shape (B, 2)."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    found, count = np.unique(edges, axis=0, return_counts=True)
    border: npt.NDArray[np.intp] = found[count == 1].astype(np.intp)
    return border
