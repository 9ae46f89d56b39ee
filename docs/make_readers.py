"""Write docs/results/readers.md from docs/results/readers.json.

``python docs/make_readers.py``          writes the page
``python docs/make_readers.py --check``  exits 1 if the page is not what the file says

``make readers`` plays the readers anew.
"""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
FILE = Path(__file__).parent / "results" / "readers.json"
PAGE = FILE.with_suffix(".md")

HEAD = """# Five readers

How long a new user needs for the pages that [the index](../README.md) names, and what comes out. A
program plays each reader: `make readers` pastes the commands of the page, in order, into terminals
in a fresh folder with a fresh home, installs the wheel of `make build`, answers questions as the
page says, and checks the result. The emulators that the page starts play the hardware. A program
cannot show whether a person understands the page, and it does not open views in windows.
"""


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |\n"


def _summary(readers: list[dict[str, Any]]) -> Iterator[str]:
    yield _row(["reader has", "page", "minutes", "installation", "promised", "found"])
    yield _row(["---"] * 6)
    for one in readers:
        pages = ", then ".join(f"[{page}](../{page})" for page in one["pages"])
        if "skipped" in one:
            yield _row(
                [one["who"], pages, "-", "-", one["promise"], f"not tried: {one['skipped']}"]
            )
            continue
        found = one["found"] if "failed" not in one else f"**failed**: {one['failed'][:200]}"
        minutes = [f"{one['minutes']:.1f}", f"{one['install_minutes']:.1f}"]
        yield _row([one["who"], pages, *minutes, one["promise"], found])


def _steps(one: dict[str, Any]) -> Iterator[str]:
    yield f"\n## {one['who'][0].upper()}{one['who'][1:]}\n\n"
    yield _row(["command", "s"]) + _row(["---", "---"])
    for step in one.get("steps", ()):
        line = step["line"].replace("|", "\\|")
        yield _row([f"`{line}`", f"{step['seconds']:.1f}"])
    for text in one.get("left_out", ()):
        yield f"\nLeft out: {text}.\n"


def page(values: dict[str, Any]) -> str:
    """The page of a result."""
    readers = values["readers"]
    least, most = min(values["load"]), max(values["load"])
    where = (
        f"Python {values['python']}, {values['cores']} cores, {values['machine']}. Load average "
        f"before a reader began: {least:.1f} to {most:.1f}; above {values['cores']} the cores are "
        "shared with other work, and everything takes longer. An installation downloads nothing "
        "that pip's cache has.\n"
    )
    parts = "".join("".join(_steps(one)) for one in readers if "skipped" not in one)
    return f"{HEAD}\n{''.join(_summary(readers))}\n{where}{parts}"


if __name__ == "__main__":
    text = page(json.loads(FILE.read_text(encoding="utf-8")))
    sys.exit(FRESH["write_or_check"]({PAGE: text}))
