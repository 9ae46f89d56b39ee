"""Data sets on disk: what goes in comes out, and what breaks the schema is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.features import (
    SENSORS_MOST,
    FeatureDataset,
    check_learnable,
    open_dataset,
    press_of,
    write_dataset,
)

MakeData = Callable[..., FeatureDataset]


@pytest.fixture
def data(press_data: MakeData) -> FeatureDataset:
    return press_data(presses=3, rows=20)


@pytest.fixture
def path(data: FeatureDataset, tmp_path: Path) -> Path:
    path = tmp_path / "presses.h5"
    write_dataset(path, data)
    return path


def test_round_trip(path: Path, data: FeatureDataset) -> None:
    read = open_dataset(path)
    assert read.arrays().keys() == data.arrays().keys()
    for name, array in data.arrays().items():
        np.testing.assert_array_equal(read.arrays()[name], array, err_msg=name)
        assert read.arrays()[name].dtype == array.dtype
    assert read.provenance == data.provenance
    assert read.sensor_names == data.sensor_names
    assert not list(path.parent.glob(".*")), "no partial file is left"


def test_content_hash_does_not_depend_on_the_layout(path: Path, data: FeatureDataset) -> None:
    relaid = path.with_name("relaid.h5")
    with h5py.File(path) as source, h5py.File(relaid, "w") as target:
        for key, value in source.attrs.items():
            target.attrs[key] = value
        for name in source:
            copy = target.create_dataset(name, data=source[name][()])  # contiguous, plain
            copy.attrs["unit"] = source[name].attrs["unit"]
    assert relaid.read_bytes() != path.read_bytes()
    assert open_dataset(relaid).content_sha256() == data.content_sha256()


def test_a_sensor_with_a_single_group_is_divided_by_its_blocks(press_data: MakeData) -> None:
    def presses(sensor: list[int], group: list[int], block: list[int]) -> list[int]:
        data = press_data(presses=6, rows=1)
        labels = {"sensor": sensor, "group": group, "block": block}
        arrays: dict[str, Any] = {
            name: np.array(values, np.int32) for name, values in labels.items()
        }
        found = press_of(replace(data, **arrays, sensor_names=("one", "two")))
        return list(np.unique(found, return_inverse=True)[1])

    blocks = [0, 1, 2, 3, 4, 5]
    assert presses([0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0], [0, 0, 1, 1, 2, 2]) == [0, 0, 1, 1, 2, 2]
    assert presses([0, 0, 0, 1, 1, 1], [0, 0, 0, 1, 1, 1], blocks) == blocks
    # The first has presses, the second is one recording; blocks may have the numbers of groups.
    mixed = presses([0, 0, 0, 1, 1, 1], [1, 1, 2, 0, 0, 0], [5, 4, 3, 2, 1, 1])
    assert [number == mixed[0] for number in mixed] == [True, True, False, False, False, False]
    assert len({*mixed}) == 4
    assert mixed[4] == mixed[5]
    # Both sensors were pressed alike: the same press is not on two sides.
    assert presses([0, 0, 0, 0, 1, 1], [0, 0, 1, 1, 0, 0], blocks) == [0, 0, 1, 1, 0, 0]


def test_content_hash_sees_every_value(data: FeatureDataset) -> None:
    force = data.force.copy()
    force[7, 2] += np.float32(1e-3)
    assert replace(data, force=force).content_sha256() != data.content_sha256()


def _damage(path: Path, change: Callable[[Any], None]) -> None:
    with h5py.File(path, "r+") as file:
        change(file)


def _replace(name: str, values: Any, unit: str) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[name]
        file.create_dataset(name, data=values).attrs["unit"] = unit

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.attrs.__setitem__("schema", "something.else"), "something.else"),
        (lambda f: f.attrs.__setitem__("schema_version", 2), "version 2.*update palpate"),
        (lambda f: f.attrs.__setitem__("frame", "world"), "frame is 'world'"),
        (lambda f: f.__delitem__("group"), "'group' is missing"),
        (lambda f: f["force"].attrs.__setitem__("unit", "mN"), "force is in 'mN'.*'N'"),
        (lambda f: f["force"].__setitem__((11, 1), np.nan), "force is not finite in row 11"),
        (lambda f: f["baseline"].__setitem__((4, 2), 1e9), r"rest of E3 is 1e\+09 in row 4"),
        (lambda f: f["baseline"].__setitem__((4, 2), -5.0), "rest of E3 is -5 in row 4"),
        (lambda f: f["baseline"].__setitem__(4, 0.0), "rest of E1 is 0 in row 4"),
        (lambda f: f["force"].__setitem__((3, 0), 9.0), "content_sha256"),
        (lambda f: f["electrodes"].__setitem__((5, 0), 5000), "4095 counts in row 5"),
        (
            _replace("electrodes", np.zeros((60, 18), np.uint16), "counts"),
            "electrodes has 18 columns, a BioTac has 19",
        ),
        (_replace("force", np.zeros((59, 3), np.float32), "N"), r"force has shape \(59, 3\)"),
        (_replace("force", np.zeros((60, 3), np.float64), "N"), "force is float64"),
        (_replace("block", np.zeros(60, np.int32), "1"), "block 0 spans groups"),
        (
            lambda f: f.attrs.__setitem__("sensor_names", ["one", "one"]),
            "two sensors have the same name: one, one",
        ),
    ],
)
def test_a_broken_file_is_named(path: Path, change: Callable[[Any], None], words: str) -> None:
    _damage(path, change)
    with pytest.raises(DatasetError, match=words) as caught:
        open_dataset(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


def test_more_sensors_than_a_file_holds_are_refused(data: FeatureDataset, tmp_path: Path) -> None:
    names = tuple(f"finger-{number}" for number in range(SENSORS_MOST + 1))
    write_dataset(tmp_path / "most.h5", replace(data, sensor_names=names[:-1]))
    assert open_dataset(tmp_path / "most.h5").sensor_names == names[:-1]
    with pytest.raises(DatasetError, match="4001 sensors are more than a file holds: 4000"):
        write_dataset(tmp_path / "more.h5", replace(data, sensor_names=names))
    assert not (tmp_path / "more.h5").exists()


def test_nothing_is_learned_from_forces_in_mn(data: FeatureDataset) -> None:
    check_learnable(data)
    with pytest.raises(DatasetError, match=r"N in row .* more than a fingertip bears .* mN"):
        check_learnable(replace(data, force=1e3 * data.force))


def test_location_must_be_known_in_contact_only(path: Path, data: FeatureDataset) -> None:
    assert data.in_contact is not None
    row = int(np.flatnonzero(data.in_contact)[0])
    _damage(path, lambda f: f["contact_location"].__setitem__((row, 0), np.nan))
    with pytest.raises(DatasetError, match=f"contact_location is not finite in row {row}"):
        open_dataset(path)


def test_a_truncated_file_is_named(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DatasetError, match="truncated or damaged"):
        open_dataset(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such file"):
        open_dataset(tmp_path / "none.h5")


def test_a_failed_write_leaves_nothing(data: FeatureDataset, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file where a folder should be")
    with pytest.raises(DatasetError, match="cannot write"):
        write_dataset(tmp_path / "taken" / "x.h5", data)
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]
