"""Cook's membrane against felupe, and Newton's count against the bulk modulus."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from palpate_fem.verify.body import TIGHT, Body
from palpate_fem.verify.check import Case, Measured
from palpate_fem.verify.meshes import cooks_membrane, octant, on_planes

COOK_MU, COOK_BULK, COOK_FORCE = 80.194, 400_890.0, 100.0
# Vertical way of the free end's upper corner with felupe 11's hexahedra of constant pressure, by
# edges a side; four digits are published, hence the tolerance.
COOK = {4: 6.020, 8: 6.619, 16: 6.814, 32: 6.884}
COOK_LIMIT = 6.92  # of ever finer meshes, Richardson


def cooks_corner(edges: int) -> float:
    """Vertical way of the corner: plane strain, a dead shear force at the free end."""
    mesh = cooks_membrane(edges)
    held = np.zeros(mesh.nodes.shape, bool)
    held[:, 2] = True
    held[mesh.nodes[:, 0] == 0] = True
    settings = replace(TIGHT, tolerance=1e-8, largest_move_m=3.0)
    body = Body(mesh, held=held, mu=COOK_MU, bulk_ratio=COOK_BULK / COOK_MU, settings=settings)
    end = np.flatnonzero(np.abs(mesh.nodes[:, 0] - 48.0) < 1e-9)
    height = mesh.nodes[end, 1]
    share = np.where((height == height.min()) | (height == height.max()), 0.5, 1.0)
    for part in np.linspace(0.0, 1.0, 6)[1:]:
        body.system.load[end, 1] = part * COOK_FORCE * share / share.sum()
        body.solve()
    corner = end[height == height.max()]
    return float((body.state.position - mesh.nodes)[corner, 1].mean())


def cook(edges: int) -> Measured:
    """The same element by another code gives the same way."""
    return Measured(cooks_corner(edges), COOK[edges], "felupe, Q1P0")


def cook_limit() -> Measured:
    """It does not lock: the finest mesh is near the limit."""
    return Measured(cooks_corner(32), COOK_LIMIT, "limit of felupe's series")


def newton_count() -> Measured:
    """Iterations of an inflation by 10 % at kappa / mu = 1e6, and at 1e2."""
    counts = []
    for ratio in (1e6, 1e2):
        mesh = octant(4, 5.5e-3, 7.07e-3, 2)
        settings = replace(TIGHT, tolerance=1e-8, volume_tolerance=1e-8)
        body = Body(mesh, held=on_planes(mesh), bulk_ratio=ratio, settings=settings)
        body.solve(volume=1.1 * body.system.balance(body.state, None).volume)
        counts.append(body.report.iterations)
    return Measured(counts[0], counts[1])


CHECKS = (
    *(
        Case(f"convergence/Cook's membrane, {edges} edges", partial(cook, edges), 2e-4)
        for edges in COOK
    ),
    Case("convergence/Cook's membrane, limit", cook_limit, 1e-2),
    Case("newton/count does not grow with kappa", newton_count, 1e-12, "iterations"),
)
