"""Progress of long work where no terminal shows it."""

from __future__ import annotations

import io
import time

import pytest
from rich.console import Console
from rich.progress import Progress

from palpate.process import told_in_log


def lines_after(capsys: pytest.CaptureFixture[str], found: list[str], wanted: int) -> list[str]:
    until = time.monotonic() + 20.0
    while len(found) < wanted and time.monotonic() < until:
        time.sleep(0.02)
        found += capsys.readouterr().err.splitlines()
    return found


def test_a_log_has_a_line_when_something_got_on(capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress(console=Console(file=io.StringIO()))
    with told_in_log(progress, every_s=0.05):
        one = progress.add_task("fingertip-01 mechanics", total=1000)
        other = progress.add_task("fields", total=None)
        progress.add_task("waits", total=3)
        progress.update(one, completed=120)
        found = lines_after(capsys, [], 1)
        time.sleep(0.2)
        assert lines_after(capsys, found, 1) == found[:1], "told again though nothing got on"
        assert found[0].endswith("s: fingertip-01 mechanics 120 of 1000")
        progress.advance(other)
        progress.remove_task(one)
        assert lines_after(capsys, found, 2)[1].endswith("s: fields 1")
    progress.advance(other)
    time.sleep(0.2)
    assert capsys.readouterr().err == "", "told after its end"


def test_a_terminal_has_the_bar_alone(capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress(console=Console(file=io.StringIO(), force_terminal=True))
    with told_in_log(progress, every_s=0.01):
        progress.advance(progress.add_task("networks", total=10))
        time.sleep(0.1)
    assert capsys.readouterr().err == ""
