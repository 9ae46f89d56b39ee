"""Patch tests, rigid motion, objectivity, Newton's order, and tangents against differences.

The tangents are those of element, fluid, core, gap, stick and slip, with the mortar corrections of
the state, as Newton's method keeps them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from palpate.rigid import rotation_matrices
from palpate_fem.arrays import Floats
from palpate_fem.indenter.distance import distance
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.state import ForceBalance
from palpate_fem.verify.bodies import MU, TIGHT, VerificationBody, ball, pose, round_core
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
    """Exponent q of r_next ~ r^q from the last three residuals above rounding errors.

    NaN if there are fewer.
    """
    last = [r for r in residuals if r > 1e-12][-3:]
    if len(last) < 3:
        return math.nan
    a, b, c = last
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


SKIN_INNER_M, SKIN_OUTER_M = 5.5e-3, 7.07e-3
CORE_M = 5.49e-3
STEP_M = 1e-8  # of the differences; truncation (step / radius)^2 and rounding / step are below 1e-9
FRICTION = 0.2
TOLERANCE = 1e-6
# A turn that no axis is special in.
TURN = np.array([1.0, 0.1, 0.2, 0.0]) / np.linalg.norm([1.0, 0.1, 0.2, 0.0])


def _shaken(*, wedges: bool = False, core: bool = False) -> tuple[VerificationBody, Floats]:
    """A free body whose nodes are displaced at random, and a random direction (V, 3)."""
    mesh = octant(3, SKIN_INNER_M, SKIN_OUTER_M, 2, wedges=True) if wedges else hollow_sphere(
        8, SKIN_INNER_M, SKIN_OUTER_M, 1
    )  # fmt: skip
    body = VerificationBody(mesh, bulk_ratio=1e2, core=round_core(CORE_M, 0.5e-3) if core else None)
    random = np.random.default_rng(5)
    body.state.position += random.normal(scale=3e-5, size=mesh.nodes.shape)
    body.system.correct_contact(body.state, None)
    _follow(body, None)
    return body, random.normal(size=mesh.nodes.shape)


def _follow(body: VerificationBody, press: PosedIndenter | None) -> None:
    """Set pressures and tractions to what their laws demand at the nodal positions.

    The solver's tangent is that of the equations with these unknowns eliminated; here NumPy
    eliminates them.
    """
    state, skin, contact = body.state, body.system.skin, body.contact
    f = np.einsum("eai,eqaj->eqij", state.position[body.mesh.elements], skin.gradient_values)
    volume = (skin.weight_values * np.linalg.det(f)).sum(axis=1)
    state.pressure = body.bulk * (volume / skin.rest_volume - 1)
    if body.system.on_core.core is not None:
        inside = body.system.inner
        corners = state.position[body.mesh.inner_faces]
        points = np.einsum("qa,fai->fqi", inside.shape_values, corners)
        gap = body.system.on_core.core.evaluate(points)[0].reshape(points.shape[:2])
        gap += state.on_core.gap
        state.core_pressure = contact.stiffness * np.maximum(-gap, 0.0)
    if press is None:
        return
    points = body.contact_points()
    local = press.to_local(points).reshape(-1, 3)
    gap, normal, _ = (part.reshape(*points.shape[:2], -1) for part in distance(
        press.shape, local
    ))  # fmt: skip
    gap = gap[..., 0] + state.on_indenter.gap
    state.indenter_pressure = contact.stiffness * np.maximum(-gap, 0.0)
    if press.friction == 0.0:
        return
    arm = local.reshape(points.shape) - state.anchor
    way = arm - (arm * normal).sum(axis=2, keepdims=True) * normal
    length = np.linalg.norm(way, axis=2)
    limit = press.friction * state.indenter_pressure
    size = np.minimum(contact.tangential_stiffness * length, limit)
    state.traction = (size / np.maximum(length, 1e-300))[..., None] * way @ press.rotation.T


def _product(body: VerificationBody, press: PosedIndenter | None, direction: Floats) -> Floats:
    """The solver's tangent times a direction (V, 3)."""
    system = body.system
    system.balance(body.state, press)
    pattern = system.pattern
    upper = sp.csr_matrix((system.tangent_values(), pattern.indices, pattern.indptr))
    flat = direction.ravel()
    product = upper @ flat + sp.triu(upper, 1).T @ flat
    if system.is_unsymmetric:
        product = product + system.unsymmetric_product(flat)
    return np.asarray(product).reshape(-1, 3)


