"""The whole study on tiny data: every cell filled, goes on where it was, one JSON, two pages."""

from __future__ import annotations

import base64
import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError
from palpate_training.cli import train_app
from palpate_training.cli.report import read_source, train_report
from palpate_training.datasets.assembly import assemble_experiment
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    write_experiment,
    write_mixed,
)
from palpate_training.datasets.export import export_published
from palpate_training.datasets.join import join_experiments
from palpate_training.datasets.trials import TrialRows
from palpate_training.evaluation.experiments import ExperimentSource
from palpate_training.evaluation.features import FeatureTask, paper_weights, weighted_median
from palpate_training.evaluation.page import PAPER_LABEL, tables_of, write_pages
from palpate_training.evaluation.study import Study, StudyPlan, write_study
from palpate_training.figures.statistics import angled_share
from palpate_training.learning.splits import RowSplit
from palpate_training.systems import ours

SIMPLE = ("zero", "training mean", "ridge")


@pytest.fixture
def data(make_rows: Callable[..., TrialRows], provenance: Provenance) -> ExperimentDataset:
    """Two units, two indenters, ten points each."""
    trials = [
        make_rows(unit, f"{indenter}/{point}/{press}")
        for unit in ("biotac-1", "biotac-2")
        for indenter in ("cube", "ring")
        for point in range(10)
        for press in ("normal", "angled-1")
    ]
    return assemble_experiment(trials, provenance)


def made(data: ExperimentDataset, folder: Path, **plan: Any) -> dict[str, Any]:
    study = Study(ExperimentSource(data, None), StudyPlan(systems=SIMPLE, **plan))
    study.make(folder, workers=0)
    return study.results(folder)


def test_what_published_names_do_not_tell_is_left_out(
    data: ExperimentDataset, tmp_path: Path
) -> None:
    """Neither points nor kinds of presses; nor are presses at random angled ones."""
    named = {
        "published": tuple(f"{data.indenters[k]}/{k}" for k in range(len(data.trajectories))),
        "random": tuple(f"cube/{k:05d}/random" for k in range(len(data.trajectories))),
    }
    for name, trajectories in named.items():
        other = replace(data, trajectories=trajectories)
        assert np.isnan(angled_share(trajectories))
        values = made(other, tmp_path / name, tasks=("location",))
        splits = {row["split"] for row in values["scores"]}
        assert ("point" in splits) == (name == "random")
        for row in values["scores"]:
            for kind in ("normal", "angled"):
                assert np.isnan(row["metrics"][f"distance_m_median_{kind}_presses"])


def test_every_cell_of_every_split_is_filled(data: ExperimentDataset, tmp_path: Path) -> None:
    values = made(data, tmp_path / "cells")
    found = {(row["task"], row["split"], row["test"], row["system"]) for row in values["scores"]}
    assert len(found) == len(values["scores"])
    splits = {(task, split) for task, split, _, _ in found}
    assert splits == {
        (task, split)
        for task in ("location", "force")
        for split in ("trajectory", "execution", "point", "indenter", "unit", "neighbour")
    }
    assert ("force", "unit", "biotac-1 to biotac-2", "zero") in found
    held = next(row for row in values["scores"] if row["split"] == "indenter")
    assert set(held["parts"]) == {"cube", "ring"}


def test_scores_are_those_of_the_estimates(data: ExperimentDataset, tmp_path: Path) -> None:
    values = made(data, tmp_path, tasks=("force",), splits=("trajectory",))
    plan = StudyPlan(tasks=("force",), splits=("trajectory",), systems=("zero",))
    study = Study(ExperimentSource(data, None), plan)
    rows = next(cell.fold.rows.test for cell in study.cells if cell.fold.test == "all units")
    zero = next(
        row for row in values["scores"] if row["test"] == "all units" and row["system"] == "zero"
    )
    force = np.linalg.norm(data.force[rows], axis=1)
    assert zero["metrics"]["magnitude_n_median"] == pytest.approx(np.median(force), rel=1e-6)
    assert zero["metrics"]["magnitude_over_norm_median_below_2n"] == pytest.approx(1.0)
    low, high = zero["intervals"]["magnitude_n_median"]
    assert low <= np.percentile(force, 50, method="lower") <= high
    every = np.linalg.norm(data.force.astype(np.float64), axis=1)
    assert values["forces"]["median_n"] == pytest.approx(np.median(every))
    assert values["forces"]["below_2n"] == pytest.approx((every < 2).sum() / len(every))


