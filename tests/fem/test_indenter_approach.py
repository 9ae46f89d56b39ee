"""First contact, clearance and orientation: closed forms on planes and ellipsoids."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.fem.quad_sphere import quad_sphere

from palpate.errors import ConfigError, SimulationError
from palpate.rigid import facing, rotation_matrices, to_local, unit
from palpate_fem.indenter.approach import OuterSurface, check_clear, first_contact
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.distance import signed_distance

Floats = NDArray[np.float64]
Direction = tuple[float, float, float]

UP = np.array([0.0, 0.0, 1.0])
DIRECTION = st.tuples(*3 * [st.floats(-1, 1)]).filter(lambda d: np.linalg.norm(d) > 1e-3)


def plate(height_m: float, count: int = 41, half_m: float = 12e-3) -> OuterSurface:
    """A flat square at z = height that faces down, as a pad does; quads."""
    part = np.linspace(-half_m, half_m, count)
    x, y = (grid.ravel() for grid in np.meshgrid(part, part))
    nodes = np.stack([x, y, np.full_like(x, height_m)], axis=1)
    first = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    faces = np.stack([first, first + count, first + count + 1, first + 1], axis=1)
    return OuterSurface(nodes, faces.astype(np.int32))


def ball(radius_m: float, count: int = 33) -> OuterSurface:
    """A sphere about the origin."""
    nodes, faces = quad_sphere(count)
    return OuterSurface(radius_m * nodes, faces)


@pytest.mark.parametrize("name", indenter_names())
def test_every_tip_touches_a_plate_at_its_height(name: str) -> None:
    travel = first_contact(make_indenter(name), facing(UP), np.zeros(3), UP, plate(2e-3))
    # On a texture or a ball only one point touches; faces are sampled, not solved for.
    assert travel == pytest.approx(2e-3, abs=2e-6)
    assert travel >= 2e-3 - 2e-9


@pytest.mark.parametrize("name", ["sphere_small", "sphere_medium", "sphere_large"])
@pytest.mark.parametrize("aside_m", [0.0, 2e-3, -4e-3])
def test_a_sphere_touches_a_sphere_where_the_radii_add_up(name: str, aside_m: float) -> None:
    skin, tip = 7e-3, {"small": 1.75e-3, "medium": 3.5e-3, "large": 7e-3}[name.split("_")[1]]
    target = np.array([aside_m, 0.0, 0.0])
    travel = first_contact(make_indenter(name), facing(UP), target, UP, ball(skin))
    # The tip is a radius ahead of its centre, which stops where it is skin + tip from the origin.
    assert travel == pytest.approx(tip - math.sqrt((skin + tip) ** 2 - aside_m**2), abs=10e-6)


def test_faces_count_not_only_their_corners() -> None:
    coarse = plate(0.0, count=8)  # faces of 3.4 mm; the tip meets the middle of one
    travel = first_contact(make_indenter("sphere_small"), facing(UP), np.zeros(3), UP, coarse)
    assert travel == pytest.approx(0.0, abs=2e-6)
    quads = coarse.faces
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    halves = OuterSurface(coarse.nodes, triangles)
    travel = first_contact(make_indenter("sphere_small"), facing(UP), np.zeros(3), UP, halves)
    assert travel == pytest.approx(0.0, abs=2e-6)


@settings(max_examples=12)
@given(
    name=st.sampled_from(indenter_names()),
    direction=DIRECTION,
    aim=st.tuples(*3 * [st.floats(-2e-3, 2e-3)]),
)
def test_at_first_contact_the_gap_is_nothing_and_before_it_is_not(
    name: str, direction: Direction, aim: Direction
) -> None:
    indenter, skin, quaternion = make_indenter(name), ball(7e-3, count=17), facing(direction)
    travel = first_contact(indenter, quaternion, aim, direction, skin)
    points = skin.samples(9).reshape(-1, 3)
    for further, low, high in ((0.0, -2e-6, 3e-6), (-1e-4, 1e-9, 1.01e-4)):
        pose = np.concatenate([aim + (travel + further) * unit(direction), quaternion])
        assert low < signed_distance(indenter, to_local(pose, points)).min() < high


def test_an_indenter_that_misses_is_told() -> None:
    away = np.array([0.05, 0.0, 0.0])
    with pytest.raises(SimulationError, match=r"'cube' passes the fingertip without touching"):
        first_contact(make_indenter("cube"), facing(UP), away, UP, ball(7e-3))


@pytest.mark.parametrize("name", indenter_names())
def test_clear_touching_inside_the_skin(name: str) -> None:
    indenter, skin = make_indenter(name), plate(0.0)
    pose = np.array([0.0, 0.0, -0.5e-3, 1.0, 0.0, 0.0, 0.0])
    assert check_clear(indenter, pose, skin) == pytest.approx(0.5e-3, abs=0.05e-3)
    pose[2] = 0.25e-3
    with pytest.raises(SimulationError, match=r"is 0\.2\d+ mm inside the skin") as caught:
        check_clear(indenter, pose, skin)
    assert "further out" in caught.value.remedy


def test_touching_is_not_clear() -> None:
    with pytest.raises(SimulationError, match="touches the skin"):
        check_clear(make_indenter("cube"), np.array([0.0, 0, 0, 1, 0, 0, 0]), plate(0.0))


def test_inside_a_large_finger_is_not_clear_although_no_skin_is_near() -> None:
    pose = np.array([0.0, 0.0, 5e-3, 1.0, 0.0, 0.0, 0.0])
    with pytest.raises(SimulationError, match="all of indenter 'sphere_small' is inside"):
        check_clear(make_indenter("sphere_small"), pose, ball(40e-3))
    assert check_clear(make_indenter("ring"), pose - np.eye(7)[2] * 60e-3, ball(40e-3)) > 0.0


@settings(max_examples=200)
@given(direction=DIRECTION)
def test_facing_turns_z_there_by_the_shortest_way(direction: Direction) -> None:
    quaternion, there = facing(direction), unit(direction)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(rotation_matrices(quaternion)[:, 2], there, atol=1e-14)
    turn = 2 * math.atan2(float(np.linalg.norm(quaternion[1:])), quaternion[0])
    angle = math.atan2(float(np.linalg.norm(np.cross(UP, there))), there[2])
    assert turn == pytest.approx(angle, abs=1e-7)
    assert quaternion[3] == 0.0  # no twist


@pytest.mark.parametrize("tilt", [0.0, 1e-3, 1e-7, 1e-9, 1e-13, 1e-200])
def test_facing_backwards_is_exact_and_exactly_backwards_turns_about_x(tilt: float) -> None:
    direction = np.array([0.6 * tilt, 0.8 * tilt, -1.0])
    matrix = rotation_matrices(facing(direction))
    np.testing.assert_allclose(matrix[:, 2], unit(direction), atol=1e-15)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)


def test_straight_at_the_pad_leaves_x_along_the_finger() -> None:
    np.testing.assert_array_equal(facing((0.0, 0.0, 5.0)), [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(facing((0.0, 0.0, -1.0)), [0.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize("bad", [(0, 0, 0), (1, 2), (math.nan, 0, 1), (math.inf, 0, 0)])
def test_what_is_no_direction_is_refused(bad: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match="is not a direction"):
        facing(bad)
