"""A bundle on other data than its own: the same figures as its report on its tested presses."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import DatasetError
from palpate.files.bundle import read_bundle
from palpate_training.cli import train_app
from palpate_training.datasets.basis import subset
from palpate_training.datasets.experiment import MixedDataset, write_mixed
from palpate_training.datasets.export import features
from palpate_training.datasets.features import open_dataset, write_dataset
from palpate_training.learning.features_net import FeaturesNetConfig
from palpate_training.learning.splits import by_group, by_trajectory, of_units
from palpate_training.tasks.evaluate import BundleErrors, Figure, evaluate
from palpate_training.tasks.features import train_features
from palpate_training.tasks.fields import FieldFitConfig, field_bundle
from palpate_training.tasks.synthesis import synthesis_bundle

pytest.importorskip("onnx")

UNIT = "biotac-2"


def figure(found: BundleErrors, name: str, where: str = "all") -> Figure:
    (one,) = (one for one in found.figures if (one.name, one.where) == (name, where))
    return one


def of_tests(mixed: MixedDataset, path: Path, unit: str | None = None) -> Path:
    """The presses that a training with seed 0 tests on."""
    split = by_trajectory(mixed.experiment, seed=0)
    if unit is not None:
        split = of_units(mixed.experiment, split, [unit])
    write_mixed(path, subset(mixed, np.unique(mixed.experiment.trial[split.test]).tolist()))
    return path


def test_a_field_bundle_is_as_good_as_it_says(
    mixed: MixedDataset, quick: FieldFitConfig, tmp_path: Path
) -> None:
    metrics = field_bundle(mixed, tmp_path / "field", config=quick)
    found = evaluate(tmp_path / "field", [of_tests(mixed, tmp_path / "test.h5")])
    one = figure(found, "displacement")
    assert one.value == pytest.approx(metrics["nodal_all_m"], rel=1e-2)
    assert one.low <= one.value <= one.high
    nodes = figure(found, "displacement_128_nodes")
    assert nodes.value == pytest.approx(metrics["nodal_subset_m"], rel=1e-2)
    assert nodes.zero == pytest.approx(metrics["zero_nodal_subset_m"], rel=1e-2)
    assert np.isnan(nodes.constant)
    assert found.sha256 == read_bundle(tmp_path / "field").sha256.hex()
    assert not found.trained_on
    other = replace(mixed, mesh=replace(mixed.mesh, sha256="cd" * 32))
    write_mixed(tmp_path / "other.h5", other)
    with pytest.raises(DatasetError, match="has the mesh cdcdcdcdcdcd"):
        evaluate(tmp_path / "field", [tmp_path / "other.h5"])
    for where in ("below_2n", "2_to_8n", "above_8n"):
        if f"nodal_all_m_{where}" in metrics:
            value = figure(found, "displacement", where).value
            assert value == pytest.approx(metrics[f"nodal_all_m_{where}"], rel=1e-2)


def test_a_synthesis_bundle_is_of_one_specimen(
    mixed: MixedDataset, quick: FieldFitConfig, tmp_path: Path
) -> None:
    metrics = synthesis_bundle(mixed, tmp_path / "synthesis", unit=UNIT, config=quick)
    path = of_tests(mixed, tmp_path / "test.h5", UNIT)
    one = figure(evaluate(tmp_path / "synthesis", [path], unit=UNIT), "electrodes")
    assert one.value == pytest.approx(metrics["electrode_rmse_counts"], rel=1e-2)
    assert one.zero > one.value
    with pytest.raises(DatasetError, match="electrodes of one specimen"):
        evaluate(tmp_path / "synthesis", [path])
    with pytest.raises(DatasetError, match="no 'biotac-9' in it"):
        evaluate(tmp_path / "synthesis", [path], unit="biotac-9")
    told = ["evaluate", str(tmp_path / "synthesis"), str(path), "--unit", UNIT]
    shown = CliRunner().invoke(train_app, told, env={"COLUMNS": "300"})
    assert f"Electrodes of {UNIT}, synthesised" in shown.output
    assert f": {UNIT}; " in shown.output  # whose they were in training


@pytest.fixture(scope="module")
def of_features(
    make_mixed: Callable[..., MixedDataset], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A folder with a data set of features, mixed.h5 that it is of, and a bundle of it."""
    folder = tmp_path_factory.mktemp("features")
    mixed = make_mixed()
    write_mixed(folder / "mixed.h5", mixed)
    write_dataset(folder / "features.h5", features(mixed))
    config = FeaturesNetConfig(epochs=3, members=1)
    train_features(folder / "features.h5", folder / "bundle", config=config)
    return folder


