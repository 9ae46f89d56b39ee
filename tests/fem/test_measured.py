"""Indentations on disk: what goes in comes out, and what breaks the schema is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_fem.calibration.measured import (
    MEASURED,
    SIMULATED,
    MeasuredIndentation,
    read_indentations,
    write_indentations,
)
from palpate_fem.indenter.path import check_path

NAME = "sphere_medium/03/normal/biotac1"


def press(name: str = NAME, samples: int = 5, origin: str = MEASURED) -> MeasuredIndentation:
    random = np.random.default_rng(len(name))
    pose = np.zeros((samples, 7))
    pose[:, 2], pose[:, 3] = np.arange(samples) * 1e-4, 1.0
    force = random.normal(size=(samples, 3)) / 3.0
    return MeasuredIndentation(name, "sphere_medium", "biotac1", pose, force, origin)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "deep" / "measured.h5"
    write_indentations(path, [press(), press("cube/00/angled-2/biotac1")], source="a test")
    return path


def test_round_trip(path: Path) -> None:
    read = read_indentations(path)
    assert [item.name for item in read] == ["cube/00/angled-2/biotac1", NAME]
    for item in read:
        written = press(item.name)
        np.testing.assert_array_equal(item.pose, written.pose)
        np.testing.assert_array_equal(item.force, written.force)
        assert (item.indenter, item.sensor, item.origin) == ("sphere_medium", "biotac1", MEASURED)
    assert not list(path.parent.glob(".*")), "no partial file is left"


def test_simulated_forces_stay_known_as_such(tmp_path: Path) -> None:
    path = tmp_path / "simulated.h5"
    item = replace(press(origin=SIMULATED), outcome="force limit")
    write_indentations(path, [item], source="a test")
    (read,) = read_indentations(path)
    assert (read.origin, read.outcome) == (SIMULATED, "force limit")


def test_numbers_of_less_precision_are_read(path: Path) -> None:
    """Another program may well write single precision."""
    with h5py.File(path, "r+") as file:
        group = file[f"trajectories/{NAME}"]
        for name in ("pose", "force"):
            array, unit = group[name][()].astype(np.float32), group[name].attrs["unit"]
            del group[name]
            group.create_dataset(name, data=array).attrs["unit"] = unit
    item = next(item for item in read_indentations(path) if item.name == NAME)
    assert item.force.dtype == np.float64
    np.testing.assert_allclose(item.force, press().force, rtol=1e-6)


def test_a_name_that_begins_another_is_read_too(tmp_path: Path) -> None:
    path = tmp_path / "measured.h5"
    names = ["cube/00", "cube/00/normal", "cube/00/normal/biotac1"]
    write_indentations(path, [press(name) for name in names], source="a test")
    assert [item.name for item in read_indentations(path)] == names


def test_a_rounded_quaternion_can_be_simulated() -> None:
    pose = press().pose.copy()
    pose[:, 3:] = 0.9239, 0.0, 0.3827, 0.0  # 45 degrees, rounded
    kept = pose.copy()
    item = replace(press(), pose=pose)
    check_path(item.pose)
    np.testing.assert_allclose(item.pose, pose, atol=1e-4)
    np.testing.assert_array_equal(pose, kept)


def _delete(name: str) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[f"trajectories/{NAME}"][name]

    return change


def _attribute(name: str, value: object, at: str = "/") -> Callable[[Any], None]:
    def change(file: Any) -> None:
        file[at].attrs[name] = value

    return change


def _replace(name: str, array: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        group = file[f"trajectories/{NAME}"]
        unit = group[name].attrs["unit"]
        del group[name]
        group.create_dataset(name, data=array).attrs["unit"] = unit

    return change


def _drop_all(file: Any) -> None:
    del file["trajectories"]
    file.create_group("trajectories")


def _drop_sensor(file: Any) -> None:
    del file[f"trajectories/{NAME}"].attrs["sensor"]


HERE = f"trajectories/{NAME}"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_delete("force"), "'force' is missing"),
        (_delete("pose"), "'pose' is missing"),
        (_attribute("unit", "lbf", f"{HERE}/force"), "force is in 'lbf'"),
        (_attribute("unit", "mm, 1", f"{HERE}/pose"), "pose is in 'mm, 1'"),
        (_attribute("schema", "something"), "schema is 'something'"),
        (_attribute("schema_version", 2), "schema version 2"),
        (_attribute("frame", "world"), "attribute frame is 'world'"),
        (_attribute("origin", "guessed"), "attribute origin is 'guessed'"),
        (_attribute("indenter", "", HERE), "names no indenter"),
        (_drop_sensor, "no attribute sensor"),
        (_drop_all, "no trajectories"),
        (_replace("force", np.zeros((5, 2))), r"force has shape \(5, 2\)"),
        (_replace("force", np.zeros((4, 3))), "5 poses but 4 forces"),
        (_replace("force", np.full((5, 3), np.nan)), "force is not finite in row 0"),
        (_replace("force", np.full((5, 3), b"x")), "no numbers"),
        (_replace("pose", np.zeros((5, 7))), "no unit quaternion"),
        (_replace("pose", np.tile([0, 0, 0, 1.0, 0, 0, 0], (5, 1))), "does not move"),
    ],
)
def test_what_breaks_the_schema_is_named(
    path: Path, change: Callable[[Any], None], says: str
) -> None:
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(DatasetError, match=says) as caught:
        read_indentations(path)
    assert str(path) in caught.value.problem
    assert caught.value.remedy


def test_one_sample_is_no_trajectory() -> None:
    with pytest.raises(DatasetError, match="at least 2"):
        press(samples=1)


def test_missing_truncated_and_foreign_files_are_named(path: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such file"):
        read_indentations(tmp_path / "nothing.h5")
    path.write_bytes(path.read_bytes()[:1500])
    with pytest.raises(DatasetError, match="truncated or damaged"):
        read_indentations(path)
    path.write_text("not HDF5 at all")
    with pytest.raises(DatasetError, match="truncated or damaged"):
        read_indentations(path)


@pytest.mark.parametrize(
    ("items", "says"),
    [
        ([], "nothing to write"),
        ([press(), press()], "two trajectories are named"),
        ([press(), press("other", origin=SIMULATED)], "measured and simulated"),
    ],
)
def test_nothing_is_written_that_could_not_be_read(
    tmp_path: Path, items: list[MeasuredIndentation], says: str
) -> None:
    path = tmp_path / "measured.h5"
    with pytest.raises(DatasetError, match=says):
        write_indentations(path, items, source="a test")
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_leaves_the_old_one(path: Path) -> None:
    before = path.read_bytes()
    blocked = path / "inside.h5"  # its folder is a file
    with pytest.raises(DatasetError, match="cannot write"):
        write_indentations(blocked, [press()], source="a test")
    assert path.read_bytes() == before


@pytest.mark.parametrize("name", ["", "a//b", "/a", "../a", "a b"])
def test_names_that_no_store_could_hold_are_refused(name: str) -> None:
    with pytest.raises(DatasetError, match="is no id"):
        press(name)
