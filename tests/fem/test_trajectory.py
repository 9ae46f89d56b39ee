"""The paper's indentations: where they aim, how they move, and all of them."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.fem.quad_sphere import quad_sphere

from palpate.errors import ConfigError, SimulationError
from palpate.rigid import path_lengths, rotation_matrices
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.distance import signed_distance
from palpate_fem.indenter.path import PathSegment, check_path, parse_segments
from palpate_fem.mesh.surface import node_normals
from palpate_fem.trajectory import (
    ANGLE_RAD,
    ANGLED_DEPTH_M,
    CLEARANCE_M,
    NORMAL_DEPTH_M,
    Campaign,
    Region,
    angled_direction,
    pad_point,
    press_path,
    sample_targets,
    segment_path,
)

Floats = NDArray[np.float64]

PAD = np.array([0.0, 0.0, -1.0])


def make_finger(count: int = 25) -> OuterSurface:
    """An ellipsoid as long and thick as a fingertip."""
    nodes, faces = quad_sphere(count)
    scale, centre = np.array([14e-3, 7.1e-3, 7.5e-3]), np.array([-7.3e-3, 0.0, -0.8e-3])
    return OuterSurface(nodes * scale + centre, faces)


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
        ({"steps": 10**12}, "1000000000000 steps"),
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


@pytest.mark.parametrize("faces", ["quads", "triangles"])
def test_a_place_of_the_pad_is_the_one_asked_for_on_every_mesh(faces: str) -> None:
    for count in (9, 25):
        finger = make_finger(count)
        if faces == "triangles":
            finger = OuterSurface(finger.nodes, finger.triangles)
        for x, y in [(-7.3e-3, 0.0), (-5.2e-3, 0.5e-3), (-6.1e-3, 0.5e-3), (-0.5e-3, -2.9e-3)]:
            point, normal = pad_point(finger, x, y)
            np.testing.assert_allclose(point[:2], [x, y], rtol=0, atol=1e-12)
            part = np.array([(x + 7.3e-3) / 14e-3, y / 7.1e-3])
            down = math.sqrt(1.0 - part @ part)
            assert point[2] == pytest.approx(-0.8e-3 - 7.5e-3 * down, abs=0.25e-3)
            true = np.array([*(part / [14e-3, 7.1e-3]), -down / 7.5e-3])
            assert np.linalg.norm(normal) == pytest.approx(1.0)
            assert normal @ true / np.linalg.norm(true) > math.cos(math.radians(2.5))


def test_at_a_node_the_pad_has_the_nodes_place_and_normal() -> None:
    normals = node_normals(FINGER.nodes, FINGER.faces)
    lowest = int(FINGER.nodes[:, 2].argmin())
    point, normal = pad_point(FINGER, *FINGER.nodes[lowest, :2])
    np.testing.assert_allclose(point, FINGER.nodes[lowest], rtol=0, atol=1e-15)
    np.testing.assert_allclose(normal, normals[lowest], rtol=0, atol=1e-9)


@pytest.mark.parametrize("place", [(7e-3, 0.0), (-7.3e-3, 7.2e-3), (3e-3, 6.5e-3)])
def test_where_no_pad_is_the_nearest_place_of_it_is_named(place: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match="no pad at") as refused:
        pad_point(FINGER, *place)
    named = re.findall(r"= (\S+) mm", refused.value.remedy)
    assert len(named) == 2
    assert np.hypot(*(np.array(named, float) * 1e-3 - place)) < 2e-3


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


TARGET = np.array([-7.3e-3, 0.0, -8.3e-3])


def path_of(words: str, indenter: str = "sphere_medium", step_m: float = 0.1e-3) -> Floats:
    segments = parse_segments(words)
    return segment_path(make_indenter(indenter), TARGET, PAD, segments, FINGER, step_m=step_m)


def axis_of(path: Floats) -> Floats:
    """Where the indenter faces at each pose."""
    return rotation_matrices(path[:, 3:])[:, :, 2]


@pytest.mark.parametrize("angle", [0, 30])
def test_a_press_in_words_is_the_papers(angle: int) -> None:
    direction = angled_direction(PAD, math.radians(angle), math.pi / 2)
    wanted = press_path(make_indenter("ring"), TARGET, direction, FINGER, depth_m=3e-3, steps=20)
    found = path_of(f"press 3 mm at {angle} deg towards +y", "ring", 0.15e-3)
    np.testing.assert_allclose(found, wanted, atol=1e-15)


def test_steps_are_equal_and_at_most_as_long_as_asked_for() -> None:
    path = path_of("press 1 mm, slide 0.55 mm towards +y, twist 10 deg, roll 10 deg towards +y")
    lengths = np.diff(path_lengths(path))
    assert lengths[1:].max() <= 0.1e-3 + 1e-12
    counts = 10, 6, 7, 7  # 3.5 mm times 10 degrees are 0.61 mm
    assert len(lengths) == sum(counts)
    for part in np.split(lengths, np.cumsum(counts)[:-1]):
        np.testing.assert_allclose(part[1:], part[1], rtol=0.02)  # a roll's tip speeds up


@pytest.mark.parametrize("between", ["unload", "unload 3 mm", "unload, slide 1 mm towards +y"])
def test_a_press_out_of_the_skin_counts_from_first_contact(between: str) -> None:
    """However the indenter came to be clear of it."""
    path = path_of(f"press 1 mm, {between}, press 0.5 mm")
    gap = signed_distance(
        make_indenter("sphere_medium"),
        (FINGER.nodes - path[-1, :3]) @ rotation_matrices(path[-1, 3:]),
    ).min()
    assert -0.55e-3 < gap < -0.3e-3


@pytest.mark.parametrize(
    ("where", "way"),
    [("distal", (1, 0)), ("+y", (0, 1)), ("proximal", (-1, 0)), ("-y", (0, -1))],
)
def test_a_slide_goes_along_the_skin_and_turns_nothing(where: str, way: tuple[int, int]) -> None:
    path = path_of(f"press 1 mm, slide 0.5 mm towards {where}")
    np.testing.assert_allclose(
        path[-1, :3] - path[-6, :3], [*(0.5e-3 * np.array(way)), 0.0], atol=1e-15
    )
    np.testing.assert_array_equal(path[:, 3:], np.tile(path[0, 3:], (16, 1)))


def test_a_twist_turns_about_the_axis_on_the_spot() -> None:
    path = path_of("press 1 mm at 30 deg towards +y, twist 20 deg")
    first, last = path[10], path[-1]
    np.testing.assert_array_equal(last[:3], first[:3])
    turn = rotation_matrices(last[3:]) @ rotation_matrices(first[3:]).T
    axis = axis_of(first[None])[0]
    np.testing.assert_allclose(turn @ axis, axis, atol=1e-14)
    across = np.cross(axis, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    assert np.cross(across, turn @ across) @ axis == pytest.approx(math.sin(math.radians(20.0)))


@pytest.mark.parametrize(
    ("indenter", "where", "radius"),
    [
        ("sphere_large", (1, 0), 7e-3),
        ("sphere_small", (0, -1), 1.75e-3),
        ("cylinder_long", (0, 1), 3.5e-3),
        ("cylinder_long", (1, 0), 0.0),  # flat that way, so it turns about its tip
        ("ring", (0, 1), 0.0),  # its tip is in the bore
        ("cube", (0, 1), 0.0),
    ],
)
def test_a_roll_does_not_slip(indenter: str, where: tuple[int, int], radius: float) -> None:
    """The middle of the curvature moves by the arc, so the point that touches stands still."""
    words = {(1, 0): "distal", (0, 1): "+y", (0, -1): "-y"}[where]
    path = path_of(f"press 1 mm, roll 20 deg towards {words}", indenter)
    along = np.array([*where, 0.0])
    middle = path[:, :3] - radius * axis_of(path)
    moved = middle[-1] - middle[10]
    np.testing.assert_allclose(moved, radius * math.radians(20.0) * along, atol=1e-9)
    tilt = axis_of(path)[-1]
    np.testing.assert_allclose(
        tilt, math.cos(math.radians(20)) * -PAD - math.sin(math.radians(20)) * along, atol=1e-12
    )
    one = path[11]  # a small turn: the velocity of the point below the middle
    contact = middle[10] - radius * PAD
    local = (contact - path[10, :3]) @ rotation_matrices(path[10, 3:])
    slip = rotation_matrices(one[3:]) @ local + one[:3] - contact
    assert np.linalg.norm(slip) < 0.02 * np.linalg.norm(one[:3] - path[10, :3]) + 0.3e-3 * 0.05


@pytest.mark.parametrize("indenter", ["sphere_small", "cube", "ring", "cylinder_long"])
def test_unloading_ends_just_clear_of_the_skin_wherever_it_went(indenter: str) -> None:
    path = path_of(
        "press 1.5 mm at 20 deg towards distal, slide 1 mm towards -y, twist 30 deg, "
        "roll 10 deg towards +y, unload",
        indenter,
    )
    assert 0.0 < check_clear(make_indenter(indenter), path[-1], FINGER) <= CLEARANCE_M + 15e-6
    with pytest.raises(SimulationError):
        check_clear(make_indenter(indenter), path[-2], FINGER)


def test_after_unloading_a_press_counts_from_contact_again() -> None:
    path = path_of("press 1 mm, unload, press 0.5 mm")
    assert path[-1, 2] == pytest.approx(path[5, 2], abs=1e-9)
    part = path_of("press 1 mm, unload 0.3 mm, press 0.2 mm")
    assert part[-1, 2] == pytest.approx(path[9, 2], abs=1e-12)


def test_a_slide_off_the_finger_can_unload() -> None:
    path = path_of("press 0.5 mm, slide 16 mm towards +y, unload")
    assert path[-1, 1] == pytest.approx(16e-3)


@pytest.mark.parametrize(
    "before",
    [
        "press 0.5 mm, slide 16 mm towards +y",  # it lies behind, or nowhere
        "press 0.5 mm, slide 16 mm towards +y, unload",
        "press 0.5 mm, unload, slide 5 mm towards +y",
    ],
)
def test_a_later_press_that_passes_the_finger_is_refused(before: str) -> None:
    """It would go through air and come to its end without force."""
    passes = "press 0.5 mm at 75 deg towards 90 deg"
    with pytest.raises(SimulationError, match=f"{passes}' passes the fingertip"):
        path_of(f"{before}, {passes}", "sphere_small")


@pytest.mark.parametrize("step_m", [1e-8, 1e-300, 0.0, math.nan, math.inf])
def test_steps_that_are_too_many_or_none_are_refused(step_m: float) -> None:
    with pytest.raises(ConfigError, match=r"poses|step_m"):
        path_of("press 1 mm, slide 20 mm towards +y", step_m=step_m)


@pytest.mark.parametrize(
    ("segments", "problem"),
    [
        ([], "begin with a press"),
        ([PathSegment("slide", 1e-3)], "begin with a press"),
        ([PathSegment("press")], "press by None"),
        ([PathSegment("press", 1e-3), PathSegment("slide", -1e-3)], "slide by -0.001"),
        ([PathSegment("press", 1e-3), PathSegment("twist", math.nan)], "twist by nan"),
        ([PathSegment("press", 1e-3), PathSegment("jump", 1e-3)], "'jump' is no segment"),
    ],
)
def test_segments_that_make_no_path_are_refused(segments: list[PathSegment], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        segment_path(make_indenter("cube"), TARGET, PAD, segments, FINGER)


def test_a_press_may_turn_the_indenter_about_its_axis_beforehand() -> None:
    def path(words: str) -> Floats:
        target = np.array([-7.3e-3, 0.0, -8.3e-3])
        return segment_path(make_indenter("cube"), target, PAD, parse_segments(words), FINGER)

    plain, turned = path("press 1 mm at 20 deg"), path("press 1 mm at 20 deg turned 30 deg")
    before, after = (rotation_matrices(one[:, 3:]) for one in (plain, turned))
    half = math.radians(30.0)
    spin = np.array(
        [[math.cos(half), -math.sin(half), 0], [math.sin(half), math.cos(half), 0], [0, 0, 1]]
    )
    np.testing.assert_allclose(after, before @ spin, atol=1e-12)
    check_clear(make_indenter("cube"), turned[0], FINGER)
    with pytest.raises(ConfigError, match="turns the indenter on the way"):
        parse_segments("press 1 mm, press 1 mm turned 3 deg")
    for wrong in ("press 1 mm turned 400 deg", "press 1 mm, unload turned 3 deg"):
        with pytest.raises(ConfigError, match="cannot be turned so"):
            parse_segments(wrong)
