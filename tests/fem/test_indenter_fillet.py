"""Fillets in the concave creases between primitives: closed forms and properties."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.fem import numpy_indenter

from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.distance import distance, signed_distance
from palpate_fem.indenter.shape import Indenter, Primitive, PrimitiveKind

Floats = NDArray[np.float64]

FILLET_M = 0.15e-3
BALL_M = 0.8e-3
APART_M = 0.45e-3  # half the distance between the two balls
PLATE = Primitive(PrimitiveKind.BOX, (0.0, 0.0, -2e-3), (5e-3, 5e-3, 1.5e-3, 0.0), 0.5e-3)


def ball(x: float, y: float = 0.0) -> Primitive:
    """Its centre in the plate's upper face, z = 0."""
    return Primitive(PrimitiveKind.REVOLVED, (x, y, 0.0), (0.0, 0.0, 0.0, 0.0), BALL_M)


ONE = Indenter("one", (PLATE, ball(0.0)), FILLET_M)
TWO = Indenter("two", (PLATE, ball(-APART_M), ball(APART_M)), FILLET_M)
CORNER = np.array([0.0, np.sqrt(BALL_M**2 - APART_M**2), 0.0])  # where plate and both balls meet


def sharp(indenter: Indenter) -> Indenter:
    return replace(indenter, fillet_m=0.0)


def around(centre: Floats, half_m: float, count: int, seed: int = 0) -> Floats:
    return centre + np.random.default_rng(seed).uniform(-half_m, half_m, (count, 3))


def texture_grains(count: int, seed: int = 0) -> Floats:
    """Points between the plate's face and the tops of texture's grains."""
    random = np.random.default_rng(seed)
    return random.uniform((-7e-3, -7e-3, -1.25e-3), (7e-3, 7e-3, 0.1e-3), (count, 3))


def test_round_a_ball_on_a_plate_it_is_a_circular_arc() -> None:
    # A ball of radius r that touches both: its centre is r over the plate, R + r from the middle.
    circle = np.sqrt((BALL_M + FILLET_M) ** 2 - FILLET_M**2)
    inward = np.radians([10.0, 30.0, 45.0, 60.0])  # the arc from the plate's foot to the ball's
    turn = np.radians([0.0, 77.0, 145.0, 300.0])
    for gap_m in (0.1e-3, 0.0, -5e-6, -0.1e-3):
        far = FILLET_M - gap_m
        radius, height = circle - far * np.sin(inward), FILLET_M - far * np.cos(inward)
        outward = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
        points = radius[:, None] * outward + height[:, None] * (0.0, 0.0, 1.0)
        gap, normal, hessian = distance(ONE, points)
        np.testing.assert_allclose(gap, gap_m, atol=1e-16)
        expected = np.sin(inward)[:, None] * outward + np.cos(inward)[:, None] * (0.0, 0.0, 1.0)
        np.testing.assert_allclose(normal, expected, atol=1e-12)
        # It curves towards its centre, and around the ball.
        curvatures = np.linalg.eigvalsh(hessian)
        np.testing.assert_allclose(curvatures[:, 0], -1.0 / far, rtol=1e-9)
        np.testing.assert_allclose(curvatures[:, 2], np.sin(inward) / radius, rtol=1e-6)


def test_beside_the_crease_nothing_changes() -> None:
    # 0.54 mm from the foot, the circle's radius: nothing of the ball is nearer than the arc.
    circle = np.sqrt((BALL_M + FILLET_M) ** 2 - FILLET_M**2)
    points = around(np.zeros(3), 1.5e-3, 5000)
    from_axis = np.linalg.norm(points[:, :2], axis=1)
    middle = np.linalg.norm(points, axis=1)
    slope = FILLET_M / (BALL_M + FILLET_M)  # sine of the elevation of the arc's end on the ball
    on_plate = (from_axis > circle) & (points[:, 2] > -0.2e-3)
    on_ball = points[:, 2] > np.maximum(slope * middle, 1e-9)
    for beside in (on_plate, on_ball):
        assert beside.sum() > 100
        for new, old in zip(
            distance(ONE, points[beside]), distance(sharp(ONE), points[beside]), strict=True
        ):
            np.testing.assert_array_equal(new, old)


@pytest.mark.parametrize("indenter", [ONE, TWO], ids=["crease", "corner"])
def test_along_a_line_the_normal_turns_and_does_not_jump(indenter: Indenter) -> None:
    """The line falls through the crease, and for two balls through their corner with the plate."""
    part = np.linspace(-1.0, 1.0, 4001)[:, None]
    for way in ((0.2e-3, 0.3e-3, 0.1e-3), (0.3e-3, 0.0, 0.05e-3), (0.0, 0.3e-3, 0.02e-3)):
        points = CORNER + (0.0, 0.0, 10e-6) + part * way
        step = np.linalg.norm(points[1] - points[0])
        gap, normal, _ = distance(indenter, points)
        turn = np.linalg.norm(np.diff(normal, axis=0), axis=1)
        close = np.maximum(gap[1:], gap[:-1]) < 0.6 * FILLET_M
        assert close.sum() > 500
        assert turn[close].max() < 1.1 * step / (0.4 * FILLET_M)  # the curvature of its arcs
        assert np.abs(np.diff(gap)).max() <= step * (1 + 1e-9)
    jump = np.diff(distance(sharp(indenter), points)[1], axis=0)
    assert np.linalg.norm(jump, axis=1).max() > 0.5


