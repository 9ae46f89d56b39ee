"""Terminal output, files to write, and Ctrl-C of the finite-element commands.

Results go to stdout; progress and remarks go to stderr.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from rich.console import Console
from rich.markup import escape
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
    """Print a table to stdout, its texts unchanged: Rich would take [mm] for a style.

    Args:
        headings: Of the columns.
        rows: Cells.
        title: Above it.
        caption: Below it.
        numbers_from: First of the columns that hold numbers, which are aligned right; None = none.
    """
    table = Table(title=escape(title) or None, caption=escape(caption) or None)
    for at, heading in enumerate(headings):
        right = numbers_from is not None and at >= numbers_from
        table.add_column(escape(heading), justify="right" if right else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    Console().print(table)


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
