"""Bundles by name, by version, by path."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.errors import ConfigError
from palpate_services.inference.repository import available, resolve


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
