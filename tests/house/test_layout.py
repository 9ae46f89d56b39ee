"""The folders are laid out so that `palpate` is one name and nothing else leaks.

Why each rule exists: docs/adr/0001-import-names.md.
"""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("protos", "gateway", "fem", "training", "services", "deploy")
PARTS = {room: {room} for room in ROOMS} | {"protos": {"protos", "v1"}}

# Top-level import names of what we depend on.  A module of ours with such a name, run by its path,
# would shadow the package.
DEPENDENCIES = {
    "can", "h5py", "hypothesis", "matplotlib", "mcap", "numpy", "onnx", "onnxruntime",
    "onnxscript", "pydantic", "pytest", "rerun", "rich", "scipy", "serial", "supervisor", "torch",
    "typer", "warp", "zenoh",
}  # fmt: skip


def _visible(folder: Path) -> list[Path]:
    return [p for p in folder.iterdir() if p.name != "__pycache__" and not p.name.startswith(".")]


@pytest.mark.parametrize("room", ROOMS)
def test_namespace_has_no_init(room: str) -> None:
    """A stray ``palpate/__init__.py`` would hide every other room in an editable install."""
    assert not (ROOT / room / "palpate" / "__init__.py").exists()


@pytest.mark.parametrize("room", ROOMS)
def test_source_root_holds_nothing_importable_beside_the_namespace(room: str) -> None:
    """A room is on ``sys.path``: a module or package beside ``palpate/`` would be a top-level one.

    ``deploy`` may also hold folders of data (profiles, units), as long as they hold no Python.
    """
    leaks = []
    for entry in _visible(ROOT / room):
        if entry.name == "palpate":
            continue
        if entry.is_dir():
            if room != "deploy" or any(entry.rglob("*.py")) or entry.name in DEPENDENCIES:
                leaks.append(entry.name)
        elif entry.suffix in {".py", ".pyi", ".so", ".pth"}:
            leaks.append(entry.name)
    assert not leaks, f"{room}/ may hold palpate/ and documents only; move {leaks}"


@pytest.mark.parametrize("room", ROOMS)
def test_namespace_holds_only_its_own_room(room: str) -> None:
    parts = {entry.name for entry in _visible(ROOT / room / "palpate")}
    assert parts == PARTS[room]


@pytest.mark.parametrize("room", ROOMS)
def test_room_says_what_it_is(room: str) -> None:
    readme = ROOT / room / "README.md"
    assert readme.is_file(), f"{room}/README.md: what the room is for, a line per file"
    assert readme.read_text(encoding="utf-8").startswith("# ")
    package = ROOT / room / "palpate" / room
    assert (package / "py.typed").is_file(), f"{package.relative_to(ROOT)}/py.typed is missing"
    assert '"""' in (package / "__init__.py").read_text(encoding="utf-8")


def test_every_package_has_an_init() -> None:
    """Inside a room folders are ordinary packages; without ``__init__`` it works by accident."""
    missing = {
        path.parent.relative_to(ROOT).as_posix()
        for room in ROOMS
        for path in (ROOT / room / "palpate" / room).rglob("*.py")
        if not (path.parent / "__init__.py").is_file()
    }
    assert not missing


def test_no_module_is_named_like_a_dependency() -> None:
    shadows = [
        path.relative_to(ROOT).as_posix()
        for room in ROOMS
        for path in (ROOT / room / "palpate").rglob("*.py")
        if path.stem in DEPENDENCIES
        or (path.name == "__init__.py" and path.parent.name in DEPENDENCIES)
    ]
    assert not shadows


def test_tests_are_no_packages() -> None:
    """With importlib mode test files need no ``__init__``, and two may have the same name."""
    assert not list((ROOT / "tests").rglob("__init__.py"))
