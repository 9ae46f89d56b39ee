"""Between two poses of an indenter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def interpolate_pose(a: Floats, b: Floats, fraction: float) -> Floats:
    """Pose (7,) at a fraction of the way from a to b: straight line, and the shortest turn."""
    position = a[:3] + fraction * (b[:3] - a[:3])
    first, second = a[3:], b[3:]
    cosine = float(first @ second)
    if cosine < 0.0:
        second, cosine = -second, -cosine
    if cosine > 1.0 - 1e-12:
        turn = first + fraction * (second - first)
    else:
        angle = np.arccos(min(cosine, 1.0))
        turn = np.sin((1 - fraction) * angle) * first + np.sin(fraction * angle) * second
    return np.concatenate([position, turn / np.linalg.norm(turn)])


def path_lengths(path: Floats) -> Floats:
    """Length of the tip's way up to each pose [m], (K,)."""
    moves = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(moves)])
