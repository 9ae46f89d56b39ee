"""What a page of the documentation tells its reader to do: its commands, files and promises.

A page is Markdown. A block of ``sh`` is run in the page's own folder, line by line; a block of
``text`` behind it is what it prints, line for line as far as shown, with ``...`` for what varies; a
block of another language after ``<!-- file: NAME -->`` is that file. A comment before a block says
what else there is to know; several are parted by ``; ``:

``<!-- run by: FILE, FILE -->``       not as pasted, but there, with the same commands and options
``<!-- not run: REASON -->``          by no test, and why
``<!-- installs: FROM WHERE -->``     makes an environment
``<!-- background until: TEXT -->``   goes on in another terminal; the page continues after TEXT
``<!-- each until: TEXT -->``         each command goes on until TEXT and Ctrl-C
``<!-- answers: ONE | TWO -->``       what is typed where it asks; only Enter = nothing between
``<!-- stand-in for: FILE -->``       makes what one has not who has FILE
``<!-- needs data: FOLDER -->``       the rest of the page needs real recordings in ``$DATA``
``<!-- exits: CODE -->``              fails on purpose

The first two may be of some lines only: ``FILE [palpate top | palpate tare]``, ``REASON [docker]``
are of the lines that begin so. The others are run.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

BLOCK = re.compile(
    r"(?:^<!--\s(?P<marks>(?:(?!-->|```).)*)\s-->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
MARK = re.compile(
    r"(run by|not run|installs|background until|each until|answers|stand-in for|needs data|exits|"
    r"file):(?: (.*))?"
)


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block of a page, and what the comment before it says."""

    language: str
    text: str
    marks: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.text.strip()

    @property
    def lines(self) -> list[str]:
        """The commands; those that go on after a backslash are one, comments are none."""
        joined = self.text.replace("\\\n", " ")
        lines = [line.strip() for line in joined.splitlines()]
        return [line for line in lines if line and not line.startswith("#")]

    @property
    def left_out(self) -> dict[str, list[tuple[str, str]]]:
        """Lines that are not run as pasted: for each the marks that say so, (mark, why).

        Raises:
            ValueError: A mark is of lines that the block has not.
        """
        found: dict[str, list[tuple[str, str]]] = {}
        for mark in ("run by", "not run"):
            for why, starts in _reasons(mark, self.marks[mark]) if mark in self.marks else ():
                for start in starts:
                    lines = [line for line in self.lines if line.startswith(start)]
                    if not lines:
                        raise ValueError(f"{mark}: no line begins with {start!r}")
                    for line in lines:
                        found.setdefault(line, []).append((mark, why))
        return found

    @property
    def run(self) -> list[str]:
        """Commands that are run as pasted, in order."""
        if self.language != "sh":
            return []
        left_out = self.left_out
        return [line for line in self.lines if line not in left_out]


def _reasons(mark: str, value: str) -> list[tuple[str, list[str]]]:
    """What a mark names, each with how its lines begin; "" begins every line."""
    parts = value.split(", ") if mark == "run by" else [value]
    found = [re.fullmatch(r"(.*?)(?: \[(.*)\])?", part) for part in parts]
    return [(one[1], one[2].split(" | ") if one[2] else [""]) for one in found if one is not None]


def blocks_of(page: str) -> list[Block]:
    """Fenced blocks in order.

    Raises:
        ValueError: A comment before a block is none of the known marks.
    """
    found = []
    for match in BLOCK.finditer(page):
        marks = {}
        comment = None if match["marks"] is None else " ".join(match["marks"].split())
        for mark in comment.split("; ") if comment is not None else ():
            known = MARK.fullmatch(mark)
            if known is None:
                raise ValueError(f"<!-- {comment} --> is no mark of a block")
            marks[known[1]] = (known[2] or "").strip()
        found.append(Block(match["language"], match["text"], marks))
    return found


def missing_lines(promised: str, printed: str) -> list[str]:
    """Lines that a page promises and that were not printed, in this order."""
    lines = iter([" ".join(line.split()) for line in printed.splitlines()])
    missing = []
    for promise in promised.splitlines():
        words = " ".join(promise.split())
        pattern = ".*".join(re.escape(part.strip()) for part in words.split("..."))
        if words and words != "..." and not any(re.fullmatch(pattern, line) for line in lines):
            missing.append(promise)
    return missing
