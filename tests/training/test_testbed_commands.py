"""``palpate data register | ingest | inspect``: a real experiment by files and commands."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from palpate.errors import ConfigError, DatasetError
from palpate_training.cli import data_app
from palpate_training.datasets.trials import RawTrial, read_contents, read_trials
from palpate_training.experiment import stand_in_arm as stand_in
from palpate_training.experiment.clearance import plate_holes
from palpate_training.experiment.kinematics import ArmKinematics
from palpate_training.experiment.plan import RobotPlan, commanded_travel
from palpate_training.experiment.registration import COLUMNS, read_registrations

sys.path.append(str(Path(__file__).parent))
fakes: Any = importlib.import_module("testbed_fakes")
arm, plan, plan_file, played = fakes.arm, fakes.plan, fakes.plan_file, fakes.played
START_NS = fakes.START_NS
thin, streams_of, write = fakes.thin, fakes.streams_of, fakes.write

CLEARANCE_M = 1e-4


def _run(*words: object) -> Result:
    return CliRunner().invoke(data_app, [str(word) for word in words], env={"COLUMNS": "250"})


def holes_csv(path: Path, *, off_m: float = 0.0) -> Path:
    """Four holes of both arms; the right arm's first hole is off."""
    lines = [",".join(COLUMNS)]
    for side in stand_in.SIDES:
        holes = plate_holes()
        robot = stand_in.sensor_robot(side).inverse().apply(holes)
        if side == "right":
            robot[0] += [off_m, 0.0, 0.0]
        for i, (by_robot, by_drawing) in enumerate(zip(robot, holes, strict=True)):
            numbers = ",".join(f"{v:.12f}" for v in (*by_robot, *by_drawing))
            lines.append(f"{side},H{i + 1},{numbers}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_register_finds_where_the_arms_stand(tmp_path: Path) -> None:
    out = tmp_path / "r.json"
    result = _run("register", holes_csv(tmp_path / "h.csv", off_m=CLEARANCE_M), out)
    assert result.exit_code == 0, result.output
    assert result.output.count("0.000") == 4  # the left arm's residuals
    found = read_registrations(out)
    assert set(found) == {"left", "right"}
    for side, bound_m in (("left", 1e-9), ("right", 2 * CLEARANCE_M)):
        true = stand_in.sensor_robot(side)
        at = true.inverse().apply(plate_holes())
        off = np.linalg.norm(found[side].sensor_robot.apply(at) - plate_holes(), axis=1)
        assert off.max() < bound_m
        np.testing.assert_allclose(found[side].sensor_robot.rotation, true.rotation, atol=5e-3)
    right = found["right"]
    assert right.holes == ("H1", "H2", "H3", "H4")
    assert right.triples == 4
    assert right.residual_m.max() > CLEARANCE_M / 4
    for residual in right.residual_m:
        assert f"{residual * 1e3:.3f}" in result.output


def test_register_names_what_is_wrong(tmp_path: Path) -> None:
    out = tmp_path / "r.json"
    whole = holes_csv(tmp_path / "h.csv").read_text()
    for text, words in (
        ("", "columns none"),
        (whole.replace("robot_x_m", "x"), "columns arm, hole, x"),
        (whole.replace("right,H2,", "middle,H2,"), "line 7: arm 'middle'"),
        (whole.replace("right,H2,", "right,H2,x"), "line 7: could not convert"),
        (whole.replace("right,H2,", "right,H2,0,"), "line 7: arm 'right' with 7 numbers"),
        (whole.replace("right,H2,", "right,H1,"), "right arm: names"),
        ("\n".join(whole.splitlines()[:-1]).replace("left,H1", "left,H1"), ""),
        ("\n".join(whole.splitlines()[:3]), "left arm: .*2 holes"),
    ):
        (tmp_path / "h.csv").write_text(text)
        result = _run("register", tmp_path / "h.csv", out)
        if not words:  # three holes are enough
            assert result.exit_code == 0, result.output
            out.unlink()
            continue
        assert isinstance(result.exception, ConfigError), text
        assert result.exception.problem.startswith(str(tmp_path / "h.csv"))
        with pytest.raises(ConfigError, match=words):
            raise result.exception
        assert not out.exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("palpate.testbed.registration", "other", "schema"),
        ('"version": 1', '"version": 2', "version"),
        ('"left"', '"middle"', "arms.middle"),
        ('"triples"', '"three"', "arms.left.t"),
        ("{", "", "the file"),
    ],
)
def test_a_damaged_registration_is_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    out = tmp_path / "r.json"
    assert _run("register", holes_csv(tmp_path / "h.csv"), out).exit_code == 0
    out.write_text(out.read_text().replace(old, new, 1))
    with pytest.raises(ConfigError, match=rf"r\.json: {words}"):
        read_registrations(out)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_registrations(tmp_path / "none.json")


