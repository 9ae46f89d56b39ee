"""Problem B: a rigid sphere pressed into a soft block, then dragged along it, with friction.

Dimensions: block 14 x 14 x 5 mm, -7 <= x, y <= 7 mm, 0 <= z <= 5 mm; sphere of radius 3.5 mm, that
    starts just touching the middle of the top, its centre at (0, 0, 8.5) mm.
Supports: z = 0 is clamped, the sides are free.
Material: incompressible neo-Hookean, mu = 280 kPa; nearly incompressible codes: kappa >= 1e3 mu.
Contact: no adhesion, Coulomb friction with coefficient 0.186 (the paper's) or 0.5, isotropic, no
    difference between static and kinetic; the sphere does not turn.
Load path: in press_steps equal steps the sphere goes down by 0.6 mm, then in shear_steps equal
    steps by 0.3 mm towards +x at that depth.
Output: after every step, net force of the sphere *on the block* [N], shape (K, 3): z negative
    (pressed down), x positive in the second part (dragged along).

The steps matter a little (0.1 % of the press force from 6 to 12): slip is measured over a step, so
the first touch of a point counts with the slip of that whole step. Codes are compared at the same
steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from tests.crosscheck.hexes import block, geometric
from tests.crosscheck.problem import Floats, Ints


@dataclass(frozen=True)
class SphereOnBlock:
    """The problem above; all lengths [m]."""

    friction: float = 0.186
    press_steps: int = 6
    shear_steps: int = 6
    depth_m: float = 0.6e-3
    travel_m: float = 0.3e-3
    radius_m: float = 3.5e-3
    half_width_m: float = 7e-3
    height_m: float = 5e-3
    shear_modulus_pa: float = 2.8e5

    def path(self) -> Floats:
        """Displacement of the sphere from first touch after every step [m], shape (K, 3)."""
        down = np.linspace(0, self.depth_m, self.press_steps + 1)[1:]
        along = np.linspace(0, self.travel_m, self.shear_steps + 1)[1:]
        path = np.zeros((len(down) + len(along), 3))
        path[: len(down), 2] = -down
        path[len(down) :, 2] = -self.depth_m
        path[len(down) :, 0] = along
        return path


@dataclass(frozen=True)
class Grading:
    """A grid that is fine under the sphere.

    Attributes:
        fine: Equal elements from the middle to zone_m.
        coarse: Growing elements from there to the side.
        layers: Elements in depth, growing downwards.
        zone_m: Half width of the fine part [m]; the contact's edge is at 1.7 mm.
        growth: Ratio of neighbours outside.
        growth_depth: Ratio of neighbours in depth.
    """

    fine: int = 5
    coarse: int = 3
    layers: int = 5
    zone_m: float = 2e-3
    growth: float = 1.6
    growth_depth: float = 1.5

    def axes(self, contact: SphereOnBlock) -> tuple[Floats, Floats, Floats]:
        """Coordinates of the half block y >= 0 [m]."""
        outside = geometric(self.zone_m, contact.half_width_m, self.coarse, self.growth)
        half = np.concatenate([np.linspace(0, self.zone_m, self.fine + 1), outside[1:]])
        depth = geometric(0, contact.height_m, self.layers, self.growth_depth)
        return np.concatenate([-half[:0:-1], half]), half, contact.height_m - depth[::-1]


def half_block(contact: SphereOnBlock, grading: Grading) -> tuple[Floats, Ints]:
    """Nodes and hexahedra of the half y >= 0; its forces in x and z count twice."""
    return block(*grading.axes(contact))


def hertz_force(contact: SphereOnBlock, depth_m: float) -> float:
    """Press force [N] at small depth without friction, incompressible layer glued to its floor.

    Hertz for the half-space, F = (16/3) mu sqrt(R d) d, times the series of Dimitriadis et al.,
    Biophys. J. 82 (2002) 2798, eq. 12, in chi = sqrt(R d) / h.
    """
    chi = (contact.radius_m * depth_m) ** 0.5 / contact.height_m
    layer: float = 1 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
    half_space = 16 / 3 * contact.shear_modulus_pa * (contact.radius_m * depth_m) ** 0.5 * depth_m
    return float(half_space * layer)