def test_features_of_both_kinds_of_file_and_of_one_specimen(of_features: Path) -> None:
    folder = of_features
    found = evaluate(folder / "bundle", [folder / "features.h5"])
    assert found.trained_on
    assert evaluate(folder / "bundle", [folder / "mixed.h5"]).trained_on
    mixed = evaluate(folder / "bundle", [folder / "mixed.h5"])
    assert [one.value for one in found.figures] == pytest.approx(
        [one.value for one in mixed.figures], nan_ok=True
    )
    for name in ("mixed.h5", "features.h5"):
        with pytest.raises(DatasetError, match="hold the same presses"):
            evaluate(folder / "bundle", [folder / "mixed.h5", folder / name])
    paired = open_dataset(folder / "features.h5")
    paired.force[:] = np.roll(paired.force, 1, axis=0)
    write_dataset(folder / "paired.h5", paired)
    with pytest.raises(DatasetError, match="hold the same presses"):
        evaluate(folder / "bundle", [folder / "mixed.h5", folder / "paired.h5"])
    own = evaluate(folder / "bundle", [folder / "mixed.h5"], unit=UNIT)
    assert 0 < own.rows < mixed.rows
    by_bin = [one.rows for one in found.figures if one.name == "force_magnitude"]
    assert by_bin[0] == found.rows
    with pytest.raises(DatasetError, match="no 'biotac-9' in it"):
        evaluate(folder / "bundle", [folder / "features.h5"], unit="biotac-9")


def test_the_constant_is_the_mean_of_the_rows_of_its_bin_in_all_data_sets(
    of_features: Path, tmp_path: Path
) -> None:
    data = open_dataset(of_features / "features.h5")
    paths = []
    for side in (0, 1):
        rows = np.flatnonzero(data.group % 2 == side)
        columns: dict[str, Any] = {name: values[rows] for name, values in data.arrays().items()}
        if side:  # so that the means of the two data sets differ
            columns["force"] = 3.0 * columns["force"]
        paths.append(tmp_path / f"{side}.h5")
        write_dataset(paths[-1], replace(data, **columns))
    found = evaluate(of_features / "bundle", paths)
    forces = [one.force[one.in_contact] for one in map(open_dataset, paths)]
    force = np.concatenate(forces).astype(np.float64)
    norm = np.linalg.norm(force, axis=1)
    for where, low, high in (("below_2n", 0.0, 2.0), ("2_to_8n", 2.0, 8.0)):
        some = (norm >= low) & (norm < high)
        mean = np.linalg.norm(force[some].mean(axis=0))
        one = figure(found, "force_magnitude", where)
        assert one.rows == some.sum() > 0
        assert one.constant == pytest.approx(np.median(np.abs(norm[some] - mean)), rel=1e-4)
        assert one.zero == pytest.approx(np.median(norm[some]), rel=1e-4)
    assert np.isnan(figure(found, "force_angle").zero)


