"""The shapes of an open BioTac: the cavity of its skin and its core, from published dimensions.

Numbers marked [M] were measured on the public mesh of NVlabs/biotac_sim (sections, fitted circles,
extents), those marked [T] come from the electrode table in docs/conventions.md. Everything is in
the sensor frame, in metres, unpressurised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mesh.field import Value, offset, plane, rounded, softplus

Floats = NDArray[np.float64]


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
