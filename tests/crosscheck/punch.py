"""Problem A3: a block under a square punch that sticks.

Dimensions: 10 x 10 x 5 mm, z up, one quarter of it: 0 <= x, y <= 5 mm, 0 <= z <= 5 mm.
Supports: x = 0 and y = 0 are planes of symmetry; z = 0 is clamped; the sides are free.
Punch: the nodes of the top with x <= 2 mm and y <= 2 mm (4 x 4 mm of the whole block) go down by
    1.5 mm (30 %) and do not move sideways (glued).
Material: mu = 280 kPa, kappa = 1e4 mu.
Mesh: cubes of edge 1 / per_mm mm.
Output: force of the punch on the whole block in z [N], negative = down; the greatest rise of the
    free top [mm].
"""

from __future__ import annotations

import numpy as np
from tests.crosscheck.hexes import block
from tests.crosscheck.problem import Problem, Solution

SHEAR_PA, BULK_RATIO = 2.8e5, 1e4
DEPTH_M = 1.5e-3
HALF_M, PUNCH_M = 5e-3, 2e-3


def pressed(per_mm: int, *, steps: int = 5) -> Problem:
    count = 5 * per_mm
    line = np.linspace(0, HALF_M, count + 1)
    nodes, hexes = block(line, line, line)
    x, y, z = nodes.T
    under = (z == line[-1]) & (x < PUNCH_M + 1e-9) & (y < PUNCH_M + 1e-9)
    held = np.column_stack([x == 0.0, y == 0.0, np.zeros(len(x), bool)])
    held[(z == 0.0) | under] = True
    displacement = np.zeros_like(nodes)
    displacement[under, 2] = -DEPTH_M
    return Problem(
        name=f"punch {per_mm}/mm",
        nodes=nodes,
        hexes=hexes,
        shear_modulus_pa=SHEAR_PA,
        bulk_modulus_pa=BULK_RATIO * SHEAR_PA,
        held=held,
        displacement=displacement,
        nodal_force=np.zeros_like(nodes),
        steps=steps,
        grids=((count, count, count),),
    )


def measure(problem: Problem, solution: Solution) -> dict[str, float]:
    """Force of the punch on the whole block and the rise of its free top."""
    moved = problem.displacement[:, 2] < 0.0
    return {
        "force_n": float(4 * solution.reaction[moved, 2].sum()),
        "rise_mm": float(1e3 * solution.displacement[:, 2].max()),
    }
