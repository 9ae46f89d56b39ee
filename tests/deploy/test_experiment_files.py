"""A real experiment by files and commands: plan, record, ingest, process. Nothing is simulated."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from palpate_deploy.cli.app import app
from palpate_fem.result import IndentationResult
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import ExperimentDataset, read_experiment, read_mixed
from palpate_training.datasets.processing import process
from palpate_training.datasets.trials import (
    RawTrial,
    TrialHeader,
    TrialRows,
    read_trials,
    write_trials,
)
from palpate_training.experiment import stand_in_arm as stand_in
from palpate_training.experiment.plan import (
    ArmBase,
    ArmMotion,
    PlannedTrajectory,
    RobotPlan,
    make_plan,
)
from palpate_training.experiment.trajectory_file import write_trajectories
from palpate_training.experiment.virtual_testbed import perform

sys.path.append(str(Path(__file__).parents[1] / "fem"))
sample: Any = importlib.import_module("stored_sample")
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory

sys.path.append(str(Path(__file__).parents[1] / "training"))
fakes: Any = importlib.import_module("testbed_fakes")
START_NS = fakes.START_NS

EVERY = 4
"""Of the samples that a test records: 25 Hz, the least that ingest takes."""

DEPTH_M = 0.4e-3
NAMES = ("sphere_medium/00/normal", "sphere_medium/01/normal", "sphere_medium/02/normal")
PROVENANCE = Provenance("a test", "", "", "use as you like", "0")


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def failure(*words: object) -> tuple[int, str]:
    """Exit code and what stderr says."""
    result = run(*words)
    return result.exit_code, result.stderr


@pytest.fixture(scope="module")
def fingertip() -> StoredFingertip:
    return sample_fingertip()


def trajectories(fingertip: StoredFingertip) -> list[PlannedTrajectory]:
    """Where the made-up simulation presses: side by side, along z."""
    start = sample_trajectory(fingertip, steps=1).path[0, :3]
    return [
        PlannedTrajectory(
            name,
            "sphere_medium",
            "left",
            start + np.array([0.0, k * 1e-3, 0.3e-3]),
            np.array([0.0, 0.0, 1.0]),
            0.0,
            DEPTH_M,
        )
        for k, name in enumerate(NAMES)
    ]


@pytest.fixture(scope="module")
def plan(fingertip: StoredFingertip) -> RobotPlan:
    made, _ = make_plan(trajectories(fingertip), {"left": ArmBase(stand_in.sensor_robot("left"))})
    return made


def executed(motion: ArmMotion, *, newton_per_m: float, seed: int = 0, unit: str = "u") -> RawTrial:
    """A press on a spring, as the testbed records it, thinned out."""
    item = motion.trajectory
    travel = np.linspace(0.0, DEPTH_M, 5)
    trial = perform(
        TrialHeader(unit, item.trajectory, item.indenter, item.arm),
        travel_m=travel,
        force=np.outer(travel, [0.0, 0.1 * newton_per_m, newton_per_m]),
        counts=3000 - np.outer(travel, np.linspace(0, 2e6, 19)),
        tip=item.target + travel[:, None] * item.direction,
        read_electrodes=lambda ideal, _: np.rint(ideal).astype(np.uint16),
        seed=seed,
    )
    kept = slice(EVERY - 1, None, EVERY)
    return replace(
        trial,
        time_s=trial.time_s[kept],
        electrodes=trial.electrodes[kept],
        force=trial.force[kept],
        tip=trial.tip[kept],
        travel_m=trial.travel_m[kept],
        increment_end=(trial.increment_end + 1) // EVERY - 1,
    )


@pytest.fixture(scope="module")
def trials(plan: RobotPlan) -> list[RawTrial]:
    """Two presses, and one that misses the finger."""
    strength = (1e4, 2e4, 100.0)
    return [
        executed(motion, newton_per_m=k, seed=i)
        for i, (motion, k) in enumerate(zip(plan.motions, strength, strict=True))
    ]


@pytest.fixture(scope="module")
def trials_file(trials: list[RawTrial], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trials") / "trials.h5"
    write_trials(path, trials, PROVENANCE)
    return path


@pytest.fixture(scope="module")
def store(fingertip: StoredFingertip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first trajectory as it is; the second, but 20 mm from where the robot went."""
    path = tmp_path_factory.mktemp("store") / "twin.sim"
    with StoreWriter(path, fingertip) as writer:
        for name, y_m in zip(NAMES, (0.0, 21e-3), strict=False):
            pressed = sample_trajectory(fingertip, depth_m=1e-3)
            aside = np.array([0.0, y_m, 0.0, 0.0, 0.0, 0.0, 0.0])
            moved = tuple(replace(step, pose=step.pose + aside) for step in pressed.steps)
            writer.write(name, replace(pressed, path=pressed.path + aside, steps=moved))
    return path


