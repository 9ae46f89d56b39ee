"""Whether another program runs what a line of a page runs: the same commands, the same options."""

from __future__ import annotations

import ast
import functools
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.readers.page import blocks_of

ROOT = Path(__file__).resolve().parents[2]
CI = ROOT / ".ci" / "run"


@dataclass(frozen=True, slots=True)
class Words:
    """What a command line is made of, without its values.

    Attributes:
        commands: The program's subcommands in order, e.g. ``("data", "generate")``, or
            the target of make as the Makefile writes it.
        options: Its long options, e.g. ``{"--out"}``.
    """

    commands: tuple[str, ...]
    options: frozenset[str]


def words_of(line: str, palpate: Any) -> Words:
    """Words of a ``palpate`` or ``make`` line; ``palpate`` is the tree of its commands.

    Raises:
        ValueError: The line is of another program, of which no test can be expected.
    """
    program, *words = shlex.split(line.removeprefix("sudo "), comments=True)
    if Path(program).name not in {"palpate", "make"}:
        raise ValueError(f"{line}: only palpate and make are run elsewhere")
    options = frozenset(word.partition("=")[0] for word in words if word.startswith("--"))
    if program == "make":
        return Words(tuple(f"{word}:" for word in words if "=" not in word), options)
    commands: list[str] = []
    for word in words:
        if word.startswith("-") or not hasattr(palpate, "commands"):
            break
        commands.append(word)
        palpate = palpate.commands[word]
    return Words(tuple(commands), options)


def runs(file: Path, line: str, palpate: Any) -> bool:
    """Whether a test, another page or the script of continuous integration runs the line's words.

    A test may say them in one text or in several, and may enter at a group of commands
    (``runner.invoke(fem_app, ["run", "--sweep"])``). A command of one word has to be a text of its
    own, since prose is full of such words.
    """
    if file.suffix == ".md" and not _known(line):
        return line.partition(" #")[0].strip() in _pasted(file)
    wanted = words_of(line, palpate)
    if file.suffix == ".md":
        pasted = [words_of(one, palpate) for one in _pasted(file) if _known(one)]
        return any(
            one.commands == wanted.commands and one.options >= wanted.options for one in pasted
        )
    if file == CI:
        return line.partition("#")[0].strip() in file.read_text(encoding="utf-8").splitlines()
    spoken = _spoken(file)
    ways = [wanted.commands]
    if spoken.has_app and len(wanted.commands) > 1:
        ways.append(wanted.commands[1:])
    said = wanted.options <= set(spoken.words)
    return said and any(spoken.says(commands) for commands in ways)


def _known(line: str) -> bool:
    return line.startswith(("palpate ", "make "))


@functools.cache
def _pasted(page: Path) -> tuple[str, ...]:
    """Lines that a page's test runs as they are."""
    blocks = blocks_of(page.read_text(encoding="utf-8"))
    return tuple(line.partition(" #")[0].strip() for block in blocks for line in block.run)


@functools.cache
def _spoken(test: Path) -> _Speaker:
    """Texts of a program, without those that describe it."""
    speaker = _Speaker()
    speaker.visit(ast.parse(test.read_text(encoding="utf-8")))
    return speaker


class _Speaker(ast.NodeVisitor):
    """Collects the words of texts in order, and the texts that are one word."""

    def __init__(self) -> None:
        self.words: list[str] = []
        self.whole: set[str] = set()
        self.has_app = False

    def says(self, commands: tuple[str, ...]) -> bool:
        """Whether the commands stand one after another."""
        length = len(commands)
        if commands[0].endswith(":"):
            return any(re.search(rf"(?<!\w){commands[0]}", word) for word in self.words)
        if length == 1:
            return commands[0] in self.whole
        starts = range(len(self.words) - length + 1)
        return any(tuple(self.words[start : start + length]) == commands for start in starts)

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):  # a docstring is no command
            self.generic_visit(node)

    def visit_Name(self, node: ast.Name) -> None:
        self.has_app |= node.id.endswith("_app")

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, str):
            words = re.split(r"[\s=]+", node.value.strip())
            self.words += words
            if len(words) == 1:
                self.whole.add(words[0])
