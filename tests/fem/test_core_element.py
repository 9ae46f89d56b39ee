"""Elements: the law is one energy, elements pass their patch test, and kernels equal their twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.fem.numpy_mechanics import Elements, Rubber, elements

from palpate_fem.mechanics.contact import ContactSettings
from palpate_fem.mechanics.element_kernels import BARRIER_FROM
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.solid import SolidMesh

Floats = NDArray[np.float64]
Mesh = Callable[..., SolidMesh]
Assembled = Callable[..., Floats]
Dense = Callable[[EquilibriumSystem], Floats]

SAME = 1e-12  # relative to the largest entry: kernels and twins differ by rounding
MU, BULK_RATIO = 2.8e5, 1e4
BOTH = pytest.mark.parametrize("corners", [8, 6])
LAWS = pytest.mark.parametrize("stiffening", [0.0, 0.3])


def difference(found: Floats, wanted: Floats) -> float:
    """Largest deviation over the largest entry."""
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


def system_of(mesh: SolidMesh, stiffening: float = 0.0) -> EquilibriumSystem:
    held = np.zeros(mesh.nodes.shape, bool)
    return EquilibriumSystem(
        mesh,
        None,
        shear_modulus_pa=MU,
        bulk_ratio=BULK_RATIO,
        contact=ContactSettings(),
        strain_stiffening=stiffening,
        held=held,
    )


def strained(mesh: SolidMesh, seed: int) -> SolutionState:
    """A stretched, sheared, uneven state with pressures that do not belong to it."""
    random = np.random.default_rng(seed)
    state = SolutionState.at_rest(mesh)
    gradient = np.eye(3) + random.uniform(-0.2, 0.2, (3, 3))
    state.position[:] = mesh.nodes @ gradient.T + random.normal(0.0, 2e-5, mesh.nodes.shape)
    state.pressure[:] = random.normal(0.0, 1e5, len(mesh.elements))
    return state


def twin(mesh: SolidMesh, state: SolutionState, stiffening: float = 0.0) -> Elements:
    law = Rubber(MU, stiffening=stiffening)
    return elements(mesh, law, BULK_RATIO * MU, state.position, state.pressure)


@LAWS
def test_stress_and_stiffness_are_derivatives_of_the_energy(stiffening: float) -> None:
    random = np.random.default_rng(0)
    law = Rubber(MU, stiffening=stiffening)
    f = np.eye(3) + random.uniform(-0.3, 0.3, (20, 3, 3))
    logarithm = np.log(np.linalg.det(f))
    assert logarithm.min() < -BARRIER_FROM  # squeezed, grown and untouched points are among them
    assert logarithm.max() > BARRIER_FROM
    assert (np.abs(logarithm) < BARRIER_FROM).any()
    move = random.normal(size=(20, 3, 3))
    step = 1e-6
    up, down = f + step * move, f - step * move
    energy = (law.function(up) - law.function(down)) / (2 * step)
    np.testing.assert_allclose(np.sum(law.gradient(f) * move, axis=(1, 2)), energy, rtol=1e-7)
    stress = (law.gradient(up) - law.gradient(down)) / (2 * step)
    stiffness = np.einsum("nijkl,nkl->nij", law.hessian(f), move)
    assert difference(stiffness, stress) < 1e-8


def test_stress_is_zero_at_rest_turns_with_the_body_and_knows_no_volume() -> None:
    random = np.random.default_rng(1)
    law = Rubber(MU)
    f = np.eye(3) + random.uniform(-0.3, 0.3, (20, 3, 3))
    turn = np.linalg.qr(random.normal(size=(20, 3, 3)))[0]
    turn *= np.linalg.det(turn)[:, None, None]
    np.testing.assert_allclose(law.gradient(np.eye(3)), 0.0, atol=1e-10)
    np.testing.assert_allclose(law.gradient(turn @ f), turn @ law.gradient(f), atol=1e-8)
    np.testing.assert_allclose(
        Rubber(MU, barrier=0.0).function(1.3 * f), Rubber(MU, barrier=0.0).function(f)
    )


def test_the_barrier_is_nothing_until_a_point_loses_its_volume() -> None:
    random = np.random.default_rng(13)
    f = np.eye(3) + random.uniform(-0.3, 0.3, (200, 3, 3))
    for size in (0.78, 1.0, 1.28):
        there = (size / np.linalg.det(f)[:, None, None]) ** (1 / 3) * f
        for kind in ("function", "gradient", "hessian"):
            found = getattr(Rubber(MU), kind)(there)
            np.testing.assert_allclose(found, getattr(Rubber(MU, barrier=0.0), kind)(there))
    pressed, grown = (
        np.trace(Rubber(MU).gradient(scale ** (1 / 3) * np.eye(3))) for scale in (0.7, 1.4)
    )
    assert pressed < 0.0 < grown


@BOTH
def test_nodal_forces_and_tangent_are_derivatives_of_one_energy(
    shell: Mesh, assembled: Assembled, corners: int
) -> None:
    mesh = shell(2, 1, 3e-3, 4e-3, corners=corners)
    state = strained(mesh, 2)
    here = twin(mesh, state)
    move = np.random.default_rng(3).normal(size=mesh.nodes.shape)
    step = 1e-9

    def moved(by: float) -> tuple[float, Floats]:
        """Energy and forces, the pressures following the volumes from where they are now."""
        there = replace_position(state, state.position + by * move)
        grown = twin(mesh, there).volume - here.volume
        energy = twin(mesh, there).energy + float(state.pressure @ grown)
        stiff = BULK_RATIO * MU / here.rest_volume
        there.pressure += stiff * grown
        return energy + float(stiff @ grown**2) / 2, twin(mesh, there).force

    (energy_up, force_up), (energy_down, force_down) = moved(step), moved(-step)
    work = float((here.force * move).sum())
    assert (energy_up - energy_down) / (2 * step) == pytest.approx(work, rel=1e-6)
    product = assembled(mesh.elements, here.tangent, len(mesh.nodes)) @ move.ravel()
    assert difference(product, (force_up - force_down).ravel() / (2 * step)) < 1e-6


def replace_position(state: SolutionState, position: Floats) -> SolutionState:
    other = state.copy()
    other.position = position
    return other


@BOTH
@LAWS
@pytest.mark.parametrize("seed", [4, 5])
def test_kernels_equal_the_twin(
    shell: Mesh, assembled: Assembled, dense: Dense, corners: int, seed: int, stiffening: float
) -> None:
    mesh = shell(3, 2, 3e-3, 4.5e-3, corners=corners)
    random = np.random.default_rng(seed)
    mesh = replace(mesh, nodes=mesh.nodes + random.normal(0.0, 5e-5, mesh.nodes.shape))
    state, system = strained(mesh, seed), system_of(mesh, stiffening)
    balance = system.balance(state, None)
    expected = twin(mesh, state, stiffening)
    stiff = BULK_RATIO * MU / expected.rest_volume
    excess = expected.volume - expected.rest_volume

    assert difference(balance.internal, expected.force) < SAME
    assert balance.smallest_jacobian == pytest.approx(expected.smallest_jacobian, rel=SAME)
    strain = np.abs(excess - state.pressure / stiff) / expected.rest_volume
    assert balance.strain_error == pytest.approx(strain.max(), rel=1e-9)
    matrix = assembled(mesh.elements, expected.tangent, len(mesh.nodes))
    assert difference(dense(system), matrix) < SAME

    move = random.normal(0.0, 1e-6, mesh.nodes.shape)
    grown = np.einsum("eai,eai->e", expected.volume_gradient, move[mesh.elements])
    assert difference(system.updated_pressures(move)[0], stiff * (excess + grown)) < SAME
    load = np.zeros_like(mesh.nodes)
    misfit = (stiff * excess - state.pressure)[:, None, None] * expected.volume_gradient
    np.add.at(load, mesh.elements, misfit)
    assert difference(system.misfit_force(state), load.ravel()) < SAME


def test_a_step_keeps_the_volume_gradients_of_its_factor(shell: Mesh) -> None:
    """Pressures and displacements must solve one linear system, also with a kept factor."""
    mesh = shell(2, 1, 3e-3, 4e-3)
    before, now, system = strained(mesh, 6), strained(mesh, 7), system_of(mesh)
    system.balance(before, None)
    system.tangent_values()
    system.balance(now, None)
    move = np.random.default_rng(8).normal(0.0, 1e-6, mesh.nodes.shape)
    old, new = twin(mesh, before), twin(mesh, now)
    grown = np.einsum("eai,eai->e", old.volume_gradient, move[mesh.elements])
    wanted = BULK_RATIO * MU / new.rest_volume * (new.volume - new.rest_volume + grown)
    assert difference(system.updated_pressures(move)[0], wanted) < SAME


@pytest.mark.parametrize("counts", [(1, 1, 1), (1, 1, 3), (3, 1, 1)])
@BOTH
def test_any_number_of_elements_is_shared_among_the_threads(
    block: Mesh,
    assembled: Assembled,
    dense: Dense,
    counts: tuple[int, int, int],
    corners: int,
) -> None:
    mesh = block(counts, corners=corners)
    state, system = strained(mesh, 9), system_of(mesh)
    balance = system.balance(state, None)
    expected = twin(mesh, state)
    assert difference(balance.internal, expected.force) < SAME
    matrix = assembled(mesh.elements, expected.tangent, len(mesh.nodes))
    assert difference(dense(system), matrix) < SAME


@BOTH
def test_patch_test(block: Mesh, corners: int) -> None:
    """In a distorted mesh under any linear motion and one pressure, inner nodes feel nothing."""
    mesh = block((3, 3, 3), corners=corners)
    random = np.random.default_rng(10)
    inside = ((mesh.nodes > 1e-6) & (mesh.nodes < 3e-3 - 1e-6)).all(axis=1)
    mesh.nodes[inside] += random.uniform(-1.5e-4, 1.5e-4, (inside.sum(), 3))
    state = SolutionState.at_rest(mesh)
    state.position[:] = mesh.nodes @ (np.eye(3) + random.uniform(-0.3, 0.3, (3, 3))).T
    state.pressure[:] = 4e5
    force = system_of(mesh).balance(state, None).internal
    assert np.abs(force[inside]).max() < SAME * np.abs(force[~inside]).max()


@BOTH
def test_rigid_motion_makes_no_force_and_turns_those_that_are(shell: Mesh, corners: int) -> None:
    mesh = shell(3, 1, 3e-3, 4e-3, corners=corners)
    system, state = system_of(mesh), strained(mesh, 11)
    turn = np.linalg.qr(np.random.default_rng(12).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    loaded = system.balance(state, None).internal
    state.position[:] = state.position @ turn.T + (5e-3, -3e-3, 1e-3)
    assert difference(system.balance(state, None).internal, loaded @ turn.T) < 1e-11
    state.position[:] = mesh.nodes @ turn.T + (5e-3, -3e-3, 1e-3)
    state.pressure[:] = 0.0
    assert np.abs(system.balance(state, None).internal).max() < 1e-12 * np.abs(loaded).max()
