"""A contact location freed of the registration errors that its network has learned."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import BundleError, DatasetError
from palpate.files.bundle import read_bundle
from palpate_training.cli import train_app
from palpate_training.datasets.features import FeatureDataset, write_dataset
from palpate_training.learning.export import run_onnx
from palpate_training.learning.features_net import FeaturesNetConfig
from palpate_training.tasks.evaluate import evaluate
from palpate_training.tasks.features import train_features
from palpate_training.tasks.intervals import add_intervals
from palpate_training.tasks.location import correct_location

MakeData = Callable[..., FeatureDataset]

pytestmark = pytest.mark.slow

QUICK = FeaturesNetConfig(members=2, width=32, blocks=1, epochs=20, batch_rows=64)
WRONG_M = {True: (0.6e-3, 0.5e-3, -0.8e-3), False: (-0.6e-3, -0.5e-3, -0.8e-3)}
"""Registration errors of the arms that press where y >= 0, and elsewhere."""


def presses(data: FeatureDataset, first: int, last: int) -> FeatureDataset:
    """Some presses of a data set."""
    rows = (data.group >= first) & (data.group < last)
    kept: dict[str, Any] = {name: values[rows] for name, values in data.arrays().items()}
    return replace(data, **kept)


def by_robots(data: FeatureDataset) -> FeatureDataset:
    """The same presses, with locations as two robots that stand wrong report them."""
    assert data.contact_location is not None
    wrong = np.array([WRONG_M[bool(y >= 0)] for y in data.contact_location[:, 1]], np.float32)
    return replace(data, contact_location=data.contact_location + wrong)


@pytest.fixture
def exact(press_data: MakeData) -> FeatureDataset:
    return press_data(presses=220, rows=30)


@pytest.fixture
def trained(exact: FeatureDataset, tmp_path: Path) -> Path:
    write_dataset(tmp_path / "train.h5", by_robots(presses(exact, 0, 80)))
    train_features(tmp_path / "train.h5", tmp_path / "old", config=QUICK)
    return tmp_path / "old"


def test_what_robots_stood_wrong_is_taken_out_and_nothing_else(
    exact: FeatureDataset, trained: Path, tmp_path: Path
) -> None:
    unseen = presses(exact, 80, 220)
    write_dataset(tmp_path / "exact.h5", unseen)
    words = ["location", str(trained), str(tmp_path / "2"), "--exact", str(tmp_path / "exact.h5")]
    done = CliRunner().invoke(train_app, words)
    assert done.exit_code == 0, done.output
    said = re.search(r"([\d.]+) mm\s+\(median\), before\s+([\d.]+) mm", done.output)
    assert said is not None, done.output
    after_mm, before_mm = map(float, said.groups())
    assert after_mm < 0.7 * before_mm
    old, new = read_bundle(trained), read_bundle(tmp_path / "2")
    assert new.manifest.version == 2
    assert "registration errors" in new.manifest.trained_on
    stated = new.manifest.metrics["location_distance_median_m"]
    assert stated == pytest.approx(1e-3 * after_mm, abs=1e-6)
    rows = unseen.tared_counts[:200]
    names = [tensor.name for tensor in old.manifest.outputs]
    (was, _), (now, _) = (run_onnx(one.model, "electrodes", rows) for one in (old, new))
    changed = {
        name
        for name, before, after in zip(names, was, now, strict=True)
        if not np.array_equal(before, after)
    }
    assert changed == {"contact_location", "contact_location_sd"}
    # What it learned from now is known to it, though its representatives are of the training.
    assert evaluate(tmp_path / "2", [tmp_path / "exact.h5"]).trained_on
    with pytest.raises(DatasetError, match=r"was trained on presses of .*exact\.h5"):
        add_intervals(tmp_path / "2", [tmp_path / "exact.h5"], tmp_path / "3")
    with pytest.raises(DatasetError, match=r"was trained on presses of .*exact\.h5"):
        correct_location(tmp_path / "2", [tmp_path / "exact.h5"], tmp_path / "3")
    assert not evaluate(trained, [tmp_path / "exact.h5"]).trained_on
    # Bounds of the location were those of other errors.
    assert new.manifest.intervals is not None
    assert [one.name for one in new.manifest.intervals.formulas] == ["force_magnitude", "force"]


def test_too_few_presses_on_a_side_are_refused(
    exact: FeatureDataset, trained: Path, tmp_path: Path
) -> None:
    write_dataset(tmp_path / "few.h5", presses(exact, 80, 110))
    with pytest.raises(DatasetError, match=r"presses of a sensor on one side .* 20 are needed"):
        correct_location(trained, [tmp_path / "few.h5"], tmp_path / "2")
    assert not (tmp_path / "2").exists()


def test_presses_of_the_training_are_refused(trained: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="was trained on presses of"):
        correct_location(trained, [tmp_path / "train.h5"], tmp_path / "2")


def test_a_bundle_without_location_is_refused(exact: FeatureDataset, tmp_path: Path) -> None:
    forces = replace(
        presses(exact, 0, 30), contact_location=None, centre_of_pressure=None, contact_normal=None
    )
    write_dataset(tmp_path / "forces.h5", forces)
    train_features(tmp_path / "forces.h5", tmp_path / "old", config=replace(QUICK, epochs=1))
    with pytest.raises(BundleError, match="gives no contact location"):
        correct_location(tmp_path / "old", [tmp_path / "forces.h5"], tmp_path / "2")