def assert_rows(data: ExperimentDataset, expected: Sequence[TrialRows], *, atol: float) -> None:
    assert data.trials == len(expected)
    for i, rows in enumerate(expected):
        at = data.rows_of(i)
        assert data.trajectories[data.trial_trajectory[i]] == rows.header.trajectory
        assert data.unit_names[data.trial_unit[i]] == rows.header.unit
        np.testing.assert_array_equal(data.trial_rest[i], rows.rest)
        for name in ("travel_m", "tared", "force", "location"):
            np.testing.assert_allclose(
                getattr(data, name)[at], getattr(rows, name), rtol=1e-6, atol=atol, err_msg=name
            )


def test_from_plan_to_data_set_by_commands(
    plan: RobotPlan, trials: list[RawTrial], tmp_path: Path
) -> None:
    """The rows are those of the trials as they were before any file."""
    planned = write_trajectories(plan, tmp_path / "plan.jsonl")
    record = fakes.write(fakes.streams_of(trials, plan), tmp_path / "r.mcap")
    ingested = run(
        *("data", "ingest", record, planned, tmp_path / "t.h5", "--unit", "u"),
        *("--sensor", "finger", "--start-wall-ns", START_NS),
    )
    assert ingested.exit_code == 0, ingested.output
    out = tmp_path / "e.h5"
    result = run("data", "process", tmp_path / "t.h5", out, "--json")
    assert result.exit_code == 0, result.output
    data = read_experiment(out)
    # a record keeps forces as float32; an interpolated row moves with the last digit of them
    assert_rows(data, [process(one) for one in trials[:2]], atol=1e-6)
    found = json.loads(result.stdout)
    assert (found["trials"], found["rows"], found["trajectories"]) == (2, len(data), 2)
    ((dropped, why),) = found["dropped"]
    assert dropped == f"u {NAMES[2]}"
    assert "never stays at 0.5 N" in why
    assert "mixed" not in found
    assert "record r.mcap of finger" in data.provenance.source


def test_process_takes_several_files_and_tells_people(
    plan: RobotPlan, trials: list[RawTrial], trials_file: Path, tmp_path: Path
) -> None:
    other = [executed(plan.motions[0], newton_per_m=1.5e4, seed=9, unit="v")]
    write_trials(tmp_path / "v.h5", other, replace(PROVENANCE, licence="mine"))
    out = tmp_path / "e.h5"
    result = run("data", "process", trials_file, tmp_path / "v.h5", out)
    assert result.exit_code == 0, result.output
    data = read_experiment(out)
    assert_rows(data, [process(one) for one in (*trials[:2], *other)], atol=1e-9)
    assert data.provenance.licence == "use as you like; mine"
    assert f"{out}: 3 trials of 2 trajectories, units u, v, {len(data)} rows" in result.stdout
    assert f"left out: 1 trials\n  u {NAMES[2]}: " in result.stdout
    # the digest of the input is of all files, in their order
    run("data", "process", tmp_path / "v.h5", trials_file, tmp_path / "turned.h5")
    turned = read_experiment(tmp_path / "turned.h5")
    assert turned.provenance.input_sha256 != data.provenance.input_sha256
    np.testing.assert_array_equal(turned.force, data.force)


def test_process_mixes_with_a_store(
    trials: list[RawTrial], trials_file: Path, store: Path, tmp_path: Path
) -> None:
    out, mixed = tmp_path / "e.h5", tmp_path / "m.h5"
    result = run(
        *("data", "process", trials_file, out, "--mechanics", store, "--mixed", mixed, "--json")
    )
    assert result.exit_code == 0, result.output
    assert_rows(read_experiment(out), [process(one) for one in trials[:2]], atol=1e-9)
    data = read_mixed(mixed)
    assert data.experiment.trials == 1
    assert data.experiment.trajectories == NAMES[:1]
    assert len(data) == 20
    at_end = sample_at_end(store, float(data.experiment.travel_m[-1]))
    off = np.linalg.norm(data.displacement(slice(19, 20))[0] - at_end, axis=1)
    assert off.mean() < 2e-6  # what modes may lose, and the line between two steps
    found = json.loads(result.stdout)
    assert found["mixed_rows"] == 20
    ((unmixed, why),) = found["unmixed"]
    assert unmixed == f"u {NAMES[1]}"
    assert "20.0 mm from the simulated path" in why
    assert [name for name, _ in found["dropped"]] == [f"u {NAMES[2]}"]


