"""The experiment on disk: what goes in comes out, and what is broken is named."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.experiment import (
    EXPERIMENT_ARRAYS,
    MIXED_COLUMNS,
    ExperimentDataset,
    MixedDataset,
    content_sha256,
    read_experiment,
    read_mixed,
    write_experiment,
    write_mixed,
)


@pytest.fixture
def path(experiment: ExperimentDataset, tmp_path: Path) -> Path:
    write_experiment(tmp_path / "e.h5", experiment)
    return tmp_path / "e.h5"


@pytest.fixture
def mixed_path(mixed: MixedDataset, tmp_path: Path) -> Path:
    write_mixed(tmp_path / "m.h5", mixed)
    return tmp_path / "m.h5"


def _same(read: ExperimentDataset, data: ExperimentDataset) -> None:
    for name in EXPERIMENT_ARRAYS:
        np.testing.assert_array_equal(getattr(read, name), getattr(data, name), err_msg=name)
    for name in ("unit_names", "trajectories", "indenters", "provenance"):
        assert getattr(read, name) == getattr(data, name)


def test_an_experiment_comes_back(path: Path, experiment: ExperimentDataset) -> None:
    _same(read_experiment(path), experiment)
    assert [file.name for file in path.parent.iterdir()] == ["e.h5"], "no partial file is left"


def test_unknown_rest_comes_back(experiment: ExperimentDataset, tmp_path: Path) -> None:
    experiment.trial_rest[2] = np.nan
    write_experiment(tmp_path / "e.h5", experiment)
    _same(read_experiment(tmp_path / "e.h5"), experiment)


def test_a_mixed_set_comes_back(mixed_path: Path, mixed: MixedDataset) -> None:
    read = read_mixed(mixed_path)
    _same(read.experiment, mixed.experiment)
    np.testing.assert_array_equal(read.displacement(slice(0, 30)), mixed.displacement(slice(0, 30)))
    np.testing.assert_array_equal(read.simulated_force, mixed.simulated_force)
    for name in ("nodes", "outer_faces", "inner_faces", "subset"):
        np.testing.assert_array_equal(getattr(read.mesh, name), getattr(mixed.mesh, name))
    assert read.mesh.sha256 == mixed.mesh.sha256
    assert (read.basis.loss_mean, read.basis.loss_max) == (
        mixed.basis.loss_mean,
        mixed.basis.loss_max,
    )
    assert content_sha256(read) == content_sha256(mixed)


def test_every_array_is_compressed_and_says_its_unit(mixed_path: Path) -> None:
    with h5py.File(mixed_path) as file:
        for name, column in MIXED_COLUMNS.items():
            assert file[name].attrs["unit"] == column.unit, name
            if column.dtype is not str:
                assert file[name].compression == "gzip", name
                assert file[name].shuffle, name
        assert file["force"].attrs["unit"] == "N"
        assert file["mesh/nodes"].attrs["unit"] == "m"
        assert file["trial_rest"].attrs["unit"] == "counts"
        assert file.attrs["schema"] == "palpate.mixed"
        assert file.attrs["schema_version"] == 1
        assert file.attrs["provenance.source"] == "made by a test"


def test_the_hash_sees_values_names_and_losses(experiment: ExperimentDataset, path: Path) -> None:
    before = content_sha256(experiment)
    with h5py.File(path) as file:
        assert file.attrs["content_sha256"] == before
    experiment.tared[7, 3] += np.float32(1e-3)
    assert content_sha256(experiment) != before
    experiment.tared[7, 3] -= np.float32(1e-3)
    object.__setattr__(experiment, "unit_names", ("biotac-1biotac-", "2"))
    assert content_sha256(experiment) != before


def _replace(name: str, values: Any, unit: str) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[name]
        file.create_dataset(name, data=values).attrs["unit"] = unit

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.attrs.__setitem__("schema", "other"), "schema is 'other'"),
        (lambda f: f.attrs.__delitem__("schema"), "schema is 'not stated'"),
        (lambda f: f.attrs.__setitem__("schema_version", 2), "version 2.*update palpate"),
        (lambda f: f.attrs.__setitem__("frame", "world"), "frame is 'world'"),
        (lambda f: f.attrs.__delitem__("content_sha256"), "content_sha256 is missing"),
        (lambda f: f.__delitem__("tared"), "'tared' is missing"),
        (lambda f: f.__delitem__("indenters"), "'indenters' is missing"),
        (lambda f: f["location"].attrs.__setitem__("unit", "mm"), "location is in 'mm'.*'m'"),
        (lambda f: f["force"].__setitem__((3, 0), 9.0), "does not match its content_sha256"),
        (lambda f: f["indenters"].__setitem__(0, "ring"), "does not match its content_sha256"),
        (_replace("trial", np.zeros(35, np.int64), "1"), "trial is int64"),
    ],
)
def test_a_broken_file_is_named(path: Path, change: Callable[[Any], None], words: str) -> None:
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(DatasetError, match=words) as caught:
        read_experiment(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


def test_content_that_breaks_the_contract_is_said_of_the_file(
    path: Path, experiment: ExperimentDataset
) -> None:
    experiment.force[4, 1] = np.nan
    with h5py.File(path, "r+") as file:
        file["force"][4, 1] = np.nan
        file.attrs["content_sha256"] = content_sha256(experiment)
    with pytest.raises(DatasetError, match="force is not finite in row 4") as caught:
        read_experiment(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
def test_a_truncated_file_is_named(mixed_path: Path, share: float) -> None:
    content = mixed_path.read_bytes()
    mixed_path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DatasetError, match="truncated or damaged"):
        read_mixed(mixed_path)


def test_the_other_schema_and_a_missing_file_are_named(mixed_path: Path, path: Path) -> None:
    with pytest.raises(DatasetError, match=r"'palpate.mixed', expected 'palpate.experiment'"):
        read_experiment(mixed_path)
    with pytest.raises(DatasetError, match="no such file"):
        read_mixed(path.with_name("none.h5"))
    with pytest.raises(DatasetError, match=f"is a folder.* in it: .*{path.name}"):
        read_mixed(path.parent)


def test_an_interrupted_write_leaves_the_old_file(
    path: Path, experiment: ExperimentDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = path.read_bytes()

    def refuse(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(DatasetError, match="no space left"):
        write_experiment(path, experiment)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["e.h5"]
