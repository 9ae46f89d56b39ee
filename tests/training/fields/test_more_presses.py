"""Bundles from more presses than fit into memory, by the commands of docs/results/shipped.md."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from palpate.files.bundle import read_bundle
from palpate_training.cli import data_app, train_app
from palpate_training.datasets.experiment import MixedDataset, read_mixed, write_mixed
from palpate_training.tasks.evaluate import evaluate

onnx = pytest.importorskip("onnx")


def run(app: typer.Typer, *words: str | Path) -> str:
    """What a command says."""
    done = CliRunner().invoke(app, list(map(str, words)), env={"COLUMNS": "200"})
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    return done.output


def test_two_experiments_make_bundles_that_are_tested_on_a_third(
    make_mixed: Callable[..., MixedDataset], tmp_path: Path
) -> None:
    first, more, held = (tmp_path / f"{name}.h5" for name in ("first", "more", "held"))
    for seed, path in enumerate((first, more, held)):
        write_mixed(path, make_mixed(seed=seed))
    quick = ["--epochs", "1", "--batch-rows", "64"]
    serial = ["--serial", "VIRTUAL-*"]

    rows = tmp_path / "features.h5"
    run(data_app, "features", first, more, rows)
    features = tmp_path / "features"
    out = ["--data", str(rows), "--out", str(features), "--name", "features-twin"]
    narrow = ["--width", "32", "--blocks", "1"]
    run(train_app, "features", *out, *serial, *quick, "--gain-spread", "0", *narrow)
    layers = {tuple(one.dims) for one in onnx.load(features / "model.onnx").graph.initializer}
    assert (32, 32) in layers
    assert (256, 256) not in layers
    bounded = tmp_path / "features-twin" / "9"
    run(train_app, "intervals", features, bounded, "--held-out", held)
    assert read_bundle(bounded).manifest.version == 9
    assert read_bundle(bounded).manifest.sensor_serials == ("VIRTUAL-*",)
    run(train_app, "evaluate", bounded, held)

    small, both = tmp_path / "small.h5", tmp_path / "both.h5"
    size = ["--modes", "20", "--force-modes", "5"]
    run(data_app, "shrink", more, small, "--trials", "40", "--rows", "6", *size)
    run(data_app, "join", first, small, both, *size)
    assert read_mixed(both).experiment.trials == 60 + 40
    named = ["--name", "field-twin", *serial]
    run(train_app, "field", both, tmp_path / "field", *named, *quick)
    found = evaluate(tmp_path / "field", [held])
    assert found.presses == 30
    named = ["--name", "synthesis-twin", "--unit", "biotac-2"]
    said = run(train_app, "synthesis", both, tmp_path / "synthesis", *named, *quick)
    assert "synthesis-twin 1, biotac-2" in said
    run(train_app, "evaluate", tmp_path / "synthesis", held, "--unit", "biotac-2")

    study = ["--data", str(both), "--out", str(tmp_path / "study"), "--workers", "1"]
    study += ["--splits", "trajectory", "--whole", "--device", "cpu", "--systems", "training mean"]
    run(train_app, "report", *study, "--test-part", "first")
    values = json.loads((tmp_path / "study" / "study.json").read_text(encoding="utf-8"))
    assert {row["task"] for row in values["scores"]} >= {"force", "field", "synthesis"}
    assert values["rows"]["rows of first, of which alone some are tested"] > 0
