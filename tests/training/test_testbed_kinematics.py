"""Kinematics: a hand-made arm against trigonometry, the stand-in arm against itself."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import ConfigError, MissingExtraError
from palpate.rigid import Transform, rotation_matrices
from palpate_training.experiment import stand_in_arm as stand_in
from palpate_training.experiment.kinematics import ACCURACY_M, ArmKinematics
from palpate_training.experiment.plan import facing

PLANAR = """<robot name="planar">
<link name="base"/><link name="upper"/><link name="fore"/><link name="hand"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="upper"/>
  <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
  <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="j2" type="{kind}"><parent link="upper"/><child link="fore"/>
  <origin xyz="0.3 0 0"/><axis xyz="0 0 1"/>
  <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="wrist" type="fixed"><parent link="fore"/><child link="hand"/>
  <origin xyz="0.2 0 0"/></joint>
</robot>
"""
TOOL = Transform(np.eye(3), np.array([0.05, 0.0, -0.02]))


@pytest.fixture
def planar(tmp_path: Path) -> ArmKinematics:
    path = tmp_path / "planar.urdf"
    path.write_text(PLANAR.format(kind="revolute"))
    return ArmKinematics.from_urdf(path, "hand", TOOL)


@pytest.fixture(params=stand_in.SIDES)
def seven(request: pytest.FixtureRequest, tmp_path: Path) -> ArmKinematics:
    path = stand_in.write_arm_urdf(request.param, tmp_path / "arm.urdf")
    return ArmKinematics.from_urdf(path, stand_in.FLANGE, stand_in.tool())


def test_tip_is_where_trigonometry_has_it(planar: ArmKinematics) -> None:
    joints = np.array([[0.0, 0.0], [0.4, -1.1], [-1.9, 0.7]])
    positions, quaternions = planar.tip(joints)
    first, both = joints[:, 0], joints.sum(axis=1)
    expected = np.stack(
        [
            0.3 * np.cos(first) + 0.25 * np.cos(both),
            0.3 * np.sin(first) + 0.25 * np.sin(both),
            np.full(3, 0.08),
        ],
        axis=1,
    )
    np.testing.assert_allclose(positions, expected, atol=1e-15)
    half = both / 2
    turned = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    np.testing.assert_allclose(rotation_matrices(quaternions), rotation_matrices(turned), atol=1e-9)
    assert planar.joint_names == ("j1", "j2")


def test_link_frames_turn_with_their_joints(planar: ArmKinematics) -> None:
    origins, rotations = planar.link_frames([[0.4, -1.1]])
    np.testing.assert_allclose(
        origins[0], [[0, 0, 0.1], [0.3 * np.cos(0.4), 0.3 * np.sin(0.4), 0.1]], atol=1e-15
    )
    np.testing.assert_allclose(
        rotations[0, 1] @ [1, 0, 0], [np.cos(-0.7), np.sin(-0.7), 0], atol=1e-15
    )


def test_inverse_is_the_inverse(seven: ArmKinematics) -> None:
    random = np.random.default_rng(1)
    joints = random.uniform(0.8 * seven.lower, 0.8 * seven.upper, (10, 7))
    poses = np.hstack(seven.tip(joints))
    for pose, start in zip(poses, joints + random.uniform(-0.2, 0.2, joints.shape), strict=True):
        start = np.clip(start, seven.lower, seven.upper)
        found = seven.solve(pose[None], start=start)
        assert found.reached
        positions, quaternions = seven.tip(found.joints)
        assert np.linalg.norm(positions - pose[:3]) <= ACCURACY_M
        assert abs(abs(float(quaternions[0] @ pose[3:])) - 1) < 1e-9
        np.testing.assert_allclose(
            found.position_error_m[0], np.linalg.norm(positions - pose[:3]), atol=1e-12
        )


def test_a_path_keeps_the_posture(seven: ArmKinematics) -> None:
    start = np.hstack(seven.tip([stand_in.HOME]))[0]
    path = np.tile(start, (61, 1))
    path[:, 2] -= 1e-4 * np.arange(61)
    found = seven.solve(path, start=stand_in.HOME)
    assert found.reached
    assert np.abs(np.diff(found.joints, axis=0)).max() < 0.01  # 0.1 mm on a lever of 0.1 m: 1 mrad
    assert (found.joints >= seven.lower).all()
    assert (found.joints <= seven.upper).all()


def test_what_is_out_of_reach_is_said_and_stays_within_limits(seven: ArmKinematics) -> None:
    far = np.array([[0.9, 0, 0.3, *facing([1, 0, 0])]])
    found = seven.solve(far)
    assert not found.reached
    assert found.position_error_m[0] > 0.05
    assert (found.joints >= seven.lower).all()
    assert (found.joints <= seven.upper).all()


def test_the_arms_are_mirror_images(tmp_path: Path) -> None:
    left, right = (
        ArmKinematics.from_urdf(stand_in.write_arm_urdf(side, tmp_path / side), stand_in.FLANGE)
        for side in stand_in.SIDES
    )
    random = np.random.default_rng(2)
    joints = random.uniform(right.lower, right.upper, (5, 7))
    np.testing.assert_allclose(left.tip(joints)[0], right.tip(joints)[0] * [1, -1, 1], atol=1e-12)
    # they stand either side of the finger: y >= 0 is left
    assert stand_in.sensor_robot("left").translation[1] > 0.1
    assert stand_in.sensor_robot("right").translation[1] < -0.1
    with pytest.raises(ConfigError, match="'middle'"):
        stand_in.arm_urdf("middle")


def test_every_joint_moves_the_tip(seven: ArmKinematics) -> None:
    bent = np.full(7, 0.3)
    still = seven.tip([bent])[0]
    moved = seven.tip(bent + 0.1 * np.eye(7))[0]
    # all but the last, whose axis is the tool's
    assert (np.linalg.norm(moved - still, axis=1)[:6] > 1e-3).all()


@pytest.mark.parametrize(
    ("joints", "match"),
    [
        ([[0.0, 0.0, 0.0]], "2 joints"),
        ([0.0, 0.0], "2 joints"),
        ([[0.0, 0.0], [0.0, np.nan]], "j2 is nan in row 1"),
        ([[0.0, 0.0], [2.1, 0.0]], r"j1 is 2\.1000 in row 1, outside -2\.0000"),
    ],
)
def test_joints_that_cannot_be_are_refused(
    planar: ArmKinematics, joints: list[list[float]], match: str
) -> None:
    with pytest.raises(ConfigError, match=match):
        planar.tip(joints)


def test_limits_have_a_margin(planar: ArmKinematics) -> None:
    planar.tip([[2.0005, 0.0]])


def test_poses_to_solve_are_checked(planar: ArmKinematics) -> None:
    with pytest.raises(ConfigError, match="shape"):
        planar.solve(np.zeros((0, 7)))
    with pytest.raises(ConfigError, match="pose 0"):
        planar.solve(np.zeros((1, 7)))


def test_a_file_that_is_no_arm_is_named(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    with pytest.raises(ConfigError, match=r"robot\.urdf cannot be read"):
        ArmKinematics.from_urdf(path, "hand")
    path.write_text("<robot")
    with pytest.raises(ConfigError, match=r"robot\.urdf is not a readable URDF"):
        ArmKinematics.from_urdf(path, "hand")
    path.write_text(PLANAR.format(kind="revolute"))
    with pytest.raises(ConfigError, match=r"no frame 'tool0'.*hand"):
        ArmKinematics.from_urdf(path, "tool0")
    path.write_text(PLANAR.format(kind="continuous"))
    with pytest.raises(ConfigError, match="revolute with limits"):
        ArmKinematics.from_urdf(path, "hand")


def test_without_pinocchio_the_install_line_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(MissingExtraError, match=r"palpate\[training\]"):
        ArmKinematics.from_urdf(tmp_path / "any.urdf", "hand")
