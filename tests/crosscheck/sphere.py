"""Problem A1: a thick spherical shell of hexahedra under internal follower pressure.

Dimensions: inner radius 5.5 mm, outer 7.07 mm (the size of the BioTac's skin), one octant.
Supports: the three planes of symmetry x = 0, y = 0, z = 0 do not move along their normals.
Material: mu = 280 kPa, kappa = 1e4 mu.
Mesh: three patches of around x around x through hexahedra.
Load: follower pressure on the inner surface, from 0 to the closed form's value at inner stretch 1.2
    (67.93 kPa) in equal steps.
Outputs: volume enclosed by the deformed bilinear inner faces, as a share of the undeformed one
    (of the octant, or of the whole sphere, which is the same number); mean inner stretch.
Sign: pressure positive from the cavity outward.
"""

from __future__ import annotations

import numpy as np
from tests.crosscheck.hexes import sphere_octant
from tests.crosscheck.problem import Floats, Problem, Solution, enclosed_volume

INNER_M, OUTER_M = 5.5e-3, 7.07e-3
SHEAR_PA, BULK_RATIO = 2.8e5, 1e4
STRETCH = 1.2


def closed_form_pressure(
    stretch: float, *, inner: float = INNER_M, outer: float = OUTER_M
) -> float:
    """Pressure that stretches the inner radius, incompressible neo-Hooke [Pa]."""

    def part(of: float) -> float:
        return 2 / of + 1 / (2 * of**4)

    at_outer = (1 + (stretch**3 - 1) * (inner / outer) ** 3) ** (1 / 3)
    return SHEAR_PA * (part(at_outer) - part(stretch))


def inflation(around: int, through: int, *, steps: int = 4) -> Problem:
    nodes, hexes, faces = sphere_octant(INNER_M, OUTER_M, around, through)
    return Problem(
        name=f"sphere {around}x{around}x{through}",
        nodes=nodes,
        hexes=hexes,
        shear_modulus_pa=SHEAR_PA,
        bulk_modulus_pa=BULK_RATIO * SHEAR_PA,
        held=nodes == 0.0,
        displacement=np.zeros_like(nodes),
        nodal_force=np.zeros_like(nodes),
        pressure_faces=faces,
        pressure_pa=closed_form_pressure(STRETCH),
        steps=steps,
        grids=((around, around, through),) * 3,
    )


def measure(problem: Problem, solution: Solution) -> dict[str, float]:
    """Cavity volume ratio and mean stretch of the inner radius."""
    moved: Floats = problem.nodes + solution.displacement
    inner = np.unique(problem.pressure_faces)
    return {
        "volume_ratio": enclosed_volume(moved, problem.pressure_faces)
        / enclosed_volume(problem.nodes, problem.pressure_faces),
        "inner_stretch": float(np.linalg.norm(moved[inner], axis=1).mean() / INNER_M),
    }
