"""Each room holds one plain package, and nothing else that can be imported.

Why: docs/adr/0018-a-package-for-each-room.md.
"""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("protos", "gateway", "fem", "training", "services", "deploy")
PACKAGES = {room: "palpate" if room == "protos" else f"palpate_{room}" for room in ROOMS}

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
def test_room_holds_one_package_and_no_other_python(room: str) -> None:
    """A room is on ``sys.path``: anything importable beside its package would be a second name."""
    leaks = []
    for entry in _visible(ROOT / room):
        if entry.name == PACKAGES[room]:
            continue
        if entry.is_dir():
            # deploy also holds folders of data: systemd units, udev rules, firmware in C
            if room != "deploy" or any(entry.rglob("*.py")) or entry.name in DEPENDENCIES:
                leaks.append(entry.name)
        elif entry.suffix in {".py", ".pyi", ".so", ".pth"}:
            leaks.append(entry.name)
    assert not leaks, f"{room}/ may hold {PACKAGES[room]}/ and documents only; move {leaks}"


@pytest.mark.parametrize("room", ROOMS)
def test_room_says_what_it_is(room: str) -> None:
    readme = ROOT / room / "README.md"
    assert readme.is_file(), f"{room}/README.md: what the room is for and where to start reading"
    assert readme.read_text(encoding="utf-8").startswith("# ")
    package = ROOT / room / PACKAGES[room]
    assert (package / "py.typed").is_file(), f"{package.relative_to(ROOT)}/py.typed is missing"
    assert '"""' in (package / "__init__.py").read_text(encoding="utf-8")


def test_every_package_has_an_init() -> None:
    """Inside a room folders are ordinary packages; without ``__init__`` it works by accident."""
    missing = {
        path.parent.relative_to(ROOT).as_posix()
        for room in ROOMS
        for path in (ROOT / room).rglob("*.py")
        if not (path.parent / "__init__.py").is_file()
    }
    assert not missing


def test_no_module_is_named_like_a_dependency() -> None:
    shadows = [
        path.relative_to(ROOT).as_posix()
        for room in ROOMS
        for path in (ROOT / room).rglob("*.py")
        if path.stem in DEPENDENCIES
        or (path.name == "__init__.py" and path.parent.name in DEPENDENCIES)
    ]
    assert not shadows


def test_tests_are_no_packages() -> None:
    """With importlib mode test files need no ``__init__``, and two may have the same name."""
    assert not list((ROOT / "tests").rglob("__init__.py"))
