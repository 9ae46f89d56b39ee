"""The plan: what is commanded, by which arm, and what is eliminated."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.errors import ConfigError
from palpate.rigid import rotation_matrices
from palpate_training.experiment import stand_in_arm as stand_in
from palpate_training.experiment.kinematics import ACCURACY_M
from palpate_training.experiment.plan import (
    ArmBase,
    PlannedTrajectory,
    RobotPlan,
    assign_arm,
    commanded_travel,
    increments_of,
    make_plan,
)

sys.path.append(str(Path(__file__).parent))
fakes: Any = importlib.import_module("testbed_fakes")
bases, two_arms = fakes.bases, fakes.two_arms
trajectory = fakes.trajectory


@pytest.mark.parametrize(("depth_m", "increments"), [(3e-3, 60), (1.5e-3, 45)])
def test_a_trajectory_is_the_papers(depth_m: float, increments: int) -> None:
    item = trajectory(depth_m=depth_m)
    assert len(item.travel_m) == increments + 1
    assert item.duration_s == 5.0 * increments
    np.testing.assert_allclose(np.diff(item.travel_m), 1e-4)
    # 3 mm before first contact, which is 0.4 mm before the target; then the depth past it
    along = (item.poses[:, :3] - item.target) @ item.direction
    np.testing.assert_allclose(along[[0, 30, -1]], [-3.4e-3, -0.4e-3, depth_m - 0.4e-3])


def test_the_tip_faces_where_it_moves() -> None:
    item = trajectory(tilt_rad=0.5)
    np.testing.assert_allclose(
        rotation_matrices(item.poses[:, 3:]) @ [0, 0, 1],
        np.tile(item.direction, (len(item.poses), 1)),
        atol=1e-12,
    )
    across = np.cross(item.poses[:, :3] - item.target, item.direction)
    np.testing.assert_allclose(across, 0.0, atol=1e-15)


@given(st.floats(1e-4, 0.019))
def test_increments_never_pass_the_end(length_m: float) -> None:
    travel = increments_of(length_m)
    assert travel[0] == 0
    assert travel[-1] <= length_m + 1e-9
    assert travel[-1] > length_m - 1e-4 - 1e-9


def test_travel_moves_at_the_start_of_an_increment_then_dwells() -> None:
    travel = increments_of(1e-3)
    time_s = np.arange(0, 50, 0.01)
    commanded = commanded_travel(time_s, travel)
    assert (np.diff(commanded) >= 0).all()
    assert commanded[0] == 0
    np.testing.assert_allclose(commanded[499::500], travel[1:])
    moving = np.diff(commanded) > 0
    assert moving.mean() == pytest.approx(0.2 / 5, abs=0.005)
    np.testing.assert_allclose(commanded_travel(np.array([0.1, 5.1]), travel), [0.5e-4, 1.5e-4])
    np.testing.assert_allclose(commanded_travel(np.array([1e3]), travel), travel[-1:])


def test_points_are_assigned_by_side() -> None:
    assert assign_arm([0, 1e-6, 0]) == "left"
    assert assign_arm([0, 0, 0]) == "left"
    assert assign_arm([0, -1e-6, 0]) == "right"


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"arm": "third"}, "left or right"),
        ({"depth_m": 3.0}, "metres"),
        ({"depth_m": 0.0}, "metres"),
        ({"contact_m": float("nan")}, "metres"),
        ({"target": np.array([0, np.nan, 0])}, "not a point"),
        ({"direction": np.zeros(3)}, "direction"),
    ],
)
def test_a_trajectory_that_is_none_is_refused(change: dict[str, Any], match: str) -> None:
    values = {
        "trajectory": "a/00/normal",
        "indenter": "a",
        "arm": "left",
        "target": np.zeros(3),
        "direction": np.array([0.0, 0.0, 1.0]),
        "contact_m": 0.0,
        "depth_m": 1e-3,
    }
    with pytest.raises(ConfigError, match=f"a/00/normal.*{match}"):
        PlannedTrajectory(**{**values, **change})


def test_joints_bring_the_tip_to_the_commands(
    two_arms: RobotPlan, bases: dict[str, ArmBase]
) -> None:
    assert [motion.trajectory.arm for motion in two_arms.motions] == ["left", "right"]
    for motion in two_arms.motions:
        base = bases[motion.trajectory.arm]
        assert base.arm is not None
        assert motion.joints is not None
        tips, _ = base.arm.tip(motion.joints)
        missed = base.sensor_robot.apply(tips) - motion.trajectory.poses[:, :3]
        assert np.linalg.norm(missed, axis=1).max() <= ACCURACY_M
    first, second = two_arms.motions
    assert first.time_s[0] == 0
    assert first.time_s[-1] == first.trajectory.duration_s
    assert second.start_s > first.time_s[-1]


def test_what_an_arm_cannot_follow_is_eliminated(bases: dict[str, ArmBase]) -> None:
    far = trajectory("far/00/normal", target=(-1.2, 0.0, 0.0))
    made, eliminated = make_plan([far, trajectory("near/00/normal", depth_m=1e-4)], bases)
    assert [motion.trajectory.trajectory for motion in made.motions] == ["near/00/normal"]
    assert [item.trajectory for item in eliminated] == ["far/00/normal"]
    assert "misses by" in eliminated[0].reason
    assert set(made.bases) == {"left"}
    # without kinematics nobody can tell
    bare = {"left": ArmBase(stand_in.sensor_robot("left"))}
    made, eliminated = make_plan([far], bare)
    assert not eliminated
    assert made.motions[0].joints is None


def test_plans_that_cannot_be_are_refused(bases: dict[str, ArmBase]) -> None:
    with pytest.raises(ConfigError, match="planned twice"):
        make_plan([trajectory(depth_m=1e-4)] * 2, bases)
    with pytest.raises(ConfigError, match="right arm, which is not registered"):
        make_plan([trajectory(lateral_m=-1e-3)], {"left": bases["left"]})
