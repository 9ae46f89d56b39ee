"""``palpate fem export``: the same store as one file; never a damaged one, never over another."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from palpate.errors import ConfigError, DatasetError
from palpate_fem.cli.app import fem_app
from palpate_fem.result import IndentationResult
from palpate_fem.store.content import Outline, StoredFingertip
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter

sample: Any = importlib.import_module("stored_sample")
indenter_outline: Callable[[str], Outline] = sample.indenter_outline
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory

NAMES = ["cube/00/normal", "sphere_medium/00/normal"]


def export(*words: object) -> Result:
    """Run the command; what it raises is raised here."""
    return CliRunner().invoke(fem_app, ["export", *map(str, words)], catch_exceptions=False)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path, tip = tmp_path / "paper.sim", sample_fingertip(divisions=3)
    with StoreWriter(path, tip, outline=indenter_outline) as writer:
        for name in NAMES:
            writer.write(name, sample_trajectory(tip, steps=2))
    return path


def test_the_file_is_the_store(store: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "paper.h5"
    done = export(store, out)
    assert done.exit_code == 0
    assert "2 trajectories" in done.stdout
    before, after = SimulationStore.open(store), SimulationStore.open(out)
    assert after.ids() == NAMES
    assert after.check() == len(NAMES)
    assert after.fingertip().key == before.fingertip().key
    np.testing.assert_array_equal(
        after.trajectory(NAMES[0]).steps[-1].displacement,
        before.trajectory(NAMES[0]).steps[-1].displacement,
    )
    assert after.outline(NAMES[0]) is not None


def test_nothing_is_overwritten(store: Path, tmp_path: Path) -> None:
    out = tmp_path / "paper.h5"
    out.write_bytes(b"mine")
    with pytest.raises(ConfigError, match="is there already"):
        export(store, out)
    assert out.read_bytes() == b"mine"


def test_what_is_no_folder_is_refused(store: Path, tmp_path: Path) -> None:
    export(store, tmp_path / "paper.h5")
    with pytest.raises(DatasetError, match="one file already"):
        export(tmp_path / "paper.h5", tmp_path / "again.h5")
    with pytest.raises(DatasetError, match="no such store"):
        export(tmp_path / "nowhere.sim", tmp_path / "again.h5")
    with pytest.raises(ConfigError, match=r"call it again\.h5"):
        export(store, tmp_path / "again.hdf")
    assert not list(tmp_path.glob("again*"))


@pytest.mark.parametrize("file", ["fingertip.h5", f"trajectories/{NAMES[1]}.h5"])
def test_damage_is_not_handed_on(store: Path, tmp_path: Path, file: str) -> None:
    image = bytearray((store / file).read_bytes())
    packed = image.index(b"\x78\x5e")  # where zlib's stream of the first packed dataset begins
    image[packed + 20] ^= 0x10
    (store / file).write_bytes(image)
    with pytest.raises(DatasetError, match=file):
        export(store, tmp_path / "paper.h5")
    assert not list(tmp_path.glob("paper.h5*"))
