"""Mortar contact: weighted gaps and the forces that belong to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.fem.numpy_mechanics import mortar

from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.shape import Indenter, Primitive, PrimitiveKind
from palpate_fem.mechanics.contact import ContactSettings, PosedIndenter
from palpate_fem.mechanics.mortar import MortarWeights
from palpate_fem.mechanics.reference_element import face_element
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.core import RigidCore
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.verify.bodies import plane

Floats = NDArray[np.float64]
Mesh = Callable[..., SolidMesh]

FAR_M = 1.0


@pytest.fixture(params=[8, 6], ids=["quads", "triangles"])
def skin(request: pytest.FixtureRequest, shell: Mesh) -> SolidMesh:
    """A hollow ball whose nodes are shaken, so that no face is a parallelogram."""
    mesh = shell(3, 1, 3e-3, 4.5e-3, corners=request.param)
    random = np.random.default_rng(5)
    return replace(mesh, nodes=mesh.nodes + random.uniform(-1e-4, 1e-4, mesh.nodes.shape))


def posed(name: str, *, below_m: float) -> PosedIndenter:
    """An indenter, tilted, with its tip at this height under the middle of the ball."""
    half = 0.15
    return PosedIndenter(
        make_indenter(name),
        np.array([2e-4, -1e-4, -below_m, np.cos(half), np.sin(half), 0.0, 0.0]),
        0.0,
    )


@pytest.mark.parametrize("name", ["sphere_medium", "cylinder_small", "cube", "ring"])
def test_gaps_and_forces_are_those_of_the_definition(skin: SolidMesh, name: str) -> None:
    indenter = posed(name, below_m=4.4e-3)
    faces = skin.outer_faces
    pressure = np.random.default_rng(1).uniform(0.0, 1e5, len(skin.nodes))
    found = MortarWeights(skin.nodes, faces).correction(skin.nodes, indenter.distance, FAR_M)
    gap, force = mortar(skin.nodes, faces, skin.nodes, pressure, indenter.distance)
    at_nodes, normal = indenter.distance(skin.nodes)
    np.testing.assert_allclose(at_nodes[faces] + found.gap, gap[faces], atol=1e-15)
    area = np.zeros(len(skin.nodes))
    element = face_element(faces.shape[1])
    for face in faces:
        by_r, by_s = np.einsum("qad,ai->dqi", element.gradient, skin.nodes[face])
        size = element.weight * np.linalg.norm(np.cross(by_r, by_s), axis=1)
        area[face] += size @ element.shape
    plain = (area * pressure)[:, None] * normal
    np.testing.assert_allclose(plain + found.load(pressure[faces]), force, atol=1e-14)


def test_a_plane_needs_no_correction(skin: SolidMesh) -> None:
    """Gaps are linear there, which the weights leave as they are."""
    press = PosedIndenter(plane(), np.array([0.0, 0.0, -4.4e-3, 1.0, 0.1, 0.0, 0.0]), 0.0)
    found = MortarWeights(skin.nodes, skin.outer_faces).correction(
        skin.nodes, press.distance, FAR_M
    )
    assert np.abs(found.gap).max() < 1e-16
    pressure = np.random.default_rng(1).uniform(0.0, 1e5, len(skin.nodes))
    assert np.abs(found.load(pressure[skin.outer_faces])).max() < 1e-12


def test_nodes_stand_off_a_ball_and_farther_on_coarser_faces(shell: Mesh) -> None:
    """Faces between nodes on a ball are inside it: by a mean of h^2 / 6 R."""
    sagitta = []
    for edges in (4, 8):
        mesh = shell(edges, 1, 2.5e-3, 3.5e-3)
        # The skin lies on a ball of its own radius from outside, as in a mould.
        found = MortarWeights(mesh.nodes, mesh.inner_faces).correction(
            mesh.nodes,
            lambda x, _: (
                np.linalg.norm(x, axis=1) - 2.5e-3,
                x / np.linalg.norm(x, axis=1)[:, None],
            ),
            FAR_M,
        )
        assert (found.gap < 0.0).all()
        sagitta.append(-found.gap.mean())
    assert sagitta[0] / sagitta[1] == pytest.approx(4.0, rel=0.15)


def test_only_what_may_touch_is_corrected(skin: SolidMesh) -> None:
    indenter, near_m = posed("sphere_medium", below_m=4.2e-3), 0.5e-3
    weights = MortarWeights(skin.nodes, skin.outer_faces)
    whole = weights.correction(skin.nodes, indenter.distance, FAR_M)
    near = weights.correction(skin.nodes, indenter.distance, near_m)
    touchable = indenter.distance(skin.nodes)[0][skin.outer_faces] < near_m
    assert 0 < touchable.sum() < touchable.size / 2
    np.testing.assert_array_equal(near.gap[touchable], whole.gap[touchable])
    assert not near.gap[~touchable].any()


@pytest.mark.parametrize(("depth_m", "jumps"), [(0.1e-3, True), (0.5e-3, False)])
def test_pressure_over_a_deep_valley_does_not_jump_from_side_to_side(
    shell: Mesh, ball: Callable[..., RigidCore], depth_m: float, jumps: bool
) -> None:
    """In an increment: two directions of one pressure would let Newton's method cycle."""
    mesh = shell(4, 1, 3e-3, 4.5e-3)
    system = EquilibriumSystem(
        mesh,
        ball(2.5e-3).grid,
        shear_modulus_pa=2.8e5,
        bulk_ratio=1e3,
        contact=ContactSettings(margin_m=2e-3),
    )
    face = np.argmin(mesh.nodes[mesh.outer_faces][:, :, 2].mean(axis=1))
    point = face_element(4).shape[0] @ mesh.nodes[mesh.outer_faces[face]]
    # Two balls, whose valley is this deep under the point.
    apart, radius = 1e-3, 1.2e-3
    drop = np.sqrt((radius + depth_m) ** 2 - apart**2)
    balls = [
        Primitive(PrimitiveKind.REVOLVED, (side, 0.0, -drop), (0.0,) * 4, radius)
        for side in (-apart, apart)
    ]
    pose = np.array([*point, 1.0, 0.0, 0.0, 0.0])
    valley = PosedIndenter(Indenter("valley", tuple(balls), fillet_m=1e-6), pose, 0.0)
    state = SolutionState.at_rest(mesh)
    system.correct_contact(state, valley)
    state.indenter_pressure[face] = 1e5
    forces = []
    for aside in (-1e-9, 1e-9):
        state.position[:] = mesh.nodes + np.array([aside, 0.0, 0.0])
        forces.append(system.balance(state, valley).indenter.copy())
    jump = np.linalg.norm(forces[1] - forces[0]) / np.linalg.norm(forces[0])
    assert (jump > 0.1) == jumps
    assert jumps or jump < 1e-4


