"""Problem A4: a plate as thick as the skin, blown up, and bent and squeezed: does Q1P0 lock?

Dimensions: 10 x 10 x 1.57 mm, z up, one quarter of it: 0 <= x, y <= 5 mm, 0 <= z <= 1.57 mm.
Supports: x = 0 and y = 0 are planes of symmetry; x = 5 mm and y = 5 mm are clamped.
Material: mu = 280 kPa, kappa = 1e4 mu.
Mesh: across x across x through equal hexahedra; with even counts, the same nodes also carry
    Taylor-Hood elements of 27 nodes, which do not lock.

Inflation: follower pressure of 40 kPa on the bottom. Output: rise of the centre of the top [mm].

Squeeze: a quarter with free edges x = 5 mm and y = 5 mm, between a rounded load and a rounded
    support, both frictionless and in full contact. With w = cos^2(pi x / 10 mm) cos^2(pi y / 10 mm)
    of the *reference* position, every node of the top goes by -1.2 mm w in z, every node of the
    bottom by -0.572 mm w, and both are free sideways: bent by 0.57 mm and squeezed by 0.628 mm,
    40 % of the thickness, at the centre; what is squeezed out leaves through the edges.
    Outputs: net force of the load on the whole plate in z (negative: down) and of the support
    (positive: up) [N]; displacement in x of the middle of the edge, (5, 0, 0.785) mm [mm].
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tests.crosscheck.hexes import block
from tests.crosscheck.problem import Problem, Solution

SHEAR_PA, BULK_RATIO = 2.8e5, 1e4
HALF_M, THICKNESS_M = 5e-3, 1.57e-3
PRESSURE_PA = 4e4
DENT_M, SQUEEZE_SHARE = 1.2e-3, 0.4


def _plate(across: int, through: int) -> Problem:
    line = np.linspace(0, HALF_M, across + 1)
    nodes, hexes = block(line, line, np.linspace(0, THICKNESS_M, through + 1))
    x, y, _ = nodes.T
    return Problem(
        name=f"plate {across}x{across}x{through}",
        nodes=nodes,
        hexes=hexes,
        shear_modulus_pa=SHEAR_PA,
        bulk_modulus_pa=BULK_RATIO * SHEAR_PA,
        held=np.column_stack([x == 0.0, y == 0.0, np.zeros(len(x), bool)]),
        displacement=np.zeros_like(nodes),
        nodal_force=np.zeros_like(nodes),
        grids=((across, across, through),),
    )


def inflated(across: int, through: int, *, steps: int = 5) -> Problem:
    plate = _plate(across, through)
    held = plate.held.copy()
    held[(plate.nodes[:, :2] == HALF_M).any(axis=1)] = True
    bottom = plate.hexes[: across * across, [0, 1, 2, 3]]
    return replace(plate, held=held, pressure_faces=bottom, pressure_pa=PRESSURE_PA, steps=steps)


def squeezed(across: int, through: int, *, steps: int = 10) -> Problem:
    plate = _plate(across, through)
    z = plate.nodes[:, 2]
    top, bottom = z == z.max(), z == 0.0
    held, displacement = plate.held.copy(), plate.displacement.copy()
    held[top | bottom, 2] = True
    dent = np.prod(np.cos(np.pi / 2 * plate.nodes[:, :2] / HALF_M) ** 2, axis=1)
    displacement[top, 2] = -DENT_M * dent[top]
    displacement[bottom, 2] = -(DENT_M - SQUEEZE_SHARE * THICKNESS_M) * dent[bottom]
    return replace(plate, held=held, displacement=displacement, steps=steps)


def measure_inflated(problem: Problem, solution: Solution) -> dict[str, float]:
    """Rise of the centre of the top."""
    z = problem.nodes[:, 2]
    centre = np.flatnonzero((problem.nodes[:, :2] == 0.0).all(axis=1) & (z == z.max()))
    return {"rise_mm": float(1e3 * solution.displacement[centre, 2].item())}


def measure_squeezed(problem: Problem, solution: Solution) -> dict[str, float]:
    """Forces of load and support on the whole plate, and where the edge goes."""
    x, y, z = problem.nodes.T
    edge = np.flatnonzero((x == HALF_M) & (y == 0.0) & np.isclose(z, THICKNESS_M / 2))
    lift = 4 * solution.reaction[:, 2]
    return {
        "load_n": float(lift[z == z.max()].sum()),
        "support_n": float(lift[z == 0.0].sum()),
        "edge_mm": float(1e3 * solution.displacement[edge, 0].item()),
    }
