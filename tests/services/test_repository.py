"""Bundles by name, by version, by path."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.errors import BundleError, ConfigError
from palpate.files.bundle import Bundle, read_bundle
from palpate_services.inference.repository import Repository, available, resolve


@pytest.fixture
def models(tmp_path: Path) -> Path:
    for version in (1, 2, 10):
        folder = tmp_path / "models" / "features-x" / str(version)
        folder.mkdir(parents=True)
        (folder / "manifest.json").write_text("{}")
    (tmp_path / "models" / "features-x" / "11").mkdir()  # half written: no manifest
    return tmp_path / "models"


def test_newest_version_of_a_name(models: Path) -> None:
    assert resolve("features-x", models) == models / "features-x" / "10"
    assert resolve("features-x:2", models) == models / "features-x" / "2"
    assert available(models) == ["features-x:1", "features-x:2", "features-x:10"]


def test_a_bundle_in_a_closed_folder_hides_no_other(
    models: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is found: whoever reads it is told why that cannot be."""
    closed = models / "features-x" / "2"

    def look(path: Path) -> bool:
        if closed in path.parents:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return os.path.isfile(path)

    monkeypatch.setattr(Path, "is_file", look)  # root may look everywhere
    assert resolve("features-x", models) == models / "features-x" / "10"
    assert available(models) == ["features-x:1", "features-x:2", "features-x:10"]
    with pytest.raises(ConfigError, match=f"{closed} cannot be read: Permission denied"):
        resolve(str(closed))


def test_path_of_a_folder(models: Path) -> None:
    folder = models / "features-x" / "1"
    assert resolve(str(folder), models) == folder


@pytest.mark.parametrize("name", ["features-y", "features-x:3", "features-x:new", "features"])
def test_what_is_not_there(models: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=r"available: features-x:1, features-x:2, features-x:10"):
        resolve(name, models)


def test_folder_without_a_bundle(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no manifest\.json in"):
        resolve(str(tmp_path), tmp_path)


@pytest.fixture
def repository(tmp_path: Path) -> Repository:
    return Repository(tmp_path / "mine", packaged=tmp_path / "packaged")


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_an_imported_bundle_is_found_by_its_own_name(
    repository: Repository, make_bundle: Callable[..., Path]
) -> None:
    made = make_bundle(name="mine", version=7)
    (made / "notes.txt").write_text("not part of a bundle")
    label, folder = repository.add(made, read_bundle)
    assert label == "mine:7"
    assert repository.available() == repository.available("features") == ["mine:7"]
    assert repository.available("field") == []
    assert repository.resolve("mine") == folder
    assert read_bundle(folder).sha256 == read_bundle(made).sha256
    assert repository.folder is not None
    assert names(repository.folder) == [
        "mine",
        "mine/7",
        *(f"mine/7/{name}" for name in ("golden.npz", "manifest.json", "model.onnx")),
    ]
    assert repository.add(made, read_bundle) == (label, folder), "the same once more is no error"


@pytest.mark.parametrize("name", available())
def test_every_kind_of_bundle_is_copied_whole(repository: Repository, name: str) -> None:
    shipped = read_bundle(resolve(name))
    label, folder = repository.add(shipped.folder, read_bundle)
    assert label == name
    assert names(folder) == names(shipped.folder)
    assert read_bundle(folder).sha256 == shipped.sha256


def test_what_the_check_refuses_leaves_nothing_behind(
    repository: Repository, make_bundle: Callable[..., Path]
) -> None:
    made = make_bundle()

    def refuse(folder: Path) -> Bundle:
        raise BundleError(f"{folder} is bad", remedy="export it again")

    with pytest.raises(BundleError, match=f"^{made} is bad"):
        repository.add(made, refuse)
    assert repository.folder is not None
    assert names(repository.folder) == []


def test_a_version_never_changes(repository: Repository, make_bundle: Callable[..., Path]) -> None:
    repository.add(make_bundle(name="mine"), read_bundle)
    with pytest.raises(BundleError, match="another bundle mine:1 is in"):
        repository.add(make_bundle(name="mine", trained_on="other data"), read_bundle)


def test_a_copy_under_another_name_is_not_read(
    repository: Repository, make_bundle: Callable[..., Path]
) -> None:
    """Its estimates would carry the name of another bundle than the one that was asked for."""
    made = make_bundle(name="mine", version=12)
    assert repository.folder is not None
    for name, version in (("mine", "13"), ("yours", "12")):
        shutil.copytree(made, repository.folder / name / version)
        with pytest.raises(BundleError, match="holds mine:12, so it lies in the wrong place"):
            repository.read(repository.resolve(f"{name}:{version}"))
    assert repository.read(made).manifest.version == 12, "elsewhere a folder has any name"


def test_a_packaged_version_is_not_hidden_by_an_imported_one(
    tmp_path: Path, make_bundle: Callable[..., Path]
) -> None:
    shutil.copytree(make_bundle(name="p"), tmp_path / "packaged" / "p" / "1")
    repository = Repository(tmp_path / "mine", packaged=tmp_path / "packaged")
    with pytest.raises(BundleError, match="another bundle p:1"):
        repository.add(make_bundle(name="p", trained_on="other data"), read_bundle)
    repository.add(make_bundle(name="p", version=2), read_bundle)
    assert repository.available() == ["p:1", "p:2"]


def test_links_and_devices_are_not_imported(
    repository: Repository, make_bundle: Callable[..., Path]
) -> None:
    made = make_bundle()
    (made / "golden.npz").unlink()
    (made / "golden.npz").symlink_to("/dev/zero")
    with pytest.raises(BundleError, match="symbolic link"):
        repository.add(made, read_bundle)


def test_a_folder_that_cannot_be_written(make_bundle: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be copied"):
        Repository(tmp_path / "file").add(make_bundle(), read_bundle)
    with pytest.raises(ConfigError, match="no folder for imported bundles"):
        Repository(None).add(make_bundle(), read_bundle)


@pytest.mark.parametrize("name", ["x/0", "x/01", "x/1a", "X/1", ".x/1", "x/9999999999", "x/٣"])
def test_folders_that_are_no_bundles(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir(parents=True)
    (tmp_path / name / "manifest.json").touch()
    assert available(tmp_path) == []
