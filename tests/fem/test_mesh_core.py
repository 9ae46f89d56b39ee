"""Signed distances: to triangles, on a grid, between its nodes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from palpate_fem.mesh.core import (
    DistanceGrid,
    box_around,
    grid_points,
    signed_distance,
    tabulate,
    volume_inside,
)
from palpate_fem.mesh.shape import cast, nearest, plane, rounded, softplus

Floats = NDArray[np.float64]

RADIUS, SPACING = 5e-3, 0.25e-3
# Trilinear products of cubics are reproduced by the spline up to rounding.
ROUNDING = 1e-12


def sphere(points: Floats) -> tuple[Floats, Floats]:
    radius = np.linalg.norm(points, axis=1)
    return radius - RADIUS, points / np.maximum(radius, 1e-12)[:, None]


@pytest.fixture(scope="module")
def grid() -> DistanceGrid:
    origin, size = box_around(np.array([[-RADIUS] * 3, [RADIUS] * 3]), 2e-3, SPACING)
    at = grid_points(origin, SPACING, size)
    return DistanceGrid.sampled(origin, SPACING, sphere(at.reshape(-1, 3))[0].reshape(size))


def on_sphere(count: int = 500) -> Floats:
    points = np.random.default_rng(1).normal(size=(count, 3))
    return np.asarray(RADIUS * points / np.linalg.norm(points, axis=1)[:, None])


def test_a_sphere_on_a_grid_is_a_sphere(grid: DistanceGrid) -> None:
    points = on_sphere()
    distance, gradient, hessian = grid.evaluate(points)
    assert (
        np.abs(distance).max() < 0.1e-6
    )  # fourth order: (h / R)^4 h, and what is left of the border
    np.testing.assert_allclose(gradient, points / RADIUS, atol=1e-4)
    expected = (np.eye(3) - np.einsum("ni,nj->nij", points, points) / RADIUS**2) / RADIUS
    np.testing.assert_allclose(hessian, expected, atol=0.02 / RADIUS)


def test_derivatives_are_those_of_the_value(grid: DistanceGrid) -> None:
    points = on_sphere() * np.random.default_rng(2).uniform(0.8, 1.1, (500, 1))
    _, gradient, hessian = grid.evaluate(points)
    step = 1e-7
    for i in range(3):
        ahead, behind = (grid.evaluate(points + sign * step * np.eye(3)[i]) for sign in (1, -1))
        np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * step), gradient[:, i], atol=1e-7)
        slope = (ahead[1] - behind[1]) / (2 * step)
        np.testing.assert_allclose(slope, hessian[:, i], atol=1e-5 * np.abs(hessian).max())


@settings(max_examples=30)
@given(st.lists(st.floats(-1, 1), min_size=27, max_size=27))
def test_a_cubic_in_the_middle_of_a_grid_is_reproduced(weights: list[float]) -> None:
    # Quadratic in each axis: the spline's mirror at the border reaches no further than a few cells.
    power = np.array(weights).reshape(3, 3, 3)
    axis = np.arange(41) - 20.0
    values = np.polynomial.polynomial.polygrid3d(axis, axis, axis, power)
    grid = DistanceGrid.sampled(np.full(3, -20.0), 1.0, values)
    points = np.random.default_rng(3).uniform(-1, 1, (20, 3))
    x, y, z = points.T
    expected = np.polynomial.polynomial.polyval3d(x, y, z, power)
    scale = 1 + np.abs(values).max()
    np.testing.assert_allclose(grid.evaluate(points)[0], expected, atol=1e3 * ROUNDING * scale)


def test_outside_the_grid_the_distance_grows_and_nothing_bends(grid: DistanceGrid) -> None:
    far = np.array([[20e-3, 0, 0], [0, -30e-3, 0], [10e-3, 10e-3, 10e-3], [1.0, 1.0, 1.0]])
    distance, gradient, hessian = grid.evaluate(far)
    assert (distance >= 1.7e-3).all()
    assert (distance > 0.5 * (np.linalg.norm(far, axis=1) - RADIUS)).all()
    assert np.isfinite(gradient).all()
    assert not hessian.any()
    edge = grid.origin + grid.spacing * (np.array(grid.coefficients.shape) - 2.0)
    inside, outside = grid.evaluate(np.stack([edge, edge + 1e-12]))[0]
    assert outside == pytest.approx(inside, abs=1e-11)


def test_volume_inside_a_sampled_sphere() -> None:
    origin, size = box_around(np.array([[-RADIUS] * 3, [RADIUS] * 3]), 1e-3, SPACING)
    values = sphere(grid_points(origin, SPACING, size).reshape(-1, 3))[0]
    assert volume_inside(values, SPACING) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=2e-3)


CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_FACES = np.array("013 032 467 475 045 051 237 276 026 064 157 173".split(), dtype="S3").view(
    "u1"
).reshape(-1, 3).astype(np.int32) - ord("0")
SMALL = 1e-3  # half edge of the cube [m]


def to_cube(points: Floats) -> Floats:
    """Exact signed distance to the cube."""
    over = np.abs(points) - SMALL
    outside = np.linalg.norm(np.maximum(over, 0), axis=-1)
    return np.asarray(outside + np.minimum(over.max(axis=-1), 0))


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_distance_to_triangles_is_exact_at_faces_edges_and_corners(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-2 * SMALL, 2 * SMALL, (200, 3))
    distance, foot = signed_distance(points, CUBE * SMALL, CUBE_FACES)
    np.testing.assert_allclose(distance, to_cube(points), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - foot, axis=1), np.abs(distance), atol=1e-12)
    np.testing.assert_allclose(to_cube(foot), 0, atol=1e-12)


def test_a_tabulated_cube_keeps_its_distance_far_from_the_band() -> None:
    origin, size = box_around(CUBE * 3 * SMALL, 1e-3, 0.2e-3)
    at = grid_points(origin, 0.2e-3, size)
    values = tabulate(CUBE * 3 * SMALL, CUBE_FACES, at, band_m=0.5e-3)
    exact = 3 * to_cube(at.reshape(-1, 3) / 3).reshape(size)
    near = np.abs(exact) < 0.5e-3
    np.testing.assert_allclose(values[near], exact[near], atol=1e-12)
    assert np.abs(values - exact).max() < 0.05e-3


def test_a_grid_is_symmetric_to_the_midline() -> None:
    origin, size = box_around(np.array([[0, -1.13e-3, 0], [1e-3, 2.01e-3, 1e-3]]), 1e-3, 0.3e-3)
    y = grid_points(origin, 0.3e-3, size)[0, :, 0, 1]
    np.testing.assert_allclose(y, -y[::-1], atol=1e-18)
    assert y.max() >= 3.01e-3 - 1e-12
    assert size[1] % 2 == 1


def test_rounding_replaces_an_edge_by_a_quarter_circle() -> None:
    turn = np.linspace(0.1, 1.4, 20)
    arc = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)

    def corner(points: Floats) -> tuple[Floats, Floats]:
        return rounded(plane(points, (1, 0, 0), 1.0), plane(points, (0, 1, 0), 1.0), 1.0)

    value, gradient = corner(arc)
    np.testing.assert_allclose(value, 0, atol=1e-15)
    np.testing.assert_allclose(gradient, arc, atol=1e-15)
    np.testing.assert_allclose(nearest(corner, 1.3 * arc), arc, atol=1e-6)
    inside = np.full((20, 3), [-3.0, -3.0, 0.0])
    aim = (arc - inside) / np.linalg.norm(arc - inside, axis=1)[:, None]
    np.testing.assert_allclose(cast(corner, inside, aim, reach=9.0), arc, atol=1e-12)


def test_softplus_is_a_rounded_step_up() -> None:
    x = np.linspace(-800, 800, 1601)
    value, slope = softplus(x, 1.0)
    np.testing.assert_allclose(np.diff(value), (slope[1:] + slope[:-1]) / 2, atol=0.02)
    assert value[0] == 0
    assert value[-1] == 800
