"""Surfaces that are drawn: their colours, normals and borders, and the body of the finger.

The body is a cylinder with a spherical tip. It shows on which side of the electrodes something
touches; no estimate depends on it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.files.bundle import FieldMesh
from palpate.messages import FloatArray

Floats = npt.NDArray[np.floating[Any]]
Ints = npt.NDArray[np.int32]

_CORE_RADIUS_M = 0.0049
"""Just below the electrodes, which sit at 5.08 mm, so that they stand out."""

_SKIN_RADIUS_M = 0.0070
"""Outer skin of an inflated BioTac, rounded."""

_BACK_X_M = -0.017
"""Where the drawn part of the finger ends."""

_SCALE = np.array(
    [[150, 156, 166], [62, 116, 178], [33, 165, 150], [94, 201, 98], [253, 231, 37]], np.float64
)
"""Colours from no displacement (grey, so that the shape shows on a dark ground) to the largest."""


class OuterSkin:
    """The outer surface of a mesh, with node numbers of its own: inner nodes would be invisible.

    Attributes:
        used: Numbers of its nodes in the mesh, shape (U,).
        triangles: Of its own numbers, shape (T, 3).
        rest: Where its nodes are untouched [m], shape (U, 3).
    """

    def __init__(self, mesh: FieldMesh) -> None:
        used, triangles = np.unique(mesh.outer_faces, return_inverse=True)
        self.used: Ints = used
        self.triangles: Ints = triangles.reshape(-1, 3).astype(np.int32)
        self.rest: FloatArray = mesh.nodes[used]


def packed_rgba(rgb: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
    """Packed RGBA of colours in the last axis, opaque."""
    packed: npt.NDArray[np.uint32] = (
        (rgb[..., 0] << 24) | (rgb[..., 1] << 16) | (rgb[..., 2] << 8) | 255
    ).astype(np.uint32)
    return packed


def shades(share: Floats) -> npt.NDArray[np.uint32]:
    """Colours of displacements, as shares 0..1 of the largest: packed RGBA, the same shape."""
    at = np.clip(share, 0.0, 1.0) * (len(_SCALE) - 1)
    low = np.minimum(at.astype(int), len(_SCALE) - 2)
    part = (at - low)[..., None]
    rgb = ((1 - part) * _SCALE[low] + part * _SCALE[low + 1]).round().astype(np.uint32)
    return packed_rgba(rgb)


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


def core_mesh() -> tuple[FloatArray, np.ndarray, FloatArray]:
    """Core as a mesh: vertices [m] ``(V, 3)``, triangles int32 ``(T, 3)``, normals ``(V, 3)``."""
    segments = 32
    profile_x, profile_r, normal_x, normal_r = _profile(_CORE_RADIUS_M, 12)
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    around = np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    axis = np.array([1.0, 0.0, 0.0])
    vertices = profile_r[:, None, None] * around + profile_x[:, None, None] * axis
    normals = normal_r[:, None, None] * around + normal_x[:, None, None] * axis
    triangles = []
    for ring in range(len(profile_x) - 1):
        for at in range(segments):
            a, b = ring * segments + at, ring * segments + (at + 1) % segments
            triangles += [[a, b, a + segments], [b, b + segments, a + segments]]
    return (
        vertices.reshape(-1, 3).astype(np.float32),
        np.array(triangles, np.int32),
        normals.reshape(-1, 3).astype(np.float32),
    )


def skin_lines() -> list[FloatArray]:
    """Skin as a wire basket around pad and sides: polylines [m], each ``(n, 3)``."""
    profile_x, profile_r, _, _ = _profile(_SKIN_RADIUS_M, 16)
    spread = np.radians(115.0)
    drawn: list[FloatArray] = []
    for angle in np.linspace(-spread, spread, 9):
        y, z = np.sin(angle), -np.cos(angle)
        drawn.append(np.stack([profile_x, profile_r * y, profile_r * z], 1).astype(np.float32))
    around = np.linspace(-spread, spread, 41)
    for x in np.linspace(_BACK_X_M, 0.0, 7):
        ring = [np.full_like(around, x), np.sin(around), -np.cos(around)]
        ring[1:] = [_SKIN_RADIUS_M * part for part in ring[1:]]
        drawn.append(np.stack(ring, 1).astype(np.float32))
    for polar in np.radians([30.0, 60.0]):
        radius, x = _SKIN_RADIUS_M * np.cos(polar), _SKIN_RADIUS_M * np.sin(polar)
        ring = [np.full_like(around, x), radius * np.sin(around), -radius * np.cos(around)]
        drawn.append(np.stack(ring, 1).astype(np.float32))
    return drawn


def _profile(radius_m: float, rings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Half outline from the back end to the tip: x, r [m] and the normal's x, r."""
    polar = np.linspace(0.0, np.pi / 2, rings)
    x = np.concatenate([[_BACK_X_M], radius_m * np.sin(polar)])
    r = np.concatenate([[radius_m], radius_m * np.cos(polar)])
    return x, r, np.concatenate([[0.0], np.sin(polar)]), np.concatenate([[1.0], np.cos(polar)])
