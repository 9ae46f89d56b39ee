"""A real experiment is read as the twin's trials are made: through a record and a plan."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import POSE
from palpate.errors import ConfigError, DatasetError
from palpate.rigid import Transform
from palpate_training.datasets.trials import RawTrial
from palpate_training.experiment import stand_in_arm as stand_in
from palpate_training.experiment.executed_plan import JointLog, ingest_experiment, read_joint_log
from palpate_training.experiment.kinematics import ArmKinematics
from palpate_training.experiment.plan import ArmBase, ArmMotion, RobotPlan, commanded_travel
from palpate_training.experiment.trajectory_file import write_trajectories

sys.path.append(str(Path(__file__).parent))
fakes: Any = importlib.import_module("testbed_fakes")
arm, plan, plan_file, played = fakes.arm, fakes.plan, fakes.plan_file, fakes.played
START_NS, ERROR_M = fakes.START_NS, fakes.ERROR_M
bases, two_arms, play = fakes.bases, fakes.two_arms, fakes.play
thin, streams_of, write = fakes.thin, fakes.streams_of, fakes.write
PRINTED_NS = 1e-9
"""Times are kept in whole nanoseconds."""


def assert_same(read: RawTrial, written: RawTrial) -> None:
    assert read.header == written.header
    np.testing.assert_array_equal(read.increment_end, written.increment_end)
    np.testing.assert_array_equal(read.electrodes, written.electrodes)
    np.testing.assert_allclose(read.time_s, written.time_s, rtol=0, atol=PRINTED_NS)
    np.testing.assert_array_equal(read.force, written.force.astype(np.float32))
    np.testing.assert_allclose(read.tip, written.tip, rtol=0, atol=1e-15)
    ends = read.increment_end
    np.testing.assert_allclose(read.travel_m[ends], written.travel_m[ends], atol=1e-12)


def test_a_performance_comes_back_from_its_record(
    plan: RobotPlan, plan_file: Path, played: list[RawTrial], tmp_path: Path
) -> None:
    trials = [played[0], thin(played[1])]
    record = write(streams_of(trials, plan), tmp_path / "r.mcap")
    back = ingest_experiment(
        record, plan_file, unit="biotac-1", sensor="finger", start_wall_ns=START_NS
    )
    assert len(back) == 2
    for read, written in zip(back, trials, strict=True):
        assert_same(read, written)
    # the robot moved when the stamps say, not when it was told: within the jitter of a stamp
    np.testing.assert_allclose(back[0].travel_m, trials[0].travel_m, atol=2e-6)


def test_trajectories_have_starts_of_their_own(
    plan: RobotPlan, plan_file: Path, played: list[RawTrial], tmp_path: Path
) -> None:
    record = write(streams_of([thin(t) for t in played], plan), tmp_path / "r.mcap")
    second = plan.motions[1]
    (back,) = ingest_experiment(
        record,
        plan_file,
        unit="biotac-1",
        sensor="finger",
        start_wall_ns={second.trajectory.trajectory: START_NS + round(second.start_s * 1e9)},
    )
    assert_same(back, thin(played[1]))
    with pytest.raises(DatasetError, match="no trajectory 'other'"):
        ingest_experiment(
            record, plan_file, unit="u", sensor="finger", start_wall_ns={"other": START_NS}
        )


def joint_log(motions: Iterable[ArmMotion], arm: ArmKinematics, path: Path) -> Path:
    """Joint angles of motions that begin at START_NS, where `thin` keeps samples."""
    lines = ["time_s," + ",".join(arm.joint_names)]
    for motion in motions:
        assert motion.joints is not None
        travel = motion.trajectory.travel_m
        near = np.concatenate([np.arange(7), np.arange(493, 500)]) / 100
        at = (5.0 * np.arange(len(travel) - 1)[:, None] + near).ravel()
        along = commanded_travel(at, travel)
        joints = np.stack([np.interp(along, travel, column) for column in motion.joints.T], axis=1)
        since = START_NS * 1e-9 + motion.start_s
        lines += [
            f"{since + t:.6f}," + ",".join(f"{v:.9f}" for v in row)
            for t, row in zip(at, joints, strict=True)
        ]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("own", [False, True])
def test_joints_stand_for_poses(
    plan: RobotPlan,
    plan_file: Path,
    played: list[RawTrial],
    arm: ArmKinematics,
    tmp_path: Path,
    own: bool,
) -> None:
    streams = streams_of([thin(t) for t in played], plan)
    streams[POSE.name] = []
    record = write(streams, tmp_path / "r.mcap")
    log = joint_log(plan.motions, arm, tmp_path / "left.csv")
    shifted = stand_in.sensor_robot("left")
    shifted = Transform(shifted.rotation, shifted.translation + ERROR_M)
    back = ingest_experiment(
        record,
        plan_file,
        unit="biotac-1",
        sensor="finger",
        start_wall_ns=START_NS,
        joint_logs={"left": JointLog(log, arm, shifted if own else None)},
    )
    for trial, motion in zip(back, plan.motions, strict=True):
        expected = motion.trajectory.poses[1:, :3] + (ERROR_M if own else 0.0)
        off = np.linalg.norm(trial.tip[trial.increment_end] - expected, axis=1)
        assert off.max() < 0.012e-3  # inverse kinematics to 0.01 mm, nine digits of a joint
    with pytest.raises(DatasetError, match="left arm, which has no joint log"):
        ingest_experiment(
            record, plan_file, unit="u", sensor="finger", start_wall_ns=START_NS, joint_logs={}
        )
    with pytest.raises(DatasetError, match="no pose stream"):
        ingest_experiment(record, plan_file, unit="u", sensor="finger", start_wall_ns=START_NS)


def test_of_two_arms_one_may_publish_its_pose(
    two_arms: RobotPlan, bases: dict[str, ArmBase], tmp_path: Path
) -> None:
    streams = streams_of([thin(trial) for trial in play(two_arms)], two_arms)
    first, second = two_arms.motions
    assert (first.trajectory.arm, second.trajectory.arm) == ("left", "right")
    between_ns = START_NS + round(second.start_s * 1e9)
    streams[POSE.name] = [p for p in streams[POSE.name] if p.stamp.wall_ns < between_ns]
    record = write(streams, tmp_path / "r.mcap")
    right = bases["right"].arm
    assert right is not None
    log = joint_log([second], right, tmp_path / "right.csv")
    back = ingest_experiment(
        record,
        write_trajectories(two_arms, tmp_path / "plan.jsonl"),
        unit="biotac-1",
        sensor="finger",
        start_wall_ns=START_NS,
        joint_logs={"right": JointLog(log, right)},
    )
    for trial, motion, error_m in zip(back, two_arms.motions, (ERROR_M, np.zeros(3)), strict=True):
        off = trial.tip[trial.increment_end] - motion.trajectory.poses[1:, :3] - error_m
        assert np.linalg.norm(off, axis=1).max() < 0.06e-3  # repeatability of the virtual robot


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "columns none"),
        ("time_s,j1\n0,0\n", "columns time_s, j1"),
        ("t,a,b,c,d,e,f,g\n0,0,0,0,0,0,0,0\n", "columns t"),
        ("time_s,a,b,c,d,e,f,g\n0,0,0,0,0,x,0,0\n", "line 2"),
        ("time_s,a,b,c,d,e,f,g\n0,0,0,0,0,0,0\n", "line 2"),
        ("time_s,a,b,c,d,e,f,g\n1,0,0,0,0,0,0,0\n1,0,0,0,0,0,0,0\n", "do not increase"),
        ("time_s,a,b,c,d,e,f,g\n1,0,0,0,0,0,0,nan\n", "not finite"),
    ],
)
def test_a_joint_log_that_is_none_is_refused(
    arm: ArmKinematics, tmp_path: Path, text: str, match: str
) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(DatasetError, match=rf"log\.csv.*{match}"):
        read_joint_log(path, arm)
    with pytest.raises(DatasetError, match="cannot be read"):
        read_joint_log(tmp_path / "none.csv", arm)


def test_joints_outside_their_limits_name_the_log(
    plan: RobotPlan, plan_file: Path, played: list[RawTrial], arm: ArmKinematics, tmp_path: Path
) -> None:
    record = write(streams_of([thin(t) for t in played], plan), tmp_path / "r.mcap")
    log = tmp_path / "left.csv"
    log.write_text("time_s,a,b,c,d,e,f,g\n0,0,0,0,0,0,90,0\n")
    with pytest.raises(ConfigError, match=r"left\.csv: left_joint6 is 90"):
        ingest_experiment(
            record,
            plan_file,
            unit="u",
            sensor="finger",
            start_wall_ns=START_NS,
            joint_logs={"left": JointLog(log, arm)},
        )
