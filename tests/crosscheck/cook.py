"""Problem A2: Cook's membrane in plane strain, the standard test of bending without locking.

Dimensions: corners (0, 0), (48, 44), (48, 60), (0, 44) mm in x, y; thickness 1 mm in z.
Supports: the edge x = 0 is clamped; no node moves in z (plane strain).
Material: mu = 80.194 MPa, kappa = 400,889.8 MPa (the usual N/mm^2).
Mesh: N x N x 1 hexahedra, bilinear mapping of the unit square.
Load: dead traction of 100 N in +y, uniform over the edge x = 48 mm, in equal steps.
Output: displacement in y of the top corner (48, 60) [mm].
"""

from __future__ import annotations

import numpy as np
from tests.crosscheck.hexes import block
from tests.crosscheck.problem import Problem, Solution

SHEAR_PA, BULK_PA = 80.194e6, 400889.8e6
FORCE_N = 100.0


def membrane(count: int, *, steps: int = 5) -> Problem:
    nodes, hexes = block(
        np.linspace(0, 1, count + 1), np.linspace(0, 1, count + 1), np.linspace(0, 1e-3, 2)
    )
    across, up = nodes[:, 0].copy(), nodes[:, 1].copy()
    nodes[:, 0] = 48e-3 * across
    nodes[:, 1] = 44e-3 * across + up * (44e-3 - 28e-3 * across)
    held = np.zeros(nodes.shape, bool)
    held[:, 2] = True
    held[across == 0.0] = True
    # consistent forces of a uniform traction on two-node edges: half as much at the ends
    force = np.zeros_like(nodes)
    end = across == 1.0
    force[end, 1] = np.where((up[end] == 0.0) | (up[end] == 1.0), 0.5, 1.0)
    force *= FORCE_N / force.sum()
    return Problem(
        name=f"cook {count}",
        nodes=nodes,
        hexes=hexes,
        shear_modulus_pa=SHEAR_PA,
        bulk_modulus_pa=BULK_PA,
        held=held,
        displacement=np.zeros_like(nodes),
        nodal_force=force,
        steps=steps,
        grids=((count, count, 1),),
    )


def measure(problem: Problem, solution: Solution) -> dict[str, float]:
    """Displacement in y of the corner that is farthest up [mm]."""
    corner = np.argmax(problem.nodes[:, 0] + problem.nodes[:, 1])
    return {"tip_mm": float(1e3 * solution.displacement[corner, 1])}
