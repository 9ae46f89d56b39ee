"""The table of docs/results/fuzz.md: one row for the last run of each decoder."""

from __future__ import annotations

import re
from dataclasses import astuple, dataclass
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "fuzz.md"

_HEAD = """# The decoders under a fuzzer

Result of the last run of `make fuzz DECODER=NAME SECONDS=600` for each decoder, and the size of
its corpus since then (`tests/fuzz/corpus/`, which `tests/fuzz/test_corpus.py` plays on every test
run). A target fails if a decoder raises an exception, keeps too much, finds different records in
the same bytes when they are cut differently, does not count a byte, or does not find the next good
frame (`tests/fuzz/targets/`). Seconds are CPU time of the fuzzer; branches and features are
libFuzzer's `cov` and `ft`.

| Decoder | Seconds | Executions | Branches | Features | Corpus: inputs | bytes | Crashes |
|---|---|---|---|---|---|---|---|
"""


@dataclass(frozen=True, slots=True)
class Row:
    """One run; the fields are the columns."""

    decoder: str
    seconds: int
    executions: int
    branches: int
    features: int
    inputs: int
    archive_bytes: int
    crashes: int


def write_row(row: Row) -> None:
    """Put a row in the place of the decoder's last one."""
    rows = {}
    if PAGE.exists():
        for line in re.findall(r"^\| (\w+ \|.*) \|$", PAGE.read_text("utf-8"), flags=re.MULTILINE):
            name, *cells = (cell.strip() for cell in line.split("|"))
            if cells[0].isdigit():
                rows[name] = cells
    rows[row.decoder] = [str(value) for value in astuple(row)[1:]]
    lines = [f"| {' | '.join([name, *cells])} |\n" for name, cells in sorted(rows.items())]
    PAGE.write_text(_HEAD + "".join(lines), "utf-8")
