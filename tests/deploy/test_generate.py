"""The experiment on the twin, end to end and small: stages, going on, clusters, damaged folders."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.cluster import RayCluster, WorkerLostError
from palpate.errors import (
    ConfigError,
    DatasetError,
    LinkError,
    MissingExtraError,
    SimulationError,
)
from palpate.files.tape import read_tape
from palpate_deploy.cli.data import twin_app
from palpate_deploy.experiment import FemSimulator, specimens_of, with_indenters_met
from palpate_fem.cli.app import fem_app
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.population.members import (
    PAPER,
    Member,
    draw_members,
    read_population,
    write_population,
)
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    read_experiment,
    read_mixed,
    write_experiment,
    write_mixed,
)
from palpate_training.datasets.export import features
from palpate_training.datasets.features import joined
from palpate_training.experiment.generate.fingertips import SharedExperiment, share_out
from palpate_training.experiment.generate.pipeline import (
    EXPERIMENT,
    IDLE,
    MIXED,
    STORE,
    TRIALS,
    GeneratedExperiment,
    generate,
    keep_spec,
    provenance_sha256,
)
from palpate_training.experiment.generate.pipeline import SPEC as SPEC_FILE
from palpate_training.experiment.generate.sample import make_sample
from palpate_training.experiment.generate.simulator import ExperimentSpec, Specimen
from palpate_training.experiment.generate.trials import registration_errors
from palpate_training.experiment.generate.workers import WorkerProcesses

SPEC = ExperimentSpec(
    points=1, angled=1, edge_m=1.2e-3, overtravel_m=0.2e-3, indenters=("sphere_medium",)
)


SPEC_SHA256 = "dd2ae706a05ce458ab10708f60fefe6e2157f61f3c62a7cdc46175729a96b891"
"""Of `SPEC`: data sets without paths other than presses keep their digest."""


def members() -> tuple[Member, ...]:
    """Two units, one of which was pressed deeper than planned."""
    unit = replace(SpecimenParameters(), noise_counts=1.0)
    return (
        Member(replace(unit, name="biotac-1", sigma_s_m=0.16), PAPER[0], 0.2e-3),
        Member(replace(unit, name="biotac-2"), PAPER[1], 0.0),
    )


def specimens() -> tuple[Specimen, ...]:
    return specimens_of(members())


def run(folder: Path) -> GeneratedExperiment:
    done = generate(folder, SPEC, specimens(), FemSimulator(), workers=1)
    assert done is not None
    return done


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> GeneratedExperiment:
    return run(tmp_path_factory.mktemp("twin") / "one")


def test_both_data_sets_hold_what_was_executed(generated: GeneratedExperiment) -> None:
    experiment = read_experiment(generated.folder / EXPERIMENT)
    mixed = read_mixed(generated.folder / MIXED)
    assert experiment.unit_names == ("biotac-1", "biotac-2")
    assert set(experiment.trajectories) == {
        "sphere_medium/00/normal",
        "sphere_medium/00/angled-0",
    }
    assert len(experiment.trial_unit) == 4
    size = np.linalg.norm(experiment.force, axis=1)
    first = np.concatenate([[True], np.diff(experiment.trial) != 0])
    np.testing.assert_allclose(size[first], 0.5, rtol=1e-5)
    assert experiment.force[:, 2].min() > 0  # the pad is pressed towards the nail
    # Twenty rows a trial, and the simulated force is what the sensor measured but for its noise.
    assert len(mixed) == 20 * len(mixed.experiment.trial_unit)
    difference = np.linalg.norm(mixed.simulated_force - mixed.experiment.force, axis=1)
    assert np.median(difference) < 0.1
    assert mixed.basis.loss_mean < 1e-6
    moved = np.linalg.norm(mixed.displacement(slice(0, len(mixed))), axis=2)
    assert moved.max(axis=1).min() > 0.2e-3
    assert len(mixed.mesh.subset) == 128


def test_specimens_fitted_on_two_presses_are_said_to_be_far_off(
    generated: GeneratedExperiment, tmp_path: Path
) -> None:
    out = tmp_path / "three.json"
    fitted = CliRunner().invoke(
        fem_app, ["units", "fit", str(generated.folder / STORE), "--out", str(out)]
    )
    assert fitted.exit_code == 1
    said = " ".join(fitted.output.split())
    for published in PAPER:
        assert f"{published.name} is far from what is published: lowest tared value" in said
    # The paths go 0.2 mm deeper than the paper's, so nobody was pressed deeper than that.
    assert max(member.overtravel_m for member in read_population(out)) <= 0.2e-3 + 1e-9


def test_a_unit_that_stands_wrong_is_pressed_deeper(generated: GeneratedExperiment) -> None:
    data = generated.data.experiment
    largest = [np.linalg.norm(data.force[data.row_unit == unit], axis=1).max() for unit in range(2)]
    assert largest[0] > 1.02 * largest[1]
    # ... and says so: its tip is believed to be lower than it is.
    last = [
        data.location[(data.row_unit == u) & (data.row_trajectory == 1)][-1, 2] for u in range(2)
    ]
    assert abs(last[0] - last[1]) < 0.15e-3  # both believe to have gone as far


def test_rows_carry_the_digest_of_all_that_decides_them(generated: GeneratedExperiment) -> None:
    key = SimulationStore.open(generated.folder / STORE).fingertip().key
    digest = provenance_sha256(SPEC, specimens(), key)
    assert generated.data.mixed.experiment.provenance.input_sha256 == digest
    other = provenance_sha256(replace(SPEC, seed=1), specimens(), key)
    assert other != digest


def test_a_run_that_was_stopped_or_killed_goes_on_with_the_same_rows(
    generated: GeneratedExperiment,
) -> None:
    """Stopped among the trials, it keeps what has ended; killed, it may leave half a file."""
    before = generated.data.experiment
    trials = sorted((generated.folder / TRIALS).glob("*.npz"))
    for trial in trials:
        trial.unlink()
    stop = threading.Event()

    def on_stage(stage: str, done: int, total: int, name: str) -> None:
        if stage == "trials" and done:
            stop.set()

    stopped = generate(
        generated.folder,
        SPEC,
        specimens(),
        FemSimulator(),
        workers=1,
        stop=stop,
        on_stage=on_stage,
    )
    assert stopped is None
    (kept,) = (generated.folder / TRIALS).glob("*.npz")
    stamp = kept.stat().st_mtime_ns
    half = next(trial for trial in trials if trial != kept).with_suffix(".part")
    half.write_bytes(b"half")
    (generated.folder / EXPERIMENT).unlink()
    after = run(generated.folder).data.experiment
    np.testing.assert_array_equal(after.tared, before.tared)
    np.testing.assert_array_equal(after.force, before.force)
    assert kept.stat().st_mtime_ns == stamp  # what was there was not made again
    assert (generated.folder / EXPERIMENT).exists()
    half.unlink()


def test_a_cluster_gives_the_same_rows(generated: GeneratedExperiment, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="needs palpate[cluster]")
    one = replace(SPEC, angled=0)  # one trajectory is enough to see that both stages run there
    done = generate(tmp_path / "cluster", one, specimens(), FemSimulator(), workers=1, ray="local")
    assert done is not None
    there, here = done.data.experiment, generated.data.experiment
    assert set(there.trajectories) == {"sphere_medium/00/normal"}
    same = here.row_trajectory == here.trajectories.index("sphere_medium/00/normal")
    # The same solver on the same processor; threads may be shared out otherwise.
    np.testing.assert_allclose(there.force, here.force[same], atol=1e-3)


@pytest.fixture
def simulate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., list[tuple[int, int]]]:
    """The mechanics by devices, on a finger that solves a formula; tells how far it was when."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "fem"))
    monkeypatch.setattr("palpate_deploy.experiment.DEFAULT_FACTORY", "fem_fakes:round_finger")

    def run_devices(devices: tuple[str, ...], slots: int | None, **more: Any) -> list[Any]:
        told: list[tuple[int, int]] = []
        assert FemSimulator().simulate(
            SPEC,
            tmp_path / STORE,
            workers=1,
            threads=1,
            stop=threading.Event(),
            on_progress=lambda done, total, _: told.append((done, total)),
            devices=devices,
            slots=slots,
            **more,
        )
        return told

    return run_devices


