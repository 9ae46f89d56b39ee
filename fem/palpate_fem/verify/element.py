"""Patch tests, rigid motion, objectivity, and Newton's order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from palpate.rigid import rotation_matrices
from palpate_fem.arrays import Floats
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.verify.bodies import MU, TIGHT, VerificationBody, ball, pose
from palpate_fem.verify.check import Measurement, check
from palpate_fem.verify.closed_forms import INNER_M, OUTER_M
from palpate_fem.verify.meshes import (
    KINDS,
    distorted,
    hollow_sphere,
    octant,
    on_planes,
    rectangle,
    slab,
    triangles,
)

SIDE_M = 1e-3
STRAIN = np.array([[0.10, 0.05, -0.02], [0.03, -0.08, 0.04], [0.01, 0.06, 0.05]])
QUATERNION = np.array([0.6, -0.4, 0.5, 0.48]) / np.linalg.norm([0.6, -0.4, 0.5, 0.48])


def _patch(
    gradient: Floats, *, wedges: bool, tolerance: float = TIGHT.tolerance
) -> tuple[VerificationBody, Floats]:
    """A distorted cube whose boundary moves by a deformation gradient, and all nodes' positions."""
    line = np.linspace(0.0, SIDE_M, 5)
    points, quads = rectangle(line, line)
    mesh = slab(points, triangles(quads) if wedges else quads, line)
    mesh = distorted(mesh, 0.25 * line[1], seed=3)
    inside = np.all((mesh.nodes > 1e-9) & (mesh.nodes < SIDE_M - 1e-9), axis=1, keepdims=True)
    held = np.broadcast_to(~inside, mesh.nodes.shape)
    body = VerificationBody(
        mesh, held=held, bulk_ratio=10.0, settings=replace(TIGHT, tolerance=tolerance)
    )
    exact = mesh.nodes @ gradient.T
    body.state.position[held] = exact[held]
    body.solve()
    return body, exact


@check("element/patch test, {wedges}", 1e-12, wedges=KINDS)
def patch(*, wedges: bool) -> Measurement:
    """Linear displacement of the boundary of a distorted cube: the inside follows exactly."""
    body, exact = _patch(np.eye(3) + STRAIN, wedges=wedges, tolerance=1e-13)
    return Measurement(np.abs(body.state.position - exact).max() / SIDE_M)


@check("element/patch test, pressure, {wedges}", 1e-12, wedges=KINDS)
def patch_pressure(*, wedges: bool) -> Measurement:
    """The same under uniform swelling: all elements have the same pressure."""
    body, _ = _patch(1.05 * np.eye(3), wedges=wedges)
    return Measurement(np.abs(body.state.pressure / (body.bulk * (1.05**3 - 1)) - 1).max())


@check("element/rigid motion, {wedges}", 1e-10, wedges=KINDS)
def rigid_motion(*, wedges: bool) -> Measurement:
    """A body at rest that is turned and moved has no energy, force or change of volume."""
    mesh = octant(3, INNER_M, OUTER_M, 2, wedges=wedges)
    body = VerificationBody(mesh)
    rest = body.system.balance(body.state, None)
    body.state.position = mesh.nodes @ rotation_matrices(QUATERNION).T + [3e-3, -5e-3, 2e-3]
    moved = body.system.balance(body.state, None)
    force = np.abs(moved.internal).max() / (MU * OUTER_M**2)
    energy = abs(body.strain_energy()) / (MU * body.system.skin.rest_volume.sum())
    return Measurement(max(force, energy, moved.strain_error), note=f"volume {rest.volume:.3g} m^3")


@check("element/objectivity of a loaded state", 1e-10)
def objectivity() -> Measurement:
    """A loaded state turned with its indenter: forces turn, energy and volume do not change."""
    mesh = hollow_sphere(4, INNER_M, OUTER_M, 2)
    body = VerificationBody(mesh)
    random = np.random.default_rng(1)
    body.state.position += random.normal(scale=5e-5, size=mesh.nodes.shape)
    body.state.pressure += random.normal(scale=MU, size=len(mesh.elements))
    body.state.indenter_pressure += 1e5
    body.state.traction += random.normal(scale=1e4, size=body.state.traction.shape)
    at = np.array([1e-4, 2e-4, -OUTER_M + 3e-4])
    press = PosedIndenter(ball(3.5e-3), pose(at), 0.2)
    body.update_anchors(press)
    before, energy = body.system.balance(body.state, press), body.strain_energy()
    turn = rotation_matrices(QUATERNION)
    body.state.position = body.state.position @ turn.T
    body.state.traction = body.state.traction @ turn.T
    after = body.system.balance(body.state, press.at(pose(turn @ at, QUATERNION)))
    off = [
        np.abs(new - old @ turn.T).max() / np.abs(old).max()
        for new, old in (
            (after.internal, before.internal),
            (after.indenter, before.indenter),
            (after.volume_gradient, before.volume_gradient),
        )
    ]
    off += [after.volume / before.volume - 1, body.strain_energy() / energy - 1]
    return Measurement(np.abs(off).max())


def order_of(residuals: Sequence[float]) -> float:
    """Exponent q of r_next ~ r^q from the last three residuals above rounding errors."""
    a, b, c = [r for r in residuals if r > 1e-12][-3:]
    return float(np.log(c / b) / np.log(b / a))


@check("newton/order, inflation, {wedges}", 0.1, at_least=True, wedges=KINDS)
def newton_order(*, wedges: bool) -> Measurement:
    """The last three residuals of an inflation decrease quadratically."""
    mesh = octant(4, INNER_M, 1.5 * INNER_M, 2, wedges=wedges)
    body = VerificationBody(mesh, held=on_planes(mesh))
    rest = body.system.balance(body.state, None).volume
    body.solve(volume=1.1 * rest)
    note = " ".join(f"{r:.0e}" for r in body.report.residuals)
    return Measurement(order_of(body.report.residuals), 2.0, note)
