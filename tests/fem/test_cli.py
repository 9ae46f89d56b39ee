"""``palpate fem``: what its commands say, write and return, on a finger that solves a formula."""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from palpate.client import Client
from palpate.client.simulations import straight_path
from palpate.config import LinkConfig
from palpate.errors import ConfigError, DatasetError, LinkError, MissingExtraError, PalpateError
from palpate.messages import SimulationOutcome, SimulationParameters, SimulationRequest
from palpate_fem.calibration.measured import SIMULATED, MeasuredIndentation, write_indentations
from palpate_fem.calibration.result import read_parameters
from palpate_fem.cli import model as cli_model
from palpate_fem.cli.app import fem_app
from palpate_fem.cli.run import telling_step
from palpate_fem.cli.terminal import print_table
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.outline import outline_of
from palpate_fem.indenter.path import COLUMNS
from palpate_fem.result import IndentationOutcome
from palpate_fem.service import node
from palpate_fem.service.config import FemConfig
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter
from palpate_fem.study import PathRow

fakes: Any = importlib.import_module("fem_fakes")

PATIENCE_S = 20.0


@pytest.fixture(autouse=True)
def _a_finger_of_formulas(monkeypatch: pytest.MonkeyPatch, workers_find_fakes: None) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(cli_model, "DEFAULT_FACTORY", "fem_fakes:round_finger")


def fem(*words: object, friction: float = fakes.QUICK) -> Result:
    """Run a command; what it raises is raised here."""
    more = ["--friction", str(friction)] if words[0] == "run" else []
    return CliRunner().invoke(fem_app, [*map(str, words), *more], catch_exceptions=False)


def test_one_press_is_shown_and_drawn(tmp_path: Path) -> None:
    png = tmp_path / "press.png"
    done = fem("run", "--indenter", "sphere_7mm", "--steps", 4, "--workers", 1, "--png", png)
    assert done.exit_code == 0
    assert "sphere_medium: complete" in done.stdout
    assert "1 of 1 run: 1 complete" in done.stdout
    assert png.stat().st_size > 10_000


def test_the_picture_of_a_press_shows_its_indenter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(
        "palpate_fem.plot.step.plot_step", lambda *_, step, indenter: drawn.append(indenter)
    )
    fem("run", "--indenter", "cube_14mm", "--steps", 3, "--png", tmp_path / "press.png")
    (outline,) = drawn
    np.testing.assert_array_equal(outline[0], outline_of("cube")[0])


def test_json_is_json(tmp_path: Path) -> None:
    done = fem("run", "--steps", 3, "--angle-deg", 30, "--depth-mm", 1.5, "--json")
    content = json.loads(done.stdout)
    (trajectory,) = content["trajectories"]
    assert len(trajectory["steps"]) == 3
    assert content["outcomes"] == {"complete": 1}
    start = fem("run", "--steps", 3, "--json")  # straight in: along the normal
    tilt = np.array(json.loads(start.stdout)["trajectories"][0]["steps"][0]["pose"][3:])
    cosine = 2 * float(tilt @ trajectory["steps"][0]["pose"][3:]) ** 2 - 1
    assert np.degrees(np.arccos(cosine)) == pytest.approx(30, abs=1e-6)


def test_a_path_from_a_file(tmp_path: Path) -> None:
    path = np.zeros((5, 7))
    path[:, 2], path[:, 3] = np.linspace(-0.010, -0.006, 5), 1.0
    np.savetxt(tmp_path / "poses.csv", path, "%.17g", ",", header=",".join(COLUMNS), comments="")
    done = fem("run", "--poses", tmp_path / "poses.csv", "--json")
    steps = json.loads(done.stdout)["trajectories"][0]["steps"]
    assert [step["pose"][2] for step in steps] == path[1:, 2].tolist()
    path[:, 2] += 0.005
    np.savetxt(tmp_path / "inside.csv", path, "%.17g", ",", header=",".join(COLUMNS), comments="")
    with pytest.raises(ConfigError, match="inside"):
        fem("run", "--poses", tmp_path / "inside.csv")