def test_a_part_of_the_training_is_known(of_features: Path, tmp_path: Path) -> None:
    data = open_dataset(of_features / "features.h5")
    split = by_group(data.group)
    for side, rows in (("train", split.train[: len(split.train) // 2]), ("test", split.test)):
        columns: dict[str, Any] = {name: values[rows] for name, values in data.arrays().items()}
        write_dataset(tmp_path / f"{side}.h5", replace(data, **columns))
        found = evaluate(of_features / "bundle", [tmp_path / f"{side}.h5"])
        assert found.trained_on == (side == "train")


def test_rows_without_contact_are_left_out_and_not_enough(
    of_features: Path, tmp_path: Path
) -> None:
    data = open_dataset(of_features / "features.h5")
    none = replace(
        data,
        in_contact=np.zeros(len(data), bool),
        contact_location=None,
        centre_of_pressure=None,
        contact_normal=None,
    )
    write_dataset(tmp_path / "none.h5", none)
    with pytest.raises(DatasetError, match="no row is in contact"):
        evaluate(of_features / "bundle", [tmp_path / "none.h5"])


def test_where_contact_is_not_known_rows_above_the_threshold_count(
    of_features: Path, tmp_path: Path
) -> None:
    data = open_dataset(of_features / "features.h5")
    assert data.in_contact is not None
    unknown = replace(
        data,
        in_contact=None,
        contact_location=None,
        centre_of_pressure=None,
        contact_normal=None,
    )
    write_dataset(tmp_path / "unknown.h5", unknown)
    threshold_n = read_bundle(of_features / "bundle").manifest.contact_threshold_n
    pressed = np.linalg.norm(data.force, axis=1) > threshold_n
    assert 0 < pressed.sum() < len(data)
    found = evaluate(of_features / "bundle", [tmp_path / "unknown.h5"])
    assert found.rows == pressed.sum()
    assert found.as_dict()["assumed_contact_n"] == threshold_n
    for name, words in (
        ("unknown.h5", f"above {threshold_n:g} N"),
        ("mixed.h5", "in_contact says"),
    ):
        at = tmp_path if name == "unknown.h5" else of_features
        told = ["evaluate", str(of_features / "bundle"), str(at / name)]
        assert words in CliRunner().invoke(train_app, told, env={"COLUMNS": "200"}).output


def test_one_press_has_no_interval(of_features: Path, tmp_path: Path) -> None:
    data = open_dataset(of_features / "features.h5")
    assert data.in_contact is not None
    own = np.flatnonzero(data.group == data.group[data.in_contact][0])
    columns: dict[str, Any] = {name: values[own] for name, values in data.arrays().items()}
    write_dataset(tmp_path / "one.h5", replace(data, **columns))
    found = evaluate(of_features / "bundle", [tmp_path / "one.h5"])
    first = found.figures[0]
    assert first.presses == 1
    assert np.isfinite(first.value)
    assert np.isnan([first.low, first.high]).all()
    assert found.as_dict()["figures"][0]["ci95"] == [None, None]
    told = ["evaluate", str(of_features / "bundle"), str(tmp_path / "one.h5")]
    shown = CliRunner().invoke(train_app, told)
    assert "nan" not in shown.output


def test_the_command_shows_and_writes(of_features: Path, tmp_path: Path) -> None:
    told = ["evaluate", str(of_features / "bundle"), str(of_features / "features.h5")]
    shown = CliRunner().invoke(train_app, [*told, "--out", str(tmp_path / "out.json")])
    assert shown.exit_code == 0, shown.output
    assert "It was trained on presses of these data sets" in shown.output
    written = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert written["schema"] == "palpate.evaluation 1"
    assert written["assumed_contact_n"] is None
    first = written["figures"][0]
    assert (first["name"], first["unit"], first["where"]) == ("force_magnitude", "N", "all")
    assert first["ci95"][0] <= first["value"] <= first["ci95"][1]
    before = (tmp_path / "out.json").read_bytes()
    again = CliRunner().invoke(train_app, [*told, "--out", str(tmp_path / "out.json")])
    assert again.exit_code != 0
    assert (tmp_path / "out.json").read_bytes() == before
