"""What the programs that write pages share; they load it by its path, as they are run by theirs."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path


def write_or_check(wanted: Mapping[Path, str]) -> int:
    """Write each file, or with ``--check`` compare it; the exit code, 1 if one is out of date."""
    if "--check" not in sys.argv[1:]:
        for path, text in wanted.items():
            path.write_text(text, encoding="utf-8")
        return 0
    stale = [
        path.name
        for path, text in wanted.items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    ]
    if stale:
        program = Path(sys.argv[0]).name
        sys.stderr.write(f"{', '.join(stale)}: out of date; run: python docs/{program}\n")
    return 1 if stale else 0


def table(columns: str, rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table; the columns' headings are one text, with ``|`` between them."""
    heads = [column.strip() for column in columns.split("|")]
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
