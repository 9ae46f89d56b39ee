"""A point of the pad by where it lies along and across the finger."""

from __future__ import annotations

import numpy as np

from palpate.errors import ConfigError
from palpate_fem.indenter.approach import Surface
from palpate_fem.mesh.surface import node_normals
from palpate_fem.result import Floats

_FACES_DOWN = -0.3  # of the normal's z: what is steeper is a side, not the pad
_NEAR_M = 1.0e-3  # twice the edge of a coarse mesh


def pad_point(surface: Surface, x_m: float, y_m: float) -> tuple[Floats, Floats]:
    """Point and outward unit normal of the pad nearest to (x, y), both shape (3,), sensor frame.

    Raises:
        ConfigError: The pad does not reach there; says how far it does.
    """
    normals = node_normals(surface.nodes, surface.faces)
    on_skin = np.unique(surface.faces)
    pad = on_skin[normals[on_skin, 2] < _FACES_DOWN]
    away = np.hypot(surface.nodes[pad, 0] - x_m, surface.nodes[pad, 1] - y_m)
    nearest = pad[int(away.argmin())]
    if not away.min() <= _NEAR_M:
        low, high = surface.nodes[pad].min(axis=0) * 1e3, surface.nodes[pad].max(axis=0) * 1e3
        raise ConfigError(
            f"there is no pad at x = {x_m * 1e3:g} mm, y = {y_m * 1e3:g} mm",
            remedy=f"the pad reaches from x = {low[0]:.0f} to {high[0]:.0f} mm and from "
            f"y = {low[1]:.0f} to {high[1]:.0f} mm",
        )
    return surface.nodes[nearest], normals[nearest]