@pytest.mark.parametrize(
    ("indenter", "points"),
    [
        (ONE, around(CORNER, 0.3e-3, 1000)),
        (TWO, around(CORNER, 0.3e-3, 1000)),
        (make_indenter("texture"), texture_grains(300) * (1.0, 1.0, 0.75)),
    ],
    ids=["crease", "corner", "texture"],
)
def test_it_is_the_closest_of_all_pairs_and_triples(indenter: Indenter, points: Floats) -> None:
    gap, normal, hessian = distance(indenter, points)
    same_gap, same_normal, same_hessian = numpy_indenter.distance(indenter, points)
    changed = gap < signed_distance(sharp(indenter), points)
    assert changed.sum() > 20
    touchable = gap > -0.3e-3
    gap, normal, hessian = gap[touchable], normal[touchable], hessian[touchable]
    np.testing.assert_allclose(gap, same_gap[touchable], atol=1e-15)
    np.testing.assert_allclose(normal, same_normal[touchable], atol=1e-10)
    size = 1.0 + np.abs(hessian).max(axis=(1, 2))
    assert (np.abs(hessian - same_hessian[touchable]).max(axis=(1, 2)) / size).max() < 1e-6


@pytest.mark.parametrize("indenter", [ONE, TWO], ids=["crease", "corner"])
def test_gradient_and_hessian_are_those_of_finite_differences(indenter: Indenter) -> None:
    points, step = around(CORNER, 0.25e-3, 4000, seed=1), 1e-7
    gap, normal, hessian = distance(indenter, points)
    smooth = (np.abs(gap) < 0.1e-3) & (gap < signed_distance(sharp(indenter), points))
    slope, curvature = np.empty_like(normal), np.empty_like(hessian)
    seam = np.zeros(len(points))
    for i in range(3):
        move = step * np.eye(3)[i]
        gap_up, normal_up, hessian_up = distance(indenter, points + move)
        gap_down, normal_down, hessian_down = distance(indenter, points - move)
        slope[:, i] = (gap_up - gap_down) / (2 * step)
        curvature[:, i] = (normal_up - normal_down) / (2 * step)
        seam = np.maximum(seam, np.abs(hessian_up - hessian_down).max(axis=(1, 2)))
    assert smooth.sum() > 500
    np.testing.assert_allclose(slope[smooth], normal[smooth], atol=1e-3)
    size = 1.0 + np.abs(hessian).max(axis=(1, 2))
    inner = smooth & (seam < 0.02 * size)  # where arcs begin, curvature jumps
    assert inner.sum() > 0.95 * smooth.sum()
    np.testing.assert_allclose(slope[inner], normal[inner], atol=1e-6)
    assert (np.abs(curvature - hessian).max(axis=(1, 2)) / size)[inner].max() < 1e-4


@pytest.mark.parametrize("indenter", [TWO, make_indenter("texture")], ids=["corner", "texture"])
def test_it_only_fills_and_by_no_more_than_its_radius(indenter: Indenter) -> None:
    points = np.concatenate([around(CORNER, 0.4e-3, 20_000), texture_grains(20_000, seed=1)])
    gap, old = signed_distance(indenter, points), signed_distance(sharp(indenter), points)
    assert (gap <= old + 1e-18).all()
    assert (gap >= old - indenter.fillet_m).all()
    np.testing.assert_array_equal(gap[old >= indenter.fillet_m], old[old >= indenter.fillet_m])


@pytest.mark.parametrize("indenter", [TWO, make_indenter("texture")], ids=["corner", "texture"])
def test_micrometres_inside_the_foot_of_the_normal_lies_on_the_surface(indenter: Indenter) -> None:
    points = np.concatenate([around(CORNER, 0.3e-3, 20_000), texture_grains(20_000, seed=2)])
    gap, normal, _ = distance(indenter, points)
    inside = (gap < 0.0) & (gap > -20e-6)
    assert (gap < signed_distance(sharp(indenter), points))[inside].sum() > 30
    foot = points[inside] - gap[inside, None] * normal[inside]
    np.testing.assert_allclose(signed_distance(indenter, foot), 0.0, atol=1e-15)


def test_close_points_have_close_gaps_also_where_three_primitives_meet() -> None:
    for indenter, points in (
        (TWO, around(CORNER, 0.3e-3, 100_000)),
        (make_indenter("texture"), texture_grains(100_000)),
    ):
        moved = points + around(np.zeros(3), 1e-7, len(points), seed=1)
        gap = signed_distance(indenter, points)
        change = np.abs(signed_distance(indenter, moved) - gap)
        touchable = gap > -0.3e-3
        assert touchable.sum() > 10_000
        assert (change <= np.linalg.norm(moved - points, axis=1) + 1e-17)[touchable].all()
