"""``palpate up``: a station in the foreground, on one screen."""

from __future__ import annotations

import contextlib
import signal
import threading
import time

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from palpate.bus import Delivery, Subscriber
from palpate.bus.topics import STATUS
from palpate.errors import StreamTimeout
from palpate.messages import ServiceState, Status
from palpate_deploy.station.host import join
from palpate_deploy.station.lifetime import stop_on_signals
from palpate_deploy.station.logs import FAILED
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.status import duration_text, shown_counters, state_text
from palpate_deploy.station.supervision import ProcessState, Supervisor, SupervisorError
from palpate_deploy.station.supervisor_report import SupervisorReport

_REFRESH_S = 0.25
_SILENT_AFTER_S = 3.0

_STATE_COLOURS = {"RUNNING": "green", "STARTING": "yellow", "STOPPING": "yellow"}


def run_up(profile: Profile, name: str) -> int:
    """Run a station until a signal, or until its finite source has ended; the exit code.

    Raises:
        LinkError: The router's port is in use.
        SupervisorError: supervisord does not start, or dies.
    """
    console = Console()
    stop = stop_on_signals(signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    with Supervisor(profile, name) as supervisor:
        console.print(
            f"station {profile.station!r} is up: {', '.join(profile.processes)}\n"
            f"router {', '.join(profile.link.connect)}   logs {supervisor.logs}\n"
            "Ctrl-C stops it",
            soft_wrap=True,
            markup=False,
        )
        with join(profile, wait_s=-1.0) as session:
            statuses = session.subscriber(STATUS, delivery=Delivery.QUEUE)
            with SupervisorReport(session, supervisor.logs) as report:
                finished = _watch(console, supervisor, statuses, report, stop)
        if not stop.is_set() and not finished:
            raise SupervisorError(
                "supervisord is gone", remedy=f"see {supervisor.logs / 'supervisord.log'}"
            )
        console.print("stopping ...")
    console.print("stopped")
    return 0 if finished in (None, 0) else FAILED


def _watch(
    console: Console,
    supervisor: Supervisor,
    statuses: Subscriber[Status],
    report: SupervisorReport,
    stop: threading.Event,
) -> int | None:
    """Show the processes until a signal (None) or the end of a finite source (its status)."""
    known: dict[str, tuple[Status, float]] = {}
    before: dict[str, tuple[str, int]] = {}
    screen = Live(console=console, auto_refresh=False) if console.is_terminal else None
    with screen or contextlib.nullcontext():
        while not stop.is_set() and supervisor.running:
            _take(statuses, known)
            processes = supervisor.processes()
            report.tell(processes)
            if screen is not None:
                screen.update(_screen(processes, known), refresh=True)
            else:
                _print_changes(console, processes, before)
            if (finished := _finished(supervisor, processes)) is not None:
                return finished
            stop.wait(_REFRESH_S)
    return None


def _print_changes(
    console: Console, processes: list[ProcessState], before: dict[str, tuple[str, int]]
) -> None:
    """Print only changes, for a log file or a service manager."""
    for process in processes:
        now = (process.state, process.pid)
        if before.get(process.service) != now:
            before[process.service] = now
            console.print(
                f"{time.strftime('%H:%M:%S')} {process.service}: {process.state.lower()}"
                + (f", pid {process.pid}" if process.pid else "")
                + (f", restart {process.restarts}" if process.restarts else ""),
                highlight=False,
            )


def _finished(supervisor: Supervisor, processes: list[ProcessState]) -> int | None:
    """Exit status of a gateway that has come to the end of its recording; None otherwise."""
    if supervisor.profile.gateway.exit_at_end:
        for process in processes:
            if process.service == "gateway" and process.state == "EXITED":
                return process.exit_status
    return None


def _take(statuses: Subscriber[Status], known: dict[str, tuple[Status, float]]) -> None:
    while True:
        try:
            status = statuses.next(timeout_s=0).message
        except StreamTimeout:
            return
        if status.instance == status.service:
            known[status.service] = (status, time.monotonic())


def _screen(processes: list[ProcessState], known: dict[str, tuple[Status, float]]) -> Group:
    table = Table(expand=True)
    for column in ("process", "runs", "pid", "up", "restarts", "says", "counters"):
        table.add_column(column, overflow="fold")
    problems: list[str] = []
    for process in processes:
        colour = _STATE_COLOURS.get(process.state, "red")
        status, heard_s = known.get(process.service, (None, 0.0))
        says = counters = ""
        if status is not None and time.monotonic() - heard_s < _SILENT_AFTER_S:
            says = f"{state_text(status.state)} {escape(status.message)}"
            counters = shown_counters(status)
            if status.last_error is not None and status.state is ServiceState.DEGRADED:
                problems.append(
                    f"{process.service}: {status.last_error.message}\n"
                    f"  fix: {status.last_error.remedy}"
                )
        table.add_row(
            process.service,
            f"[{colour}]{process.state.lower()}[/]",
            str(process.pid or "-"),
            duration_text(process.uptime_s),
            str(process.restarts or "-"),
            says,
            counters,
        )
    return Group(table, *(Text(problem, style="red") for problem in problems))
