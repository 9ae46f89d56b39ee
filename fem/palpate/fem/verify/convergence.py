"""Cook's membrane, and the inflated public skin: figures that must not change."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from palpate.fem.mesh.nvlabs import SKIN, read_nvlabs
from palpate.fem.verify.body import MU, TIGHT, Body
from palpate.fem.verify.check import Absent, Case, Measured
from palpate.fem.verify.meshes import cooks_membrane

COOK_MU, COOK_BULK, COOK_FORCE = 80.194, 400_890.0, 100.0
# Vertical way of the upper corner by felupe's Q1P0 element, for edges a side.
COOK = {4: 6.020, 8: 6.619, 16: 6.814, 32: 6.884}


@cache
def cook(edges: int) -> Measured:
    """Cook's membrane in plane strain: a dead shear force at the free end, against felupe 11."""
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
    way = (body.state.position - mesh.nodes)[corner, 1].mean()
    return Measured(way, COOK[edges])
