"""Terminal output, files to write, and Ctrl-C of the finite-element commands.

Results go to stdout; progress and remarks go to stderr.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from palpate.errors import ConfigError
from palpate.process import setter_for_signals, told_in_log

console = Console(stderr=True)
"""For progress and remarks."""


class _Info(ProgressColumn):
    """The ``info`` of a task, if it has one."""

    def render(self, task: Task) -> Text:
        return Text(str(task.fields.get("info", "")))


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A progress bar on stderr, lines in a log; tasks may carry ``info``, a text after the bar."""
    columns = (TextColumn("{task.description:10}"), BarColumn(), MofNCompleteColumn())
    bar = Progress(*columns, TimeElapsedColumn(), _Info(), console=console, transient=True)
    with bar, told_in_log(bar):
        yield bar


def print_lines(*lines: str, to: Console | None = None) -> None:
    """Print lines unchanged (no markup, colours or wrapping); to stdout unless ``to`` is given."""
    if lines:
        (to or Console()).print(*lines, sep="\n", markup=False, highlight=False, soft_wrap=True)


def print_table(
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    title: str = "",
    caption: str = "",
    numbers_from: int | None = None,
) -> None:
    """Print a table to stdout.

    Args:
        headings: Of the columns.
        rows: Cells, as Rich markup.
        title: Above it.
        caption: Below it.
        numbers_from: First of the columns that hold numbers, which are aligned right; None = none.
    """
    table = Table(title=title or None, caption=caption or None)
    for at, heading in enumerate(headings):
        right = numbers_from is not None and at >= numbers_from
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def check_output(path: Path | None, option: str, ending: str, *inputs: Path | None) -> None:
    """Before a computation: whether its result can be written to a file, if one is named.

    Args:
        path: The file; one that is there is replaced, if it has the ending.
        option: What names it, for the error.
        ending: Of its name: a file of another kind was named by mistake.
        inputs: What the command reads.

    Raises:
        ConfigError: It has another ending, is an input or a folder, or its folder takes no file.
    """
    if path is None:
        return
    if path.suffix != ending:
        raise ConfigError(
            f"{option} {path} does not end in {ending}", remedy=f"name a file NAME{ending}"
        )
    if path.is_dir():
        raise ConfigError(f"{option} {path} is a folder", remedy=f"name a file NAME{ending}")
    if any(one is not None and one.resolve() == path.resolve() for one in inputs):
        raise ConfigError(f"{option} {path} is what the command reads", remedy="name another file")
    check_folder(path.absolute().parent, option)


def check_folder(path: Path, option: str) -> None:
    """Before a computation: whether files can be written into a folder, which may not exist yet.

    Raises:
        ConfigError: It is a file, or may not be made or written.
    """
    there = next(one for one in (path, *path.absolute().parents) if one.exists())
    if not there.is_dir():
        raise ConfigError(f"{option}: {there} is no folder", remedy="name another one")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"{option}: {there} may not be written", remedy="name another folder")


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """An event that is set by the first Ctrl-C or ``SIGTERM``; a second Ctrl-C ends at once."""
    stop = threading.Event()
    tell = setter_for_signals(stop)

    def on_signal(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        console.print("stopping; what has ended is kept")
        tell()

    before = {
        number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
