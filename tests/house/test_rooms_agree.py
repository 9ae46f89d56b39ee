"""The list of rooms stands in many settings of pyproject.toml; they must name the same rooms."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
SETTINGS: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
TOOL: dict[str, Any] = SETTINGS["tool"]


def _rooms_on_disk() -> set[str]:
    return {path.parent.name for path in ROOT.glob("*/palpate*") if path.is_dir()}


def _layers() -> list[str]:
    for contract in TOOL["importlinter"]["contracts"]:
        if contract["type"] == "layers" and "containers" not in contract:
            return list(contract["layers"])
    pytest.fail("no import-linter contract of type layers over the rooms")


WHERE = {
    "tool.hatch.build.targets.wheel.packages": [
        path.partition("/")[0] for path in TOOL["hatch"]["build"]["targets"]["wheel"]["packages"]
    ],
    "tool.mypy.mypy_path": TOOL["mypy"]["mypy_path"].split(":"),
    "tool.mypy.files": TOOL["mypy"]["files"],
    "tool.pyright.include": TOOL["pyright"]["include"],
    "tool.pyright.extraPaths": TOOL["pyright"]["extraPaths"],
    "tool.ruff.src": TOOL["ruff"]["src"],
    "tool.ruff.lint.flake8-tidy-imports.banned-api": list(
        TOOL["ruff"]["lint"]["flake8-tidy-imports"]["banned-api"]
    ),
}


@pytest.mark.parametrize("setting", WHERE)
def test_setting_names_every_room(setting: str) -> None:
    rooms = set(WHERE[setting]) - {"tests", "docs"}
    assert rooms == _rooms_on_disk(), f"pyproject.toml: {setting} and the folders disagree"


def test_import_contract_names_every_room() -> None:
    named = {name.strip() for layer in _layers() for name in layer.split("|")}
    assert named == {path.name for path in ROOT.glob("*/palpate*") if path.is_dir()}


def test_every_room_but_two_has_an_extra() -> None:
    """``protos`` and ``deploy`` come with every install; the others have an extra each."""
    extras = set(SETTINGS["project"]["optional-dependencies"])
    assert extras >= (_rooms_on_disk() - {"protos", "deploy"}) | {"dev", "all"}


def test_torch_is_pinned_alike_in_makefile_and_settings() -> None:
    training = SETTINGS["project"]["optional-dependencies"]["training"]
    (pin,) = [requirement for requirement in training if requirement.startswith("torch")]
    assert f"TORCH := {pin}\n" in (ROOT / "Makefile").read_text(encoding="utf-8")
