"""A BioTac-like body for pictures: how core and skin look around the electrodes.

Core and skin are a cylinder with a spherical tip, good enough to see on which side something
touches; no estimate depends on them.
"""

from __future__ import annotations

import numpy as np

from palpate.messages import FloatArray

CORE_RADIUS_M = 0.0049
"""Just below the electrodes, which sit at 5.08 mm, so that they stand out."""

SKIN_RADIUS_M = 0.0070
"""Outer skin of an inflated BioTac, rounded."""

BACK_X_M = -0.017
"""Where the drawn part of the finger ends."""


def core_mesh(segments: int = 32, rings: int = 12) -> tuple[FloatArray, np.ndarray, FloatArray]:
    """Core as a mesh: vertices [m] ``(V, 3)``, triangles int32 ``(T, 3)``, normals ``(V, 3)``."""
    profile_x, profile_r, normal_x, normal_r = _profile(CORE_RADIUS_M, rings)
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


def skin_lines(lines: int = 9, hoops: int = 7) -> list[FloatArray]:
    """Skin as a wire basket around pad and sides: polylines [m], each ``(n, 3)``."""
    profile_x, profile_r, _, _ = _profile(SKIN_RADIUS_M, 16)
    spread = np.radians(115.0)
    drawn: list[FloatArray] = []
    for angle in np.linspace(-spread, spread, lines):
        y, z = np.sin(angle), -np.cos(angle)
        drawn.append(np.stack([profile_x, profile_r * y, profile_r * z], 1).astype(np.float32))
    around = np.linspace(-spread, spread, 41)
    for x in np.linspace(BACK_X_M, 0.0, hoops):
        ring = [np.full_like(around, x), np.sin(around), -np.cos(around)]
        ring[1:] = [SKIN_RADIUS_M * part for part in ring[1:]]
        drawn.append(np.stack(ring, 1).astype(np.float32))
    for polar in np.radians([30.0, 60.0]):
        radius, x = SKIN_RADIUS_M * np.cos(polar), SKIN_RADIUS_M * np.sin(polar)
        ring = [np.full_like(around, x), radius * np.sin(around), -radius * np.cos(around)]
        drawn.append(np.stack(ring, 1).astype(np.float32))
    return drawn


def _profile(radius_m: float, rings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Half outline from the back end to the tip: x, r [m] and the normal's x, r."""
    polar = np.linspace(0.0, np.pi / 2, rings)
    x = np.concatenate([[BACK_X_M], radius_m * np.sin(polar)])
    r = np.concatenate([[radius_m], radius_m * np.cos(polar)])
    return x, r, np.concatenate([[0.0], np.sin(polar)]), np.concatenate([[1.0], np.cos(polar)])