def test_a_registration_that_is_no_pose_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "r.json"
    assert _run("register", holes_csv(tmp_path / "h.csv"), out).exit_code == 0
    content = json.loads(out.read_text())
    content["arms"]["left"]["sensor_robot"][3:] = [1.0, 1.0, 0.0, 0.0]
    out.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=r"left\.sensor_robot: quaternion"):
        read_registrations(out)


@pytest.fixture
def record(plan: RobotPlan, played: list[RawTrial], tmp_path: Path) -> Path:
    recorded: Path = write(streams_of([thin(one) for one in played], plan), tmp_path / "r.mcap")
    return recorded


# START_NS as a time of day
START = "2023-11-14T23:13:20+01:00"


@pytest.mark.parametrize("when", [("--start-wall-ns", START_NS), ("--start", START)])
def test_ingest_writes_the_trials(
    record: Path,
    plan_file: Path,
    played: list[RawTrial],
    tmp_path: Path,
    when: tuple[str, object],
) -> None:
    out = tmp_path / "t.h5"
    result = _run(
        "ingest", record, plan_file, out, "--unit", "biotac-1", "--sensor", "finger", *when
    )
    assert result.exit_code == 0, result.output
    assert "2 trials" in result.output
    for read, true in zip(read_trials(out), played, strict=True):
        assert read.header == true.header
        np.testing.assert_array_equal(read.electrodes, thin(true).electrodes)
    provenance = read_contents(out).provenance
    assert len(provenance.input_sha256) == 64
    assert provenance.licence == "own record"
    assert plan_file.name in provenance.source