def test_a_path_of_segments_is_run_and_stored_once(tmp_path: Path) -> None:
    words = "press 1 mm, slide 0.5 mm towards +y, twist 10 deg, unload"
    common = ("run", "--path", words, "--step-mm", 0.25, "--store", tmp_path / "a.sim")
    done = fem(*common, "--json")
    (trajectory,) = json.loads(done.stdout)["trajectories"]
    poses = np.array([step["pose"] for step in trajectory["steps"]])
    assert trajectory["outcome"] == "complete"
    assert poses[5, 1] - poses[3, 1] == pytest.approx(0.5e-3)
    turned = np.unwrap(2.0 * np.arctan2(poses[:, 6], poses[:, 3]))
    assert turned[8] - turned[5] == pytest.approx(np.deg2rad(10.0))
    assert "1 were there already" in fem(*common).stdout


def test_a_picture_shows_the_last_touch_or_the_hardest() -> None:
    force = np.zeros((4, 3))
    force[1:, 2] = 2.0, 1.0, 0.5
    assert telling_step(force) == 3
    force[3] = 0.0
    assert telling_step(force) == 1
    assert telling_step(force[:3]) == 2


def test_the_fill_is_an_option() -> None:
    done = fem("run", "--steps", 2, "--fill-ml", 0.6, "--json")
    parameters = json.loads(done.stdout)["fingertip"]["parameters"]
    assert parameters["fluid_volume_m3"] == pytest.approx(0.6e-6)
    with pytest.raises(ConfigError, match="fluid_volume_m3"):
        fem("run", "--steps", 2, "--fill-ml", 600)