def _difference(
    body: VerificationBody,
    press: PosedIndenter | None,
    direction: Floats,
    pick: Callable[[ForceBalance], Floats],
) -> Floats:
    """Central difference of nodal forces along a direction."""
    kept, ends = body.state, []
    for sign in (1.0, -1.0):
        body.state = kept.copy()
        body.state.position += sign * STEP_M * direction
        _follow(body, press)
        ends.append(pick(body.system.balance(body.state, press)).copy())
    body.state = kept
    return np.asarray((ends[0] - ends[1]) / (2 * STEP_M))


def _off(found: Floats, expected: Floats) -> Measurement:
    return Measurement(float(np.abs(found - expected).max() / np.abs(expected).max()))


@check("element/force is the energy's gradient, {wedges}", TOLERANCE, wedges=KINDS)
def element_force(*, wedges: bool) -> Measurement:
    """Nodal forces are the derivative of the mixed energy by the nodes."""
    body, direction = _shaken(wedges=wedges)
    state = body.state
    force = body.system.balance(state, None).internal
    up, down = (
        body.energy_at(state.position + sign * STEP_M * direction, state.pressure)
        for sign in (1.0, -1.0)
    )
    slope = (up - down) / (2 * STEP_M)
    return Measurement(abs(float((force * direction).sum()) / slope - 1))


@check("element/tangent by differences, {wedges}", TOLERANCE, wedges=KINDS)
def element_tangent(*, wedges: bool) -> Measurement:
    """The condensed tangent is the derivative of the nodal forces with pressures eliminated."""
    body, direction = _shaken(wedges=wedges)
    expected = _difference(body, None, direction, lambda balance: balance.internal)
    return _off(_product(body, None, direction), expected)


@check("fluid/volume gradient by differences", TOLERANCE)
def fluid_gradient() -> Measurement:
    """Gradient dV/dx against differences of the cavity's volume."""
    body, direction = _shaken()
    state, volumes = body.state.copy(), []
    for sign in (1.0, -1.0):
        state.position = body.state.position + sign * 1e-7 * direction
        volumes.append(body.system.balance(state, None).volume)
    gradient = body.system.balance(body.state, None).volume_gradient
    slope = (volumes[0] - volumes[1]) / 2e-7
    return Measurement(abs(float((gradient * direction).sum()) / slope - 1))


@check("fluid/tangent by differences", TOLERANCE)
def fluid_tangent() -> Measurement:
    """Tangent of the follower pressure, -p d2V/dx2, against differences of dV/dx."""
    body, direction = _shaken()
    without = _product(body, None, direction)
    body.state.fluid_pressure = MU
    found = _product(body, None, direction) - without
    expected = _difference(body, None, direction, lambda b: -MU * b.volume_gradient)
    return _off(found, expected)


@check("contact/tangent by differences, core", TOLERANCE)
def core_tangent() -> Measurement:
    """Contact with the tabulated core, its curvature included."""
    body, direction = _shaken(core=True)
    expected = _difference(body, None, direction, lambda balance: balance.core)
    with_core = _product(body, None, direction)
    body.system.on_core.core = None
    return _off(with_core - _product(body, None, direction), expected)


@check("friction/tangent by differences, {slip_m}", TOLERANCE, slip_m={"stick": 1e-7, "slip": 3e-3})
@check(
    "contact/tangent by differences, {friction}", TOLERANCE, friction={"gap": 0.0}, slip_m=(0.0,)
)
def contact_tangent(slip_m: float, friction: float = FRICTION) -> Measurement:
    """Contact with a ball; with friction, points are displaced by ``slip_m`` from their anchors."""
    body, direction = _shaken()
    press = PosedIndenter(ball(3.5e-3), pose((1e-4, 2e-4, -SKIN_OUTER_M + 3e-4), TURN), friction)
    body.state.anchor[:] = press.to_local(body.contact_points() - slip_m * np.array([1, 0.3, 0.1]))
    body.system.correct_contact(body.state, press)
    _follow(body, press)
    expected = _difference(body, press, direction, lambda balance: balance.indenter)
    found = _product(body, press, direction) - _product(body, None, direction)
    limit = friction * body.state.indenter_pressure
    touching = body.state.indenter_pressure > 0
    slides = touching & (np.linalg.norm(body.state.traction, axis=2) > 0.999 * limit)
    note = f"{touching.sum()} points touch"
    if friction:
        note += f", {slides.sum()} slide"
    return Measurement(_off(found, expected).value, note=note)
