"""Documents say what is so: links lead somewhere, commands exist, generated pages are fresh."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate import errors

ROOT = Path(__file__).resolve().parents[2]
MIRROR = [10, 11, 12, 13, 14, 15, 6, 8, 7, 9, 0, 1, 2, 3, 4, 5, 16, 17, 18]
"""Electrode indices after y -> -y; bilateral symmetry is exact in the published table."""

FENCE = re.compile(r"^```.*?\n(.*?)^```", flags=re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


@pytest.fixture(scope="module")
def pages(project_files: list[Path]) -> dict[Path, str]:
    """Every markdown file."""
    return {p: p.read_text(encoding="utf-8") for p in project_files if p.suffix == ".md"}


def _anchors(page: str) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ +(.*)$", FENCE.sub("", page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _code(page: str) -> Iterator[str]:
    """Lines of code blocks, without prompts and comments, and code spans in the text."""
    for block in FENCE.findall(page):
        for line in block.replace("\\\n", " ").splitlines():
            yield line.strip().removeprefix("$ ").partition(" #")[0].strip()
    yield from SPAN.findall(FENCE.sub("", page))


def test_links_lead_somewhere(pages: dict[Path, str], relative: Callable[[Path], str]) -> None:
    broken = []
    for path, page in pages.items():
        for link in LINK.findall(FENCE.sub("", page)):
            if re.match(r"[a-z]+:", link):
                continue
            target, _, anchor = link.partition("#")
            file = (path.parent / target).resolve() if target else path
            if not file.exists():
                broken.append(f"{relative(path)}: {link}")
            elif anchor and anchor not in _anchors(file.read_text(encoding="utf-8")):
                broken.append(f"{relative(path)}: {link} (no such heading)")
    assert not broken


def test_make_targets_exist(pages: dict[Path, str], relative: Callable[[Path], str]) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z]+):", makefile, flags=re.MULTILINE))
    unknown = [
        f"{relative(path)}: {code}"
        for path, page in pages.items()
        for code in _code(page)
        for target in re.findall(r"(?:^|&& |; )make(?: [A-Z]+=\S+)* ([a-z][\w-]*)", code)
        if target not in targets
    ]
    assert not unknown


def test_makefile_describes_every_target() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (phony,) = re.findall(r"^\.PHONY: (.*)$", makefile, flags=re.MULTILINE)
    described = re.findall(r"^([a-z]+):.*## \S", makefile, flags=re.MULTILINE)
    assert sorted(phony.split()) == sorted(described)
    assert set(described) >= {"setup", "demo", "test", "check", "bench", "docs"}


def test_make_bench_runs_programs_that_need_no_options() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (names,) = re.findall(r"for bench in ([a-z ]+);", makefile)
    for name in names.split():
        program = ROOT / "tests" / "benchmarks" / f"bench_{name}.py"
        assert "required=True" not in program.read_text(encoding="utf-8"), program


@pytest.fixture(scope="module")
def command() -> Any:
    """The tree of `palpate` commands."""
    typer = importlib.import_module("typer")
    cli = importlib.import_module("palpate_deploy.cli.app")
    return typer.main.get_command(cli.app)


def _problem(line: str, command: Any) -> str | None:
    """What is wrong with a `palpate ...` line, seen by the tree of commands; None = nothing."""
    try:
        words = shlex.split(line)[1:]
    except ValueError:
        return "cannot be read as a shell line"
    known = {option for param in command.params for option in param.opts} | {"--help"}
    for word in words:
        if word in {"|", ">", "&&", ";", "&", "..."}:
            break
        if word.startswith("--"):
            name = word.partition("=")[0]
            if name not in known:
                return f"no option {name}"
        elif hasattr(command, "commands"):
            for alternative in word.split("|"):
                if alternative not in command.commands:
                    return f"no command {alternative}"
            command = command.commands[word.split("|")[0]]
            known |= {opt for p in command.params for opt in (*p.opts, *p.secondary_opts)}
    return None


def test_palpate_commands_exist(
    pages: dict[Path, str], relative: Callable[[Path], str], command: Any
) -> None:
    wrong = []
    for path, page in pages.items():
        for code in _code(page):
            line = code.removeprefix(".venv/bin/")
            if line.startswith("palpate ") and (problem := _problem(line, command)):
                wrong.append(f"{relative(path)}: `{line}`: {problem}")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for line in re.findall(r"^\t@?\$\(BIN\)/(palpate .*)$", makefile, flags=re.MULTILINE):
        if problem := _problem(line, command):
            wrong.append(f"Makefile: `{line}`: {problem}")
    assert not wrong


@pytest.mark.parametrize(
    "program",
    [
        "make_messages.py",
        "make_asyncapi.py",
        "make_chaos.py",
        "make_failures.py",
        "make_fleet.py",
        "make_house.py",
        "make_install.py",
        "make_models.py",
        "make_numbers.py",
        "make_readers.py",
        "make_serving.py",
        "make_study.py",
    ],
)
def test_generated_documents_are_fresh(program: str) -> None:
    if program == "make_messages.py":
        pytest.importorskip("grpc_tools", reason="grpcio-tools not installed (extra dev)")
    result = subprocess.run(
        [sys.executable, f"docs/{program}", "--check"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr


def test_tree_of_errors_is_the_one_in_the_code() -> None:
    page = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    (block,) = [block for block in FENCE.findall(page) if block.startswith("PalpateError")]
    drawn: dict[str, tuple[str, ...]] = {}
    above: list[str] = []
    for line in block.splitlines():
        found = re.match(r"([│├└─ ]*)(\w+)(?:\((\w+)\))?", line)
        assert found, line
        stem, name, builtin = found.groups()
        del above[len(stem) // 4 :]
        drawn[name] = (*above[-1:], *([builtin] if builtin else []))
        above.append(name)
    coded = {
        name: tuple(base.__name__ for base in value.__bases__)
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, errors.PalpateError)
    }
    assert drawn == coded | {"PalpateError": ()}


def _electrodes() -> tuple[Any, Any]:
    """Positions [mm] and normals in the table of docs/conventions.md, each shape (19, 3)."""
    page = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| E\d+ \|((?: -?\d+\.\d+ \|){6})$", page, flags=re.MULTILINE)
    table = np.array([[float(value) for value in row.split("|")[:-1]] for row in rows])
    assert table.shape == (19, 6)
    return table[:, :3], table[:, 3:]


def test_electrode_table_is_mirror_symmetric_with_unit_normals() -> None:
    positions, normals = _electrodes()
    flip = np.array([1.0, -1.0, 1.0])
    np.testing.assert_array_equal(positions[MIRROR] * flip, positions)
    np.testing.assert_array_equal(normals[MIRROR] * flip, normals)
    # three printed digits
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=2e-3)


def test_electrode_tables_in_the_code_are_the_documented_one(project_files: list[Path]) -> None:
    positions, _ = _electrodes()
    found = []
    for path in project_files:
        if path.suffix != ".py" or "palpate" not in path.parts:
            continue
        if not re.search(r"^ELECTRODE_POSITIONS\b", path.read_text("utf-8"), flags=re.MULTILINE):
            continue
        parts = path.relative_to(ROOT).with_suffix("").parts[1:]
        module = importlib.import_module(".".join(parts))
        # float32 holds 14 mm to 1 nm
        np.testing.assert_allclose(
            np.asarray(module.ELECTRODE_POSITIONS) * 1e3, positions, atol=1e-5, err_msg=str(path)
        )
        found.append(path)
    assert found, "no module defines ELECTRODE_POSITIONS; did it move or change its name?"


def test_decisions_are_numbered_listed_and_complete(pages: dict[Path, str]) -> None:
    folder = ROOT / "docs" / "adr"
    index = pages[ROOT / "docs" / "README.md"]
    numbers = []
    for path in sorted(folder.glob("*.md")):
        page = pages[path]
        number = path.name[:4]
        numbers.append(int(number))
        assert page.startswith(f"# {number}: "), path.name
        sections = re.findall(r"^## (.*)$", page, flags=re.MULTILINE)
        assert sections == ["Motivation", "Approach", "Alternatives", "Testing"], path.name
        assert "**Status:**" in page, path.name
        assert f"adr/{path.name}" in index, f"docs/README.md does not list {path.name}"
    assert numbers == list(range(len(numbers)))