def test_devices_fill_the_same_store(simulate: Callable[..., Any], tmp_path: Path) -> None:
    """By processes of devices."""
    told = simulate(("cpu", "cpu"), 2) + simulate(("cpu",), None)
    assert told == [(1, 2), (2, 2)], "the second finds all there"
    assert len(SimulationStore.open(tmp_path / STORE).done()) == 2


def test_devices_of_a_cluster_fill_the_same_store(
    simulate: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("ray", reason="needs palpate[cluster]")
    with RayCluster("local") as cluster:
        told = simulate(("cpu",), 2, cluster=cluster)
    assert told == [(1, 2), (2, 2)]
    assert len(SimulationStore.open(tmp_path / STORE).done()) == 2


def test_what_another_process_has_claimed_is_not_left_out(
    simulate: Callable[..., Any], tmp_path: Path
) -> None:
    """Else a data set of a part would look whole."""
    simulate(("cpu",), 2)
    store = SimulationStore.open(tmp_path / STORE)
    name = min(store.done())
    fingertip = store.fingertip()
    (file,) = (tmp_path / STORE).rglob(f"*{name.rpartition('/')[2]}*.h5")
    file.unlink()
    other = StoreWriter(tmp_path / STORE, fingertip, shared=True)
    with other, other.claim(name), pytest.raises(DatasetError, match=r"1 of 2 .* claimed"):
        simulate(("cpu",), 2)
    simulate(("cpu",), 2)  # the claim is gone


DIES, HELD = 0.13, 0.22
"""Of `fem_fakes`: friction with which a run ends its process, or goes on until its time is over."""


@pytest.mark.parametrize(
    ("friction", "limit_s", "said"), [(DIES, 600.0, "exit status 7"), (HELD, 0.5, "")]
)
def test_what_failed_or_ran_out_of_time_is_not_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, friction: float, limit_s: float, said: str
) -> None:
    """Else a data set of a part would look whole."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "fem"))
    monkeypatch.setattr("palpate_deploy.experiment.DEFAULT_FACTORY", "fem_fakes:round_finger")
    monkeypatch.setattr("palpate_deploy.experiment.LIMIT_S", limit_s)
    first = "the first is sphere_medium/00/"
    with pytest.raises(SimulationError, match=f"2 of 2 .* failed, {first}.*{said}"):
        FemSimulator().simulate(
            replace(SPEC, friction_coefficient=friction),
            tmp_path / STORE,
            workers=1,
            threads=1,
            stop=threading.Event(),
            on_progress=lambda *_: None,
        )


def test_stopped_is_not_said_where_json_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SharedExperiment, "made", lambda *_: iter(()))
    done = CliRunner().invoke(twin_app, ["generate", str(tmp_path / "twin"), "--json"])
    assert done.exit_code == 1
    assert done.stdout == ""
    assert "stopped" in done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--slots", "4"), "--slots without --device"),
        (("--device", "cuda:77"), "cuda:77"),
        (("--device", "cuda:0", "--ray", "auto"), "give cuda"),
    ],
)
def test_devices_that_cannot_be_meant_are_refused(
    tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    folder = tmp_path / "twin"
    with pytest.raises(ConfigError, match=said):
        CliRunner().invoke(twin_app, ["generate", str(folder), *words], catch_exceptions=False)
    assert not folder.exists()


def test_paths_that_slide_twist_and_go_back_become_rows_too(
    generated: GeneratedExperiment, tmp_path: Path
) -> None:
    words = "press 1.5 mm, slide 0.6 mm towards +y, twist 15 deg, unload"
    spec = replace(SPEC, angled=0, overtravel_m=0.0, paths=(words,))
    done = generate(tmp_path / "paths", spec, specimens(), FemSimulator(), workers=1)
    assert done is not None
    data, name = done.data.experiment, "sphere_medium/00/path-0"
    assert set(data.trajectories) == {"sphere_medium/00/normal", name}
    # One that stands too high presses as deep: it feels its way to the skin.
    mine = data.row_trajectory == data.trajectories.index(name)
    hardest = [
        np.sort(np.linalg.norm(data.force[mine & (data.row_unit == unit)], axis=1))[-8:].mean()
        for unit in (0, 1)
    ]
    assert hardest[0] == pytest.approx(hardest[1], rel=0.08)  # 0.2 mm deeper would be a fifth more
    for unit in (0, 1):
        rows = mine & (data.row_unit == unit)
        travel, force = data.travel_m[rows], np.linalg.norm(data.force[rows], axis=1)
        assert np.all(np.diff(travel) > 0)
        assert np.ptp(data.location[rows, 1]) > 0.5e-3
        assert force.argmax() < len(force) - 5  # it goes back, down to where a press begins
        assert force[-1] < 0.8 * force.max()
    # The rows of the press are those of an experiment without further paths.
    plain = replace(spec, paths=())
    assert "paths" not in plain.content()
    assert provenance_sha256(plain, specimens(), "") != provenance_sha256(spec, specimens(), "")
    assert provenance_sha256(SPEC, specimens(), "") == SPEC_SHA256
    mixed = done.data.mixed.experiment
    assert name in {mixed.trajectories[t] for t in mixed.trial_trajectory}


def test_presses_at_random_are_executed_on_some_of_the_specimens(tmp_path: Path) -> None:
    spec = ExperimentSpec(presses=6, units_each=1, edge_m=1.2e-3, seed=5)
    unit = SpecimenParameters()
    four = specimens_of(
        Member(replace(unit, name=f"unit-{k}", sigma_s_m=0.2 + 0.1 * k), None, 0.0)
        for k in range(4)
    )
    done = generate(tmp_path / "random", spec, four, FemSimulator(), workers=1)
    assert done is not None
    data = done.data.experiment
    # Sizes between the paper's come after its nine, so six presses are of six of those.
    assert len(set(data.indenters)) == len(data.trajectories) > 3
    assert all(name.endswith("/random") for name in data.trajectories)
    assert len(data.trial_unit) == len(data.trajectories)  # one specimen each
    assert len(set(data.trial_unit.tolist())) > 1
    assert done.data.mixed.contact is not None
    again = generate(tmp_path / "random", spec, four, FemSimulator(), workers=1)
    assert again is not None
    np.testing.assert_array_equal(again.data.experiment.tared, data.tared)
    every = replace(spec, units_each=0)
    assert provenance_sha256(every, four, "") != provenance_sha256(spec, four, "")
    # The same presses by robots that stand as they did in another experiment.
    elsewhere = replace(spec, registration_seed=9)
    assert "registration_seed" not in spec.content()
    assert provenance_sha256(elsewhere, four, "") != provenance_sha256(spec, four, "")
    shutil.copytree(tmp_path / "random" / STORE, tmp_path / "moved" / STORE)
    moved = generate(tmp_path / "moved", elsewhere, four, FemSimulator(), workers=1)
    assert moved is not None
    assert moved.data.experiment.trajectories == data.trajectories
    apart_m = np.linalg.norm(moved.data.experiment.location[0] - data.location[0])
    assert 1e-5 < apart_m < 3e-3
    # The same presses again, with locations that no registration error is in.
    truly = replace(spec, exact_labels=True)
    assert "exact_labels" not in spec.content()
    shutil.copytree(tmp_path / "random" / STORE, tmp_path / "exact" / STORE)
    exact = generate(tmp_path / "exact", truly, four, FemSimulator(), workers=1)
    assert exact is not None
    np.testing.assert_array_equal(exact.data.experiment.force, data.force)
    errors = np.stack(list(registration_errors(four, spec.seed).values()))  # of both arms
    missed = data.location - exact.data.experiment.location
    off = np.linalg.norm(errors[:, data.row_unit] - missed, axis=-1).min(axis=0)
    np.testing.assert_allclose(off, 0.0, atol=1e-8)


def test_the_command_takes_points_a_seed_and_specimens(tmp_path: Path) -> None:
    units, out = tmp_path / "units.json", tmp_path / "few"
    write_population(units, draw_members(2, 3), source="drawn")
    words = ["generate", str(out), "--points", "1", "--angled", "0", "--seed", "11"]
    words += ["--units", str(units), "--edge-mm", "1.2", "--indenter", "sphere_medium"]
    words += ["--registration-seed", "0", "--layers", "1", "--strain-stiffening", "0.01"]
    words += ["--exact-labels"]
    done = CliRunner().invoke(twin_app, [*words, "--workers", "1"])
    assert done.exit_code == 0, done.output
    spec = json.loads((out / SPEC_FILE).read_text())["spec"]
    assert (spec["points"], spec["angled"], spec["seed"]) == (1, 0, 11)
    assert (spec["registration_seed"], spec["layers"], spec["exact_labels"]) == (0, 1, True)
    fingertip = SimulationStore.open(out / STORE).fingertip()
    assert len(fingertip.mesh.elements) == len(fingertip.mesh.outer_faces)
    assert fingertip.parameters.strain_stiffening == spec["strain_stiffening"] == 0.01
    assert read_mixed(out / MIXED).experiment.unit_names == ("unit-001", "unit-002")


def test_fingertips_have_skins_presses_and_specimens_of_their_own(tmp_path: Path) -> None:
    runner, units, out = CliRunner(), tmp_path / "units.json", tmp_path / "several"
    write_population(units, draw_members(4, 3), source="drawn")
    words = ["generate", str(out), "--random", "3", "--fingertips", "2", "--units", str(units)]
    words += ["--units-each", "1", "--edge-mm", "1.2", "--indenter", "sphere_medium"]
    words += ["--strain-stiffening", "0.01", "--layers", "1", "--json"]
    words += ["--device", "cpu", "--device", "cpu", "--slots", "1"]
    done = runner.invoke(twin_app, words)  # each device presses one of them
    assert done.exit_code == 0, done.output
    one, other = (out / "fingertip-01", out / "fingertip-02")
    specs = [json.loads((tip / SPEC_FILE).read_text())["spec"] for tip in (one, other)]
    assert [spec["presses"] for spec in specs] == [1, 2]
    for key in ("skin_thickness_m", "shear_modulus_pa", "friction_coefficient", "fluid_volume_m3"):
        assert specs[0][key] != specs[1][key]
    skin = SimulationStore.open(other / STORE).fingertip()
    assert skin.parameters.shear_modulus_pa == specs[1]["shear_modulus_pa"]
    assert skin.parameters.friction_coefficient == specs[1]["friction_coefficient"]
    assert skin.parameters.strain_stiffening == 0.01  # which is not drawn
    parts = [read_mixed(tip / MIXED) for tip in (one, other)]
    assert parts[0].experiment.unit_names == ("unit-001", "unit-002")
    assert parts[1].experiment.unit_names == ("unit-003", "unit-004")
    both = joined([features(part) for part in parts])
    assert len(both) == sum(len(features(part)) for part in parts)
    assert both.sensor_names == ("unit-001", "unit-002", "unit-003", "unit-004")
    # Presses of different fingertips have the same names; they are different presses.
    assert len(np.unique(both.group)) == sum(len(p.experiment.trajectories) for p in parts)
    # What is there is not made again.
    stamp = (other / MIXED).stat().st_mtime_ns
    again = runner.invoke(twin_app, words)
    assert [one["finished"] for one in json.loads(again.stdout)] == ["before", "before"]
    assert (other / MIXED).stat().st_mtime_ns == stamp
    words.remove("--json")
    again = runner.invoke(twin_app, words)
    assert f"{other}: was finished before" in again.output
    # What is damaged is named.
    whole = (other / MIXED).read_bytes()
    (other / MIXED).write_bytes(whole[:1000])
    damaged = runner.invoke(twin_app, words).exception
    assert isinstance(damaged, DatasetError)
    assert str(other / MIXED) in damaged.problem
    assert "remove it" in damaged.remedy
    # Nor does an experiment on one fingertip go beside them.
    refused = runner.invoke(twin_app, ["generate", str(out), "--random", "3"])
    assert "on several fingertips" in str(refused.exception)
    assert not (out / SPEC_FILE).exists()


def test_indenters_that_no_specimen_was_pressed_with_are_left_out(tmp_path: Path) -> None:
    """The published biotac-1 met spheres alone."""
    spheres, every = specimens()
    random = ExperimentSpec(presses=9)
    named = with_indenters_met(random, (spheres,)).indenters
    assert {name.split("_")[0] for name in named} == {"sphere"}
    assert len(named) == 5  # sizes between the nine's, too
    assert with_indenters_met(random, (spheres, every)) == random
    units, no = tmp_path / "spheres.json", tmp_path / "no"
    write_population(units, members()[:1], source="published")
    words = ["generate", str(no), "--points", "1", "--indenter", "cube", "--units", str(units)]
    refused = CliRunner().invoke(twin_app, words)
    assert isinstance(refused.exception, ConfigError)
    assert "no specimen of biotac-1 was pressed with cube" in str(refused.exception)
    assert not no.exists()


def test_trials_are_done_though_no_specimen_met_an_indenter(tmp_path: Path) -> None:
    spec = replace(SPEC, angled=0, layers=1, indenters=("cube", "sphere_medium"))
    done = generate(tmp_path, spec, specimens()[:1], FemSimulator(), workers=1)
    assert done is not None
    assert [name.split("/")[0] for name in done.data.experiment.trajectories] == ["sphere_medium"]


def test_it_stops_while_data_sets_are_made_and_goes_on(
    tmp_path: Path, generated: GeneratedExperiment
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(generated.folder, folder)
    (folder / MIXED).unlink()
    stop = threading.Event()

    def on_stage(stage: str, done: int, total: int, word: str) -> None:
        if stage == "data sets":
            stop.set()

    stopped = generate(
        folder, SPEC, specimens(), FemSimulator(), workers=1, stop=stop, on_stage=on_stage
    )
    assert stopped is None
    assert {path.name for path in folder.iterdir()} == {
        path.name for path in generated.folder.iterdir() if path.name != MIXED
    }
    assert run(folder).data.mixed.experiment.trials == generated.data.mixed.experiment.trials


def test_what_trials_need_is_missed_before_anything_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(MissingExtraError, match="pinocchio"):
        run(tmp_path / "no")
    assert not (tmp_path / "no").exists()


def test_fingertips_without_presses_or_specimens_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "no"
    for extra, said in (
        (("--fingertips", "2"), "needs --random"),
        (("--random", "3", "--fingertips", "2", "--fill-ml", "0.6"), "has no --fill-ml"),
    ):
        refused = CliRunner().invoke(twin_app, ["generate", str(out), *extra])
        assert refused.exit_code == 2
        assert said in refused.output
    many = ExperimentSpec(presses=3, units_each=2)
    for count in (0, 2, 4):  # none; two specimens each for three units; more than presses
        with pytest.raises(ConfigError, match=f"for {count} fingertips"):
            share_out(many, [{}] * count, (*specimens(), specimens()[0]))
    assert not out.exists()


@pytest.mark.parametrize("extra", [("--points", "3"), ("--angled", "0"), ("--path", "press 1 mm")])
def test_presses_at_random_have_no_points_angles_or_paths(
    tmp_path: Path, extra: tuple[str, ...]
) -> None:
    words = ["generate", str(tmp_path / "no"), "--random", "3", *extra]
    refused = CliRunner().invoke(twin_app, words)
    assert refused.exit_code == 2
    assert "--random has no" in refused.output
    assert not (tmp_path / "no").exists()


def test_another_experiment_does_not_go_into_the_same_folder(
    generated: GeneratedExperiment,
) -> None:
    with pytest.raises(ConfigError, match="seed 3 is not 0"):
        generate(generated.folder, replace(SPEC, seed=3), specimens(), FemSimulator(), workers=1)
    with pytest.raises(ConfigError, match="members"):
        generate(generated.folder, SPEC, specimens()[:1], FemSimulator(), workers=1)
    words = ["generate", str(generated.folder), "--random", "2", "--fingertips", "2"]
    refused = CliRunner().invoke(twin_app, words)
    assert "on one fingertip" in str(refused.exception)
    assert not list(generated.folder.glob("fingertip-*"))


@pytest.mark.parametrize("extra", [(), ("--fingertips", "2")])
def test_an_experiment_without_a_fingertip_leaves_the_folder_to_another(
    tmp_path: Path, extra: tuple[str, ...]
) -> None:
    words = ["generate", str(tmp_path), "--random", "2", "--edge-mm", "50", *extra]
    refused = CliRunner().invoke(twin_app, words)
    assert "edge_m" in str(refused.exception)
    assert not list(tmp_path.rglob(SPEC_FILE))
    keep_spec(tmp_path, SPEC, specimens())


def test_damaged_files_are_named(generated: GeneratedExperiment) -> None:
    trial = next((generated.folder / TRIALS).glob("*normal.npz"))
    whole = trial.read_bytes()
    trial.write_bytes(whole[: len(whole) // 2])
    try:
        with pytest.raises(DatasetError, match=r"normal\.npz"):
            run(generated.folder)
    finally:
        trial.write_bytes(whole)


def test_idle_counts_that_are_damaged_are_made_again(generated: GeneratedExperiment) -> None:
    path = generated.folder / IDLE
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    run(generated.folder)
    with np.load(path) as idle:
        assert {"biotac-1", "biotac-2"} <= set(idle.files)


def test_a_damaged_spec_is_named(tmp_path: Path) -> None:
    (tmp_path / SPEC_FILE).write_text("{", encoding="utf-8")
    with pytest.raises(ConfigError, match=SPEC_FILE):
        generate(tmp_path, SPEC, specimens(), FemSimulator(), workers=1)
    (tmp_path / SPEC_FILE).write_text("[]", encoding="utf-8")
    with pytest.raises(ConfigError, match="no settings"):
        generate(tmp_path, SPEC, specimens(), FemSimulator(), workers=1)
    (tmp_path / SPEC_FILE).write_text(json.dumps({"schema": "other"}), encoding="utf-8")
    with pytest.raises(ConfigError, match="another experiment"):
        generate(tmp_path, SPEC, specimens(), FemSimulator(), workers=1)


def test_a_full_disk_is_not_called_a_damaged_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(file: Path, *_: object, **__: object) -> None:
        file.write_bytes(b"{")
        raise OSError(errno.ENOSPC, "No space left on device")

    folder = tmp_path / "g"
    with monkeypatch.context() as full:
        full.setattr(Path, "write_text", half)
        with pytest.raises(DatasetError, match=r"experiment\.json.*No space left") as caught:
            keep_spec(folder, SPEC, specimens())
    assert "damaged" not in caught.value.remedy
    assert not list(folder.iterdir())
    keep_spec(folder, SPEC, specimens())
    keep_spec(folder, SPEC, specimens())
    with pytest.raises(ConfigError, match="seed 1 is not 0"):
        keep_spec(folder, replace(SPEC, seed=1), specimens())


def test_processes_answer_every_task_and_hand_errors_on() -> None:
    pool = WorkerProcesses(2)
    try:
        answers = sorted(pool.run(math.sqrt, [float(k * k) for k in range(20)]))
        assert answers == [(float(k * k), float(k)) for k in range(20)]
        with pytest.raises(ValueError, match=r"math domain|nonnegative"):
            list(pool.run(math.sqrt, [-1.0]))
        with pytest.raises(WorkerLostError, match="died"):
            list(pool.run(os._exit, [1]))
    finally:
        pool.close()


KILLED = """
import os, signal, time
from palpate_training.experiment.generate.workers import WorkerProcesses