def sample_at_end(store: Path, travel_m: float) -> Any:
    """The simulated field that far past 0.5 N, straight from the store."""
    steps = SimulationStore.open(store).trajectory(NAMES[0]).steps
    force = [float(np.linalg.norm(step.force)) for step in steps]
    along = [float(step.pose[2]) for step in steps]
    at = np.interp(0.5, force, along) + travel_m
    after = int(np.searchsorted(along, at))
    share = (at - along[after - 1]) / (along[after] - along[after - 1])
    before, then = steps[after - 1].displacement, steps[after].displacement
    return before + share * (then - before)


def test_process_refuses_before_it_writes(
    trials: list[RawTrial], trials_file: Path, store: Path, tmp_path: Path
) -> None:
    out = tmp_path / "e.h5"
    before = trials_file.read_bytes()
    again = tmp_path / "again.h5"
    write_trials(again, trials[:1], PROVENANCE)
    missed, elsewhere = tmp_path / "missed.h5", tmp_path / "elsewhere.h5"
    write_trials(missed, trials[2:], PROVENANCE)
    write_trials(elsewhere, trials[1:2], PROVENANCE)
    for words, code, said in (
        ((again, trials_file), 2, "holds raw trials"),
        ((trials_file, out, "--mixed", tmp_path / "m.h5"), 2, "only one of"),
        ((trials_file, out, "--mechanics", store), 2, "only one of"),
        ((trials_file, out, "--mechanics", store, "--mixed", out), 2, "written twice"),
        ((trials_file, again, out), 1, f"{again}: u {NAMES[0]} is in {trials_file} too"),
        ((missed, out), 1, "none of 1 trials gave rows; the first: u"),
        (
            (elsewhere, out, "--mechanics", store, "--mixed", tmp_path / "m.h5"),
            1,
            "none of 1 trials could be mixed; the last: u",
        ),
        ((tmp_path / "none.h5", out), 1, "no such file"),
    ):
        exit_code, stderr = failure("data", "process", *words)
        assert exit_code == code, stderr
        assert said in stderr.replace("\n", " ")
        assert not out.exists()
        assert not (tmp_path / "m.h5").exists()
    assert trials_file.read_bytes() == before
    assert len(list(read_trials(again))) == 1


def test_process_goes_up_to_the_mount_and_no_further(
    trials: list[RawTrial], fingertip: StoredFingertip, tmp_path: Path
) -> None:
    """From the step on in which what is held bears the indenter, nothing is mixed."""
    pressed = sample_trajectory(fingertip, depth_m=1e-3)
    bears = np.zeros_like(pressed.steps[0].indenter_force)
    bears[fingertip.mesh.fixed] = 1.0
    write_trials(tmp_path / "t.h5", trials[:1], PROVENANCE)
    for first, said in ((0, "meets the mount"), (14, "the simulation reaches"), (19, "")):
        steps = [
            replace(step, indenter_force=bears) if k >= first else step
            for k, step in enumerate(pressed.steps)
        ]
        path = tmp_path / f"{first}.sim"
        with StoreWriter(path, fingertip) as writer:
            writer.write(NAMES[0], replace(pressed, steps=tuple(steps)))
        mixed = tmp_path / f"{first}.h5"
        result = run(
            *("data", "process", tmp_path / "t.h5", tmp_path / "e.h5", "--mechanics", path),
            *("--mixed", mixed),
        )
        assert result.exit_code == bool(said), result.output
        if said:
            assert said in result.stderr
            continue
        force = [float(np.linalg.norm(step.force)) for step in pressed.steps]
        along = [float(step.pose[2]) for step in pressed.steps]
        most = along[first - 1] - float(np.interp(0.5, force, along))
        assert read_mixed(mixed).experiment.travel_m[-1] == pytest.approx(most, rel=1e-5)
