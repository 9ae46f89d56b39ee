"""The paper's indentations: where they aim, how they move, and all of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.errors import ConfigError, SimulationError
from palpate.rigid import rotation_matrices
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.path import check_path
from palpate_fem.trajectory import (
    ANGLE_RAD,
    ANGLED_DEPTH_M,
    CLEARANCE_M,
    NORMAL_DEPTH_M,
    Campaign,
    Region,
    angled_direction,
    press_path,
    sample_targets,
)

Floats = NDArray[np.float64]

PAD = np.array([0.0, 0.0, -1.0])


def make_finger(count: int = 25) -> OuterSurface:
    """An ellipsoid as long and thick as a fingertip, made of a cube of quads."""
    nodes: list[Floats] = []
    faces: list[NDArray[np.int64]] = []
    part = np.tan(np.linspace(-np.pi / 4, np.pi / 4, count))
    u, v = (grid.ravel() for grid in np.meshgrid(part, part, indexing="ij"))
    first = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    quads = np.stack([first, first + count, first + count + 1, first + 1], axis=1)
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.empty((len(u), 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, u, v
            faces.append((quads if side > 0 else quads[:, ::-1]) + len(nodes) * len(u))
            nodes.append(face / np.linalg.norm(face, axis=1, keepdims=True))
    scale, centre = np.array([14e-3, 7.1e-3, 7.5e-3]), np.array([-7.3e-3, 0.0, -0.8e-3])
    return OuterSurface(
        np.concatenate(nodes) * scale + centre, np.concatenate(faces).astype(np.int32)
    )


FINGER = make_finger()


def test_a_normal_path_starts_clear_and_goes_in_by_equal_steps_from_contact() -> None:
    target = np.array([-7.3e-3, 0.0, -8.3e-3])
    path = press_path(make_indenter("sphere_medium"), target, -PAD, FINGER, depth_m=NORMAL_DEPTH_M)
    assert path.shape == (21, 7)
    np.testing.assert_array_equal(path, check_path(path))
    np.testing.assert_allclose(path[:, :2], np.broadcast_to(target[:2], (21, 2)), atol=1e-18)
    np.testing.assert_allclose(path[:, 3:], np.broadcast_to([1.0, 0, 0, 0], (21, 4)))
    np.testing.assert_allclose(np.diff(path[1:, 2]), 3e-3 / 20, atol=1e-15)
    assert path[1, 2] - path[0, 2] == pytest.approx(CLEARANCE_M + 3e-3 / 20, abs=1e-15)
    assert path[0, 2] == pytest.approx(-8.3e-3 - CLEARANCE_M, abs=5e-6)


@pytest.mark.parametrize("azimuth", range(4))
def test_an_angled_path_moves_at_30_degrees_and_faces_there(azimuth: int) -> None:
    target = np.array([-7.3e-3, 0.0, -8.3e-3])
    direction = angled_direction(PAD, ANGLE_RAD, azimuth * math.pi / 2)
    path = press_path(
        make_indenter("sphere_medium"), target, direction, FINGER, depth_m=ANGLED_DEPTH_M
    )
    way = path[-1, :3] - path[1, :3]
    assert np.linalg.norm(path[-1, :3] - path[0, :3]) == pytest.approx(1.5e-3 + CLEARANCE_M)
    way /= np.linalg.norm(way)
    assert math.acos(-PAD @ way) == pytest.approx(ANGLE_RAD, abs=1e-9)
    np.testing.assert_allclose(rotation_matrices(path[0, 3:])[:, 2], way, atol=1e-12)
    aside = [(1, 0), (0, 1), (-1, 0), (0, -1)][azimuth]  # distal, +y, proximal, -y
    np.testing.assert_allclose(way[:2], math.sin(ANGLE_RAD) * np.array(aside), atol=1e-12)


def test_an_angled_direction_exists_everywhere_even_at_the_very_tip() -> None:
    random = np.random.default_rng(0)
    for normal in (*random.normal(size=(50, 3)), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)):
        inward = -np.asarray(normal) / np.linalg.norm(normal)
        for azimuth in (0.0, 1.0, 4.0):
            direction = angled_direction(normal, ANGLE_RAD, azimuth)
            assert np.linalg.norm(direction) == pytest.approx(1.0)
            assert direction @ inward == pytest.approx(math.cos(ANGLE_RAD))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"depth_m": 0.0}, "depth_m = 0.0"),
        ({"depth_m": math.nan}, "depth_m = nan"),
        ({"clearance_m": -1e-3}, "clearance_m"),
        ({"steps": 0}, "0 steps"),
        ({"target": [0.0, math.nan, 0.0]}, "target"),
        ({"direction": [0.0, 0.0, 0.0]}, "not a direction"),
    ],
)
def test_what_makes_no_path_is_refused(change: dict[str, object], problem: str) -> None:
    wanted = {"target": [-7e-3, 0.0, -8e-3], "direction": -PAD, "depth_m": 1e-3, **change}
    with pytest.raises(ConfigError, match=problem):
        press_path(make_indenter("cube"), surface=FINGER, **wanted)  # type: ignore[arg-type]


def test_a_path_beside_the_finger_is_refused() -> None:
    with pytest.raises(SimulationError, match="passes the fingertip"):
        press_path(make_indenter("sphere_small"), [0.0, 0.03, 0.0], -PAD, FINGER, depth_m=3e-3)


def test_targets_lie_on_the_region_with_outward_normals() -> None:
    points, normals = sample_targets(FINGER, 400, seed=3)
    assert points.shape == normals.shape == (400, 3)
    assert Region().holds(points, normals).all()
    exact = (points - [-7.3e-3, 0.0, -0.8e-3]) / np.square([14e-3, 7.1e-3, 7.5e-3])
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    angle = np.degrees(np.arccos((exact * normals).sum(axis=1).clip(-1, 1)))
    assert angle.max() < 2.5  # at the seams of the cube, whose nodes see one side only
    assert np.median(angle) < 0.2


def test_targets_are_the_same_again_and_more_of_them_begin_alike() -> None:
    ten, _ = sample_targets(FINGER, 10, seed=5)
    again, _ = sample_targets(FINGER, 200, seed=5)
    other, _ = sample_targets(FINGER, 10, seed=6)
    np.testing.assert_array_equal(ten, again[:10])
    assert np.abs(ten - other).max() > 1e-4


def test_targets_are_even_by_area() -> None:
    # A surface twice as fine on one side must not draw more points there.
    x = np.concatenate([np.linspace(-10e-3, -5e-3, 41), np.linspace(-5e-3, 0.0, 11)[1:]])
    y = np.linspace(-4e-3, 4e-3, 11)
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    nodes = np.column_stack([grid, np.full(len(grid), -8e-3)])
    first = (np.arange(len(x) - 1)[:, None] * 11 + np.arange(10)).ravel()
    faces = np.stack([first, first + 1, first + 12, first + 11], axis=1).astype(np.int32)
    points, normals = sample_targets(OuterSurface(nodes, faces), 4000)
    np.testing.assert_allclose(normals, np.broadcast_to(PAD, normals.shape), atol=1e-12)
    assert (points[:, 0] < -5e-3).mean() == pytest.approx(0.5, abs=0.03)  # 3.8 deviations
    assert points[:, 1].mean() == pytest.approx(0.0, abs=0.15e-3)


def test_a_surface_without_the_region_is_refused() -> None:
    inside_out = OuterSurface(FINGER.nodes, FINGER.faces[:, ::-1])
    with pytest.raises(ConfigError, match="no part of the surface lies in"):
        sample_targets(inside_out, 3, region=Region(half_width_m=1e-3))
    with pytest.raises(ConfigError, match="no part of the surface lies in"):
        sample_targets(OuterSurface(FINGER.nodes * 1e3, FINGER.faces), 3)


def test_the_campaign_is_the_papers() -> None:
    campaign = Campaign(FINGER)
    assert len(campaign) == 450
    assert campaign.indenters == indenter_names()


def test_each_indentation_has_its_name_depth_and_place_and_starts_clear() -> None:
    campaign = Campaign(FINGER, indenters=("sphere_large", "ring", "cube"), points=2)
    planned = list(campaign)
    assert len(planned) == len(campaign) == 30
    assert [p.name for p in planned[5:10]] == [
        "sphere_large/01/normal",
        *(f"sphere_large/01/angled-{k}" for k in range(4)),
    ]
    assert len({p.name for p in planned}) == 30
    for p in planned:
        indenter = make_indenter(p.indenter)
        straight = p.name.endswith("normal")
        assert p.depth_m == (3e-3 if straight else 1.5e-3)
        angle = math.acos(min(1.0, float(-p.normal @ p.direction)))
        assert angle == pytest.approx(0.0 if straight else ANGLE_RAD, abs=1e-7)
        np.testing.assert_allclose(
            p.path[-1, :3], p.target + (p.contact_m + p.depth_m) * p.direction, atol=1e-15
        )
        assert 0.0 < check_clear(indenter, p.path[0], FINGER) <= CLEARANCE_M + 15e-6
        with pytest.raises(SimulationError):
            check_clear(indenter, p.path[1], FINGER)


def test_fewer_angled_ones_are_the_first_of_all() -> None:
    whole = {p.name: p for p in Campaign(FINGER, indenters=("ring",), points=1)}
    some = Campaign(FINGER, indenters=("ring",), points=1, angled=1)
    assert [p.name for p in some] == ["ring/00/normal", "ring/00/angled-0"]
    assert len(some) == 2
    for p in some:
        np.testing.assert_array_equal(p.path, whole[p.name].path)


def test_an_indenters_points_are_its_own_and_do_not_depend_on_the_others() -> None:
    both = list(Campaign(FINGER, indenters=("sphere_small", "sphere_medium"), points=1))
    alone = list(Campaign(FINGER, indenters=("sphere_medium",), points=1))
    np.testing.assert_array_equal([p.path for p in both[5:]], [p.path for p in alone])
    assert np.abs(both[0].target - both[5].target).max() > 1e-4
    other = next(iter(replace(Campaign(FINGER, indenters=("sphere_medium",)), seed=1)))
    assert np.abs(other.target - alone[0].target).max() > 1e-4
    assert next(iter(Campaign(FINGER, indenters=("sphere_7mm",)))).name == "sphere_medium/00/normal"
