"""Contact of skin with indenter and core: kernels equal their twin, tangents are derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from tests.fem.numpy_indenter import distance
from tests.fem.numpy_mechanics import Contact, ContactLaw, Rubber, contact, elements, return_map

from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.contact import ContactSettings, ContactSurface, PosedIndenter
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.core import RigidCore

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Make = Callable[..., Any]
Dense = Callable[[EquilibriumSystem], Floats]

SAME = 1e-12  # relative to the largest entry: kernels and twins differ by rounding
MU, BULK_RATIO, OUTER_M = 2.8e5, 10.0, 4e-3
SKIN = {"shear_modulus_pa": MU, "bulk_ratio": BULK_RATIO}
# As soft as the skin, so that no part of a tangent hides behind another.
SOFT = ContactSettings(
    stiffness=2e9, tangential_stiffness=8e8, complement=1e8, margin_m=0.5e-3, mortar=False
)

# Indenter, friction, drag of the anchors [m], and the statuses that come of it.
CASES: dict[str, tuple[str, float, float, set[int]]] = {
    "touching": ("sphere_medium", 0.0, 0.0, {0, 1}),
    "sticking": ("sphere_medium", 5.0, 1e-5, {0, 2}),
    "sliding": ("sphere_medium", 0.05, 5e-4, {0, 3}),
    "both": ("cube", 0.4, 1e-4, {0, 2, 3}),
}


def difference(found: Floats, wanted: Floats) -> float:
    """Largest deviation over the largest entry."""
    assert np.abs(wanted).max() > 0.0, "compares nothing"
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


@dataclass
class Pressed:
    """A shell between an indenter and a ball inside, at a state that solves nothing."""

    system: EquilibriumSystem
    core: RigidCore
    state: SolutionState
    press: PosedIndenter
    assembled: Callable[..., Floats]

    @property
    def law(self) -> ContactLaw:
        normal, friction, tangential = (
            SOFT.stiffness,
            self.press.friction,
            SOFT.tangential_stiffness,
        )
        return ContactLaw(normal, friction, tangential, SOFT.complement)

    def points(self, surface: ContactSurface, faces: Ints, nodal: Floats | None = None) -> Floats:
        """Positions of contact points, or what another nodal field has there."""
        corners = (self.state.position if nodal is None else nodal)[faces]
        at = np.einsum("qa,fai->fqi", surface.shape_values, corners)
        return np.asarray(at.reshape(-1, 3))

    def near(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Gap to the indenter, normal, hessian and arm of the outer points, sensor frame."""
        turn, anchor = self.press.rotation, self.state.anchor.reshape(-1, 3)
        x = self.points(self.system.outer, self.system.mesh.outer_faces)
        gap, normal, hessian = distance(self.press.shape, self.press.to_local(x))
        arm = x - (self.press.tip + anchor @ turn.T)
        return gap, normal @ turn.T, turn @ hessian @ turn.T, arm

    def outside(self) -> tuple[Contact, NDArray[np.bool_]]:
        """Twin at the outer points, and which of them are near."""
        gap, normal, hessian, arm = self.near()
        near = gap < SOFT.margin_m
        gap = np.where(near, gap, 1.0)
        pressure = np.where(near, self.state.indenter_pressure.ravel(), 0.0)
        traction = self.state.traction.reshape(-1, 3)
        return contact(self.law, gap, normal, hessian, pressure, traction, arm), near

    def inside(self) -> Contact:
        """Twin at the inner points; without friction."""
        x = self.points(self.system.inner, self.system.mesh.inner_faces)
        law, none = replace(self.law, friction=0.0), np.zeros_like(x)
        pressure = self.state.core_pressure.ravel()
        return contact(law, *self.core.grid.evaluate(x), pressure, none, none)

    def settle(self) -> None:
        """Give all pressures and tractions the values that belong to the positions."""
        mesh, state, bulk = self.system.mesh, self.state, BULK_RATIO * MU
        skin = elements(mesh, Rubber(MU), bulk, state.position, state.pressure)
        state.pressure = bulk * (skin.volume / skin.rest_volume - 1.0)
        gap = self.core.grid.evaluate(self.points(self.system.inner, mesh.inner_faces))[0]
        pressure = np.maximum(0.0, -SOFT.stiffness * (gap + state.on_core.gap.ravel()))
        state.core_pressure = pressure.reshape(state.core_pressure.shape)
        gap, normal, _, arm = self.near()
        pressure = np.maximum(0.0, -SOFT.stiffness * (gap + state.on_indenter.gap.ravel()))
        state.indenter_pressure = pressure.reshape(state.indenter_pressure.shape)
        traction = return_map(self.law, pressure, normal, arm)
        state.traction = traction.reshape(state.traction.shape)

    def scattered(self, surface: ContactSurface, faces: Ints, load: Floats) -> Floats:
        """Nodal forces of loads per area at the points, (V, 3)."""
        force = np.zeros_like(self.state.position)
        at = surface.area_values[..., None] * load.reshape(len(faces), -1, 3)
        np.add.at(force, faces, np.einsum("qa,fqi->fai", surface.shape_values, at))
        return force

    def matrix(self, surface: ContactSurface, faces: Ints, stiffness: Floats) -> Floats:
        """Dense matrix of stiffnesses per point."""
        shape, area = surface.shape_values, surface.area_values
        blocks = stiffness.reshape(*area.shape, 3, 3)
        local = np.einsum("fq,qa,qb,fqij->faibj", area, shape, shape, blocks)
        return self.assembled(faces, local, len(self.state.position))


