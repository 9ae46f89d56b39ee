"""The product's modules as a whole: how many, how they import one another, what they are called."""

from __future__ import annotations

import ast
import runpy
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

FILES_MAX = 570
"""Product files, without what protoc generates."""

FRAGMENTS_MAX = 25
"""Short files with a single importer: an idea cut in two, which is read together anyway."""

FRAGMENT_LINES = 110


# The program that draws the house knows its modules and their imports.
HOUSE = runpy.run_path(str(ROOT / "docs" / "make_house.py"))


@dataclass(frozen=True, slots=True)
class _Module:
    path: Path
    tree: ast.Module
    lines: int


def _read(folder: Path) -> dict[str, _Module]:
    """Dotted name -> module, of every product file that was written by hand."""
    found = {}
    for name, path in HOUSE["product_modules"](folder).items():
        text = path.read_text(encoding="utf-8")
        found[name] = _Module(path, ast.parse(text), len(text.splitlines()))
    return found


def _imports(modules: Mapping[str, _Module]) -> dict[str, set[str]]:
    """Module -> the product's modules that it imports, also inside functions and for types only."""
    graph: dict[str, set[str]] = HOUSE["import_graph"](
        {name: module.path for name, module in modules.items()}
    )
    return graph


def _circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Modules that import one another in a circle; empty if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        circle: list[str] = error.args[1]
        return circle
    return []


def _fragments(modules: Mapping[str, _Module], graph: Mapping[str, set[str]]) -> list[str]:
    """Short modules with a single importer."""
    importers: dict[str, set[str]] = defaultdict(set)
    for name, imported in graph.items():
        for other in imported:
            importers[other].add(name)
    return [
        f"{name} ({module.lines} lines) <- {next(iter(importers[name]))}"
        for name, module in modules.items()
        if len(importers[name]) == 1
        and module.lines < FRAGMENT_LINES
        and module.path.name != "__init__.py"
    ]


def _shared_names(modules: Mapping[str, _Module]) -> dict[str, list[str]]:
    """Class name -> the modules that define it at their top level, where they are several."""
    homes: dict[str, list[str]] = defaultdict(list)
    for name, module in modules.items():
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(name)
    return {name: found for name, found in homes.items() if len(found) > 1}


@pytest.fixture(scope="module")
def modules() -> dict[str, _Module]:
    """The product."""
    return _read(ROOT)


@pytest.fixture(scope="module")
def graph(modules: dict[str, _Module]) -> dict[str, set[str]]:
    """Who imports whom."""
    return _imports(modules)


def test_product_has_few_files(modules: dict[str, _Module]) -> None:
    assert len(modules) <= FILES_MAX, "join files that are only read together"


def test_no_circle_of_imports(graph: dict[str, set[str]]) -> None:
    assert not _circle(graph)


def test_few_files_are_fragments(modules: dict[str, _Module], graph: dict[str, set[str]]) -> None:
    fragments = _fragments(modules, graph)
    assert len(fragments) <= FRAGMENTS_MAX, "join them with their importer:\n" + "\n".join(
        sorted(fragments)
    )


def test_no_two_classes_share_a_name(modules: dict[str, _Module]) -> None:
    """In an error message a class has no module beside it."""
    assert not _shared_names(modules)


def test_codecs_are_named_in_the_table_of_endpoints_only(modules: dict[str, _Module]) -> None:
    """`palpate.bus` has one table of services with their messages; no call repeats it."""
    callers = {
        module.path.relative_to(ROOT).as_posix()
        for module in modules.values()
        for node in ast.walk(module.tree)
        if isinstance(node, ast.keyword) and node.arg in {"request_codec", "reply_codec"}
    }
    assert not callers


@pytest.fixture
def small_house(tmp_path: Path) -> Path:
    """Two modules of a room: a circle of imports, a name that stands twice, a fragment."""
    folder = tmp_path / "fem" / "palpate_fem"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "a.py").write_text("from palpate_fem import b\n\n\nclass Step: ...\n")
    (folder / "b.py").write_text(
        "def f():\n    from palpate_fem.a import Step\n\n\nclass Step: ...\n"
    )
    return tmp_path


def test_each_fault_is_found_where_it_is_planted(small_house: Path) -> None:
    found = _read(small_house)
    graph = _imports(found)
    assert set(found) == {"palpate_fem", "palpate_fem.a", "palpate_fem.b"}
    assert set(_circle(graph)) == {"palpate_fem.a", "palpate_fem.b"}
    assert _shared_names(found) == {"Step": ["palpate_fem.a", "palpate_fem.b"]}
    assert len(_fragments(found, graph)) == 2
