"""The pages can be followed by a program, and the program notices what is not as a page says."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.readers.page import blocks_of
from tests.readers.readers import READERS, ROOT, Reader
from tests.readers.terminal import Terminal, Unexpected, plain

pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="terminals need Linux")
PATIENCE_S = 120.0


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    with Terminal(tmp_path, {"PATH": os.environ["PATH"], "HOME": str(tmp_path)}) as one:
        yield one


def lines_of(reader: Reader) -> list[str]:
    """Commands that the program runs, in order."""
    return [
        line
        for page in reader.pages
        for block in blocks_of((ROOT / "docs" / page).read_text(encoding="utf-8"))
        if block.language == "sh" and "not run" not in block.marks
        for line in block.lines
    ]


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_a_page_installs_before_it_uses(reader: Reader) -> None:
    lines = lines_of(reader)
    made = next(n for n, line in enumerate(lines) if "pip install" in line or "make demo" in line)
    entered = next(n for n, line in enumerate(lines) if line.startswith("source "))
    used = next(n for n, line in enumerate(lines) if line.startswith("palpate "))
    assert made < used
    assert entered < used


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_what_is_looked_at_is_on_the_page(reader: Reader) -> None:
    lines = lines_of(reader)
    looked_at = re.findall(r'(?:said|number)\(\s*"([^"]+)"', inspect.getsource(reader.check))
    assert looked_at
    for start in looked_at:
        assert any(line.startswith(start) for line in lines), start


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_the_index_leads_to_the_page(reader: Reader) -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    table = index.partition("| you have |")[2].partition("\n\n")[0]
    for page in reader.pages:
        assert f"]({page})" in table


def test_a_command_its_output_and_its_exit_code(terminal: Terminal, tmp_path: Path) -> None:
    assert terminal.run("echo one; false", timeout_s=PATIENCE_S) == (1, "echo one; false\none\n")
    (tmp_path / "below").mkdir()
    assert terminal.run("cd below", timeout_s=PATIENCE_S)[0] == 0
    assert terminal.folder == tmp_path / "below"


def test_questions_are_answered_in_order(terminal: Terminal) -> None:
    line = """read -p 'Name [x]: ' a; read -p 'Number: ' b; echo "got $a-$b\""""
    code, text = terminal.run(line, answers=["", "7"], timeout_s=PATIENCE_S)
    assert code == 0
    assert "got -7" in text


def test_a_question_that_the_page_does_not_mention_is_an_error(terminal: Terminal) -> None:
    with pytest.raises(Unexpected, match="does not say what to answer"):
        terminal.run("read -p 'Name: ' a", timeout_s=PATIENCE_S)


def test_an_answer_that_nobody_asks_for_is_an_error(terminal: Terminal) -> None:
    with pytest.raises(Unexpected, match="never asked"):
        terminal.run("true", answers=["7"], timeout_s=PATIENCE_S)


def test_a_program_goes_on_until_it_is_interrupted(terminal: Terminal) -> None:
    said = terminal.start("echo is  up; sleep 600", "is up", timeout_s=PATIENCE_S)
    assert "is up" in said
    code, _ = terminal.interrupt(PATIENCE_S)
    assert code == 130


def test_a_program_that_ends_instead_is_an_error(terminal: Terminal) -> None:
    with pytest.raises(Unexpected, match="ended"):
        terminal.start("echo is down", "is up", timeout_s=PATIENCE_S)


@pytest.mark.parametrize(
    ("shown", "seen"),
    [
        ("\x1b[31mred\x1b[0m\r\n", "red\n"),
        ("1 %\r2 %\r\n", "2 %\n"),
        ("a 1\r\nb 1\r\x1b[2K\x1b[1A\x1b[2Ka 2\r\nb 2\r\n", "a 2\nb 2\n"),
        ("done\r\n\x1e0\x1e$ ", "done\n$"),
    ],
)
def test_what_is_drawn_over_is_not_seen(shown: str, seen: str) -> None:
    assert plain(shown) == seen


def test_nothing_is_left_of_a_window_that_is_closed(tmp_path: Path) -> None:
    left = tmp_path / "left"
    with Terminal(tmp_path, {"PATH": os.environ["PATH"], "HOME": str(tmp_path)}) as one:
        one.start(f"echo is  up; sleep 300; touch {left}", "is up", timeout_s=PATIENCE_S)
        (child,) = Path(f"/proc/{one.pid}/task/{one.pid}/children").read_text().split()
    assert not Path(f"/proc/{child}").exists()
    assert not left.exists()
