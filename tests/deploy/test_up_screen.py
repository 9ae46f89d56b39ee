"""What ``palpate up`` shows of processes that were started again."""

from __future__ import annotations

import time
from dataclasses import replace

from rich.console import Console

from palpate.errors import ErrorCode
from palpate.messages import ErrorReply, ServiceState, Status
from palpate_deploy.station.supervision import ProcessState, recent
from palpate_deploy.station.up import _is_up, _last_words, _print_changes, _table

FINE = ProcessState("gateway", "RUNNING", 10, 900.0, 0, 0, True, 0, "")
HUNG = ProcessState("features", "RUNNING", 12, 30.0, 3, 1, True, -9, "hung: no heartbeat for 5.0 s")


def test_the_table_counts_hangs_and_says_why() -> None:
    console = Console(width=160, force_terminal=False)
    with console.capture() as shown:
        console.print(_table([FINE, HUNG], {}))
    text = shown.get()
    assert "3 (1 hung)" in text
    assert "features: hung: no heartbeat for 5.0 s" in text
    assert "gateway:" not in text


def test_why_is_told_while_it_is_news() -> None:
    assert recent([FINE, HUNG]) == [HUNG]
    assert not recent([replace(HUNG, uptime_s=3600.0)])
    assert recent([replace(HUNG, state="BACKOFF", pid=0, uptime_s=0.0)])


def test_a_log_gets_one_line_a_change() -> None:
    console = Console(width=160, force_terminal=False)
    before: dict[str, tuple[str, int]] = {}
    with console.capture() as shown:
        for _ in range(3):
            _print_changes(console, [HUNG], before)
    (line,) = shown.get().splitlines()
    assert line.endswith("features: running, pid 12, restart 3 (hung: no heartbeat for 5.0 s)")


def test_a_station_is_up_with_its_router_and_something_that_serves() -> None:
    router = replace(FINE, service="router")
    starting = replace(FINE, service="features", state="STARTING", uptime_s=3.0)
    again = replace(starting, restarts=1, pid=0, state="BACKOFF", why="hung")
    assert _is_up([router, FINE])
    assert not _is_up([router, FINE, starting]), "its first start may take a while"
    assert _is_up([router, FINE, again])
    assert not _is_up([replace(again, service="router"), FINE])
    assert not _is_up([replace(again, service=name) for name in ("router", "gateway", "features")])
    assert not _is_up([replace(again, service=name) for name in ("gateway", "features")])
    assert _is_up([replace(FINE, state="EXITED"), router]), "a recording has come to its end"


def test_no_text_of_a_process_acts_on_the_terminal_or_ends_the_screen() -> None:
    """Any local process may send one."""
    acts = "\x1b]0;owned\x07[/]"
    error = ErrorReply(ErrorCode.INTERNAL, acts, acts, 0.0)
    status = Status(
        "gateway",
        "gateway",
        ServiceState.DEGRADED,
        10**9,
        10**9,
        5.0,
        "1",
        counters={f"lost{acts}": 1},
        message=acts,
        last_error=error,
    )
    console = Console(width=160, force_terminal=True)
    with console.capture() as shown:
        console.print(_table([FINE], {"gateway": (status, time.monotonic())}))
    assert "owned" in shown.get()
    assert "\x1b]0" not in shown.get()
    finished = replace(status, state=ServiceState.FINISHED)
    assert "\x1b" not in _last_words({"gateway": (finished, 0.0)})