@pytest.mark.parametrize("which", ["indenter", "core"])
def test_the_force_is_the_derivative_of_the_springs_energy(
    shell: Mesh, ball: Callable[..., RigidCore], which: str
) -> None:
    """With pressures by the normal law: minus grad of sum A e g^2 / 2 over what touches."""
    mesh = shell(4, 1, 3e-3, 4.5e-3)
    settings = ContactSettings(stiffness=1e9)
    system = EquilibriumSystem(
        mesh, ball(3.0e-3).grid, shear_modulus_pa=2.8e5, bulk_ratio=1e3, contact=settings
    )
    indenter = posed("sphere_medium", below_m=4.4e-3) if which == "indenter" else None
    surface = system.outer if which == "indenter" else system.inner

    def at(position: Floats) -> tuple[float, Floats]:
        """Energy [J] and forces on the nodes [N]."""
        state = SolutionState.at_rest(mesh)
        state.position[:] = position
        system.correct_contact(state, indenter)
        system.balance(state, indenter)
        state.indenter_pressure[:] = np.maximum(0.0, -settings.stiffness * system.outer.gap)
        state.core_pressure[:] = np.maximum(0.0, -settings.stiffness * system.inner.gap)
        pressure = state.indenter_pressure if which == "indenter" else state.core_pressure
        balance = system.balance(state, indenter)
        energy = (surface.area_values * pressure**2).sum() / 2 / settings.stiffness
        return float(energy), -(balance.indenter if which == "indenter" else balance.core)

    random = np.random.default_rng(3)
    start = mesh.nodes + random.uniform(-2e-5, 2e-5, mesh.nodes.shape)
    way = random.normal(size=mesh.nodes.shape)
    step = 1e-9
    slope = (at(start + step * way)[0] - at(start - step * way)[0]) / (2 * step)
    energy, force = at(start)
    assert energy > 0.0
    assert -(force * way).sum() == pytest.approx(slope, rel=1e-5)


def test_a_face_that_hangs_over_the_core_has_one_gap_and_force(
    shell: Mesh, ball: Callable[..., RigidCore]
) -> None:
    """One node touches, and the other ends of its faces are farther away than any margin."""
    mesh = shell(3, 1, 3e-3, 4.5e-3)
    settings = ContactSettings(stiffness=1e9)
    system = EquilibriumSystem(
        mesh, ball(1.5e-3).grid, shear_modulus_pa=2.8e5, bulk_ratio=1e3, contact=settings
    )
    state = SolutionState.at_rest(mesh)
    touching = mesh.inner_nodes[np.argmin(mesh.nodes[mesh.inner_nodes] @ (1.0, 2.0, 3.0))]
    state.position[touching] *= 0.5
    state.core_pressure[mesh.inner_faces == touching] = 1e4
    system.correct_contact(state, None)
    force = -system.balance(state, None).core
    way = np.random.default_rng(0).normal(size=mesh.nodes.shape)
    ends, step = [], 1e-9
    for sign in (1.0, -1.0):
        other = state.copy()
        other.position += sign * step * way
        system.correct_contact(other, None)
        system.balance(other, None)
        work = system.inner.area_values * state.core_pressure * system.inner.gap
        ends.append(float(work[mesh.inner_faces == touching].sum()))
    assert (force * way).sum() == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)
    assert np.count_nonzero(np.linalg.norm(force, axis=1)) > 4