Squeeze = Callable[..., Pressed]


@pytest.fixture
def squeeze(shell: Make, ball: Make, assembled: Make) -> Squeeze:
    """Makes a `Pressed`: indenter, friction, drag of the anchors [m], corners, mortar or nodes."""

    def make(
        indenter: str,
        friction: float,
        *,
        drag_m: float = 0.0,
        corners: int = 8,
        mortar: bool = False,
    ) -> Pressed:
        random = np.random.default_rng(1)
        mesh = shell(6, 1, 3e-3, OUTER_M, corners=corners)
        core = ball(3e-3)
        held = np.zeros(mesh.nodes.shape, bool)
        contact = replace(SOFT, mortar=mortar)
        system = EquilibriumSystem(mesh, core.grid, **SKIN, contact=contact, held=held)
        state = SolutionState.at_rest(mesh)
        state.position += random.normal(0.0, 2e-5, mesh.nodes.shape)
        state.fluid_pressure = 3e4
        turn = np.array([1.0, 0.1, 0.2, -0.3])
        pose = np.array([1e-4, 2e-4, 0.3e-3 - OUTER_M, *turn / np.linalg.norm(turn)])
        press = PosedIndenter(make_indenter(indenter), pose, friction)
        pressed = Pressed(system, core, state, press, assembled)
        points = pressed.points(system.outer, mesh.outer_faces)
        away = random.normal(size=points.shape)
        away *= drag_m / np.linalg.norm(away, axis=1, keepdims=True)
        state.anchor = press.to_local(points + away).reshape(state.anchor.shape)
        return pressed

    return make


def at_random(pressed: Pressed) -> None:
    """Pressures and tractions that belong to nothing; half of the points have none."""
    random, state = np.random.default_rng(2), pressed.state
    for pressure in (state.indenter_pressure, state.core_pressure):
        pressure[:] = np.maximum(0.0, random.normal(0.0, 1e5, pressure.shape))
    state.traction[:] = random.normal(0.0, 2e4, state.traction.shape)


def friction_arrays(surface: ContactSurface, twin: Contact) -> list[tuple[wp.array, Floats]]:
    """What the kernel leaves, and what it should be."""
    area = surface.area_values.ravel()
    return [
        (surface.wanted_traction_array, twin.wanted_traction),
        (surface.traction_slope, twin.traction_slope),
        (surface.coupled, area[:, None] * twin.coupled),
        (surface.unsymmetric, area[:, None, None] * twin.rest),
    ]


@pytest.mark.parametrize("corners", [8, 6])
@pytest.mark.parametrize(
    ("indenter", "friction"), [("sphere_medium", 0.3), ("cube", 0.3), ("ring", 0.0)]
)
def test_kernels_equal_the_twin(
    squeeze: Squeeze, dense: Dense, indenter: str, friction: float, corners: int
) -> None:
    pressed = squeeze(indenter, friction, drag_m=5e-5, corners=corners)
    at_random(pressed)
    system, state, mesh = pressed.system, pressed.state, pressed.system.mesh
    outer, inner = system.outer, system.inner
    balance = system.balance(state, pressed.press)
    with_contact = dense(system)
    (out, near), core = pressed.outside(), pressed.inside()
    assert set(out.status[near]) == ({0, 2, 3} if friction else {0, 1})
    np.testing.assert_array_equal(outer.status.numpy().ravel(), out.status)
    np.testing.assert_array_equal(inner.status.numpy().ravel(), core.status)
    for array, wanted in [
        (outer.wanted_array, out.wanted),
        (outer.slope, out.slope),
        (outer.misfit, outer.area_values.reshape(-1, 1) * out.misfit),
        (inner.wanted_array, core.wanted),
        (inner.slope, core.slope),
    ] + friction_arrays(outer, out) * (friction > 0.0):
        assert difference(array.numpy().reshape(wanted.shape), wanted) < SAME
    on_outer = pressed.scattered(outer, mesh.outer_faces, out.force)
    assert difference(-balance.indenter, on_outer) < SAME
    on_inner = pressed.scattered(inner, mesh.inner_faces, core.force)
    assert difference(-balance.core, on_inner) < SAME

    expected = pressed.matrix(outer, mesh.outer_faces, out.tangent)
    expected += pressed.matrix(inner, mesh.inner_faces, core.tangent)
    rest = pressed.matrix(outer, mesh.outer_faces, out.rest)
    move = np.random.default_rng(3).normal(0.0, 1e-6, len(rest))
    if friction:
        assert difference(system.unsymmetric_product(move), rest @ move) < SAME
    else:
        assert not system.is_unsymmetric
    state.core_pressure[:] = 0.0
    held = np.zeros(mesh.nodes.shape, bool)
    apart = EquilibriumSystem(mesh, None, **SKIN, contact=SOFT, held=held)
    apart.balance(state, None)
    alone = dense(apart)
    assert np.abs(with_contact - alone - expected).max() < SAME * np.abs(with_contact).max()


