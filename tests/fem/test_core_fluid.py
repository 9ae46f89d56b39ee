"""The sealed fluid: known volumes, exact derivatives, and kernels that equal their twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.fem.numpy_mechanics import cavity

from palpate_fem.mechanics.contact import ContactSettings
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.solid import SolidMesh

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Mesh = Callable[..., SolidMesh]
Sphere = Callable[[int, int], SolidMesh]
Assembled = Callable[..., Floats]
Dense = Callable[[EquilibriumSystem], Floats]

SAME = 1e-12  # relative to the largest entry: kernels and twins differ by rounding
BOTH = pytest.mark.parametrize("corners", [8, 6])

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
SQUARES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]], np.int32
)
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


@pytest.fixture
def sphere(shell: Mesh) -> Sphere:
    """A mesh by elements around and their corners; the cavity's radius is 3 mm."""
    return lambda around, corners: shell(around, 1, 3e-3, 4e-3, corners=corners)


def uneven(mesh: SolidMesh, seed: int) -> Floats:
    """Positions with no symmetry; quadrilaterals are warped."""
    random = np.random.default_rng(seed)
    gradient = np.eye(3) + random.uniform(-0.2, 0.2, (3, 3))
    return np.asarray(mesh.nodes @ gradient.T + random.normal(0.0, 1e-4, mesh.nodes.shape))


def test_volume_of_bodies_whose_volume_is_known() -> None:
    shear = np.array([[2.0, 0.3, -0.7], [0.1, 1.5, 0.4], [0.0, -0.2, 3.0]])
    squares = cavity(SQUARES, CUBE @ shear.T + (5.0, -3.0, 2.0))
    assert squares.volume.sum() == pytest.approx(np.linalg.det(shear), rel=1e-13)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.2, 2.0, 0.0], [0.3, 0.4, 3.0]])
    assert cavity(TETRAHEDRON, corners + 7.0).volume.sum() == pytest.approx(1.0, rel=1e-12)


def test_volume_under_a_saddle() -> None:
    """A bilinear face is no two triangles: one corner of the cube's top raised by h adds h / 4."""
    raised = CUBE.copy()
    raised[7, 2] += 0.6
    assert cavity(SQUARES, raised).volume.sum() == pytest.approx(1.0 + 0.6 / 4, rel=1e-13)


@BOTH
def test_volume_of_a_sphere_converges(sphere: Sphere, corners: int) -> None:
    errors = []
    for around in (4, 8):
        mesh = sphere(around, corners)
        volume = cavity(mesh.inner_faces, mesh.nodes).volume.sum()
        errors.append(1.0 - volume / (4 / 3 * np.pi * 3e-3**3))
    assert 0.0 < errors[1] < 0.03
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


@BOTH
def test_derivatives_are_those_of_the_volume(
    sphere: Sphere, assembled: Assembled, corners: int
) -> None:
    mesh = sphere(3, corners)
    faces, position = mesh.inner_faces, uneven(mesh, 0)
    move = np.random.default_rng(1).normal(size=position.shape)
    step = 1e-6
    up, down = cavity(faces, position + step * move), cavity(faces, position - step * move)
    here = cavity(faces, position)
    slope = (up.volume.sum() - down.volume.sum()) / (2 * step)
    assert float((here.gradient * move).sum()) == pytest.approx(slope, rel=1e-6)
    matrix = assembled(faces, here.hessian, len(position))
    turned = (matrix @ move.ravel()).reshape(-1, 3)
    difference = (up.gradient - down.gradient) / (2 * step)
    np.testing.assert_allclose(turned, difference, atol=1e-9 * np.abs(turned).max())


@BOTH
def test_a_closed_surface_feels_no_net_force_and_no_net_moment(
    sphere: Sphere, assembled: Assembled, corners: int
) -> None:
    mesh = sphere(3, corners)
    position = uneven(mesh, 2)
    here = cavity(mesh.inner_faces, position)
    gradient = here.gradient
    largest = np.abs(gradient).max()
    assert np.abs(gradient.sum(axis=0)).max() < SAME * largest
    moment = np.cross(position, gradient).sum(axis=0)
    assert np.abs(moment).max() < SAME * largest * np.abs(position).max()
    matrix = assembled(mesh.inner_faces, here.hessian, len(position))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-18)


@BOTH
@pytest.mark.parametrize("pressure", [3e4, -2e3])
def test_kernels_equal_the_twin(
    sphere: Sphere, assembled: Assembled, dense: Dense, corners: int, pressure: float
) -> None:
    mesh = sphere(4, corners)
    random = np.random.default_rng(3)
    held = random.random(mesh.nodes.shape) < 0.2
    system = EquilibriumSystem(
        mesh, None, shear_modulus_pa=1.0, bulk_ratio=10.0, contact=ContactSettings(), held=held
    )
    state = SolutionState.at_rest(mesh)
    state.position[:], state.fluid_pressure = uneven(mesh, 4), pressure
    expected = cavity(mesh.inner_faces, state.position)
    balance = system.balance(state, None)
    assert balance.volume == pytest.approx(expected.volume.sum(), rel=SAME)
    assert (
        np.abs(balance.volume_gradient - expected.gradient).max()
        < SAME * np.abs(expected.gradient).max()
    )
    with_fluid = dense(system)
    free = system.pattern.free
    outside = (balance.internal - pressure * expected.gradient).reshape(-1)[free]
    assert np.abs(balance.unbalanced - outside).max() < SAME * np.abs(outside).max()

    state.fluid_pressure = 0.0
    system.balance(state, None)
    share = with_fluid - dense(system)
    matrix = -pressure * assembled(mesh.inner_faces, expected.hessian, len(mesh.nodes))
    wanted = matrix[np.ix_(free, free)]
    # A difference of tangents, so the elements' rounding is in it; they are soft.
    assert np.abs(share - wanted).max() < SAME * np.abs(with_fluid).max()
    assert np.abs(share - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_a_solid_without_a_cavity_has_no_volume(block: Mesh) -> None:
    mesh = block((2, 1, 1))
    mesh = replace(mesh, fixed=np.array([0, 1, 2], np.int32))
    system = EquilibriumSystem(
        mesh, None, shear_modulus_pa=1.0, bulk_ratio=10.0, contact=ContactSettings()
    )
    balance = system.balance(SolutionState.at_rest(mesh), None)
    assert balance.volume == 0.0
    assert not balance.volume_gradient.any()
