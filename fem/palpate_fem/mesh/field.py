"""Bodies as scalar fields: negative inside, zero on the surface, about a distance near it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Value = tuple[Floats, Floats]
# Positions [m], shape (N, 3) -> value [m], shape (N,), and its exact gradient, shape (N, 3).
Field = Callable[[Floats], Value]


def softplus(x: Floats, width: float) -> Value:
    """max(0, x), rounded over a few widths, and its derivative."""
    t = x / width
    return np.logaddexp(0.0, t) * width, 0.5 * (1 + np.tanh(t / 2))


def rounded(a: Value, b: Value, radius: float) -> Value:
    """What two bodies have in common, the edge between them rounded.

    At a right angle the edge becomes a circle of the radius; at another one an ellipse. Surfaces
    further than the radius from the edge stay what they are.
    """
    u, v = np.maximum(a[0] + radius, 0.0), np.maximum(b[0] + radius, 0.0)
    length = np.hypot(u, v)
    both = (u > 0) & (v > 0)
    safe = np.where(both, length, 1.0)
    share_a = np.where(both, u / safe, a[0] >= b[0])
    share_b = np.where(both, v / safe, a[0] < b[0])
    value = np.where(both, length - radius, np.maximum(a[0], b[0]))
    return value, share_a[:, None] * a[1] + share_b[:, None] * b[1]


def offset(a: Value, distance: float) -> Value:
    """The body grown by a distance."""
    return a[0] - distance, a[1]


def plane(points: Floats, normal: tuple[float, float, float], distance: float) -> Value:
    """Half-space behind a plane: normal . x <= distance."""
    gradient = np.broadcast_to(np.array(normal, np.float64), points.shape)
    # Not a matrix product: its last bit may depend on the number of threads, and so would hashes.
    along = points[:, 0] * normal[0] + points[:, 1] * normal[1] + points[:, 2] * normal[2]
    return along - distance, gradient


def project(field: Field, points: Floats, *, steps: int = 6) -> Floats:
    """Move points along the gradient onto the surface, shape (N, 3)."""
    for _ in range(steps):
        value, gradient = field(points)
        square = np.maximum(np.einsum("ni,ni->n", gradient, gradient), 1e-6)
        points = points - (value / square)[:, None] * gradient
    return points


def cast(field: Field, start: Floats, direction: Floats, *, reach: float) -> Floats:
    """Points of the surface on rays from inside: bisection, then Newton kept within the bracket.

    Args:
        field: The body; along each ray it is left only once.
        start: Points inside [m], shape (N, 3).
        direction: Unit vectors, shape (N, 3).
        reach: Length within which each ray leaves the body [m].

    Returns:
        Positions [m], shape (N, 3).
    """
    low, high = np.zeros(len(start)), np.full(len(start), reach)
    way = high / 2
    for step in range(6 + 7):
        value, gradient = field(start + way[:, None] * direction)
        inside = value < 0
        low, high = np.where(inside, way, low), np.where(inside, high, way)
        way = (low + high) / 2
        if step >= 6:
            slope = np.einsum("ni,ni->n", gradient, direction)
            newton = np.where(inside, low, high) - value / np.where(slope > 0, slope, 1.0)
            way = np.where((slope > 0) & (newton >= low) & (newton <= high), newton, way)
    return np.asarray(start + way[:, None] * direction)


def nearest(field: Field, points: Floats, *, steps: int = 15) -> Floats:
    """Nearest points of the surface to points not far from it, shape (N, 3).

    Alternates a Newton step onto the surface with the tangential part of the way back to the point,
    which is at rest only where that way is normal to the surface.
    """
    foot = project(field, points, steps=3)
    for _ in range(steps):
        _, gradient = field(foot)
        normal = gradient / np.linalg.norm(gradient, axis=1)[:, None]
        back = points - foot
        along = back - np.einsum("ni,ni->n", back, normal)[:, None] * normal
        foot = project(field, foot + 0.7 * along, steps=2)
    return foot