def test_condensed_loads_and_updates_equal_the_twin(squeeze: Squeeze) -> None:
    pressed = squeeze("sphere_medium", 0.3, drag_m=5e-5)
    at_random(pressed)
    system, state, mesh = pressed.system, pressed.state, pressed.system.mesh
    # The skin's own misfit is tested with the elements.
    system.balance(state, pressed.press)
    system.tangent_values()
    skin = elements(mesh, Rubber(MU), BULK_RATIO * MU, state.position, state.pressure)
    state.pressure = BULK_RATIO * MU * (skin.volume / skin.rest_volume - 1.0)
    (out, _), core = pressed.outside(), pressed.inside()
    load = pressed.scattered(system.outer, mesh.outer_faces, out.misfit)
    load += pressed.scattered(system.inner, mesh.inner_faces, core.misfit)
    assert difference(system.misfit_force(state), -load.ravel()) < 1e-11
    grown = pressed.scattered(system.outer, mesh.outer_faces, out.coupled)
    assert difference(system.coupled_force(), -grown.ravel()) < SAME

    move = np.random.default_rng(4).normal(0.0, 2e-5, mesh.nodes.shape)
    _, on_core, on_indenter, traction = system.updated_pressures(move)
    for surface, faces, twin, found in (
        (system.outer, mesh.outer_faces, out, on_indenter),
        (system.inner, mesh.inner_faces, core, on_core),
    ):
        moved = pressed.points(surface, faces, move)
        pressure = np.maximum(0.0, twin.wanted - np.sum(twin.slope * moved, axis=1))
        assert difference(found.ravel(), pressure) < SAME
        if surface is system.outer:
            by_law = twin.wanted_traction + np.einsum("nij,nj->ni", twin.traction_slope, moved)
            wanted = np.where(pressure[:, None] > 0.0, by_law, 0.0)
            assert difference(traction.reshape(-1, 3), wanted) < SAME


@pytest.mark.parametrize("mortar", [True, False], ids=["mortar", "nodes"])
@pytest.mark.parametrize("corners", [8, 6])
@pytest.mark.parametrize("case", CASES)
def test_assembled_tangent_is_the_derivative_of_the_forces(
    squeeze: Squeeze, dense: Dense, case: str, corners: int, mortar: bool
) -> None:
    """Of skin, fluid, core and indenter together, pressures following their laws.

    With the mortar correction of the state, which Newton's method keeps.
    """
    indenter, friction, drag_m, statuses = CASES[case]
    pressed = squeeze(indenter, friction, drag_m=drag_m, corners=corners, mortar=mortar)
    system, state = pressed.system, pressed.state
    system.correct_contact(state, pressed.press)
    assert state.on_core.gap.any() == state.on_indenter.gap.any() == mortar
    pressed.settle()
    system.balance(state, pressed.press)
    assert set(system.outer.status.numpy().ravel()) == statuses
    assert 1 in system.inner.status.numpy()
    matrix = dense(system)
    here, step, forces = state.position.copy(), 1e-10, []
    move = np.random.default_rng(5).normal(size=here.shape)
    for sign in (1.0, -1.0):
        state.position = here + sign * step * move
        pressed.settle()
        forces.append(system.balance(state, pressed.press).unbalanced)
    found = matrix @ move.ravel() + system.unsymmetric_product(move.ravel())
    assert difference(found, (forces[0] - forces[1]) / (2 * step)) < 1e-6


