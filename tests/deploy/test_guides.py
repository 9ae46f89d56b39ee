"""The quick start and the guides: every command runs, in order, and prints what its page promises.

How a page is read: ``tests/readers/page.py``. What ``make readers`` alone runs is left out here.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.readers.page import Block, blocks_of, missing_lines

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "docs" / "quick-start.md", *sorted((ROOT / "docs" / "guides").glob("*.md"))]
LIMIT_S = 600.0
"""One block, on a host on which other tests run, too."""


class Terminal:
    """Runs the commands of a page; programs in the background end with it."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self._folder, self._environment = folder, environment
        self._running: list[subprocess.Popen[bytes]] = []

    def run(self, block: Block) -> str:
        """What a block prints; an AssertionError if it fails."""
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block.text],
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )
        expected = int(block.marks.get("exits", 0))
        assert done.returncode == expected, f"$ {block}\nexit {done.returncode}\n{done.stdout}"
        return done.stdout

    def start(self, block: Block) -> str:
        """Run a block in the background until it has printed what its mark says."""
        log = self._folder / f"background-{len(self._running)}.log"
        with log.open("wb") as out:
            process = subprocess.Popen(
                ["bash", "-euo", "pipefail", "-c", f"exec {block.text}"],
                cwd=self._folder,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._running.append(process)
        deadline = time.monotonic() + LIMIT_S
        words = block.marks["background until"]
        while words not in (printed := log.read_text(encoding="utf-8", errors="replace")):
            assert process.poll() is None, f"$ {block}\nended\n{printed}"
            assert time.monotonic() < deadline, f"$ {block}\nnever said {words!r}\n{printed}"
            time.sleep(0.1)
        return printed

    def end(self) -> None:
        """Ctrl-C in every other terminal, last first."""
        for process in reversed(self._running):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
                try:
                    process.wait(timeout=60)
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()


@contextmanager
def terminal(folder: Path, port: int) -> Iterator[Terminal]:
    """A folder like a checkout, and commands that meet on a router of their own."""
    for part in ("docs", "training"):
        (folder / part).symlink_to(ROOT / part)
    endpoint = f"tcp/127.0.0.1:{port}"
    data = ROOT.parent / "shared" / "data"
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("PALPATE_")
    } | {
        "PATH": f"{_commands(folder)}:{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join([str(folder / "installed"), *filter(None, sys.path)]),
        "PALPATE_ROUTER__LISTEN": f'["{endpoint}"]',
        "PALPATE_CONNECT": endpoint,
        "DATA": str(data),
        "COLUMNS": "120",
        # `pip install ./FOLDER` of a page: into the page's folder, without the network.
        "PIP_TARGET": str(folder / "installed"),
        "PIP_NO_BUILD_ISOLATION": "0",  # pip reads it as the option's value: no isolation
        "PIP_NO_DEPS": "1",
        "PIP_NO_INDEX": "1",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }
    running = Terminal(folder, environment)
    try:
        yield running
    finally:
        running.end()


def _commands(folder: Path) -> Path:
    """A folder with `palpate` and `python`: those of this interpreter, also if not installed."""
    commands = folder / "commands"
    commands.mkdir()
    for name, words in {"palpate": "-m palpate_deploy ", "python": ""}.items():
        command = commands / name
        command.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words}"$@"\n', encoding="utf-8")
        command.chmod(0o755)
    return commands


def test_every_block_says_what_it_is() -> None:
    """No block is left out without a reason, and none by its language."""
    wrong = []
    for path in PAGES:
        before = None
        for block in blocks_of(path.read_text(encoding="utf-8")):
            if block.language not in {"sh", "text", "python", "toml", "ini", "csv"}:
                wrong.append(f"{path.name}: a block of {block.language!r}")
            if block.language == "text" and (before is None or before.language != "sh"):
                wrong.append(f"{path.name}: {block} is printed by no command")
            if block.language not in {"sh", "text"} and "file" not in block.marks:
                wrong.append(f"{path.name}: {block} has no name of a file")
            for mark in ("not run", "make readers"):
                if len(block.marks.get(mark, "and why").split()) < 2:
                    wrong.append(f"{path.name}: {block} is not run, and no reason says why")
            before = block
    assert not wrong
    assert len(PAGES) > 5


@pytest.mark.slow
@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_commands_of_a_page_do_what_it_says(
    path: Path, tmp_path: Path, new_port: Callable[[], int]
) -> None:
    printed = ""
    with terminal(tmp_path, new_port()) as commands:
        for block in blocks_of(path.read_text(encoding="utf-8")):
            data = block.marks.get("needs data")
            if data and not (ROOT.parent / "shared" / "data" / data).is_dir():
                pytest.skip(f"the rest needs ../shared/data/{data}")
            if "file" in block.marks:
                file = tmp_path / block.marks["file"]
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(block.text, encoding="utf-8")
            elif block.marks.keys() & {"not run", "make readers"}:
                printed = ""
            elif block.language == "sh":
                run = commands.start if "background until" in block.marks else commands.run
                printed = run(block)
            elif block.language == "text" and printed:
                missing = missing_lines(block.text, printed)
                assert not missing, f"{path.name} promises {missing}; printed was\n{printed}"


def test_what_a_page_promises_has_to_be_printed() -> None:
    assert not missing_lines("wrote ... rows\n...\nend", "begin\nwrote 12  rows\nmore\nend")
    assert missing_lines("wrote ... rows", "wrote 12 columns") == ["wrote ... rows"]
    assert missing_lines("b\na", "a\nb") == ["a"], "the order counts"


@pytest.mark.parametrize("text", ["false", "false | true", "exit 3"])
def test_a_command_that_fails_fails_its_page(text: str, tmp_path: Path, free_port: int) -> None:
    with terminal(tmp_path, free_port) as commands, pytest.raises(AssertionError, match="exit"):
        commands.run(Block("sh", text))


def test_an_unknown_comment_is_no_way_to_leave_a_block_out() -> None:
    with pytest.raises(ValueError, match="no mark"):
        blocks_of("<!-- skip this -->\n```sh\nfalse\n```\n")