def test_inspect_knows_trials(record: Path, plan_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "t.h5"
    words = ("--unit", "biotac-1", "--sensor", "finger", "--start-wall-ns", START_NS)
    assert _run("ingest", record, plan_file, out, *words).exit_code == 0
    assert "s/01/normal" in _run("inspect", out).output
    found = json.loads(_run("inspect", out, "--json").output)
    assert found["kind"] == "palpate.trials"
    assert [one["trajectory"] for one in found["trials"]] == ["s/00/normal", "s/01/normal"]
    assert found["trials"][0]["samples"] == len(next(read_trials(out)).time_s)


def test_ingest_takes_starts_of_trajectories(
    record: Path, plan: RobotPlan, plan_file: Path, tmp_path: Path
) -> None:
    times, out = tmp_path / "starts.csv", tmp_path / "t.h5"
    second = plan.motions[1]
    at = START_NS + round(second.start_s * 1e9)
    words = ("ingest", record, plan_file, out, "--unit", "u", "--sensor", "finger")
    # With the byte order mark that spreadsheets write.
    times.write_text(f"trajectory,start_wall_ns\ns/01/normal,{at}\n", encoding="utf-8-sig")
    assert _run(*words, "--starts", times).exit_code == 0
    assert [header.trajectory for header in read_contents(out).headers] == ["s/01/normal"]
    for text, match in (
        ("a,b\n", "columns a, b"),
        ("trajectory,start_wall_ns\ns/01/normal,1e9\n", "line 2"),
        ("trajectory,start_wall_ns\nx,1\nx,2\n", "line 3: 'x' comes twice"),
    ):
        times.write_text(text)
        result = _run(*words, "--starts", times)
        assert isinstance(result.exception, ConfigError)
        with pytest.raises(ConfigError, match=match):
            raise result.exception


def test_ingest_takes_joint_angles(
    plan: RobotPlan, plan_file: Path, played: list[RawTrial], arm: ArmKinematics, tmp_path: Path
) -> None:
    streams = streams_of([thin(one) for one in played], plan)
    streams["pose"] = []
    record = write(streams, tmp_path / "r.mcap")
    lines = ["time_s," + ",".join(arm.joint_names)]
    for motion in plan.motions:
        assert motion.joints is not None
        travel = motion.trajectory.travel_m
        near = np.concatenate([np.arange(7), np.arange(493, 500)]) / 100
        at = (5.0 * np.arange(len(travel) - 1)[:, None] + near).ravel()
        along = commanded_travel(at, travel)
        joints = np.stack([np.interp(along, travel, column) for column in motion.joints.T], axis=1)
        lines += [
            f"{START_NS * 1e-9 + motion.start_s + t:.6f}," + ",".join(f"{v:.9f}" for v in row)
            for t, row in zip(at, joints, strict=True)
        ]
    log = tmp_path / "left.csv"
    log.write_text("\n".join(lines) + "\n")
    urdf = stand_in.write_arm_urdf("left", tmp_path / "left.urdf")
    out = tmp_path / "t.h5"
    words = (
        *("ingest", record, plan_file, out, "--unit", "u", "--sensor", "finger"),
        *("--start-wall-ns", START_NS, "--joints", f"left={log}"),
    )
    tool = ("--urdf", f"left={urdf}", "--tip-frame", "flange", "--tool-mm", 60)
    result = _run(*words, *tool)
    assert result.exit_code == 0, result.output
    for trial, motion in zip(read_trials(out), plan.motions, strict=True):
        off = trial.tip[trial.increment_end] - motion.trajectory.poses[1:, :3]
        assert np.linalg.norm(off, axis=1).max() < 0.012e-3
    for wrong, match in (
        ((), "--joints for left, --urdf for none"),
        (tool[:2], "without --tip-frame"),
        ((*tool, "--urdf", f"left={urdf}"), "comes twice"),
        (("--urdf", urdf), "--urdf"),
        (("--urdf", f"middle={urdf}"), "--urdf middle"),
    ):
        failed = _run(*words, *wrong)
        assert isinstance(failed.exception, ConfigError), failed.output
        with pytest.raises(ConfigError, match=match):
            raise failed.exception


@pytest.mark.parametrize(
    ("words", "kind", "match"),
    [
        ((), ConfigError, "0 of --start-wall-ns"),
        (("--start-wall-ns", 1, "--start", START), ConfigError, "2 of --start-wall-ns"),
        (("--start", "yesterday"), ConfigError, "--start yesterday"),
        (("--start", "2023-11-14T23:13:20"), ConfigError, "no time zone"),
        (("--start-wall-ns", START_NS - 10**13), DatasetError, "nothing was recorded"),
    ],
)
def test_ingest_names_what_is_wrong_and_writes_nothing(
    record: Path,
    plan_file: Path,
    tmp_path: Path,
    words: tuple[object, ...],
    kind: type[Exception],
    match: str,
) -> None:
    out = tmp_path / "t.h5"
    result = _run("ingest", record, plan_file, out, "--unit", "u", "--sensor", "finger", *words)
    assert isinstance(result.exception, kind), result.output
    with pytest.raises(kind, match=match):
        raise result.exception
    assert not out.exists()
