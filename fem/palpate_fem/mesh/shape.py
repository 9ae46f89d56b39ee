"""Implicit bodies, and with them the cavity of the BioTac's skin and its core.

A body is a scalar field: negative inside, zero on the surface, and near it about the distance.

The shapes are made from published dimensions. Numbers marked [M] were measured on the public mesh
of NVlabs/biotac_sim (sections, fitted circles, extents), those marked [T] come from the electrode
table in docs/conventions.md. Everything is in the sensor frame, in metres, unpressurised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from palpate_fem.arrays import Floats

Value = tuple[Floats, Floats]
# Positions [m], shape (N, 3) -> value [m], shape (N,), and its exact gradient, shape (N, 3).
Field = Callable[[Floats], Value]


def softplus(x: Floats, width: float) -> Value:
    """max(0, x), rounded over a few widths, and its derivative."""
    t = x / width
    return np.logaddexp(0.0, t) * width, 0.5 * (1 + np.tanh(t / 2))


def rounded(a: Value, b: Value, radius: float) -> Value:
    """Intersection of two bodies with a rounded edge.

    At a right angle the edge becomes a circle of that radius, else an ellipse. Surfaces further
    than the radius from the edge do not change.
    """
    value, share = np.maximum(a[0], b[0]), (a[0] >= b[0]).astype(np.float64)
    other = 1.0 - share
    near = np.flatnonzero((a[0] > -radius) & (b[0] > -radius))
    u, v = a[0][near] + radius, b[0][near] + radius
    length = np.hypot(u, v)
    value[near], share[near], other[near] = length - radius, u / length, v / length
    return value, share[:, None] * a[1] + other[:, None] * b[1]


def offset(a: Value, distance: float) -> Value:
    """A body grown by a distance."""
    return a[0] - distance, a[1]


def plane(points: Floats, normal: tuple[float, float, float], distance: float) -> Value:
    """Half-space behind a plane: normal . x <= distance."""
    gradient = np.broadcast_to(np.array(normal, np.float64), points.shape)
    # Not a matrix product, whose last bit may depend on the number of threads: meshes are hashed.
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
    """Intersect rays from inside with the surface: bisection, then bracketed Newton iterations.

    Args:
        field: The body; each ray leaves it only once.
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


def nearest(field: Field, points: Floats) -> Floats:
    """Nearest points of the surface to points not far from it, shape (N, 3).

    Alternates Newton steps onto the surface with the tangential part of the vector to the point; it
    comes to rest where that vector is normal to the surface.
    """
    foot = project(field, points, steps=3)
    for _ in range(15):
        _, gradient = field(foot)
        normal = gradient / np.linalg.norm(gradient, axis=1)[:, None]
        back = points - foot
        along = back - np.einsum("ni,ni->n", back, normal)[:, None] * normal
        foot = project(field, foot + 0.7 * along, steps=2)
    return foot


