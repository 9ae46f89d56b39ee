"""``palpate data inspect | export | features`` on the experiment's data sets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from palpate.errors import ConfigError, DatasetError
from palpate_training.cli import data_app
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    content_sha256,
    write_experiment,
    write_mixed,
)
from palpate_training.datasets.export import export_published
from palpate_training.datasets.features import FeatureDataset, open_dataset, write_dataset
from palpate_training.datasets.published import read_published


def _run(*words: object) -> Result:
    return CliRunner().invoke(data_app, [str(word) for word in words], env={"COLUMNS": "250"})


@pytest.fixture
def path(experiment: ExperimentDataset, tmp_path: Path) -> Path:
    write_experiment(tmp_path / "e.h5", experiment)
    return tmp_path / "e.h5"


def test_inspect_counts_and_measures(path: Path, experiment: ExperimentDataset) -> None:
    result = _run("inspect", path, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.output)
    assert (found["kind"], found["trajectories"], found["trials"], found["rows"]) == (
        "palpate.experiment",
        3,
        5,
        35,
    )
    first, second = found["units"]
    assert (first["unit"], first["trials"], first["indenters"], first["rows"]) == (
        "biotac-1",
        3,
        2,
        18,
    )
    mine = slice(18, 35)
    assert second["tared_min"] == pytest.approx(experiment.tared[mine].min())
    assert second["tared_max"] == pytest.approx(experiment.tared[mine].max())
    assert second["force_max_n"] == pytest.approx(
        np.linalg.norm(experiment.force[mine], axis=1).max()
    )
    assert second["electrode_sd"] == pytest.approx(experiment.tared[mine].std(axis=0), rel=1e-5)
    assert found["content_sha256"] == content_sha256(experiment)
    assert found["provenance"]["source"] == "made by a test"


def test_inspect_tells_people(path: Path) -> None:
    result = _run("inspect", path)
    assert result.exit_code == 0, result.output
    for word in ("biotac-2", "3 trajectories, 5 trials", "35 rows", "made by a test"):
        assert word in result.output


def test_inspect_knows_mixed_sets(mixed: MixedDataset, tmp_path: Path) -> None:
    write_mixed(tmp_path / "m.h5", mixed)
    found = json.loads(_run("inspect", tmp_path / "m.h5", "--json").output)
    assert found["kind"] == "palpate.mixed"
    assert found["nodes"] == 12
    assert found["modes"] == len(mixed.basis.modes)
    assert 0 < found["field_loss_mean_m"] < 1e-6
    # The simulated force is 1.1 times the measured one.
    rms = np.sqrt(np.mean(mixed.experiment.force.astype(float) ** 2))
    assert found["force_rms_n"] == pytest.approx(0.1 * rms, rel=1e-4)
    assert "12 nodes" in _run("inspect", tmp_path / "m.h5").output


def test_an_input_is_not_replaced_where_the_output_is_left_out(
    path: Path, experiment: ExperimentDataset, tmp_path: Path
) -> None:
    write_experiment(tmp_path / "second.h5", experiment)
    before = (tmp_path / "second.h5").read_bytes()
    result = _run("features", path, tmp_path / "second.h5")
    assert isinstance(result.exception, DatasetError)
    assert "name the file to write" in str(result.exception)
    assert (tmp_path / "second.h5").read_bytes() == before
    assert not list(tmp_path.glob(".*"))
    assert _run("features", path, tmp_path / "f.h5").exit_code == 0
    assert _run("features", path, tmp_path / "f.h5").exit_code == 0  # made again
    # Paths of text are paths, too.
    assert len(open_dataset(str(tmp_path / "f.h5"))) > 0


def test_inspect_knows_rows_of_features(
    path: Path, press_data: type[FeatureDataset], tmp_path: Path
) -> None:
    data = press_data(presses=3)  # type: ignore[call-arg]
    write_dataset(tmp_path / "p.h5", data)
    found = json.loads(_run("inspect", tmp_path / "p.h5", "--json").output)
    assert found["kind"] == "palpate.features"
    assert found["groups"] == 3
    assert found["arrays"]["force"] == {"type": "float32", "shape": [180, 3], "unit": "N"}
    assert found["content_sha256"] == data.content_sha256()


def test_inspect_knows_published_files_also_alone(
    experiment: ExperimentDataset, tmp_path: Path
) -> None:
    export_published(tmp_path / "out", experiment)
    found = json.loads(_run("inspect", tmp_path / "out", "--json").output)
    assert (found["kind"], found["trials"], found["rows"]) == ("published layout", 5, 35)
    alone = json.loads(_run("inspect", tmp_path / "out" / "biotac2.hdf5", "--json").output)
    assert [unit["unit"] for unit in alone["units"]] == ["biotac-2"]
    assert alone["rows"] == 17


def test_inspect_refuses_what_it_does_not_know(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("no HDF5")
    assert isinstance(_run("inspect", tmp_path / "text.h5").exception, DatasetError)
    assert isinstance(_run("inspect", tmp_path / "none.h5").exception, DatasetError)
    assert isinstance(_run("inspect", tmp_path).exception, DatasetError)


def test_export_both_ways(path: Path, tmp_path: Path) -> None:
    assert _run("export", path, tmp_path / "out", "--published").exit_code == 0
    assert len(read_published(tmp_path / "out", units=[1, 2])) == 35
    assert _run("export", path, tmp_path / "rows.csv", "--csv").exit_code == 0
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 36
    assert isinstance(_run("export", path, tmp_path / "none").exception, ConfigError)


def test_features_can_be_read_for_training(path: Path, tmp_path: Path) -> None:
    result = _run("features", path, tmp_path / "f.h5", "--untouched-rows", 4)
    assert result.exit_code == 0, result.output
    rows = open_dataset(tmp_path / "f.h5")
    assert len(rows) == 35 + 5 * 4
    assert rows.in_contact is not None
    assert rows.in_contact.sum() == 35


def test_features_of_published_files_need_an_assumed_rest(
    experiment: ExperimentDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["/usr/bin/palpate", "data", "features", "out", "f.h5"])
    export_published(tmp_path / "out", experiment)
    refused = _run("features", tmp_path / "out", tmp_path / "f.h5")
    assert isinstance(refused.exception, DatasetError)
    done = _run("features", tmp_path / "out", tmp_path / "f.h5", "--assumed-rest", 3300)
    assert done.exit_code == 0, done.output
    rows = open_dataset(tmp_path / "f.h5")
    assert (rows.baseline == 3300).all()
    assert rows.provenance.command == "palpate data features out f.h5"