def test_a_study_of_paths_says_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    good = PathRow(
        "cube", (0.0, 1.0), "press 1 mm, unload", 9, 9, "complete", "", 1.0, 3e-6, 2e-6, 0.0, 1e-9,
        9, 30, 1.0,
    )  # fmt: skip
    rows = [good, replace(good, friction_least_j=-1e-7), replace(good, undone_m=2e-8)]
    rows.append(replace(good, outcome="diverged", reason="no way", done=4, undone_m=math.nan))
    asked: list[dict[str, Any]] = []

    def study(*, on_row: Any, **options: Any) -> list[PathRow]:
        asked.append(options)
        return rows[: options["count"]]

    monkeypatch.setattr("palpate_fem.study.path_study", study)
    done = fem("study", "paths", "--count", 4, "--edge-mm", 0.8, "--fill-ml", 0.6)
    assert asked == [{"count": 4, "seed": 0, "edge_m": 0.8e-3, "fluid_volume_m3": 0.6e-6}]
    said = " ".join(done.stdout.split())
    assert done.exit_code == 1
    assert "3 of 4 complete; friction took work on all but 1; at most 0.0200 um left" in said
    assert "no way" in said
    done = fem("study", "paths", "--count", 1, "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout)["rows"][0]["words"] == "press 1 mm, unload"
    assert fem("study", "paths", "--png", "a.png").exit_code == 2
    assert fem("study", "mesh", "--fill-ml", "nan").exit_code == 2


def test_the_bench_tells_times_and_rates_of_the_solver() -> None:
    done = fem("bench", "--json", "--edge-mm", 1.5, "--layers", 1)
    assert done.exit_code == 0
    told = json.loads(done.stdout)
    assert told["solver.solve_s"] > 0.0
    assert told["solver.factor_gflops"] > 0.0
    assert told["memory.peak_mib"] > 0.0


def test_a_sweep_is_resumed_and_drawn(tmp_path: Path) -> None:
    store, png = tmp_path / "a.sim", tmp_path / "a.png"
    words = ("run", "--sweep", "--points", 1, "--steps", 3, "--store", store, "--workers", 2)
    done = fem(*words, "--indenter", "cube", "--indenter", "ring", "--indenter", "cube_14mm")
    assert done.exit_code == 0
    assert "10 of 10 run: 10 complete" in done.stdout
    done = fem(*words, "--indenter", "cube", "--indenter", "sphere_7mm", "--png", png)
    assert "5 of 5 run: 5 complete; 5 were there already" in done.stdout
    assert len(SimulationStore.open(store).done()) == 15
    assert png.stat().st_size > 10_000


def test_what_another_process_runs_is_told(tmp_path: Path) -> None:
    store, sweep = tmp_path / "a.sim", ("--sweep", "--points", 1, "--angled", 1, "--steps", 3)
    words = ("run", *sweep, "--store", store, "--indenter", "cube")
    assert fem(*words).exit_code == 0
    held = SimulationStore.open(store)
    taken = next(name for name in held.ids() if name.endswith("/normal"))
    held.file_of(taken).unlink()
    with StoreWriter(store, held.fingertip(), shared=True) as other, other.claim(taken):
        again = fem(*words)
        assert again.exit_code == 1
        assert "1 were there already; 1 run by another process" in again.stdout
        assert "the same command goes on" in again.stdout
        told = json.loads(fem(*words, "--json").stdout)
        assert (told["elsewhere"], told["present"]) == (1, 1)
    assert fem(*words).exit_code == 0


def test_one_press_that_another_process_runs_is_told(tmp_path: Path) -> None:
    store = tmp_path / "a.sim"
    words = ("run", "--steps", 3, "--store", store)
    assert json.loads(fem(*words, "--json").stdout)["elsewhere"] == 0
    held = SimulationStore.open(store)
    (name,) = held.ids()
    held.file_of(name).unlink()
    with StoreWriter(store, held.fingertip(), shared=True) as other, other.claim(name):
        again = fem(*words, "--png", tmp_path / "a.png")
    assert again.exit_code == 1
    assert "run by another process" in again.stdout
    assert not (tmp_path / "a.png").exists()


def test_json_of_a_sweep_has_a_line_for_each_trajectory_that_the_store_holds(
    tmp_path: Path,
) -> None:
    sweep = ("--sweep", "--points", 1, "--angled", 1, "--steps", 3, "--indenter", "cube")
    words = ("run", *sweep, "--json", "--store", tmp_path / "a.sim")
    for present in (0, 2):
        told = json.loads(fem(*words).stdout)
        assert told["present"] == present
        rows = {one["name"]: one for one in told["trajectories"]}
        assert len(rows) == 2
        press = next(one for name, one in rows.items() if name.endswith("/normal"))
        assert press["outcome"] == "complete"
        assert press["steps_converged"] == press["steps_total"] == 3
        assert press["peak_force_n"] > 0.0


def test_one_press_into_a_store_is_run_once(tmp_path: Path) -> None:
    words = ("run", "--steps", 3, "--store", tmp_path / "a.sim")
    assert "1 of 1 run" in fem(*words).stdout
    again = fem(*words)
    assert "1 were there already" in again.stdout
    assert "complete" in again.stdout


@pytest.mark.parametrize(
    ("words", "kind", "code"),
    [
        (("--steps", 3), "DIVERGES", 1),
        (("--steps", 3), "PINCHES", 0),
        (("--sweep", "--points", 1, "--angled", 0, "--indenter", "cube"), "DIVERGES", 1),
    ],
)
def test_what_failed_before_fails_the_same_command(
    tmp_path: Path, words: tuple[object, ...], kind: str, code: int
) -> None:
    store, friction = tmp_path / "a.sim", getattr(fakes, kind)
    for run in ("1 of 1 run", "0 of 0 run; 1 were there already"):
        done = fem("run", *words, "--store", store, friction=friction)
        assert run in done.stdout
        assert done.exit_code == code
    assert ("of which 1 did not complete" in done.stdout) is (code == 1)


def test_a_store_keeps_stress_of_all_or_of_none(tmp_path: Path) -> None:
    with_stress, without = tmp_path / "with.sim", tmp_path / "without.sim"
    assert fem("run", "--steps", 3, "--store", with_stress, "--stress").exit_code == 0
    assert fem("run", "--steps", 3, "--store", without).exit_code == 0
    for steps in (3, 4):
        with pytest.raises(DatasetError, match="without stress") as caught:
            fem("run", "--steps", steps, "--store", without, "--stress")
    assert "leave out --stress" in caught.value.remedy
    with pytest.raises(DatasetError, match="with stress"):
        fem("run", "--steps", 4, "--store", with_stress)
    assert fem("run", "--steps", 4, "--store", with_stress, "--stress").exit_code == 0


def test_stress_is_not_mixed_with_what_ran_out_of_time_without(tmp_path: Path) -> None:
    store = tmp_path / "a.sim"
    assert fem("run", "--steps", 5, "--store", store).exit_code == 0
    held = SimulationStore.open(store)
    (name,) = held.ids()
    whole = held.trajectory(name)
    held.file_of(name).unlink()
    with StoreWriter(store, held.fingertip()) as writer:
        late = replace(whole, steps=whole.steps[:2], outcome=IndentationOutcome.DEADLINE)
        writer.write(name, late)
    with pytest.raises(DatasetError, match="without stress"):
        fem("run", "--steps", 3, "--store", store, "--stress")
    # The one that is there is run again, so it may have stress then.
    assert fem("run", "--steps", 5, "--store", store, "--stress").exit_code == 0


@pytest.mark.parametrize(
    ("kind", "code", "said"),
    [
        ("PINCHES", 0, "force limit"),
        ("DIVERGES", 1, "2.5 mm along the path"),
        ("REFUSES", 1, "folded"),
        ("DIES", 1, "exit status 7"),
    ],
)
def test_an_early_end_is_listed(kind: str, code: int, said: str) -> None:
    done = fem("run", "--steps", 6, friction=getattr(fakes, kind))
    assert done.exit_code == code
    assert "did not complete" in done.stdout
    assert said in " ".join(done.stdout.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--indenter", "spere_7mm"), "sphere_7mm"),
        (("--sweep",), "--store"),
        (("--angle-deg", 90), "angle-deg"),
        (("--indenter", "cube", "--indenter", "ring"), "several"),
        (("--shear-modulus-kpa", 280_000), "shear_modulus_pa"),
        (("--skin-thickness-mm", 1.57e-3), "in mm, kPa or ml as options"),
        (("--strain-stiffening", 0.5), "strain_stiffening"),
        (("--mesh", "nowhere"), "nowhere"),
        (("--poses", "nowhere.csv"), "nowhere.csv"),
        (("--path", "nowhere.csv"), "--poses"),
        (("--path", "pres 1 mm"), "pres 1 mm"),
        (("--path", "press 1 mm", "--poses", "a.csv"), "exclude"),
        (("--path", "press 1 mm", "--step-mm", 0), "--step-mm 0 is no length"),
        (("--depth-mm", -1), "--depth-mm -1 is no length"),
        (("--steps", 10**12), "--steps 1000000000000: at most 10,000 poses"),
        (("--sweep", "--store", "a.sim", "--steps", 10_000), "--steps 10000: at most"),
        (("--path", "press 1 mm, slide 20 mm towards +y", "--step-mm", 0.001), "poses"),
        (("--parameters", "nowhere.json"), "nowhere.json"),
        (("--at-mm", 40, 0), "no pad"),
        (("--at-mm", -4, "nan"), "--at-mm -4 nan is not finite"),
        (("--azimuth-deg", "inf", "--angle-deg", 10), "--azimuth-deg inf is not finite"),
        (("--angle-deg", "nan"), "--angle-deg nan is not finite"),
        (("--depth-mm", "inf"), "--depth-mm inf is not finite"),
        (("--path", "press 1 mm", "--step-mm", "inf"), "--step-mm inf is not finite"),
        (("--limit-s", "inf"), "--limit-s inf is not finite"),
        (("--store", "store.h5"), ".sim"),
        (("--store", f"{__file__}/a.sim"), "no folder"),
        (("--edge-mm", 0), "edge_m"),
        (("--edge-mm", 50), "edge_m"),
        (("--edge-mm", 1.2345), "whole micrometres"),
        (("--layers", 50), "layers"),
        (("--sweep", "--store", "a.sim", "--depth-mm", 1), "--depth-mm has no effect"),
        (("--path", "press 1 mm", "--steps", 3), "--steps has no effect with --path"),
        (("--poses", "a.csv", "--at-mm", 0, 0), "--at-mm has no effect"),
        (("--seed", 3), "--seed has no effect with a single press"),
        (("--stress",), "--store"),
        (("--png", "measured.h5"), ".png"),
    ],
)
def test_what_cannot_be_meant_is_refused(words: tuple[object, ...], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        fem("run", *words)
    assert said in f"{caught.value.problem}; {caught.value.remedy}"


TRUTH = FingertipParameters(
    skin_thickness_m=1.4e-3, shear_modulus_pa=3.2e5, friction_coefficient=0.35
)


def test_units_in_tables_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """Rich takes [mm] for a style, and leaves it out."""
    rows = [("moved [um]", "stopped at pose[k]")]
    print_table(("", "depth offset [mm]"), rows, title="a [s]", caption="b [kPa]")
    told = capsys.readouterr().out
    for words in ("moved [um]", "pose[k]", "depth offset [mm]", "a [s]", "b [kPa]"):
        assert words in told


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    """Two indentations of a finger with other parameters than the default."""
    items = []
    for k, angle in enumerate((0.0, 0.5)):
        path = np.zeros((22, 7))
        path[:, 3], path[:, 5] = np.cos(angle / 2), np.sin(angle / 2)
        inward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        start = np.array([0.0, 0.0, -9.5e-3 - 2e-3 * k])
        path[:, :3] = start + np.linspace(0.0, 5e-3 + 2e-3 * k, 22)[:, None] * inward
        tip = fakes.RoundTip(TRUTH)
        force = np.array([tip.force(pose, TRUTH.friction_coefficient) for pose in path])
        items.append(
            MeasuredIndentation(f"cube/{k:02}/press", "cube", "virtual", path, force, SIMULATED)
        )
    write_indentations(tmp_path / "measured.h5", items, source="a formula")
    return tmp_path / "measured.h5"


def test_calibrate_then_validate(measured: Path, tmp_path: Path) -> None:
    fit, png, out = tmp_path / "fit.json", tmp_path / "fit.png", tmp_path / "validation"
    done = fem("calibrate", measured, "--out", fit, "--png", png, "--workers", 2)
    assert done.exit_code == 0, done.stdout
    assert "this tests the method" in done.stderr
    found = read_parameters(fit)
    for name in ("skin_thickness_m", "shear_modulus_pa", "friction_coefficient"):
        assert getattr(found, name) == pytest.approx(getattr(TRUTH, name), rel=0.05), name
    assert png.stat().st_size > 10_000
    done = fem("validate", measured, "--parameters", fit, "--out", out, "--workers", 2)
    assert done.exit_code == 0
    assert "SELF-TEST" in done.stdout
    assert {file.name for file in out.iterdir()} >= {"validation.json", "examples.png"}
    assert json.loads((out / "validation.json").read_text())["median_n"] < 0.05
    with pytest.raises(ConfigError, match="begins with ring"):
        fem("validate", measured, "--only", "ring")


def test_a_finger_is_calibrated_at_the_thickness_that_was_measured(
    measured: Path, tmp_path: Path
) -> None:
    fit = tmp_path / "fit.json"
    words = ("calibrate", measured, "--out", fit, "--workers", 2, "--total-thickness-mm")
    done = fem(*words, 14.57)
    assert done.exit_code == 0, done.stdout
    assert read_parameters(fit).total_thickness_m == pytest.approx(14.57e-3)
    for thickness_mm in (14.57e-3, "nan"):
        with pytest.raises(ConfigError, match="total_thickness_m"):
            fem(*words, thickness_mm)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("calibrate", "measured.h5", "--out", "measured.h5"), ".json"),
        (("calibrate", "measured.h5", "--png", "measured.h5"), ".png"),
        (("calibrate", "linked.json", "--out", "linked.json"), "reads"),
        (("calibrate", "linked.json", "--out", "./again.json"), "reads"),
        (("calibrate", "measured.h5", "--out", "folder.json"), "is a folder"),
        (("calibrate", "measured.h5", "--png", "folder.png"), "is a folder"),
        (("calibrate", "measured.h5", "--out", "measured.h5/fit.json"), "no folder"),
        (("validate", "measured.h5", "--out", "measured.h5"), "no folder"),
        (("units", "draw", 2, "--out", "measured.h5"), ".json"),
        (("units", "fit", "a.sim", "--out", "measured.h5"), ".json"),
        (("units", "fit", "a.sim", "--recording", "b.h5", "--out", "b.h5"), ".json"),
        (("study", "mesh", "--png", "measured.h5"), ".png"),
    ],
)
def test_what_would_replace_another_file_is_refused_at_once(
    measured: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...], said: str
) -> None:
    monkeypatch.chdir(measured.parent)
    before = measured.read_bytes()
    Path("folder.json").mkdir()
    Path("folder.png").mkdir()
    for name in ("linked.json", "again.json"):
        Path(name).symlink_to(measured)
    with pytest.raises(ConfigError, match=said):
        fem(*words)
    assert measured.read_bytes() == before