@dataclass(frozen=True, slots=True)
class CavityShape:
    """Inner surface of the skin: a barrel with a dome, a dorsal flat with a hump, a proximal end.

    Each section x = const is a circle in the ventral half (r.m.s. 0.01 mm [M]) whose centre lies
    below the core's axis; the dorsal flat cuts it, and rises to the hump near the clamp.
    """

    radius_m: float = 5.54e-3  # [M] of the barrel
    axis_z_m: float = -0.80e-3  # [M] its axis at both ends
    bulge_m: float = 0.38e-3  # [M] the axis sinks so much further in the middle of the pad
    bulge_x_m: float = -6.8e-3  # [M] where most
    bulge_length_m: float = 6.8e-3  # [M] half length, to 1/e
    dome_x_m: float = -0.2e-3  # [M] the dome is a half ellipsoid from here
    tip_x_m: float = 5.77e-3  # [M] to here
    taper_x_m: float = -14.9e-3  # [M] the barrel becomes a cone from here towards the clamp
    taper_slope: float = 0.26  # [M]
    flat_z_m: float = 1.91e-3  # [M]
    hump_x_m: float = -14.35e-3  # [M] the flat rises from here towards the clamp
    hump_slope: float = 0.65  # [M] on the midline
    hump_half_width_m: float = 4.2e-3  # [M] an arch: no higher than the flat at this |y|
    end_x_m: float = -19.04e-3  # [M] proximal end
    dorsal_edge_m: float = 1.25e-3  # [M] of the edge round the flat
    end_edge_m: float = 0.5e-3  # radius of the proximal edge; [M] is 0.35, too tight for columns
    blend_m: float = 0.4e-3  # width over which barrel and cone meet
    # Of flat and hump: their bend is hollow outside, of radius 4 blend / slope = 3.4 mm, so that
    # columns cross in skins thicker than that only.
    hump_blend_m: float = 0.55e-3

    def __call__(self, points: Floats) -> Value:
        """Field of the cavity."""
        body = rounded(self._barrel(points), self._dorsal(points), self.dorsal_edge_m)
        end = plane(points, (-1.0, 0.0, 0.0), -self.end_x_m)
        return rounded(body, end, self.end_edge_m)

    def _barrel(self, points: Floats) -> Value:
        x, y, z = points.T
        t = (x - self.bulge_x_m) / self.bulge_length_m
        sink = self.bulge_m * np.exp(-(np.abs(t) ** 3))
        axis, axis_slope = self.axis_z_m - sink, 3 * sink * t * np.abs(t) / self.bulge_length_m
        cone, cone_slope = softplus(self.taper_x_m - x, self.blend_m)
        flattening = self.radius_m / (self.tip_x_m - self.dome_x_m)
        ahead = np.maximum(x - self.dome_x_m, 0.0) * flattening
        up = z - axis
        radius = np.maximum(np.sqrt(y**2 + up**2 + ahead**2), 1e-9)
        value = radius - self.radius_m + self.taper_slope * cone
        gradient = np.stack(
            [(ahead * flattening - up * axis_slope) / radius, y / radius, up / radius], 1
        )
        gradient[:, 0] -= self.taper_slope * cone_slope
        return value, gradient

    def _dorsal(self, points: Floats) -> Value:
        rise, steepness = softplus(self.hump_x_m - points[:, 0], self.hump_blend_m)
        across = points[:, 1] / self.hump_half_width_m
        arch = self.hump_slope * (1 - across**2)
        value = points[:, 2] - self.flat_z_m - rise * arch
        lateral = 2 * self.hump_slope * rise * across / self.hump_half_width_m
        return value, np.stack([steepness * arch, lateral, np.ones(len(points))], axis=1)


@dataclass(frozen=True, slots=True)
class CoreShape:
    """The core: half-cylinder and quarter-sphere about the origin, cut by the tip's facet.

    Dorsally, at the clamp and wherever else it comes near, it keeps a clearance from the skin, as
    the public core does (its median dorsal and lateral gaps are 0.24 and 0.23 mm). The clearance is
    larger at the proximal end, where facets of the skin cut the corner.
    """

    cavity: CavityShape
    radius_m: float = 5.34e-3  # [M]; the electrodes of the table lie at 5.08e-3 [T]
    facet_m: float = 4.40e-3  # [T] from the origin
    facet_normal: tuple[float, float, float] = (0.5, 0.0, -(0.75**0.5))  # [T]
    clearance_m: float = 0.15e-3
    end_clearance_m: float = 0.50e-3
    edge_m: float = 0.3e-3

    def __call__(self, points: Floats) -> Value:
        """Field of the core."""
        ahead = np.maximum(points[:, 0], 0.0)
        way = np.stack([ahead, points[:, 1], points[:, 2]], axis=1)
        radius = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
        finger = radius - self.radius_m, way / radius[:, None]
        facet = plane(points, self.facet_normal, self.facet_m)
        end = plane(points, (-1.0, 0.0, 0.0), -self.cavity.end_x_m - self.end_clearance_m)
        cut = rounded(rounded(finger, facet, self.edge_m), end, self.edge_m)
        return rounded(cut, offset(self.cavity(points), -self.clearance_m), self.edge_m)