def test_pages_show_the_json_beside_the_paper(data: ExperimentDataset, tmp_path: Path) -> None:
    values = made(data, tmp_path / "cells", splits=("trajectory",))
    write_study(tmp_path / "study.json", values)
    read = json.loads((tmp_path / "study.json").read_text())
    paths = write_pages(tmp_path, read, command="palpate train report")
    markdown, page = (path.read_text() for path in paths)
    assert "made by a test" in markdown
    ridge = next(
        row
        for row in read["scores"]
        if row["task"] == "location" and row["system"] == "ridge" and row["test"] == "biotac-1"
    )
    shown = f"{1e3 * ridge['metrics']['distance_m_median']:.2f}"
    for text in (markdown, page):
        assert shown in text
    assert markdown.count(PAPER_LABEL) == 3
    assert page.count("<table>") == sum(bool(table.rows) for table in tables_of(read))


def test_the_floor_stands_beside_each_number(data: ExperimentDataset, tmp_path: Path) -> None:
    values = made(data, tmp_path, tasks=("force",), splits=("trajectory", "neighbour"))
    tables = [table for table in tables_of(values) if table.columns[:1] == ("system",)]
    beside, floor = (
        next(
            table
            for table in tables
            if table.text.startswith("Median error") and of in table.heading
        )
        for of in ("Unseen trajectory", "Not a result")
    )
    assert beside.columns[-1] == "*not a result*, neighbouring rows in training: all units"
    left = {row[0]: row[-1] for row in floor.rows}
    shown = {row[0]: row[-1] for row in beside.rows if row[0] != PAPER_LABEL}
    assert shown == left
    assert all(len(row) == len(beside.columns) for row in beside.rows)


def test_seeds_are_spent_where_all_units_are_trained_together(data: ExperimentDataset) -> None:
    plan = StudyPlan(
        tasks=("force",), splits=("trajectory", "unit"), systems=("MLP (the",), seeds=(0, 1, 2)
    )
    cells = Study(ExperimentSource(data, None), plan).cells
    seeds: dict[tuple[str, str], list[int]] = {}
    for cell in cells:
        seeds.setdefault((cell.fold.split, cell.fold.test), []).append(cell.seed)
    assert seeds.pop(("trajectory", "all units")) == [0, 1, 2]
    assert set(map(tuple, seeds.values())) == {(0,)}
    assert len(seeds) == 4


def test_what_is_not_known_is_a_dash(data: ExperimentDataset, tmp_path: Path) -> None:
    values = made(data, tmp_path, tasks=("force",), splits=("trajectory",))
    for row in values["scores"]:
        row["metrics"]["magnitude_n_mean"] = float("nan")
    write_study(tmp_path / "study.json", values)
    read = json.loads((tmp_path / "study.json").read_text())
    table = next(table for table in tables_of(read) if "mean [N]" in table.columns)
    assert {row[table.columns.index("mean [N]")] for row in table.rows} == {"-"}


def test_a_study_that_holds_nothing_says_what_there_is(data: ExperimentDataset) -> None:
    with pytest.raises(ConfigError, match="no system of these tasks"):
        Study(ExperimentSource(data, None), StudyPlan(systems=("nobody",)))
    with pytest.raises(ConfigError, match="no task 'forces'"):
        Study(ExperimentSource(data, None), StudyPlan(tasks=("forces",)))
    with pytest.raises(ConfigError, match="nothing is to be made"):
        Study(ExperimentSource(data, None), StudyPlan(tasks=("field",)))