def test_what_was_found_is_told_though_the_disk_refuses(
    measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise DatasetError("no space", remedy="free some")

    monkeypatch.setattr("palpate_fem.cli.identify.write_calibration", refuse)
    words = ["calibrate", str(measured), "--out", str(tmp_path / "fit.json"), "--workers", "2"]
    done = CliRunner().invoke(fem_app, words)
    assert isinstance(done.exception, DatasetError)
    assert "shear_modulus_pa" in done.stdout
    assert "wrote" not in done.stdout


@pytest.mark.parametrize(
    "words", [("--edge-mm", 0.9), ("--layers", 1), ("--parameters", "a.json"), ("--mesh", "biotac")]
)
def test_a_store_is_compared_as_it_is(words: tuple[object, ...]) -> None:
    with pytest.raises(ConfigError, match=f"{words[0]} has no effect with --store"):
        fem("validate", "measured.h5", "--store", "a.sim", *words)


def test_a_missing_extra_gives_the_install_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "palpate_fem.cli.run", None)
    monkeypatch.setattr("palpate_fem.cli.app.EXTRA_MODULES", ("palpate_fem",))
    with pytest.raises(MissingExtraError, match=r'pip install "palpate\[fem\]"'):
        fem("run")


PROGRAM = """
import sys
from palpate_fem.cli import model as cli_model
cli_model.DEFAULT_FACTORY = "fem_fakes:round_finger"
from palpate_fem.calibration.result import read_parameters
from palpate_fem.cli.app import fem_app
from palpate_fem.config import FingertipParameters
fem_app({words!r})
"""


