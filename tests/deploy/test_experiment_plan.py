"""``palpate data plan``: the paper's plan for a real robot. Nothing is simulated."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner, Result

from palpate_deploy.cli.app import app
from palpate_fem.indenter.approach import first_contact
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.result import IndentationResult
from palpate_fem.service.fingertips import skin_of
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.writer import StoreWriter
from palpate_fem.trajectory import Campaign
from palpate_training.experiment import stand_in_arm as stand_in
from palpate_training.experiment.plan import APPROACH_M
from palpate_training.experiment.registration import ArmRegistration, write_registrations
from palpate_training.experiment.trajectory_file import read_trajectories

sys.path.append(str(Path(__file__).parents[1] / "fem"))
sample: Any = importlib.import_module("stored_sample")
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def fingertip() -> StoredFingertip:
    return sample_fingertip()


@pytest.fixture
def empty(fingertip: StoredFingertip, tmp_path: Path) -> Path:
    """A store in which nothing is simulated yet."""
    StoreWriter(tmp_path / "empty.sim", fingertip).close()
    return tmp_path / "empty.sim"


@pytest.fixture(scope="module")
def registration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("registration") / "r.json"
    found = {
        side: ArmRegistration(stand_in.sensor_robot(side), ("a", "b", "c"), np.zeros(3), 1)
        for side in stand_in.SIDES
    }
    return write_registrations(path, found)


PLAN = ("--points", 2, "--angled", 1, "--indenter", "sphere_7mm", "--json")


def test_plan_is_the_papers_on_the_simulated_skin(
    empty: Path, fingertip: StoredFingertip, tmp_path: Path
) -> None:
    out = tmp_path / "p.jsonl"
    result = run("data", "plan", out, "--store", empty, "--seed", 5, *PLAN)
    assert result.exit_code == 0, result.output
    plan = read_trajectories(out)
    found = json.loads(result.stdout)
    assert found["trajectories"] + len(found["eliminated"]) == 4
    campaign = Campaign(skin_of(fingertip), ("sphere_medium",), points=2, angled=1, seed=5)
    wanted = {item.name: item for item in campaign}
    assert plan.motions
    for motion in plan.motions:
        item, planned = motion.trajectory, wanted[motion.trajectory.trajectory]
        assert item.depth_m == (3e-3 if item.trajectory.endswith("/normal") else 1.5e-3)
        np.testing.assert_array_equal(item.target, planned.target)
        np.testing.assert_allclose(item.direction, planned.direction, atol=1e-12)
        # 3 mm after its start the indenter touches the skin
        contact = first_contact(
            make_indenter(item.indenter),
            item.poses[0, 3:],
            item.target,
            item.direction,
            skin_of(fingertip),
        )
        touched = item.poses[round(APPROACH_M / 1e-4), :3]
        np.testing.assert_allclose(touched, item.target + contact * item.direction, atol=1e-7)
        assert item.arm == ("left" if item.target[1] >= 0 else "right")
        assert motion.joints is not None
    assert found["arms"] == {
        arm: sum(m.trajectory.arm == arm for m in plan.motions) for arm in plan.bases
    }


@pytest.mark.parametrize(("seed", "code"), [(5, 0), (6, 2)])
def test_plan_is_the_stores(
    fingertip: StoredFingertip, tmp_path: Path, seed: int, code: int
) -> None:
    """The names of another seed's trajectories are the same; where they aim is not."""
    store, out = tmp_path / "twin.sim", tmp_path / "p.jsonl"
    pressed = sample_trajectory(fingertip, steps=2)
    with StoreWriter(store, fingertip) as writer:
        # as the twin simulates: deeper than the paper's depths
        for item in Campaign(
            skin_of(fingertip), ("sphere_medium",), 2, 5, angled=1, overtravel_m=0.6e-3
        ):
            writer.write(item.name, replace(pressed, path=item.path[:3]))
    result = run("data", "plan", out, "--store", store, "--seed", seed, *PLAN)
    assert result.exit_code == code, result.output
    assert out.exists() == (code == 0)
    if code:
        assert "give the --seed with which the store was made" in result.stderr


def test_plan_for_arms_of_ones_own(empty: Path, registration: Path, tmp_path: Path) -> None:
    out = tmp_path / "p.jsonl"
    words = ("data", "plan", out, "--store", empty, *PLAN)
    # poses only: the robot's controller finds the joints
    result = run(*words, "--registration", registration)
    assert result.exit_code == 0, result.output
    plan = read_trajectories(out)
    assert len(plan.motions) == 4
    assert all(motion.joints is None for motion in plan.motions)
    # one arm does everything; a tool a metre long reaches nothing
    one = json.loads(registration.read_text())
    one["arms"].pop("right")
    (tmp_path / "one.json").write_text(json.dumps(one))
    urdf = stand_in.write_arm_urdf("left", tmp_path / "left.urdf")
    arm = ("--registration", tmp_path / "one.json", "--urdf", f"left={urdf}", "--tip-frame")
    result = run(*words, *arm, "flange", "--tool-mm", 60)
    assert result.exit_code == 0, result.output
    assert set(json.loads(result.stdout)["arms"]) == {"left"}
    assert all(motion.joints is not None for motion in read_trajectories(out).motions)
    out.unlink()
    for more, said in (
        ((*arm, "flange", "--tool-mm", 2000), "all 4 trajectories are eliminated"),
        ((*arm, "wrist"), "no frame 'wrist'"),
        (("--urdf", f"left={urdf}", "--tip-frame", "flange"), "no registration"),
        (("--edge-mm", 1.0), "cannot be given too"),
    ):
        result = run(*words, *more)
        assert result.exit_code == 2
        assert said in result.stderr
        assert not out.exists()


def test_commands_say_what_they_are() -> None:
    group: Any = typer.main.get_command(app)
    commands = group.commands["data"].commands
    for name in ("plan", "register", "ingest", "process", "inspect", "export", "generate"):
        assert commands[name].help
