"""Files hold one idea: they are named after it, and split before they hold two."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

LINES_WARN = 600
LINES_MAX = 800
NAMES_THAT_SAY_NOTHING = {
    "utils",
    "util",
    "helpers",
    "helper",
    "common",
    "misc",
    "manager",
    "tools",
}


def _python(files: list[Path]) -> list[Path]:
    return [path for path in files if path.suffix == ".py" and not path.stem.endswith("_pb2")]


def test_no_file_is_long(project_files: list[Path], relative: Callable[[Path], str]) -> None:
    lengths = {
        relative(path): len(path.read_text(encoding="utf-8").splitlines())
        for path in _python(project_files)
    }
    long = {name: lines for name, lines in lengths.items() if lines > LINES_MAX}
    growing = {name: lines for name, lines in lengths.items() if LINES_WARN < lines <= LINES_MAX}
    if growing:
        warnings.warn(f"more than {LINES_WARN} lines; one idea a file: {growing}", stacklevel=1)
    assert not long, f"more than {LINES_MAX} lines; one idea a file: {long}"


def test_no_name_says_nothing(project_files: list[Path], relative: Callable[[Path], str]) -> None:
    vague = [
        relative(path)
        for path in _python(project_files)
        if path.stem in NAMES_THAT_SAY_NOTHING
        or (path.name == "__init__.py" and path.parent.name in NAMES_THAT_SAY_NOTHING)
    ]
    assert not vague, f"name the file after the domain it serves: {vague}"
