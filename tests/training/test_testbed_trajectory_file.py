"""The trajectory file: what goes in comes back, and a changed file is refused by name."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import ConfigError, DatasetError
from palpate_training.experiment import stand_in_arm as stand_in
from palpate_training.experiment.plan import RobotPlan
from palpate_training.experiment.trajectory_file import read_trajectories, write_trajectories

sys.path.append(str(Path(__file__).parent))
fakes: Any = importlib.import_module("testbed_fakes")
bases, two_arms = fakes.bases, fakes.two_arms

PRINTED = 1e-9
"""What is computed again on reading may differ by rounding [m, rad, s]."""


def test_a_plan_comes_back_from_its_file(two_arms: RobotPlan, tmp_path: Path) -> None:
    path = write_trajectories(two_arms, tmp_path / "plan.jsonl")
    assert [p.name for p in tmp_path.iterdir()] == ["plan.jsonl"]
    back = read_trajectories(path)
    assert len(back.motions) == 2
    for written, read in zip(two_arms.motions, back.motions, strict=True):
        np.testing.assert_array_equal(read.trajectory.poses, written.trajectory.poses)
        np.testing.assert_array_equal(read.joints, written.joints)
        np.testing.assert_allclose(read.poses_robot, written.poses_robot, atol=PRINTED)
        assert read.start_s == written.start_s
        assert read.trajectory.trajectory == written.trajectory.trajectory
        assert read.trajectory.indenter == written.trajectory.indenter
        assert read.trajectory.depth_m == written.trajectory.depth_m
    for arm in ("left", "right"):
        np.testing.assert_allclose(
            back.bases[arm].sensor_robot.pose, stand_in.sensor_robot(arm).pose, atol=PRINTED
        )
    # the same plan makes the same bytes
    again = write_trajectories(two_arms, tmp_path / "again.jsonl")
    assert again.read_bytes() == path.read_bytes()


def test_a_file_says_all_that_a_robot_needs(two_arms: RobotPlan, tmp_path: Path) -> None:
    lines = write_trajectories(two_arms, tmp_path / "p").read_text("utf-8").splitlines()
    header, first = json.loads(lines[0]), json.loads(lines[1])
    assert header["schema"] == "palpate.testbed.trajectories"
    assert header["joint_names"]["left"][0] == "left_joint1"
    assert len(first["increments"]) == 34
    row = first["increments"][7]
    assert row["time_s"] == 35.0
    assert row["travel_m"] == pytest.approx(0.7e-3)
    assert len(row["pose_sensor"]) == len(row["pose_robot"]) == len(row["joints"]) == 7
    to_sensor = stand_in.sensor_robot("left")
    np.testing.assert_allclose(
        to_sensor.apply(np.array(row["pose_robot"][:3])), row["pose_sensor"][:3], atol=1e-12
    )


Change = Callable[[dict[str, Any], list[dict[str, Any]]], None]


def rewrite(path: Path, change: Change) -> None:
    """Change a file and make its hash right again, as one who edits it by program would."""
    lines = path.read_text("utf-8").splitlines()
    header, rows = json.loads(lines[0]), [json.loads(line) for line in lines[1:]]
    change(header, rows)
    body = "".join(json.dumps(row) + "\n" for row in rows).encode()
    header["content_sha256"] = hashlib.sha256(body).hexdigest()
    path.write_bytes(json.dumps(header).encode() + b"\n" + body)


def test_rewriting_alone_harms_nothing(two_arms: RobotPlan, tmp_path: Path) -> None:
    path = write_trajectories(two_arms, tmp_path / "plan.jsonl")
    rewrite(path, lambda header, rows: None)
    assert len(read_trajectories(path).motions) == 2


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda h, r: h.update(schema="other"), "schema is not"),
        (lambda h, r: h.update(version=2), "version 2"),
        (lambda h, r: h.update(frame="world"), "frame"),
        (lambda h, r: h.update(colour="red"), "colour"),
        (lambda h, r: h.pop("units"), "units"),
        (lambda h, r: h.update(dwell_s=4.0), "dwell_s is 4"),
        (lambda h, r: h.update(trajectories=3), "2 trajectories, the header says 3"),
        (lambda h, r: h["sensor_robot"].pop("right"), "no registration of the right arm"),
        (lambda h, r: h["sensor_robot"]["left"].__setitem__(0, 0.31), "line 2: pose_robot"),
        (lambda h, r: h["sensor_robot"]["left"].__setitem__(3, 0.31), "length 1"),
        (lambda h, r: h["joint_names"].pop("left"), "joints of 'a/00/normal'"),
        (lambda h, r: r[0].update(depth_m=0.4e-3), "line 2: time_s"),
        (lambda h, r: r[0].update(depth_m=-1.0), "line 2.*depth_m"),
        (lambda h, r: r[0]["target"].__setitem__(0, 0.0), "line 2: pose_sensor"),
        (lambda h, r: r[1].update(start_s=0.0), "line 3: time_s"),
        (lambda h, r: r[1]["increments"].pop(), "line 3: time_s"),
        (lambda h, r: r[1]["increments"][5].update(travel_m=0.0), "line 3: travel_m"),
        (lambda h, r: r[1]["increments"][5].update(joints=[0.0]), "joints of 'b/01/angled-0'"),
        (lambda h, r: r[1]["increments"][5].update(time_s="25.0"), "increments.5.time_s"),
        (lambda h, r: r[1].update(arm="middle"), "line 3: arm"),
        (lambda h, r: r.__setitem__(1, r[0]), "line 3: 'a/00/normal' comes twice"),
        (lambda h, r: r.reverse(), "before the one above ends"),
        (lambda h, r: r[0].update(contact_m=float("nan")), "line 2"),
    ],
)
def test_a_changed_file_is_refused_by_name(
    two_arms: RobotPlan, tmp_path: Path, change: Change, match: str
) -> None:
    path = write_trajectories(two_arms, tmp_path / "plan.jsonl")
    rewrite(path, change)
    with pytest.raises(DatasetError, match=rf"plan\.jsonl.*{match}"):
        read_trajectories(path)


def test_a_damaged_file_is_refused(two_arms: RobotPlan, tmp_path: Path) -> None:
    path = write_trajectories(two_arms, tmp_path / "plan.jsonl")
    content = path.read_bytes()
    for damaged in (content[:-100], content.replace(b"0.2", b"0.3", 1), b"", b"\x00\xff\n"):
        path.write_bytes(damaged)
        with pytest.raises(DatasetError, match=r"plan\.jsonl"):
            read_trajectories(path)
    with pytest.raises(DatasetError, match="cannot be read"):
        read_trajectories(tmp_path / "none")


def test_an_interrupted_write_leaves_the_old_file(
    two_arms: RobotPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_trajectories(two_arms, tmp_path / "plan.jsonl")
    before = path.read_bytes()

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", die)
    with pytest.raises(KeyboardInterrupt):
        write_trajectories(RobotPlan(two_arms.motions[:1], two_arms.bases), path)
    assert path.read_bytes() == before


def test_an_empty_plan_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="empty"):
        write_trajectories(RobotPlan((), {}), tmp_path / "plan.jsonl")
    assert not list(tmp_path.iterdir())
