"""What is not a store, not whole, or another's, is named, and never read as numbers."""

from __future__ import annotations

import importlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from palpate.errors import ConfigError, DatasetError
from palpate.files.simulation_store import FINGERTIP
from palpate_fem.result import IndentationResult
from palpate_fem.store.content import Outline, StoredFingertip
from palpate_fem.store.files import StoreDiskError
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter

sample: Any = importlib.import_module("stored_sample")
indenter_outline: Callable[[str], Outline] = sample.indenter_outline
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory

ID = "sphere_medium/03/normal"


@pytest.fixture(scope="module")
def tip() -> StoredFingertip:
    return sample_fingertip(divisions=4)


@pytest.fixture(scope="module")
def press(tip: StoredFingertip, whole_store: Path) -> IndentationResult:
    """As it is read from a sound store."""
    return SimulationStore.open(whole_store).trajectory(ID)


@pytest.fixture(scope="module")
def whole_store(tip: StoredFingertip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "sweep.sim"
    with StoreWriter(path, tip, outline=indenter_outline) as store:
        store.write(ID, sample_trajectory(tip, steps=6))
    return path


@pytest.fixture
def path(whole_store: Path, tmp_path: Path) -> Path:
    """A copy of it to break."""
    return Path(shutil.copytree(whole_store, tmp_path / "sweep.sim"))


def _assert_same(read: IndentationResult, sound: IndentationResult) -> None:
    for name in ("indenter", "outcome", "reason", "travel_m", "seconds"):
        assert getattr(read, name) == getattr(sound, name), name
    np.testing.assert_array_equal(read.path, sound.path)
    assert len(read.steps) == len(sound.steps)
    for one, other in zip(read.steps, sound.steps, strict=True):
        for name in one.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def _attribute(name: str, value: object) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file.attrs[name] = value

    return change


@pytest.mark.parametrize("target", [FINGERTIP, f"trajectories/{ID}.h5"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_attribute("schema", "palpate.features"), "expected 'palpate.simulations'"),
        (_attribute("schema_version", 2), "version 2.*update palpate"),
        (_attribute("schema_version", 0), "version 0.*make the file again"),
        (_attribute("frame", "world"), "frame is 'world'"),
        (lambda path: os.truncate(path, path.stat().st_size // 2), "truncated"),
        (lambda path: os.truncate(path, 0), "truncated"),
        (lambda path: path.write_bytes(b"no HDF5 at all"), "no HDF5 file"),
    ],
)
def test_broken_file_is_named(
    path: Path, target: str, change: Callable[[Path], None], words: str
) -> None:
    change(path / target)
    with pytest.raises(DatasetError, match=words) as caught:
        SimulationStore.open(path).trajectory(ID)
    assert str(path / target) in str(caught.value)


def test_flipped_bytes_are_errors_or_harmless(path: Path, press: IndentationResult) -> None:
    """A damaged file gives the right numbers or a typed error: never others, never a crash."""
    target = path / "trajectories" / f"{ID}.h5"
    whole = target.read_bytes()
    rng = np.random.default_rng(7)
    named = []
    for at in rng.integers(0, len(whole), 80):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        target.write_bytes(damaged)
        store = SimulationStore.open(path)
        try:
            store.check()
            read = store.trajectory(ID)
        except DatasetError as error:
            named.append(str(target) in str(error))
        else:
            _assert_same(read, press)
    assert all(named)
    assert len(named) > 40, "most bytes are covered by a checksum"


def test_trajectory_of_another_fingertip_is_found(
    path: Path, press: IndentationResult, tmp_path: Path
) -> None:
    other = sample_fingertip(divisions=3)
    with StoreWriter(tmp_path / "other.sim", other) as store:
        store.write(ID, sample_trajectory(other, steps=2))
    shutil.copy(tmp_path / "other.sim" / "trajectories" / f"{ID}.h5",
                path / "trajectories" / f"{ID}.h5")  # fmt: skip
    with pytest.raises(DatasetError, match="another fingertip"):
        SimulationStore.open(path).check()


def test_no_store_is_refused(tmp_path: Path, tip: StoredFingertip) -> None:
    with pytest.raises(DatasetError, match="no such store"):
        SimulationStore.open(tmp_path / "none.sim")
    folder = tmp_path / "photos.sim"
    folder.mkdir()
    (folder / "cat.jpg").touch()
    with pytest.raises(DatasetError, match=r"no fingertip\.h5"):
        SimulationStore.open(folder)
    with pytest.raises(DatasetError, match=r"cat\.jpg"):
        StoreWriter(folder, tip)
    with pytest.raises(ConfigError, match=r"\.sim"):
        StoreWriter(tmp_path / "sweep", tip)
    (tmp_path / "file.sim").touch()
    with pytest.raises(StoreDiskError, match="rights"):
        StoreWriter(tmp_path / "file.sim", tip)


def test_reading_needs_no_right_to_write(path: Path) -> None:
    for file in [path, *path.rglob("*")]:
        file.chmod(0o555 if file.is_dir() else 0o444)
    try:
        assert SimulationStore.open(path).check() == 1
    finally:
        for file in [path, *path.rglob("*")]:
            file.chmod(0o755)