def spawn(*words: object) -> subprocess.Popen[str]:
    """A command in a process of its own, for signals."""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(words=[str(word) for word in words])],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_sweep_keeps_what_has_ended(stop: signal.Signals, tmp_path: Path) -> None:
    store = tmp_path / "a.sim"
    process = spawn(
        "run", "--sweep", "--indenter", "cube", "--steps", 5, "--store", store, "--friction",
        fakes.SLOW, "--workers", 2,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + PATIENCE_S
        while len(list(store.rglob("normal.h5"))) < 1:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        # To the workers, too, as a terminal, `timeout` and a cluster's scheduler do.
        os.killpg(process.pid, stop)
        output, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        with contextlib.suppress(ProcessLookupError):  # all have ended
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 1
    assert "the same command goes on" in output
    assert "failed" not in output
    assert "Traceback" not in errors
    assert "ended by" not in errors
    assert SimulationStore.open(store).check() >= 1


def test_json_of_what_is_stopped_before_the_finger_is_filled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("palpate_fem.service.batch.SimulationBatch.fingertip", lambda *_: None)
    done = fem("run", "--workers", 1, "--json")
    assert done.exit_code == 1
    told = json.loads(done.stdout)
    assert told["stopped"]
    assert told["fingertip"] is None


def test_serve_answers_until_it_is_told_to_stop(link: LinkConfig) -> None:
    process = spawn("serve", "--connect", link.connect[0], "--workers", 1)
    try:
        with Client(link.connect[0], timeout_s=5) as robot:
            deadline = time.monotonic() + PATIENCE_S
            while not any(process.ready for process in robot.alive()):
                assert time.monotonic() < deadline
                time.sleep(0.02)
            path = straight_path((0, 0, -0.010), (0, 0, -0.006), 4)
            request = SimulationRequest(
                "r", "cube", path, SimulationParameters(friction_coefficient=fakes.QUICK)
            )
            assert robot.simulate(request).outcome is SimulationOutcome.COMPLETE
            errors: list[PalpateError] = []

            def ask_slowly() -> None:
                try:
                    robot.simulate(
                        SimulationRequest(
                            "slow",
                            "cube",
                            straight_path((0, 0, -0.010), (0, 0, -0.006), 100),
                            SimulationParameters(friction_coefficient=fakes.SLOW),
                        ),
                        on_step=lambda *_: process.terminate(),
                    )
                except PalpateError as error:
                    errors.append(error)

            asker = threading.Thread(target=ask_slowly)
            asker.start()
            asker.join(PATIENCE_S)
            assert errors[0].code.name == "UNAVAILABLE"
        output, said = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert "ready for requests" in output + said
        assert "Traceback" not in said
    finally:
        process.kill()
        process.wait()


def test_each_serve_answers_for_its_own_sensor(link: LinkConfig) -> None:
    common = ("serve", "--connect", link.connect[0], "--workers", 1)
    processes = [
        spawn(*common, "--sensor", sensor, "--shear-modulus-kpa", modulus)
        for sensor, modulus in (("soft", 100), ("hard", 1000))
    ]
    try:
        with Client(link.connect[0], timeout_s=5) as robot:
            deadline = time.monotonic() + PATIENCE_S
            while sum(process.ready for process in robot.alive()) < 2:
                assert time.monotonic() < deadline
                time.sleep(0.02)
            assert len({process.instance for process in robot.alive()}) == 2
            soft, hard = (
                robot.simulate(fakes.request(sensor), sensor=sensor).steps[-1].force[2]
                for sensor in ("soft", "hard")
            )
            assert hard == pytest.approx(10.0 * soft)
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_serve_starts_with_its_defaults_on_a_host_of_any_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 400)
    served: list[FemConfig] = []
    monkeypatch.setattr(node, "run", lambda config, *_, **__: served.append(config))
    assert fem("serve").exit_code == 0
    assert fem("serve", "--workers", 1).exit_code == 0
    assert [(one.workers, one.threads_each()) for one in served] == [(64, 6), (1, 400)]
    with pytest.raises(ConfigError, match="workers"):
        fem("serve", "--workers", 65)


def test_serve_without_a_router(free_port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpate_fem.cli.run._ROUTER_WAIT_S", 0.2)
    with pytest.raises(LinkError, match="no router"):
        fem("serve", "--connect", f"tcp/127.0.0.1:{free_port}")
