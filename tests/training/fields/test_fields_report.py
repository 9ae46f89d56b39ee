"""One command, one table: every unit, every rival, and the paper beside the twin."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.files.bundle import read_bundle
from palpate_training.cli import train_app
from palpate_training.cli.train import EPOCHS
from palpate_training.datasets.experiment import MixedDataset, write_experiment, write_mixed
from palpate_training.learning.baselines import constant, ridge, zero
from palpate_training.learning.fit import FeaturesFitConfig
from palpate_training.tasks.features import evaluate_features, features_networks
from palpate_training.tasks.fields import FieldFitConfig, evaluate_field
from palpate_training.tasks.report import (
    by_force,
    headline_table,
    table,
    ventral_faces,
    write_report,
)
from palpate_training.tasks.results import (
    ALL,
    MEAN,
    OWN,
    RIDGE,
    ZERO,
    ModelResult,
    TaskReport,
    typical,
)
from palpate_training.tasks.synthesis import evaluate_synthesis

SHORT = FeaturesFitConfig(widths=(32,), epochs=15, batch_rows=64)


def by_model(report: TaskReport, test: str) -> dict[str, ModelResult]:
    return {result.model: result for result in report.results if result.test == test}


@pytest.fixture(scope="module")
def reports(mixed: MixedDataset, quick: FieldFitConfig) -> list[TaskReport]:
    trained: list[int] = []

    def tick() -> None:
        trained.append(1)

    made = [
        evaluate_field(mixed, seeds=2, config=quick, draws=60, on_network=tick),
        evaluate_synthesis(mixed, seeds=2, config=quick, draws=60, on_network=tick),
        *evaluate_features(mixed.experiment, seeds=2, config=SHORT, draws=60, on_network=tick),
    ]
    assert len(trained) == 2 * 3 + 2 * 2 + features_networks(mixed.experiment, 2)
    return made


def test_every_unit_has_its_rivals_and_two_networks(reports: list[TaskReport]) -> None:
    field, synthesis, force, location = reports
    assert [report.task for report in reports] == ["field", "synthesis", "force", "location"]
    for unit in ("biotac-1", "biotac-2"):
        assert list(by_model(field, unit)) == [ZERO, MEAN, RIDGE, OWN, ALL]
        assert list(by_model(synthesis, unit)) == [ZERO, MEAN, RIDGE, OWN]
        assert list(by_model(force, unit)) == [ZERO, MEAN, RIDGE, OWN, ALL]
        assert list(by_model(location, unit)) == [MEAN, RIDGE, OWN, ALL]
    assert list(by_model(field, "all units")) == [ZERO, MEAN, RIDGE, OWN]
    assert not by_model(synthesis, "all units")


def test_numbers_hang_together(reports: list[TaskReport], mixed: MixedDataset) -> None:
    field = by_model(reports[0], "biotac-1")
    assert field[ZERO].metrics["skill_subset"] == 0
    key = "nodal_subset_m"
    for model, result in field.items():
        low, high = result.interval[key]
        assert low <= result.metrics[key] <= high, model
        share = result.metrics[key] / field[ZERO].metrics[key]
        assert result.metrics["skill_subset"] == pytest.approx(1 - share, rel=1e-6)
    assert field[OWN].metrics[key] < field[MEAN].metrics[key]
    assert set(field[OWN].seed_sd) == set(field[OWN].metrics)
    assert not field[RIDGE].seed_sd
    electrodes = by_model(reports[1], "biotac-2")[OWN].metrics
    assert electrodes["electrode_rmse"] == pytest.approx(electrodes["electrode_rmse_counts"] / 4095)
    each = np.array([electrodes[f"rmse_e{i + 1:02d}_counts"] for i in range(19)])
    assert (each > 0).all()
    force = by_model(reports[2], "biotac-1")
    assert (
        force[OWN].metrics["force_magnitude_median_n"]
        < force[ZERO].metrics["force_magnitude_median_n"]
    )


def test_zero_is_the_motion_itself(reports: list[TaskReport], mixed: MixedDataset) -> None:
    from palpate_training.learning.splits import by_trajectory, of_units

    rows = of_units(mixed.experiment, by_trajectory(mixed.experiment), ["biotac-2"]).test
    truth = np.linalg.norm(mixed.displacement(rows), axis=2)
    zero_row = by_model(reports[0], "biotac-2")[ZERO].metrics
    assert zero_row["nodal_all_m"] == pytest.approx(truth.mean(), rel=1e-5)
    assert zero_row["nodal_subset_m"] == pytest.approx(truth[:, mixed.mesh.subset].mean(), rel=1e-5)


def test_files_and_the_papers_rows(
    reports: list[TaskReport], mixed: MixedDataset, tmp_path: Path
) -> None:
    paths = write_report(tmp_path / "out", reports, mixed.mesh, command="palpate test", seeds=2)
    assert sorted(path.name for path in paths) == sorted(
        p.name for p in (tmp_path / "out").iterdir()
    )
    assert {path.suffix for path in paths} == {".md", ".json", ".png"}
    text = (tmp_path / "out" / "twin.md").read_text()
    for task in ("field", "synthesis"):
        assert f"(twin-{task}.png)" in text
    facts = json.loads((tmp_path / "out" / "twin-field.json").read_text())
    assert facts["command"] == "palpate test"
    assert facts["trajectories"] == 30
    assert len(facts["results"]) == len(reports[0].results)
    lines = table(reports[0]).splitlines()
    assert [line for line in lines if line.startswith("| biotac-2 | paper (real) |")] == [
        "| biotac-2 | paper (real) | best published | 0.200 | - | - | - | - | - |"
    ]
    electrodes = table(reports[1])
    assert "| biotac-1 | paper (real) | best published | 0.0190 | 80 | 225 | - |" in electrodes
    short = headline_table(reports)
    assert "| biotac-1 | paper (real) | best published | 0.210 | 80 | 1.50 | 0.96 |" in short
    assert "| all units | paper (real) | best published | 0.220 | - | 2.00 | 0.64 |" in short
    value = by_model(reports[0], "biotac-1")[ZERO].metrics["nodal_subset_m"]
    (row,) = [line for line in short.splitlines() if line.startswith("| biotac-1 | twin | zero |")]
    assert f" {1e3 * value:.3f} (" in row


def test_one_command_writes_the_table(
    make_mixed: Callable[..., MixedDataset], tmp_path: Path
) -> None:
    mixed = make_mixed(trajectories=10, steps=4)  # the numbers are tested above, here the command
    write_mixed(tmp_path / "mixed.h5", mixed)
    write_experiment(tmp_path / "experiment.h5", mixed.experiment)
    few = ["--epochs", "2"]
    words = ["twin", str(tmp_path / "mixed.h5"), str(tmp_path / "experiment.h5")]
    result = CliRunner().invoke(train_app, [*words, str(tmp_path / "out"), "--seeds", "1", *few])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "twin.md").is_file()
    assert json.loads((tmp_path / "out" / "twin-field.json").read_text())["config"]["epochs"] == 2
    for command, option in (("field", "--units"), ("synthesis", "--unit")):
        words = [command, str(tmp_path / "mixed.h5"), str(tmp_path / command), option, "biotac-2"]
        result = CliRunner().invoke(train_app, [*words, *few])
        assert result.exit_code == 0, result.output
        bundle = read_bundle(tmp_path / command)
        assert bundle.manifest.task == command
        assert ": biotac-2;" in bundle.manifest.trained_on


def test_the_commands_train_as_long_as_the_library() -> None:
    assert FieldFitConfig().epochs == EPOCHS


def test_typical_row_is_the_median_of_the_harder_half() -> None:
    force = np.array([[1, 0, 0], [9, 0, 0], [2, 0, 0], [8, 0, 0], [7, 0, 0]], np.float32)
    assert typical(np.array([0.0, 5.0, 9.0, 3.0, 4.0]), force) == 4


def test_rows_fall_into_their_force_bin() -> None:
    bins = by_force(np.array([0.5, 2.0, 7.9, 8.0, 30.0]), np.arange(5.0))
    assert [part.tolist() for part in bins] == [[0], [1, 2], [3, 4]]


def test_ventral_faces_look_down(mixed: MixedDataset) -> None:
    faces = ventral_faces(mixed.mesh)
    assert 0 < len(faces) < len(mixed.mesh.outer_faces)
    assert mixed.mesh.nodes[faces].mean(axis=1)[:, 2].max() < 0.5e-3


def test_ridge_finds_a_line_and_chooses_its_penalty_on_validation_rows() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(5, [1, 100], (200, 2))
    weight = np.array([[1.0, 2.0], [0.03, -0.01]])
    y = x @ weight + [3.0, -1.0]
    line = ridge(x[:100], y[:100], x[100:], y[100:])
    np.testing.assert_allclose(line.predict(x), y, atol=1e-2)
    few = rng.normal(0, 1, (12, 10))
    noise = rng.normal(0, 1, (12, 1))
    calm = ridge(few, noise, rng.normal(0, 1, (200, 10)), np.zeros((200, 1)))
    exact = ridge(few, noise, few, noise)
    assert np.linalg.norm(calm.weight) < np.linalg.norm(exact.weight)


def test_zero_and_mean_ignore_their_inputs() -> None:
    x, y = np.ones((4, 3)), np.arange(8.0).reshape(4, 2)
    np.testing.assert_array_equal(zero(x, y).predict(x), np.zeros((4, 2)))
    np.testing.assert_array_equal(constant(x, y).predict(9 * x), np.tile([3.0, 4.0], (4, 1)))
