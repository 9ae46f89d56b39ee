"""Fingertips to press: a ball of skin around a ball, and the parametric BioTac, coarse."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics.balance import Balance
from palpate_fem.mechanics.laws import ContactSettings, Press
from palpate_fem.mechanics.solver import Fingertip, Settings
from palpate_fem.mesh.core import DistanceGrid
from palpate_fem.mesh.geometry import Geometry
from palpate_fem.mesh.parametric import biotac
from palpate_fem.verify.body import MU, TIGHT, Body
from palpate_fem.verify.meshes import hollow_sphere
from palpate_fem.verify.rigid import ball, pose

Floats = NDArray[np.float64]

INNER_M, OUTER_M, CORE_M, BALL_M = 3.0e-3, 4.5e-3, 2.95e-3, 2.0e-3
FILLED = 1.06  # cavity over the unpressurised one
ASIDE_M = (0.31e-3, 0.17e-3)  # of the indenter: no symmetry
EDGE_M = 1.4e-3  # of the coarse BioTac


@dataclass
class Finger:
    """A pressurised body, the sealed volume [m^3], and an indenter whose z = 0 just touches."""

    body: Body
    volume: float
    press: Press
    start: Floats

    def at(self, move: Floats) -> Balance:
        """Equilibrium with the indenter moved by so much from where it touches [m]."""
        return self.body.solve(self.placed(move), volume=self.volume)

    def placed(self, move: Floats) -> Press:
        """The indenter there."""
        return self.press.at(pose(self.start + move))


def round_core(radius: float, spacing: float) -> DistanceGrid:
    """A ball around the origin, tabulated with a margin of 1 mm or more."""
    half = int(np.ceil((radius + 1e-3) / spacing)) + 2
    line = spacing * np.arange(-half, half + 1)
    at = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    return DistanceGrid.sampled(at[0, 0, 0], spacing, np.linalg.norm(at, axis=-1) - radius)


def round_finger(
    *, friction: float, scale: float = 1.0, mu: float = MU, stiffness: float = 1.0
) -> Finger:
    """A ball of skin, its upper part held, around a ball; filled, and ready to be pressed.

    Args:
        friction: Of the indenter.
        scale: Factor on all lengths.
        mu: Modulus of the skin [Pa].
        stiffness: Factor on the constants of contact.
    """
    mesh = hollow_sphere(6, INNER_M, OUTER_M, 1)
    fixed = np.flatnonzero(mesh.nodes[:, 2] > 0.2e-3).astype(np.int32)
    mesh = replace(mesh, nodes=mesh.nodes * scale, fixed=fixed)
    grid = round_core(CORE_M, 0.25e-3)
    core = DistanceGrid(grid.origin * scale, grid.spacing * scale, grid.coefficients * scale)
    usual = ContactSettings()
    contact = replace(usual.scaled(stiffness), margin_m=usual.margin_m * scale)
    body = Body(mesh, core=core, mu=mu, contact=contact)
    rest = body.system.balance(body.state, None).volume
    for share in (0.5, 1.0):
        body.solve(volume=rest * (1 + share * (FILLED - 1)))
    return _touched(body, rest * FILLED, ball(BALL_M * scale), np.array(ASIDE_M) * scale, friction)


@cache
def _coarse() -> tuple[Geometry, Fingertip]:
    geometry = biotac(edge_m=EDGE_M, layers=1)
    return geometry, Fingertip.pressurised(
        geometry, settings=Settings(newton=TIGHT, solver="fronts-double")
    )


def biotac_finger(*, friction: float, aside: tuple[float, float]) -> Finger:
    """The parametric BioTac, coarse, and a ball of 3.5 mm under the pad at x, y [m]."""
    geometry, tip = _coarse()
    body = Body(geometry.mesh, core=geometry.core.grid)
    body.state = tip.state.copy()
    return _touched(body, tip.cavity, ball(3.5e-3), np.array(aside), friction)


def _touched(
    body: Body, volume: float, indenter: Indenter, aside: Floats, friction: float
) -> Finger:
    """Raise the indenter until it touches the highest of the contact points above it."""
    press = Press(indenter, pose((0.0, 0.0, 0.0)), friction)
    radius = indenter.primitives[0].rounding
    x, y, z = np.moveaxis(body.contact_points(), -1, 0)
    off = (x - aside[0]) ** 2 + (y - aside[1]) ** 2
    below = (off < radius**2) & (z < 0)
    height = (z[below] + radius - np.sqrt(radius**2 - off[below])).min()
    finger = Finger(body, volume, press, np.array([*aside, height]))
    body.settle(finger.placed(np.zeros(3)))
    return finger