def test_a_renewed_spread_follows_a_state_that_has_moved_on(squeeze: Squeeze, dense: Dense) -> None:
    """The derivative is right again, of equations whose gaps' offsets stay as they were."""
    pressed = squeeze("sphere_medium", 0.3, drag_m=1e-4, mortar=True)
    system, state = pressed.system, pressed.state
    system.correct_contact(state, pressed.press)
    offset, stale = state.on_indenter.gap, state.on_indenter.spread
    state.position += np.random.default_rng(6).normal(0.0, 3e-5, state.position.shape)
    here, step = state.position.copy(), 1e-10
    move = np.random.default_rng(5).normal(size=here.shape)
    forces, found = [], []
    for sign in (1.0, -1.0):
        state.position = here + sign * step * move
        pressed.settle()
        forces.append(system.balance(state, pressed.press).unbalanced)
    for renewed in (False, True):
        state.position = here
        pressed.settle()
        system.balance(state, pressed.press)
        if renewed:
            system.renew_spread(state, pressed.press)
        found.append(dense(system) @ move.ravel() + system.unsymmetric_product(move.ravel()))
    wanted = (forces[0] - forces[1]) / (2 * step)
    assert difference(found[0], wanted) > 1e-3
    assert difference(found[1], wanted) < 1e-6
    assert state.on_indenter.gap is offset
    assert abs(state.on_indenter.spread - stale).max() > 0.0


def test_pressures_and_friction_follow_offsets_that_follow_a_change(squeeze: Squeeze) -> None:
    """To first order they are what the laws demand where the correction is evaluated again."""
    pressed = squeeze("sphere_medium", 0.05, drag_m=1e-4, mortar=True)
    system, state, step = pressed.system, pressed.state, 1e-9
    here, move = state.position.copy(), np.random.default_rng(5).normal(size=state.position.shape)
    ends = []
    for sign in (0.0, 1.0, -1.0):
        state.position = here + sign * step * move
        system.correct_contact(state, pressed.press)
        pressed.settle()
        gaps = state.on_indenter.gap, state.on_core.gap
        ends.append((*gaps, state.core_pressure, state.indenter_pressure, state.traction))
    state.position = here
    system.correct_contact(state, pressed.press)
    pressed.settle()
    system.balance(state, pressed.press)
    system.tangent_values()
    assert (system.outer.status.numpy() == 3).any()  # some slide, with the pressure
    offsets = system.offset_changes(move.ravel())
    faces = (system.mesh.outer_faces, system.mesh.inner_faces)
    touching = (state.indenter_pressure > 0.0, state.core_pressure > 0.0)
    for k, (offset, nodes, those) in enumerate(zip(offsets, faces, touching, strict=True)):
        wanted = (ends[1][k] - ends[2][k]) / (2 * step)
        assert np.abs(wanted[those]).max() > 1e-3
        assert difference(offset[nodes][those], wanted[those]) < 1e-6
    outer, inner = offsets
    _, *targets = system.updated_pressures(step * move, (step * outer, step * inner))
    _, *kept = system.updated_pressures(step * move)
    for k, (found, without) in enumerate(zip(targets, kept, strict=True), start=2):
        those = touching[1] if k == 2 else touching[0]
        now, wanted = ends[0][k][those], ends[1][k][those]
        assert difference(found[those] - now, wanted - now) < 1e-4
        assert difference(without[those] - now, wanted - now) > 1e-3


def test_sticking_to_a_flat_has_a_symmetric_tangent(squeeze: Squeeze) -> None:
    """So no iterations are spent on its rest."""
    pressed = squeeze("cube", 5.0, drag_m=1e-6)
    pressed.settle()
    pressed.system.balance(pressed.state, pressed.press)
    surface = pressed.system.outer
    assert 2 in surface.status.numpy()
    assert np.abs(surface.unsymmetric.numpy()).max() < 1e-9 * SOFT.tangential_stiffness * 1e-6


def test_an_indenter_that_is_gone_leaves_nothing(squeeze: Squeeze) -> None:
    pressed = squeeze("sphere_medium", 0.3, drag_m=5e-5)
    at_random(pressed)
    system, state = pressed.system, pressed.state
    system.balance(state, pressed.press)
    state.indenter_pressure[:], state.traction[:] = 0.0, 0.0
    for away in (None, pressed.press.at(np.array([0.0, 0.0, -0.1, 1.0, 0.0, 0.0, 0.0]))):
        balance = system.balance(state, away)
        system.tangent_values()
        assert not balance.indenter.any()
        assert not system.is_unsymmetric
        assert not system.coupled_force().any()
        assert not system.outer.status.numpy().any()