@pytest.mark.parametrize("device", ["gpu", "cuda"])
def test_a_device_that_is_not_there_is_told_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    words = ["report", "--data", str(tmp_path), "--out", str(tmp_path / "out"), "--device", device]
    result = CliRunner().invoke(train_app, words)
    assert isinstance(result.exception, ConfigError)
    assert "no device 'gpu'" in str(result.exception) or "no GPU" in str(result.exception)


def test_the_command_reads_a_folder_and_goes_on(data: ExperimentDataset, tmp_path: Path) -> None:
    write_experiment(tmp_path / "experiment.h5", data)
    options: dict[str, Any] = {
        "data": tmp_path, "out": tmp_path / "out", "tasks": "force", "splits": "trajectory",
        "systems": "zero, ridge", "seeds": 1, "whole": True, "workers": 2, "device": "auto",
        "cells": None, "so_far": False,
    }  # fmt: skip
    with pytest.raises(ConfigError, match="holds no finished training"):
        train_report(**{**options, "so_far": True})
    train_report(**options)
    kept = sorted((tmp_path / "out" / "cells" / "force").glob("*.npz"))
    times = [path.stat().st_mtime_ns for path in kept]
    assert len(kept) == 2
    page = (tmp_path / "out" / "report.html").read_text()
    for name in ("forces", "force-errors", "force-press"):
        picture = (tmp_path / "out" / f"{name}.png").read_bytes()
        assert base64.b64encode(picture).decode() in page
        assert f"({name}.png)" in (tmp_path / "out" / "report.md").read_text()
    train_report(**options)
    assert [path.stat().st_mtime_ns for path in kept] == times
    with pytest.raises(ConfigError, match="no split sideways"):
        train_report(**{**options, "splits": "sideways"})
    with pytest.raises(DatasetError, match="neither experiment"):
        read_source(tmp_path / "out")
    words = ["report", "--data", str(tmp_path), "--out", str(tmp_path / "out"), "--so-far"]
    words += ["--tasks", "force", "--splits", "trajectory", "--systems", "zero, ridge", "--whole"]
    done = CliRunner().invoke(train_app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert [path.stat().st_mtime_ns for path in kept] == times


def test_other_parts_of_a_joined_data_set_are_learned_from_alone(
    data: ExperimentDataset,
    mixed: MixedDataset,
    make_rows: Callable[..., TrialRows],
    provenance: Provenance,
    tmp_path: Path,
) -> None:
    """The command on a file: the same rows are tested as without the other part."""
    more = [make_rows(unit, f"ring/{n}") for unit in data.unit_names for n in range(4)]
    joined = join_experiments(
        [data, assemble_experiment(more, provenance)], ["twin", "more"], provenance
    )
    write_experiment(tmp_path / "experiment.h5", joined)
    options: dict[str, Any] = {
        "data": tmp_path, "out": tmp_path / "out", "tasks": "force", "systems": "training mean",
        "seeds": 1, "whole": True, "workers": 1, "device": "cpu", "cells": None, "so_far": False,
        "test_part": "twin",
    }  # fmt: skip
    train_report(**options)
    values = json.loads((tmp_path / "out" / "study.json").read_text())
    assert {row["split"] for row in values["scores"]} == {"trajectory", "execution", "unit"}
    said = {name: count for name, count in values["rows"].items() if "tested" in name}
    assert said == {"rows of twin, of which alone some are tested": len(data)}
    alone = Study(ExperimentSource(data, None), StudyPlan(tasks=("force",)))
    part = Study(ExperimentSource(joined, None, "twin"), StudyPlan(tasks=("force",)))
    tested = [
        {(cell.fold.test, *cell.fold.rows.test) for cell in one.cells
         if cell.fold.split == "trajectory"}
        for one in (alone, part)
    ]  # fmt: skip
    assert tested[0] == tested[1]
    with pytest.raises(ConfigError, match="no split point"):
        train_report(**options, splits="point, trajectory")
    with pytest.raises(ConfigError, match="third is no part"):
        train_report(**{**options, "test_part": "third"})
    write_mixed(tmp_path / "mixed-alone.h5", mixed)
    with pytest.raises(ConfigError, match="twin is no part"):
        train_report(**{**options, "data": tmp_path / "mixed-alone.h5"})


def test_the_published_layout_goes_through_the_same_command(
    make_rows: Callable[..., TrialRows],
    provenance: Provenance,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without untouched counts, which those files do not hold: ours has to assume them."""
    monkeypatch.setattr(ours, "OURS_CONFIG", replace(ours.OURS_CONFIG, epochs=2))
    make = Study.make
    # In this process: others would not see that the training is short.
    monkeypatch.setattr(Study, "make", lambda *args, **more: make(*args, **more | {"workers": 0}))
    trials = [
        make_rows(f"biotac-{unit}", f"cube/{point}/normal")
        for unit in (1, 2, 3)
        for point in range(10)
    ]
    export_published(tmp_path / "published", assemble_experiment(trials, provenance))
    train_report(
        data=tmp_path / "published", out=tmp_path / "out", tasks="location, force",
        splits="trajectory", systems="ridge, mean of three", seeds=1, whole=True, workers=0,
        device="cpu", cells=None, so_far=False,
    )  # fmt: skip
    values = json.loads((tmp_path / "out" / "study.json").read_text())
    assert values["sources"][0]["source"] == "made by a test"
    assert len(values["scores"]) == 4
    for row in values["scores"]:
        error = "distance_m_median" if row["task"] == "location" else "magnitude_n_median"
        assert np.isfinite(row["metrics"][error])


def test_what_is_made_so_far_is_shown_without_ratios_to_half_of_the_paper(
    data: ExperimentDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ours, "OURS_CONFIG", replace(ours.OURS_CONFIG, epochs=1))
    write_experiment(tmp_path / "experiment.h5", data)
    source = ExperimentSource(data, None)
    plan = StudyPlan(
        tasks=("force",), splits=("trajectory",), seeds=(0,), whole=True,
        systems=("zero", "MLP (the paper's)", "residual network", "voxel network"),
    )  # fmt: skip
    first = Study(source, replace(plan, systems=plan.systems[:3]))
    first.make(tmp_path / "cells", workers=0)
    alone = first.results(tmp_path / "cells")["ratios"]
    assert alone == [], "the best of the paper's three is not that of the one that was planned"
    train_report(
        data=tmp_path, out=tmp_path / "out", tasks="force", splits="trajectory",
        systems=", ".join(plan.systems), seeds=1, whole=True, workers=1, device="cpu",
        cells=tmp_path / "cells", so_far=True,
    )  # fmt: skip
    values = json.loads((tmp_path / "out" / "study.json").read_text())
    assert (values["missing"], values["trainings"]) == (1, len(first.cells) + 1)
    assert {row["system"] for row in values["scores"]} == {one.system for one in first.cells}
    assert values["ratios"] == []
    said = f"1 of {values['trainings']} trainings are not made yet"
    assert said in (tmp_path / "out" / "report.md").read_text()


@pytest.fixture
def guessed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No training: every system knows the truth to a tenth."""

    def guess(task: FeatureTask, _: Any, rows: RowSplit, seed: int) -> dict[str, np.ndarray]:
        truth = task.samples.take(rows.test).truth(task.name)
        noise = np.random.default_rng(seed).normal(size=truth.shape)
        return {"estimate": truth + 0.1 * np.abs(truth).max() * noise}

    monkeypatch.setattr(FeatureTask, "fit_and_test", guess)


@pytest.mark.usefixtures("guessed")
def test_the_page_of_a_test_without_hard_presses_is_written(
    data: ExperimentDataset, tmp_path: Path
) -> None:
    force = 1.9 * data.force / np.linalg.norm(data.force, axis=1).max()
    source = ExperimentSource(replace(data, force=force.astype(np.float32)), None)
    plan = StudyPlan(("force",), ("trajectory",), ("residual", "paper"), seeds=(0,), whole=True)
    study = Study(source, plan)
    study.make(tmp_path / "cells", workers=0)
    write_study(tmp_path / "study.json", study.results(tmp_path / "cells"))
    values = json.loads((tmp_path / "study.json").read_text())
    page = write_pages(tmp_path, values, command="palpate train report")[0].read_text()
    lines = [line for line in page.splitlines() if line.startswith("| force, magnitude_n |")]
    assert any(" | from 2 N | - |" in line for line in lines)
    assert all(" | from 2 N | - |" in line for line in lines if "| all | " not in line)
    assert any(" | all | 1.00 (1.00-1.00) |" in line for line in lines)


@pytest.mark.usefixtures("guessed")
def test_a_ratio_is_given_only_beside_all_of_the_paper_s_networks(
    data: ExperimentDataset, tmp_path: Path
) -> None:
    def ratios(*systems: str) -> Any:
        plan = StudyPlan(("force",), ("trajectory",), systems, seeds=(0,), whole=True)
        study = Study(ExperimentSource(data, None), plan)
        study.make(tmp_path / "cells", workers=0)
        return study.results(tmp_path / "cells")["ratios"]

    assert ratios("residual", "(the paper's)")
    assert ratios("residual", "MLP (the paper's)") == []


def test_weights_give_the_forces_the_paper_s_spread() -> None:
    force = np.random.default_rng(0).exponential(2.5, 4000) + 0.5
    weights = paper_weights(force)
    mean = weights @ force
    assert np.sqrt(weights @ (force - mean) ** 2) == pytest.approx(4.6, rel=0.05)
    assert paper_weights(np.full(10, 3.0)) == pytest.approx(0.1)


def test_a_weighted_median_is_that_of_repeated_values() -> None:
    values = np.array([3.0, 1.0, np.nan, 2.0])
    assert weighted_median(values, np.array([1.0, 1.0, 9.0, 1.0])) == 2.0
    assert weighted_median(values, np.array([5.0, 1.0, 9.0, 1.0])) == 3.0
    assert np.isnan(weighted_median(values[2:3], np.ones(1)))


def test_pictures_show_the_widest_test_of_unseen_trajectories(
    data: ExperimentDataset, tmp_path: Path
) -> None:
    plan = StudyPlan(tasks=("location", "force"), splits=("trajectory",), systems=SIMPLE)
    study = Study(ExperimentSource(data, None), plan)
    study.make(tmp_path / "cells", workers=0)
    pictures = study.draw(tmp_path / "cells", tmp_path)
    assert [one["file"] for one in pictures] == [
        "forces.png", "location-errors.png", "location-pairs.png",
        "force-errors.png", "force-press.png",
    ]  # fmt: skip
    rows = {len(cell.fold.rows.test) for cell in study.cells if cell.fold.test == "all units"}
    assert f"{rows.pop():,} rows" in pictures[1]["caption"]
    other = Study(
        ExperimentSource(data, None), StudyPlan(tasks=("force",), splits=("point",), systems=SIMPLE)
    )
    other.make(tmp_path / "cells", workers=0)
    drawn = other.draw(tmp_path / "cells", tmp_path)
    assert [one["task"] for one in drawn] == [""], "trajectories were not tested"


def test_workers_do_not_outlive_a_command_that_was_killed(
    data: ExperimentDataset, tmp_path: Path
) -> None:
    write_experiment(tmp_path / "experiment.h5", data)
    code = (
        "from pathlib import Path\n"
        "from palpate_training.cli.report import train_report\n"
        f"folder = Path({str(tmp_path)!r})\n"
        "train_report(folder, folder / 'out', systems='mean of three', workers=2)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL) as command:
        workers: list[int] = []
        deadline = time.monotonic() + 60
        while len(workers) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
            workers = _workers_of(command.pid)
        time.sleep(1.0)  # they have begun to import or to train
        command.kill()
    assert len(workers) == 2
    deadline = time.monotonic() + 30
    while any(map(_lives, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(_lives, workers))


def _workers_of(pid: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            child = int(entry.name)
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"spawn_main" in (entry / "cmdline").read_bytes():
                found.append(child)
    return found


def _lives(pid: int) -> bool:
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
