"""What a page of the documentation tells its reader to do: its commands, files and promises.

A page is Markdown. A block of ``sh`` is run in the page's own folder; a block of ``text`` after it
is what it prints, line for line as far as shown, with ``...`` for what varies; a block of another
language after ``<!-- file: NAME -->`` is that file. A comment before a block says what else there
is to know; several are parted by ``; ``:

``<!-- not run: REASON -->``          not by a program, and why
``<!-- make readers: REASON -->``     by ``make readers`` alone, and why
``<!-- background until: TEXT -->``   goes on in another terminal; the page continues after TEXT
``<!-- answers: ONE | TWO -->``       what is typed where it asks; only Enter = nothing between
``<!-- stand-in for: FILE -->``       makes what one has not who has FILE
``<!-- needs data: FOLDER -->``       the rest of the page needs real recordings in ``$DATA``
``<!-- exits: CODE -->``              fails on purpose
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

BLOCK = re.compile(
    r"(?:^<!-- (?P<marks>[^\n]*) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
MARK = re.compile(
    r"(not run|make readers|background until|answers|stand-in for|needs data|exits|file):(?: (.*))?"
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
        """The commands; those that go on after a backslash are one."""
        joined = self.text.replace("\\\n", " ")
        return [line.strip() for line in joined.splitlines() if line.strip()]


def blocks_of(page: str) -> list[Block]:
    """Fenced blocks in order.

    Raises:
        ValueError: A comment before a block is none of the known marks.
    """
    found = []
    for match in BLOCK.finditer(page):
        marks = {}
        for mark in (match["marks"] or "").split("; ") if match["marks"] is not None else ():
            known = MARK.fullmatch(mark)
            if known is None:
                raise ValueError(f"<!-- {match['marks']} --> is no mark of a block")
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
