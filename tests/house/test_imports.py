"""Who may import whom: the contracts hold, and each is seen to catch a planted violation."""

from __future__ import annotations

import ast
import functools
import site
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("protos", "gateway", "fem", "training", "services", "deploy")
PACKAGES = {room: "palpate" if room == "protos" else f"palpate_{room}" for room in ROOMS}
ROOM_OF = {package: room for room, package in PACKAGES.items()}
LINTER: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "tool"
]["importlinter"]

# Packages with one home.  import-linter can forbid a package to a room but cannot say "only here".
# What the bare floor of the benchmark uses, because it must not use palpate's own code.
FLOOR = "deploy/palpate_deploy/bench/floor.py"
STRANGER = "deploy/palpate_deploy/bench/strangers.py"  # keeps to no contract

HOMES = {
    "zenoh": ("protos/palpate/bus/", FLOOR, STRANGER),
    # The bare reader of the benchmark must not use palpate's own ports.
    "serial": ("gateway/", "deploy/palpate_deploy/bench/hand_parts.py"),
    "can": ("gateway/", "deploy/palpate_deploy/bench/hand_parts.py"),
    "torch": ("training/",),
    "warp": ("fem/",),
    "onnxruntime": ("services/", "training/palpate_training/learning/export.py", FLOOR),
    "rerun": ("services/",),
    "google": ("protos/",),
    "palpate.v1": ("protos/", FLOOR),
}

# file to plant in, line to plant, a word of the contract that must catch it
PLANTS = [
    ("services/palpate_services/planted.py", "import palpate_gateway", "Rooms share only palpate"),
    ("protos/palpate/planted.py", "import palpate_training", "Rooms share only palpate"),
    ("gateway/palpate_gateway/planted.py", "import palpate_deploy", "Rooms share only palpate"),
    (
        "gateway/palpate_gateway/planted.py",
        "from palpate.v1 import frames_pb2",
        "generated wire classes",
    ),
    ("gateway/palpate_gateway/planted.py", "import zenoh", "palpate.bus speaks Zenoh"),
    ("protos/palpate/codec/planted.py", "import zenoh", "Messages are plain data"),
    ("services/palpate_services/planted.py", "import serial", "Ports stay in the gateway"),
    ("services/palpate_services/planted.py", "import torch", "Torch stays in training"),
    ("services/palpate_services/planted.py", "import warp", "Warp stays in fem"),
    ("fem/palpate_fem/indenter/planted.py", "import palpate_fem.store", "Inside fem"),
    ("protos/palpate/messages/planted.py", "import palpate.bus", "Inside palpate"),
    (
        "training/palpate_training/datasets/planted.py",
        "import palpate_training.learning",
        "Inside training",
    ),
    ("gateway/palpate_gateway/ports/planted.py", "import palpate_gateway.tare", "Inside gateway"),
    (
        "gateway/palpate_gateway/emulators/planted.py",
        "import palpate_gateway.protocols",
        "Emulators are written from the page",
    ),
]


def _lint(sources: Path, settings: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the rooms below ``sources`` only.

    ``-S`` leaves out the ``.pth`` file of the editable install, which would mix in the real rooms.
    """
    paths = [str(sources / room) for room in ROOMS]
    packages = [
        sysconfig.get_path("purelib"),
        sysconfig.get_path("platlib"),
        *site.getsitepackages(),
    ]
    program = (
        f"import sys; sys.path[:0] = {paths!r}; sys.path += {packages!r}\n"
        "from importlinter.cli import lint_imports_command\n"
        f"lint_imports_command(['--config', {str(settings)!r}, '--no-cache'])"
    )
    return subprocess.run(
        [sys.executable, "-S", "-c", program],
        cwd=sources,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def _write(path: Path, text: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


@pytest.fixture
def stub_house(tmp_path: Path) -> Path:
    """Our rooms as empty modules, with every module that a contract names, under our settings."""
    for room, package in PACKAGES.items():
        _write(tmp_path / room / package / "__init__.py")
    _write(tmp_path / "protos/palpate/v1/frames_pb2.py")
    _write(tmp_path / "protos/palpate/v1/__init__.py")
    for contract in LINTER["contracts"]:
        layered = [
            f"{container}.{name}"
            for container in contract.get("containers", ())
            for layer in contract["layers"]
            for name in layer.split(" | ")
        ]
        named = (*contract.get("source_modules", ()), *contract.get("forbidden_modules", ()))
        for name in (*layered, *named):
            parts = name.split(".")
            if parts[0] in ROOM_OF and len(parts) > 1:
                _write(tmp_path.joinpath(ROOM_OF[parts[0]], *parts, "__init__.py"))
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    _write(tmp_path / "pyproject.toml", text[text.index("[tool.importlinter]") :])
    return tmp_path


def test_contracts_hold() -> None:
    result = _lint(ROOT, ROOT / "pyproject.toml")
    assert result.returncode == 0, result.stdout + result.stderr


def test_contracts_hold_on_the_stub_house(stub_house: Path) -> None:
    """Else the planted violations below would prove nothing."""
    result = _lint(stub_house, stub_house / "pyproject.toml")
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(("where", "line", "contract"), PLANTS)
def test_planted_violation_is_caught(
    stub_house: Path, where: str, line: str, contract: str
) -> None:
    _write(stub_house / where, f'"""Planted."""\n{line}\n')
    result = _lint(stub_house, stub_house / "pyproject.toml")
    assert result.returncode == 1, result.stdout + result.stderr
    broken = [text for text in result.stdout.splitlines() if text.endswith("BROKEN")]
    assert any(contract in text for text in broken), result.stdout


def test_every_contract_has_a_planted_violation() -> None:
    words = [word for _, _, word in PLANTS]
    names = [contract["name"] for contract in LINTER["contracts"]]
    assert not [name for name in names if not any(word in name for word in words)]


@functools.cache  # each package below looks at every file
def _imported(path: Path) -> frozenset[str]:
    """Every module that a file imports, also inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


@pytest.mark.parametrize("package", HOMES)
def test_package_is_imported_only_at_home(package: str) -> None:
    strangers = []
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            name = path.relative_to(ROOT).as_posix()
            if name.startswith(HOMES[package]):
                continue
            if any(f"{found}.".startswith(f"{package}.") for found in _imported(path)):
                strangers.append(name)
    assert not strangers, f"{package} may be imported only in {HOMES[package]}"
