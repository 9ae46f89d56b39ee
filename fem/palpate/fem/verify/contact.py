"""Frictionless contact against Hertz, the flat punch, Johnson's roll, and two patch tests."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from palpate.fem.indenter.shape import Indenter
from palpate.fem.laws import Press
from palpate.fem.mesh.solid import SolidMesh
from palpate.fem.system import Balance
from palpate.fem.verify.body import MU, Body
from palpate.fem.verify.check import Case, Measured
from palpate.fem.verify.meshes import graded, on_planes, quarter_disc, rectangle, slab
from palpate.fem.verify.rigid import ball, plane, pose, punch, roll

Floats = NDArray[np.float64]

FAR = 60.0  # size of the body over the contact's: a half-space to 1 %
GROWTH = 1.5


def _touched(body: Body, mesh: SolidMesh, balance: Balance) -> tuple[Floats, Floats]:
    """Nodal forces along z [N] and positions [m] of nodes that the indenter presses."""
    force = -balance.indenter[:, 2]
    pressed = force > 0
    return force[pressed], body.state.position[pressed]


def _pressed(mesh: SolidMesh, indenter: Indenter, depth: float, steps: int) -> tuple[Body, Balance]:
    """A quarter or a strip, deep end held, pressed to a depth."""
    held = on_planes(mesh)
    held[:, 2] = False
    held[mesh.nodes[:, 2] > mesh.nodes[:, 2].max() - 1e-12] = True
    body = Body(mesh, held=held)
    press = Press(indenter, pose((0.0, 0.0, 0.0)), 0.0)
    for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
        balance = body.solve(press.at(pose((0.0, 0.0, share * depth))))
    return body, balance


@cache
def hertz(radius: float, depth: float, across: int) -> tuple[float, float, float]:
    """Force [N], contact radius [m] and largest pressure [Pa] of a ball on a half-space.

    A quarter; ``across`` elements from the middle to the edge of contact. The radius is that of
    Hertz' pressure with the same mean square radius: a^2 = 5/2 <r^2>, which does not jump from
    node to node.
    """
    a = np.sqrt(radius * depth)
    radii = graded(a / across, 1.3 * a, FAR * a, GROWTH)[2:]
    depths = graded(a / across, 0.5 * a, FAR * a, GROWTH)
    mesh = slab(*quarter_disc(radii, 8), depths, name="Hertz")
    body, balance = _pressed(mesh, ball(radius), depth, 2)
    force, at = _touched(body, mesh, balance)
    mean_square = (force * (at[:, :2] ** 2).sum(axis=1)).sum() / force.sum()
    return 4 * force.sum(), np.sqrt(2.5 * mean_square), body.state.indenter_pressure.max()
