"""Bundles: immutable, checked by digest, bound to a task's contract."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from palpate.errors import BundleError
from palpate.files.bundle import read_bundle, write_bundle
from palpate.files.manifest import Manifest
from palpate.files.tasks import TASKS


@pytest.fixture
def manifest() -> Manifest:
    task = TASKS["features"]
    return Manifest(
        name="test",
        version=1,
        task="features",
        inputs=task.inputs,
        outputs=task.outputs,
        sensor_type="BIOTAC",
        contact_threshold_n=0.3,
        training_data_sha256="00" * 32,
        trained_on="nothing",
        metrics={"force_magnitude_median_n": 0.1},
        model_sha256="",
        golden_sha256="",
        created="2026-11-21T00:00:00Z",
        palpate_version="0.1.0",
        opset=18,
    )


@pytest.fixture
def golden() -> dict[str, npt.NDArray[np.float32]]:
    return {
        "electrodes": np.zeros((2, 19), np.float32),
        "force": np.zeros((2, 3), np.float32),
        "force_sd": np.ones((2, 3), np.float32),
    }


@pytest.fixture
def folder(tmp_path: Path, manifest: Manifest, golden: dict[str, npt.NDArray[np.float32]]) -> Path:
    write_bundle(tmp_path / "test" / "1", model=b"onnx", golden=golden, manifest=manifest)
    return tmp_path / "test" / "1"


def test_round_trip_and_digest(folder: Path, manifest: Manifest) -> None:
    bundle = read_bundle(folder)
    assert bundle.model == b"onnx"
    assert bundle.manifest.metrics == manifest.metrics
    assert len(bundle.sha256) == 32
    assert bundle.golden["force_sd"].tolist() == [[1, 1, 1], [1, 1, 1]]


def test_bundles_are_immutable(
    folder: Path, manifest: Manifest, golden: dict[str, npt.NDArray[np.float32]]
) -> None:
    with pytest.raises(BundleError, match="immutable"):
        write_bundle(folder, model=b"other", golden=golden, manifest=manifest)
    assert read_bundle(folder).model == b"onnx"


@pytest.mark.parametrize("name", ["model.onnx", "golden.npz"])
def test_an_edited_file_is_refused(folder: Path, name: str) -> None:
    (folder / name).write_bytes(b"something else")
    with pytest.raises(BundleError, match=rf"{name} is not the file.*restore"):
        read_bundle(folder)


@pytest.mark.parametrize("name", ["model.onnx", "golden.npz", "manifest.json"])
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(BundleError, match=name):
        read_bundle(folder)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"contract_version": 2}, r"contract v2.*upgrade palpate"),
        ({"contract_version": 0}, "contract_version"),
        ({"task": "telepathy"}, r"task 'telepathy' is not one of features"),
        ({"outputs": []}, "outputs"),
        ({"surprise": 1}, "unknown keys surprise"),
        ({"sensor_type": "GELSIGHT"}, "GELSIGHT"),
        ({"inputs": 3}, "not a bundle manifest"),
    ],
)
def test_a_manifest_that_breaks_the_contract_is_refused(
    folder: Path, change: dict[str, object], named: str
) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(BundleError, match=named):
        read_bundle(folder)


def test_nothing_is_left_of_a_bundle_that_is_refused(
    tmp_path: Path,
    manifest: Manifest,
    golden: dict[str, npt.NDArray[np.float32]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    target = tmp_path / "models" / "1"

    def full(*_: object, **__: object) -> str:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for refuses in ("tempfile.mkdtemp", "os.rename"):
        with monkeypatch.context() as disk:
            disk.setattr(refuses, full)
            with pytest.raises(BundleError, match="No space left"):
                write_bundle(target, model=b"", golden=golden, manifest=manifest)
        assert not list(tmp_path.iterdir())
    with pytest.raises(BundleError, match="lack force_sd"):
        write_bundle(
            target,
            model=b"",
            golden={k: v for k, v in golden.items() if k != "force_sd"},
            manifest=manifest,
        )
    with pytest.raises(BundleError, match="not those of task"):
        write_bundle(
            target, model=b"", golden=golden, manifest=dataclasses.replace(manifest, inputs=())
        )
    assert not target.exists()


def test_a_bundle_is_on_the_disk_before_it_appears(
    tmp_path: Path,
    manifest: Manifest,
    golden: dict[str, npt.NDArray[np.float32]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a power failure it is whole or not there: a station serves it at once."""
    synced: set[str] = set()
    there: list[set[str]] = []
    sync, rename = os.fsync, os.rename

    def synced_too(file: int) -> None:
        sync(file)
        synced.add(os.readlink(f"/proc/self/fd/{file}"))

    def renamed(made: Path, folder: Path) -> None:
        there.append({str(made), *map(str, made.iterdir())})
        assert there[0] <= synced
        rename(made, folder)

    monkeypatch.setattr(os, "fsync", synced_too)
    monkeypatch.setattr(os, "rename", renamed)
    write_bundle(tmp_path / "test" / "1", model=b"onnx", golden=golden, manifest=manifest)
    assert len(there[0]) == 4, "the folder and its three files"