if __name__ == "__main__":
    pool = WorkerProcesses(1)
    pool._pool.submit(time.sleep, 600)
    while not pool._pool._processes:
        time.sleep(0.01)
    (worker,) = pool._pool._processes
    while "spawn_main" not in open(f"/proc/{worker}/cmdline").read():
        time.sleep(0.01)
    time.sleep(3)
    print(worker, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_workers_do_not_outlive_a_command_that_is_killed(tmp_path: Path) -> None:
    """Nothing catches SIGKILL, and a worker may be in the middle of its task."""
    script = tmp_path / "killed.py"
    script.write_text(KILLED, encoding="utf-8")
    told = tmp_path / "worker"
    with told.open(
        "w", encoding="ascii"
    ) as file:  # no pipe: a worker that lives would hold it open
        subprocess.run([sys.executable, str(script)], stdout=file, check=False, timeout=60)
    worker = int(told.read_text(encoding="ascii"))
    deadline = time.monotonic() + 20.0
    while Path(f"/proc/{worker}").exists() and _state(worker) != "Z":
        assert time.monotonic() < deadline, "the worker lives on"
        time.sleep(0.05)


def _state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return "Z"


def test_ray_that_is_not_there_is_said() -> None:
    pytest.importorskip("ray", reason="needs palpate[cluster]")
    for address in ("127.0.0.1:1", "nowhere:x"):
        with pytest.raises(LinkError, match="no Ray cluster"):
            RayCluster(address)


def test_sample_is_small_and_playable(generated: GeneratedExperiment, tmp_path: Path) -> None:
    """One normal and one angled press: that is all there is, so a rest cannot be written."""
    words = ["sample", str(generated.folder), "--dataset", str(tmp_path / "s.h5")]
    words += ["--tape", str(tmp_path / "t.npz")]
    with pytest.raises(DatasetError, match="no trials of biotac-3"):
        CliRunner().invoke(twin_app, words, catch_exceptions=False)
    units = tmp_path / "units.json"
    write_population(units, members(), source="made by a test")
    words += ["--units", str(units)]
    with pytest.raises(DatasetError, match="no trials are given"):
        CliRunner().invoke(
            twin_app, [*words, "--rest", str(tmp_path / "rest")], catch_exceptions=False
        )
    assert [path.name for path in tmp_path.iterdir()] == ["units.json"]
    done = CliRunner().invoke(twin_app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    small, whole = read_mixed(tmp_path / "s.h5"), generated.data.mixed
    np.testing.assert_array_equal(small.experiment.tared, whole.experiment.tared)
    rows = slice(0, len(whole))
    lost = np.linalg.norm(small.displacement(rows) - whole.displacement(rows), axis=2)
    assert lost.mean() < 10e-6
    tape = read_tape(tmp_path / "t.npz")
    assert [unit.name for unit in tape.specimens] == ["biotac-1", "biotac-2"]
    press = next(one for one in tape.trajectories if one.id.endswith("/normal"))
    np.testing.assert_allclose(press.counts[0, 0], tape.specimens[0].rest_counts)
    assert np.linalg.norm(press.force[-1]) > np.linalg.norm(press.force[1])
    assert sum((tmp_path / name).stat().st_size for name in ("s.h5", "t.npz")) < 3e6


def test_the_rest_is_all_that_the_sample_lacks(
    generated: GeneratedExperiment, tmp_path: Path
) -> None:
    """The trials of one specimen get trajectories of their own, which a sample does not take."""
    folder = tmp_path / "four"

    def later(names: Sequence[str]) -> tuple[str, ...]:
        return tuple(name.replace("/00/", "/01/") for name in names)

    shutil.copytree(generated.folder, folder)

    def parted(data: ExperimentDataset) -> ExperimentDataset:
        return replace(
            data,
            trajectories=(*data.trajectories, *later(data.trajectories)),
            indenters=2 * data.indenters,
            trial_trajectory=data.trial_trajectory + 2 * data.trial_unit,
        )

    experiment, mixed = read_experiment(folder / EXPERIMENT), read_mixed(folder / MIXED)
    write_experiment(folder / EXPERIMENT, parted(experiment))
    write_mixed(folder / MIXED, replace(mixed, experiment=parted(mixed.experiment)))
    dataset, tape, rest = tmp_path / "s.h5", tmp_path / "t.npz", tmp_path / "rest"
    wanted, _ = make_sample(folder, specimens(), FemSimulator(), dataset, tape, rest)
    assert set(wanted) == set(experiment.trajectories)
    sampled = read_mixed(dataset).experiment
    others = read_experiment(rest / EXPERIMENT), read_mixed(rest / MIXED).experiment
    for whole, other in zip((experiment, mixed.experiment), others, strict=True):
        assert set(other.trajectories) == set(later(wanted))
        np.testing.assert_array_equal(other.tared, whole.tared[whole.row_unit == 1])
    assert set(sampled.trajectories) == set(wanted)
    assert len(sampled.tared) + len(others[1].tared) == len(mixed)


@pytest.mark.parametrize(
    ("dataset", "tape", "rest", "words"),
    [
        ("s.h5", "t.npz", "four", "--rest .*: its experiment.h5 is what the command reads"),
        ("four/mixed.h5", "t.npz", None, "--dataset .* is what the command reads"),
        ("link/experiment.h5", "t.npz", None, "--dataset .* is what the command reads"),
        ("s.h5", f"four/{TRIALS}/t.npz", None, "--tape .* is inside what the command reads"),
        ("rest/mixed.h5", "t.npz", "rest", "--dataset .* is a file of --rest, too"),
    ],
)
def test_a_sample_is_not_written_over_what_it_is_taken_from(
    tmp_path: Path, dataset: str, tape: str, rest: str | None, words: str
) -> None:
    """Told by the paths alone: the files are not even read."""
    folder = tmp_path / "four"
    (folder / TRIALS).mkdir(parents=True)
    (tmp_path / "link").symlink_to(folder)
    for name in (EXPERIMENT, MIXED):
        (folder / name).write_text("hours of simulation")
    with pytest.raises(ConfigError, match=words):
        make_sample(
            folder,
            specimens(),
            FemSimulator(),
            tmp_path / dataset,
            tmp_path / tape,
            None if rest is None else tmp_path / rest,
        )
    for name in (EXPERIMENT, MIXED):
        assert (folder / name).read_text() == "hours of simulation"


@pytest.mark.parametrize("slow_starts", [1, 2])
def test_a_new_cluster_may_be_slow_to_start_once(
    slow_starts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def init(**options: object) -> None:
        calls.append("init")
        if calls.count("init") <= slow_starts:
            raise Exception("The current node timed out during startup.")  # as Ray says it

    ray = SimpleNamespace(init=init, shutdown=lambda: calls.append("shutdown"))
    monkeypatch.setattr("palpate.cluster.require", lambda module, extra: ray)
    if slow_starts > 1:
        busy = "may be too busy: The current node timed out during startup. -> leave --ray out"
        with pytest.raises(LinkError, match=busy):
            RayCluster("local")
    else:
        RayCluster("local")
    assert calls == ["init", "shutdown", "init"]
