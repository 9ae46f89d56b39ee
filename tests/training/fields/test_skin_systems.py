"""Every system of the skin learns from invented presses; the study shows its errors as they are."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from palpate_training.datasets.experiment import MixedDataset
from palpate_training.evaluation.experiments import ExperimentSource
from palpate_training.evaluation.study import Study, StudyPlan
from palpate_training.learning.splits import RowSplit, by_trajectory, of_units
from palpate_training.systems import fields, latent, ruppel, synthesis
from palpate_training.tasks.fields import FieldFitConfig, tared_counts

LEARNT = 0.75
"""Error beside that of the training mean, at most."""

NODES_ONLY = ("PointNet++ (the paper's)", "PointNet++, radii 6 and 10 mm")


@pytest.fixture(scope="module")
def held(mixed: MixedDataset) -> RowSplit:
    return of_units(mixed.experiment, by_trajectory(mixed.experiment), ["biotac-1"])


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch, quick: FieldFitConfig) -> None:
    """Trainings of seconds: what is tested is that a system learns, not how well it can."""
    set_points(monkeypatch, fields, epochs=15)
    set_points(monkeypatch, synthesis, epochs=12, learning_rate=1e-3)
    monkeypatch.setattr(latent, "LATENT_CONFIG", replace(latent.LATENT_CONFIG, epochs=120))
    monkeypatch.setattr(
        synthesis, "RUPPEL_CONFIG", replace(ruppel.CONFIG, epochs=15, patience=15, batch_rows=64)
    )
    for module in (fields, synthesis):
        monkeypatch.setattr(module, "FieldFitConfig", partial(replace, quick))


def set_points(
    monkeypatch: pytest.MonkeyPatch,
    module: ModuleType,
    *,
    epochs: int,
    learning_rate: float = 2e-3,
) -> None:
    """An epoch costs the same however many steps it has, so few epochs have many of them."""
    config = replace(
        synthesis.POINTS_CONFIG,
        epochs=epochs,
        patience=epochs,
        batch_rows=8,
        learning_rate=learning_rate,
    )
    monkeypatch.setattr(module, "POINTS_CONFIG", config)


def field_errors_of(name: str, data: MixedDataset, rows: RowSplit, seed: int = 0) -> fields.Errors:
    system = next(one for one in fields.FIELD_SYSTEMS if one.name == name)
    return system.fit(data, rows, seed).errors(rows.test)


def counts_of(name: str, data: MixedDataset, rows: RowSplit, seed: int = 0) -> Any:
    system = next(one for one in synthesis.SYNTHESIS_SYSTEMS if one.name == name)
    return system.fit(data, rows, seed)(rows.test)


@pytest.mark.parametrize("name", [one.name for one in fields.FIELD_SYSTEMS[2:]])
def test_a_field_system_learns(name: str, mixed: MixedDataset, held: RowSplit) -> None:
    errors = field_errors_of(name, mixed, held)
    mean = field_errors_of("training mean", mixed, held)
    assert errors["subset_m"].mean() < LEARNT * mean["subset_m"].mean()
    for values in errors.values():
        assert values.shape == held.test.shape
        assert np.isfinite(values).all()
    assert set(errors) == ({"subset_m"} if name in NODES_ONLY else set(mean))


@pytest.mark.parametrize("name", [one.name for one in synthesis.SYNTHESIS_SYSTEMS[2:]])
def test_a_synthesis_system_learns(name: str, mixed: MixedDataset, held: RowSplit) -> None:
    truth = tared_counts(mixed)[held.test]
    left = counts_of(name, mixed, held) - truth
    mean = counts_of("training mean", mixed, held) - truth
    assert left.shape == truth.shape
    assert np.square(left).mean() < LEARNT * np.square(mean).mean()


@pytest.mark.parametrize("name", ["PointNet++ (the paper's)", "network to modes"])
def test_the_seed_decides_a_field_system(
    name: str, mixed: MixedDataset, held: RowSplit, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_points(monkeypatch, fields, epochs=2)
    first, again, other = (field_errors_of(name, mixed, held, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first["subset_m"], again["subset_m"])
    assert not np.array_equal(first["subset_m"], other["subset_m"])


def test_baselines_are_what_they_are_called(mixed: MixedDataset, held: RowSplit) -> None:
    moved = np.linalg.norm(mixed.displacement(held.test), axis=2).mean(axis=1)
    zero = field_errors_of("zero", mixed, held)
    np.testing.assert_allclose(zero["all_m"], moved, rtol=1e-5)
    counts = tared_counts(mixed)
    assert not counts_of("zero", mixed, held).any()
    np.testing.assert_allclose(
        counts_of("training mean", mixed, held)[0], counts[held.train].mean(axis=0), rtol=1e-4
    )


def test_the_study_shows_the_errors_of_fields_and_counts(
    mixed: MixedDataset, tmp_path: Path
) -> None:
    plan = StudyPlan(tasks=("field", "synthesis"), splits=("trajectory", "unit"), systems=("zero",))
    study = Study(ExperimentSource(mixed.experiment, mixed), plan)
    study.make(tmp_path, workers=0)
    values = study.results(tmp_path)
    pictures = [one["file"] for one in study.draw(tmp_path, tmp_path)]
    assert pictures == ["forces.png", "synthesis-map.png"]
    rows_of = {
        (cell.task, cell.fold.split, cell.fold.test): cell.fold.rows.test for cell in study.cells
    }
    assert {key[:2] for key in rows_of} == {
        ("field", "trajectory"), ("field", "unit"), ("synthesis", "trajectory")
    }  # fmt: skip
    counts = tared_counts(mixed)
    for score in values["scores"]:
        rows = rows_of[score["task"], score["split"], score["test"]]
        metrics = score["metrics"]
        if score["task"] == "field":
            moved = np.linalg.norm(mixed.displacement(rows), axis=2)
            assert metrics["all_m_mean"] == pytest.approx(moved.mean(), rel=1e-5)
            low, high = score["intervals"]["all_m_mean"]
            assert low <= metrics["all_m_mean"] <= high
        else:
            assert metrics["rmse_counts"] == pytest.approx(np.sqrt(np.square(counts[rows]).mean()))
            assert metrics["rmse_e07_counts"] == pytest.approx(
                np.sqrt(np.square(counts[rows, 6]).mean())
            )
