"""Contact of skin with indenter and core: kernels equal their twin, tangents are derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.fem.contact import Contact, ContactLaw, contact, return_map
from palpate.fem.element import elements
from palpate.fem.indenter.catalogue import make_indenter
from palpate.fem.indenter.distance import distance
from palpate.fem.laws import ContactSettings, Press
from palpate.fem.material import NeoHooke
from palpate.fem.mesh.core import Core
from palpate.fem.mesh.solid import SolidMesh
from palpate.fem.state import State
from palpate.fem.surface import Surface
from palpate.fem.system import System

Floats = NDArray[np.float64]
Mesh = Callable[..., SolidMesh]
Dense = Callable[[System], Floats]

SAME = 1e-12  # relative to the largest entry: kernels and twins differ by rounding
MU, BULK_RATIO, OUTER_M = 2.8e5, 10.0, 4e-3
# As soft as the skin, so that no part of a tangent hides behind another.
SOFT = ContactSettings(stiffness=2e9, tangential_stiffness=8e8, complement=1e8, margin_m=0.5e-3)


def difference(found: Floats, wanted: Floats) -> float:
    """Largest deviation over the largest entry."""
    assert np.abs(wanted).max() > 0.0, "compares nothing"
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


def directions(random: np.random.Generator, count: int) -> Floats:
    vectors = random.normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@dataclass
class Pressed:
    """A shell between an indenter and a ball inside, at a state that solves nothing."""

    system: System
    core: Core
    state: State
    press: Press
    assembled: Callable[..., Floats]

    @property
    def law(self) -> ContactLaw:
        return ContactLaw(
            SOFT.stiffness, self.press.friction, SOFT.tangential_stiffness, SOFT.complement
        )

    def points(self, surface: Surface, faces: NDArray[np.int32]) -> Floats:
        corners = self.state.position[faces]
        at = np.einsum("qa,fai->fqi", surface.shape_values, corners)
        return np.asarray(at.reshape(-1, 3))

    def outside(self) -> tuple[Contact, NDArray[np.bool_]]:
        """Twin at the outer points, and which of them are near."""
        turn, state = self.press.rotation, self.state
        x = self.points(self.system.outer, self.system.mesh.outer_faces)
        gap, normal, hessian = distance(self.press.indenter, self.press.to_local(x))
        near = gap < SOFT.margin_m
        answer = contact(
            self.law,
            np.where(near, gap, 1.0),
            normal @ turn.T,
            turn @ hessian @ turn.T,
            np.where(near, state.indenter_pressure.ravel(), 0.0),
            state.traction.reshape(-1, 3),
            x - (self.press.tip + state.anchor.reshape(-1, 3) @ turn.T),
        )
        return answer, near

    def inside(self) -> Contact:
        """Twin at the inner points; without friction."""
        x = self.points(self.system.inner, self.system.mesh.inner_faces)
        gap, normal, hessian = self.core.grid.evaluate(x)
        law = ContactLaw(SOFT.stiffness, 0.0, SOFT.tangential_stiffness, SOFT.complement)
        zero = np.zeros_like(x)
        return contact(law, gap, normal, hessian, self.state.core_pressure.ravel(), zero, zero)

    def settle(self) -> None:
        """Give all pressures and tractions the values that belong to the positions."""
        mesh, state = self.system.mesh, self.state
        bulk = BULK_RATIO * MU
        skin = elements(mesh, NeoHooke(MU), bulk, state.position, state.pressure)
        state.pressure = bulk * (skin.volume / skin.rest_volume - 1.0)
        inner = self.points(self.system.inner, mesh.inner_faces)
        gap = self.core.grid.evaluate(inner)[0].reshape(state.core_pressure.shape)
        state.core_pressure = np.maximum(0.0, -SOFT.stiffness * gap)
        outer = self.points(self.system.outer, mesh.outer_faces)
        gap, normal, _ = distance(self.press.indenter, self.press.to_local(outer))
        turn = self.press.rotation
        arm = outer - (self.press.tip + state.anchor.reshape(-1, 3) @ turn.T)
        pressure = np.maximum(0.0, -SOFT.stiffness * gap)
        traction = return_map(self.law, pressure, normal @ turn.T, arm)
        state.indenter_pressure = pressure.reshape(state.indenter_pressure.shape)
        state.traction = traction.reshape(state.traction.shape)

    def scattered(self, surface: Surface, faces: NDArray[np.int32], load: Floats) -> Floats:
        """Nodal forces of loads per point, (V, 3)."""
        force = np.zeros_like(self.state.position)
        at = load.reshape(len(faces), -1, 3)
        np.add.at(force, faces, np.einsum("qa,fqi->fai", surface.shape_values, at))
        return force

    def matrix(self, surface: Surface, faces: NDArray[np.int32], stiffness: Floats) -> Floats:
        """Dense matrix of stiffnesses per point."""
        shape, area = surface.shape_values, surface.area_values
        blocks = stiffness.reshape(*area.shape, 3, 3)
        local = np.einsum("fq,qa,qb,fqij->faibj", area, shape, shape, blocks)
        return self.assembled(faces, local, len(self.state.position))


Squeeze = Callable[..., Pressed]


@pytest.fixture
def squeeze(shell: Mesh, ball: Callable[..., Core], assembled: Callable[..., Floats]) -> Squeeze:
    """Makes a `Pressed`: indenter, friction, drag of the anchors [m], element corners."""

    def make(
        indenter: str, friction: float, *, drag_m: float = 0.0, corners: int = 8, around: int = 6
    ) -> Pressed:
        random = np.random.default_rng(1)
        mesh = shell(around, 1, 3e-3, OUTER_M, corners=corners)
        core = ball(3e-3)
        system = System(
            mesh,
            core.grid,
            shear_modulus_pa=MU,
            bulk_ratio=BULK_RATIO,
            contact=SOFT,
            held=np.zeros(mesh.nodes.shape, bool),
        )
        state = State.at_rest(mesh)
        state.position += random.normal(0.0, 2e-5, mesh.nodes.shape)
        state.fluid_pressure = 3e4
        turn = np.array([1.0, 0.1, 0.2, -0.3])
        pose = np.array([1e-4, 2e-4, 0.3e-3 - OUTER_M, *turn / np.linalg.norm(turn)])
        press = Press(make_indenter(indenter), pose, friction)
        pressed = Pressed(system, core, state, press, assembled)
        points = pressed.points(system.outer, mesh.outer_faces)
        away = directions(random, len(points)) * drag_m
        state.anchor = press.to_local(points + away).reshape(state.anchor.shape)
        return pressed

    return make


def at_random(pressed: Pressed) -> None:
    """Pressures and tractions that belong to nothing; half of the points have none."""
    random, state = np.random.default_rng(2), pressed.state
    for pressure in (state.indenter_pressure, state.core_pressure):
        pressure[:] = np.maximum(0.0, random.normal(0.0, 1e5, pressure.shape))
    state.traction[:] = random.normal(0.0, 2e4, state.traction.shape)


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
    balance = system.balance(state, pressed.press, tangent=True)
    with_contact = dense(system)
    (out, near), core = pressed.outside(), pressed.inside()
    area = outer.area_values.ravel()

    assert set(out.status[near]) == ({0, 2, 3} if friction else {0, 1})
    np.testing.assert_array_equal(outer.status.numpy().ravel(), out.status)
    np.testing.assert_array_equal(inner.status.numpy().ravel(), core.status)
    assert difference(outer.wanted_array.numpy().ravel(), out.wanted) < SAME
    assert difference(outer.slope.numpy().reshape(-1, 3), out.slope) < SAME
    misfit = area[:, None] * out.misfit
    assert difference(outer.misfit.numpy().reshape(-1, 3), misfit) < SAME
    if friction:
        found = outer.wanted_traction_array.numpy().reshape(-1, 3)
        assert difference(found, out.wanted_traction) < SAME
        found = outer.traction_slope.numpy().reshape(-1, 3, 3)
        assert difference(found, out.traction_slope) < SAME
        found = outer.coupled.numpy().reshape(-1, 3)
        assert difference(found, area[:, None] * out.coupled) < SAME
        found = outer.rest.numpy().reshape(-1, 3, 3)
        assert difference(found, area[:, None, None] * out.rest) < SAME
    on_outer = pressed.scattered(outer, mesh.outer_faces, area[:, None] * out.force)
    assert difference(-balance.indenter, on_outer) < SAME
    on_inner = pressed.scattered(
        inner, mesh.inner_faces, inner.area_values.ravel()[:, None] * core.force
    )
    assert difference(-balance.core, on_inner) < SAME
    assert difference(inner.wanted_array.numpy().ravel(), core.wanted) < SAME
    assert difference(inner.slope.numpy().reshape(-1, 3), core.slope) < SAME

    expected = pressed.matrix(outer, mesh.outer_faces, out.tangent)
    expected += pressed.matrix(inner, mesh.inner_faces, core.tangent)
    rest = pressed.matrix(outer, mesh.outer_faces, out.rest)
    move = np.random.default_rng(3).normal(0.0, 1e-6, len(rest))
    if friction:
        assert difference(system.rest_product(move), rest @ move) < SAME
    else:
        assert not system.slides
    state.core_pressure[:] = 0.0
    apart = System(
        mesh, None, shear_modulus_pa=MU, bulk_ratio=BULK_RATIO, contact=SOFT,
        held=np.zeros(mesh.nodes.shape, bool),
    )  # fmt: skip
    apart.balance(state, None, tangent=True)
    alone = dense(apart)
    assert np.abs(with_contact - alone - expected).max() < SAME * np.abs(with_contact).max()


def test_condensed_loads_and_updates_equal_the_twin(squeeze: Squeeze) -> None:
    pressed = squeeze("sphere_medium", 0.3, drag_m=5e-5)
    at_random(pressed)
    system, state, mesh = pressed.system, pressed.state, pressed.system.mesh
    # The skin's own misfit is tested with the elements.
    system.balance(state, pressed.press, tangent=True)
    system.tangent_values()
    skin = elements(mesh, NeoHooke(MU), BULK_RATIO * MU, state.position, state.pressure)
    state.pressure = BULK_RATIO * MU * (skin.volume / skin.rest_volume - 1.0)
    (out, _), core = pressed.outside(), pressed.inside()
    load = pressed.scattered(
        system.outer, mesh.outer_faces, system.outer.area_values.ravel()[:, None] * out.misfit
    )
    load += pressed.scattered(
        system.inner, mesh.inner_faces, system.inner.area_values.ravel()[:, None] * core.misfit
    )
    assert difference(system.misfit_force(state), -load.ravel()) < 1e-11
    grown = pressed.scattered(
        system.outer, mesh.outer_faces, system.outer.area_values.ravel()[:, None] * out.coupled
    )
    assert difference(system.coupled_force(), -grown.ravel()) < SAME

    move = np.random.default_rng(4).normal(0.0, 2e-5, mesh.nodes.shape)
    _, on_core, on_indenter, traction = system.updated_pressures(move)
    still = state.position.copy()
    for surface, faces, twin, found in (
        (system.outer, mesh.outer_faces, out, on_indenter),
        (system.inner, mesh.inner_faces, core, on_core),
    ):
        state.position[:] = move
        moved = pressed.points(surface, faces)
        state.position[:] = still
        pressure = np.maximum(0.0, twin.wanted - np.sum(twin.slope * moved, axis=1))
        assert difference(found.ravel(), pressure) < SAME
        if surface is system.outer:
            by_law = twin.wanted_traction + np.einsum("nij,nj->ni", twin.traction_slope, moved)
            wanted = np.where(pressure[:, None] > 0.0, by_law, 0.0)
            assert difference(traction.reshape(-1, 3), wanted) < SAME


@pytest.mark.parametrize(
    ("indenter", "friction", "drag_m", "statuses"),
    [
        ("sphere_medium", 0.0, 0.0, {0, 1}),
        ("sphere_medium", 5.0, 1e-5, {0, 2}),
        ("sphere_medium", 0.05, 5e-4, {0, 3}),
        ("cube", 0.4, 1e-4, {0, 2, 3}),
    ],
    ids=["touching", "sticking", "sliding", "both"],
)
@pytest.mark.parametrize("corners", [8, 6])
def test_assembled_tangent_is_the_derivative_of_the_forces(
    squeeze: Squeeze,
    dense: Dense,
    indenter: str,
    friction: float,
    drag_m: float,
    statuses: set[int],
    corners: int,
) -> None:
    """Of skin, fluid, core and indenter together, pressures following their laws."""
    pressed = squeeze(indenter, friction, drag_m=drag_m, corners=corners)
    system, state = pressed.system, pressed.state
    pressed.settle()
    system.balance(state, pressed.press, tangent=True)
    assert set(system.outer.status.numpy().ravel()) == statuses
    assert 1 in system.inner.status.numpy()
    matrix = dense(system)
    here, step = state.position.copy(), 1e-10
    move = np.random.default_rng(5).normal(size=here.shape)
    forces = []
    for sign in (1.0, -1.0):
        state.position = here + sign * step * move
        pressed.settle()
        forces.append(system.balance(state, pressed.press).unbalanced)
    found = matrix @ move.ravel() + system.rest_product(move.ravel())
    assert difference(found, (forces[0] - forces[1]) / (2 * step)) < 1e-6


def test_only_the_symmetric_part_is_without_sliding_on_a_flat(squeeze: Squeeze) -> None:
    """Sticking to a flat has a symmetric tangent, so no iterations are spent on its rest."""
    pressed = squeeze("cube", 5.0, drag_m=1e-6)
    pressed.settle()
    pressed.system.balance(pressed.state, pressed.press, tangent=True)
    pressed.system.tangent_values()
    rest = pressed.system.outer.rest.numpy()
    assert 2 in pressed.system.outer.status.numpy()
    assert np.abs(rest).max() < 1e-9 * SOFT.tangential_stiffness * 1e-6


def test_an_indenter_that_is_gone_leaves_nothing(squeeze: Squeeze) -> None:
    pressed = squeeze("sphere_medium", 0.3, drag_m=5e-5)
    at_random(pressed)
    system, state = pressed.system, pressed.state
    system.balance(state, pressed.press, tangent=True)
    state.indenter_pressure[:], state.traction[:] = 0.0, 0.0
    for away in (None, pressed.press.at(np.array([0.0, 0.0, -0.1, 1.0, 0.0, 0.0, 0.0]))):
        balance = system.balance(state, away, tangent=True)
        system.tangent_values()
        assert not balance.indenter.any()
        assert not system.slides
        assert not system.outer.status.numpy().any()
        assert not system.coupled_force().any()
