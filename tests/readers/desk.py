"""A reader's desk: terminals in which the commands of a page run, line by line."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.readers.page import Block, blocks_of, missing_lines
from tests.readers.terminal import Terminal, Unexpected, plain

from palpate.process import Closing

CHECKOUT = "<this repository>"
"""Where a page says to clone from."""
LIMIT_S = 1200.0
"""For one command, on a host with other work."""


class Desk(Closing):
    """The terminals of a reader, and what was done in them.

    Attributes:
        folder: Where the reader is now.
        printed: Output of each command, by its line.
        steps: Each command with its time [s], and whether it installs.
    """

    def __init__(
        self,
        folder: Path,
        variables: Mapping[str, str],
        *,
        prefix: Sequence[str] = (),
        source: str = "",
        here: Mapping[str, str] | None = None,
        data: Path,
    ) -> None:
        """Sit down.

        Args:
            folder: Where the reader begins.
            variables: Environment of each terminal.
            prefix: What a command line begins with to be in the reader's network.
            source: Command that enters an environment that is there already.
            here: What is written for something on a page, e.g. for an address.
            data: Folder of real recordings.
        """
        self.folder, self._first, self._variables = folder, folder, variables
        self._prefix, self._source, self._here, self._data = prefix, source, here or {}, data
        self._stack = ExitStack()
        self._front: Terminal | None = None
        self._running: list[tuple[str, Terminal]] = []
        self._all: list[Terminal] = []
        self.printed: dict[str, str] = {}
        self.steps: list[dict[str, Any]] = []

    def close(self) -> None:
        """Close all terminals, and end what runs in them."""
        self._stack.close()

    def follow(self, path: Path, *, again: bool = False) -> list[str]:
        """Do what a page says; which commands were left out, and why.

        ``again``: the environment is there.

        Raises:
            Unexpected: Something is not as the page says.
        """
        printed, left_out = "", []
        for block in blocks_of(path.read_text(encoding="utf-8")):
            marks = block.marks
            if marks.get("needs data") and not (self._data / marks["needs data"]).is_dir():
                left_out.append(f"the rest of {path.name}: no ../shared/data/{marks['needs data']}")
                break
            if "file" in marks:
                file = self.folder / marks["file"]
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(self._pasted(block.text), encoding="utf-8")
            elif block.language == "sh":
                for line, reasons in block.left_out.items():
                    left_out.extend(f"`{line}`: {mark}: {why}" for mark, why in reasons)
                there = marks.get("stand-in for") and (self._first / marks["stand-in for"]).exists()
                skip = there or (again and "installs" in marks) or not block.run
                printed = "" if skip else self.do(block)
            elif block.language == "text" and printed:
                if missing := missing_lines(block.text, printed):
                    raise Unexpected(f"{path.name} promises {missing}; printed was\n{printed}")
        return left_out

    def do(self, block: Block) -> str:
        """Run a block; what it printed.

        Raises:
            Unexpected: A command fails, or does not do what the block's marks say.
        """
        install = "installs" in block.marks
        if install or "background until" in block.marks or self._front is None:
            terminal = self._open(() if install else self._prefix)
        else:
            terminal = self._front
        printed = ""
        if "each until" in block.marks:
            for line in block.run:
                printed += self._until(terminal, line, block.marks["each until"])
            return printed
        for number, line in enumerate(block.run, 1):
            printed += self._line(terminal, line, block, last=number == len(block.run))
        if install:
            self.folder = terminal.folder
            terminal.close()
            self._front = None
        elif "background until" in block.marks:
            self._running.append((block.run[-1], terminal))
        else:
            self._front = terminal
        return printed

    def _line(self, terminal: Terminal, line: str, block: Block, *, last: bool) -> str:
        answers = block.marks["answers"].split("|") if last and "answers" in block.marks else []
        answers = [answer.strip() for answer in answers]
        pasted = self._pasted(line)
        sys.stderr.write(f"  $ {line}\n")
        began_s = time.monotonic()
        if last and "background until" in block.marks:
            text = terminal.start(
                pasted, block.marks["background until"], answers=answers, timeout_s=LIMIT_S
            )
        else:
            code, text = terminal.run(pasted, answers=answers, timeout_s=LIMIT_S)
            expected = int(block.marks.get("exits", 0)) if last else 0
            if code != expected:
                raise Unexpected(f"$ {line}\nexit {code}\n{text}")
            if line.startswith("source "):
                self._source = line.replace("source ", f"source {terminal.folder}/", 1)
        took_s = time.monotonic() - began_s
        sys.stderr.write(f"    {took_s:.1f} s\n")
        install = "installs" in block.marks
        self.steps.append({"line": line, "seconds": round(took_s, 1), "install": install})
        self.printed[line] = text
        return text

    def _until(self, terminal: Terminal, line: str, text: str) -> str:
        """Run a command that goes on; Ctrl-C as soon as it has printed the text."""
        block = Block("sh", line, {"background until": text})
        printed = self._line(terminal, line, block, last=True)
        return printed + _ended(line, terminal)

    def _pasted(self, text: str) -> str:
        """Text of a page as it is written here."""
        for there, here in self._here.items():
            text = text.replace(there, here)
        return text

    def _open(self, prefix: Sequence[str]) -> Terminal:
        """A new terminal where the reader is, with the environment that he has activated."""
        terminal = self._stack.enter_context(Terminal(self.folder, self._variables, prefix))
        self._all.append(terminal)
        terminal.run("set -o pipefail", timeout_s=60)
        if self._source:
            terminal.run(self._source, timeout_s=60)
        return terminal

    def end_page(self) -> None:
        """Ctrl-C in the other terminals, the last first.

        Raises:
            Unexpected: A program shows a traceback when it is ended.
        """
        for line, terminal in reversed(self._running):
            _ended(line, terminal)
        self._running.clear()

    def log(self) -> str:
        """What all terminals showed."""
        parts = [f"==== terminal {n}\n{plain(one.shown)}\n" for n, one in enumerate(self._all, 1)]
        return "".join(parts)


def _ended(line: str, terminal: Terminal) -> str:
    """Ctrl-C; what the command still said.

    Raises:
        Unexpected: It shows a traceback.
    """
    _code, text = terminal.interrupt(LIMIT_S)
    if "Traceback" in text:
        raise Unexpected(f"$ {line}\nCtrl-C\n{text}")
    return text
