"""Registration: planted transforms come back, and what is wrong with holes is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.errors import ConfigError, DatasetError
from palpate.rigid import Transform, quaternions_of, rotation_matrices
from palpate_training.experiment.clearance import plate_holes
from palpate_training.experiment.plan import facing
from palpate_training.experiment.registration import (
    average,
    frame_of,
    register,
    write_registrations,
)

Floats = npt.NDArray[np.float64]

ROUNDING_M = 1e-12
"""Coordinates of half a metre in float64, a few dozen operations."""

unit_quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
places = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


def planted(seed: int = 3) -> Transform:
    random = np.random.default_rng(seed)
    q = random.normal(size=4)
    return Transform(rotation_matrices(q / np.linalg.norm(q)), random.uniform(-0.5, 0.5, 3))


@given(unit_quaternions)
def test_quaternions_and_matrices_are_the_same_turns(quaternion: Floats) -> None:
    matrix = rotation_matrices(quaternion)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) > 0
    back = quaternions_of(matrix)
    assert back[0] >= 0
    np.testing.assert_allclose(rotation_matrices(back), matrix, atol=1e-12)


def test_quaternion_is_w_first_and_turns_the_right_way() -> None:
    quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # about z
    np.testing.assert_allclose(rotation_matrices(quarter) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@given(places.filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_an_indenter_faces_where_it_presses_by_the_shortest_turn(direction: Floats) -> None:
    along = direction / np.linalg.norm(direction)
    quaternion = facing(direction)
    np.testing.assert_allclose(rotation_matrices(quaternion) @ [0, 0, 1], along, atol=1e-9)
    angle = 2 * np.arccos(np.clip(quaternion[0], -1, 1))
    np.testing.assert_allclose(angle, np.arccos(np.clip(along[2], -1, 1)), atol=1e-6)


@pytest.mark.parametrize("z", [1.0, -1.0])
def test_an_indenter_faces_straight_up_and_down(z: float) -> None:
    matrix = rotation_matrices(facing([0, 0, z]))
    np.testing.assert_allclose(matrix, np.diag([1, z, z]), atol=1e-15)


def test_poses_are_mapped_as_points_and_axes_are() -> None:
    outer, inner = planted(1), planted(2)
    (pose,) = outer.apply_poses(inner.pose[None])
    both = outer @ inner
    np.testing.assert_allclose(Transform.from_pose(pose).rotation, both.rotation, atol=1e-12)
    np.testing.assert_allclose(pose[:3], outer.apply(inner.translation), atol=1e-12)
    back = outer.inverse() @ outer
    np.testing.assert_allclose(back.pose, [0, 0, 0, 1, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("bad", [np.zeros(7), np.full(7, np.nan), np.ones(6)])
def test_a_pose_that_is_none_is_refused(bad: Floats) -> None:
    with pytest.raises(ConfigError, match="of the plate"):
        Transform.from_pose(bad, "pose of the plate")


def test_frame_of_three_holes_is_marvels() -> None:
    frame = frame_of(np.array([[1.0, 1, 1], [3, 1, 1], [2, 5, 1]]))
    np.testing.assert_allclose(frame.rotation, np.eye(3), atol=1e-15)
    np.testing.assert_array_equal(frame.translation, [1, 1, 1])
    assert np.linalg.det(frame_of(plate_holes()[:3]).rotation) == pytest.approx(1)


@given(unit_quaternions, places)
def test_a_planted_transform_comes_back(quaternion: Floats, place: Floats) -> None:
    true = Transform(rotation_matrices(quaternion), place)  # robot -> sensor
    found = register(true.inverse().apply(plate_holes()), plate_holes())
    finger = np.array([-0.005, 0.0, -0.008])
    in_robot = true.inverse().apply(finger)
    assert np.linalg.norm(found.sensor_robot.apply(in_robot) - finger) < ROUNDING_M
    np.testing.assert_allclose(found.sensor_robot.rotation, true.rotation, atol=1e-12)
    assert found.residual_m.max() < ROUNDING_M
    assert found.triples == 4


def test_three_holes_are_enough() -> None:
    true = planted()
    holes = plate_holes()[[0, 1, 3]] * [1.0, 1.3, 1.0]  # no two sides alike
    found = register(true.inverse().apply(holes), holes, names=("a", "b", "c"))
    assert found.triples == 1
    assert found.holes == ("a", "b", "c")
    np.testing.assert_allclose(found.sensor_robot.pose, true.pose, atol=1e-12)


def test_the_average_lies_between() -> None:
    turns = [facing([np.sin(a), 0, np.cos(a)]) for a in (0.0, 0.02, 0.04)]
    mean = average([Transform(rotation_matrices(q), np.full(3, i)) for i, q in enumerate(turns)])
    np.testing.assert_allclose(mean.rotation, rotation_matrices(turns[1]), atol=1e-12)
    np.testing.assert_allclose(mean.translation, 1.0)


def test_one_bad_hole_has_the_largest_residual_and_is_averaged_down() -> None:
    true = planted()
    in_robot = true.inverse().apply(plate_holes())
    in_robot[2] += true.rotation.T @ [0.0, 0.0, 1e-3]
    found = register(in_robot, plate_holes())
    assert found.residual_m.shape == (4,)
    assert 0.1e-3 < found.residual_m.max() < 1e-3
    centre = plate_holes().mean(axis=0)
    missed = found.sensor_robot.apply(true.inverse().apply(centre)) - centre
    assert np.linalg.norm(missed) < 0.5e-3


def test_swapped_holes_are_named() -> None:
    in_robot = planted().inverse().apply(plate_holes())
    for first, second in ((0, 1), (0, 2), (1, 2), (2, 3)):
        order = [0, 1, 2, 3]
        order[first], order[second] = second, first
        with pytest.raises(ConfigError, match=f"hole {first + 1} and hole {second + 1} seem"):
            register(in_robot[order], plate_holes())


def test_a_pair_that_does_not_fit_is_named() -> None:
    in_robot = planted().inverse().apply(plate_holes())
    away = in_robot[3] - in_robot[:3].mean(axis=0)
    in_robot[3] += 5e-3 * away / np.linalg.norm(away)
    with pytest.raises(ConfigError, match=r"and d are \d+\.\d+ mm apart by the robot"):
        register(in_robot, plate_holes(), names=("a", "b", "c", "d"))
    with pytest.raises(ConfigError, match="units"):
        register(in_robot * 1e3, plate_holes())


def test_a_mirrored_drawing_is_refused() -> None:
    """Holes that are not in one plane show it; distances do not."""
    holes = plate_holes()
    holes[0, 2] += 0.03
    with pytest.raises(ConfigError, match="mirror"):
        register(planted().apply(holes * [1, 1, -1]), holes)


def test_a_plate_on_which_holes_can_be_confused_is_refused() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * 0.05
    in_robot = planted().inverse().apply(square)
    with pytest.raises(ConfigError, match="would go unseen"):
        register(in_robot, square)
    found = register(in_robot, square, allow_symmetric=True)
    np.testing.assert_allclose(found.sensor_robot.pose, planted().pose, atol=1e-12)


def test_holes_on_a_line_are_named() -> None:
    holes = plate_holes()
    holes[2] = (holes[0] + holes[1]) / 2
    with pytest.raises(ConfigError, match="hole 1, hole 2, hole 3 lie on a line by the drawing"):
        register(holes, holes)


@pytest.mark.parametrize(
    ("in_robot", "in_sensor", "match"),
    [
        (plate_holes()[:2], plate_holes()[:2], "2 holes"),
        (plate_holes()[:3], plate_holes(), "3 holes by the robot, 4 by the drawing"),
        (plate_holes()[:, :2], plate_holes(), "shape"),
        (np.where(np.arange(4)[:, None] == 2, np.nan, plate_holes()), plate_holes(), "hole 3 is"),
    ],
)
def test_holes_that_are_none_are_refused(in_robot: Floats, in_sensor: Floats, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        register(in_robot, in_sensor)


def test_names_belong_to_holes() -> None:
    with pytest.raises(ConfigError, match="a name of its own"):
        register(plate_holes(), plate_holes(), names=("a", "a", "b", "c"))


def test_registrations_that_the_disk_refuses_leave_nothing_behind(tmp_path: Path) -> None:
    true = planted()
    found = register(true.inverse().apply(plate_holes()), plate_holes())
    (tmp_path / "arms.json").mkdir()
    with pytest.raises(DatasetError, match=r"cannot write .*arms\.json"):
        write_registrations(tmp_path / "arms.json", {"left": found})
    assert [path.name for path in tmp_path.iterdir()] == ["arms.json"]
