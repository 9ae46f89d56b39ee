"""``palpate up``: a station in the foreground, on one screen."""

from __future__ import annotations

import contextlib
import faulthandler
import signal
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from palpate.bus import Delivery, Session, Subscriber
from palpate.bus.topics import STATUS
from palpate.census import ROUTER, SUPERVISOR
from palpate.errors import (
    ConfigError,
    LinkError,
    MissingExtraError,
    PalpateError,
    StreamTimeout,
    printable,
)
from palpate.health import Health, HealthReporter
from palpate.heartbeat import ServiceManager
from palpate.messages import ServiceState, Status, SupervisedProcess
from palpate.process import Closing, ProcessUsage, stop_on_signals
from palpate_deploy.station.host import join, names_taken
from palpate_deploy.station.lifetime import end_with_parent
from palpate_deploy.station.logs import cell, print_error
from palpate_deploy.station.processes import check_certificates, check_packages, ended_error
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.status import duration_text, shown_counters, state_text
from palpate_deploy.station.supervision import (
    ProcessState,
    Supervisor,
    SupervisorError,
    recent,
)
from palpate_deploy.station.watch import cannot_serve

_REFRESH_S = 0.25
_SILENT_AFTER_S = 3.0
_JOIN_S = 2.0
_STARTED = ("RUNNING", "EXITED")

_STATE_COLOURS = {"RUNNING": "green", "STARTING": "yellow", "STOPPING": "yellow"}


def run_up(profile: Profile, name: str) -> int:
    """Run a station until a signal, or until its finite source has ended; the exit code.

    Raises:
        ConfigError: A process cannot serve what the profile says, or its certificate does not hold.
        LinkError: The router's port is in use, or a station of this name runs on this host.
        MissingExtraError: A process needs a package that is not installed.
        SupervisorError: supervisord does not start, dies or hangs.
    """
    check_packages(profile)
    with contextlib.suppress(MissingExtraError):  # for this check only: no process needs it
        # Not who may read the keys: those that systemd hands over seem open to a group.
        check_certificates(profile, private=False)
    console = _LossyConsole()
    manager = ServiceManager()
    # A service manager that finds it hanging asks where, before it kills it.
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    stop = stop_on_signals()
    end_with_parent()
    with names_taken(profile), Supervisor(profile, name) as supervisor:
        console.print(
            f"station {profile.station!r} starts: {', '.join(profile.processes)}\n"
            f"router {', '.join(profile.link.connect)}   logs {supervisor.logs}\n"
            "Ctrl-C stops it",
            soft_wrap=True,
            markup=False,
        )
        with StationLink(profile, supervisor.logs) as link:
            finished = _Screen(console, supervisor, manager, link).watch(stop)
        manager.say("STOPPING=1")
        console.print("stopping ...")
    console.print("stopped")
    return 0 if finished is None else finished


class _LossyConsole(Console):
    """Goes on where its output is a file on a full disk."""

    def print(self, *objects: Any, **options: Any) -> None:
        try:
            super().print(*objects, **options)
        except OSError:
            del self._buffer[:]


class _Screen:
    """What `palpate up` shows, in a terminal, in a log, and to systemd."""

    def __init__(
        self,
        console: Console,
        supervisor: Supervisor,
        manager: ServiceManager,
        link: StationLink,
    ) -> None:
        self._console = console
        self._supervisor = supervisor
        self._manager = manager
        self._link = link
        self._known: dict[str, tuple[Status, float]] = {}
        self._absent = ""
        self._before: dict[str, tuple[str, int]] = {}
        self._up = False
        self._running = -1

    def watch(self, stop: threading.Event) -> int | None:
        """Show the processes until a signal (None) or the end of a finite source (its status).

        Raises:
            ConfigError: A process cannot serve what the profile says.
            SupervisorError: supervisord is gone, or does not answer.
        """
        terminal = self._console.is_terminal
        screen = Live(console=self._console, auto_refresh=False) if terminal else None
        with screen or contextlib.nullcontext():
            while not stop.is_set():
                self._link.take(self._known)
                processes = self._processes()
                self._link.tell(processes)
                self._say_absent()
                if screen is not None:
                    screen.update(_table(processes, self._known), refresh=True)
                else:
                    _print_changes(self._console, processes, self._before)
                self._check(processes)
                self._tell(processes)
                if (finished := self._finished(processes)) is not None:
                    return finished
                stop.wait(_REFRESH_S)
        return None

    def _say_absent(self) -> None:
        """Say why the station cannot be joined, each time that it is another reason."""
        if (absent := self._link.absent) not in ("", self._absent):
            self._absent = absent
            self._console.print(f"not linked: {printable(absent)}", markup=False, soft_wrap=True)

    def _processes(self) -> list[ProcessState]:
        try:
            return self._supervisor.processes()
        except SupervisorError:  # on a busy host one answer may be late
            return self._supervisor.processes()

    def _check(self, processes: list[ProcessState]) -> None:
        for process in processes:
            status, why = process.exit_status, process.why
            if cannot_serve(served=process.served, exit_status=status, why=why):
                log = self._supervisor.logs / f"{process.service}.log"
                error = ended_error(process.service, status, log)
                raise ConfigError(error.problem, remedy=error.remedy)

    def _tell(self, processes: list[ProcessState]) -> None:
        """Tell systemd that the station is up, and alive."""
        running = sum(process.state == "RUNNING" for process in processes)
        if not self._up and _is_up(processes):
            self._up = True
            absent = [f"{p.service} ({p.why})" for p in processes if p.state not in _STARTED]
            without = f" without {', '.join(absent)}" if absent else ""
            station = self._supervisor.profile.station
            self._console.print(f"station {station!r} is up{without}", markup=False)
        if self._up:
            self._manager.alive(time.monotonic_ns())
        if running != self._running:
            self._running = running
            self._manager.say(f"STATUS={running} of {len(processes)} processes run")

    def _finished(self, processes: list[ProcessState]) -> int | None:
        """Exit status of a gateway that has come to the end of its recordings; None otherwise."""
        if not self._supervisor.profile.gateway.exit_at_end:
            return None
        for process in processes:
            if process.service == "gateway" and process.state == "EXITED":
                if process.exit_status:
                    log = self._supervisor.logs / "gateway.log"
                    print_error(ended_error("gateway", process.exit_status, log))
                else:
                    self._console.print(f"gateway: {_last_words(self._known)}", markup=False)
                return process.exit_status
        return None


def _is_up(processes: Sequence[ProcessState]) -> bool:
    """Whether every process has started once, and what can serve does."""
    absent = [one for one in processes if one.state not in _STARTED]
    # One that comes and goes must not keep the others from being up; none serves without a router.
    return (
        all(one.restarts for one in absent)
        and len(absent) < len(processes)
        and all(one.service != ROUTER[0] for one in absent)
    )


def _last_words(known: dict[str, tuple[Status, float]]) -> str:
    status, _ = known.get("gateway", (None, 0.0))
    ended = status is not None and status.state is ServiceState.FINISHED
    return printable(status.message) if status is not None and ended else "all sources have ended"


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
                + (f", restart {process.restarts}" if process.restarts else "")
                + (f" ({process.why})" if process.why else ""),
                highlight=False,
                markup=False,
            )


def _table(processes: list[ProcessState], known: dict[str, tuple[Status, float]]) -> Group:
    table = Table(expand=True)
    for column in ("process", "runs", "pid", "up", "restarts", "says", "counters"):
        table.add_column(column, overflow="fold")
    problems = [f"{one.service}: {one.why}" for one in recent(processes)]
    for process in processes:
        colour = _STATE_COLOURS.get(process.state, "red")
        status, heard_s = known.get(process.service, (None, 0.0))
        says = counters = ""
        if status is not None and time.monotonic() - heard_s < _SILENT_AFTER_S:
            says = f"{state_text(status.state)} {cell(status.message)}"
            counters = cell(shown_counters(status))
            if status.last_error is not None and status.state is ServiceState.DEGRADED:
                problems.append(
                    f"{process.service}: {printable(status.last_error.message)}\n"
                    f"  fix: {printable(status.last_error.remedy)}"
                )
        table.add_row(
            process.service,
            f"[{colour}]{process.state.lower()}[/]",
            str(process.pid or "-"),
            duration_text(process.uptime_s),
            _restarts(process),
            says,
            counters,
        )
    return Group(table, *(Text(problem, style="red") for problem in problems))


def _restarts(process: ProcessState) -> str:
    if not process.restarts:
        return "-"
    return str(process.restarts) + (f" ({process.hangs} hung)" if process.hangs else "")


_FINE = frozenset({"RUNNING", "EXITED"})
"""EXITED is the state of a finite source at its end; any other process is started again."""


class ProcessDown(PalpateError, RuntimeError):
    """A process of the station does not run at present."""


class StationLink(Closing):
    """The link of `palpate up` to its station: what the processes say, and the report on them.

    A router elsewhere may be away for long: it is joined in a thread, and tried until it is there.

    Attributes:
        absent: Why the station could not be joined the last time; empty = it was.

    Raises:
        LinkError: The address of this process's own listener is in use.
        ConfigError: Its certificates cannot be used.
    """

    def __init__(self, profile: Profile, logs: Path) -> None:
        self.absent = ""
        self._profile, self._logs = profile, logs
        self._stop = threading.Event()
        self._opened = contextlib.ExitStack()
        self._linked: tuple[Subscriber[Status], SupervisorReport] | None = None
        self._joining = threading.Thread(target=self._join, name="join", daemon=True)
        if profile.link.links_directly:  # opens at once, whatever its router does
            self._open(-1.0)
        else:
            self._joining.start()

    def _open(self, wait_s: float) -> None:
        with contextlib.ExitStack() as undo:
            session = undo.enter_context(join(self._profile, wait_s=wait_s))
            statuses = session.subscriber(STATUS, delivery=Delivery.QUEUE)
            report = undo.enter_context(SupervisorReport(session, self._profile, self._logs))
            self._opened = undo.pop_all()
        self._linked = statuses, report

    def _join(self) -> None:
        while not self._stop.is_set():
            try:
                self._open(_JOIN_S)
            except (LinkError, ConfigError) as error:  # also certificates that are being renewed
                self.absent = error.problem
                self._stop.wait(_REFRESH_S)
            else:
                self.absent = ""
                return

    def take(self, known: dict[str, tuple[Status, float]]) -> None:
        """Put each process's newest status, and when it came [s], into ``known``."""
        while self._linked is not None:
            try:
                status = self._linked[0].next(timeout_s=0).message
            except StreamTimeout:
                return
            if status.instance == self._profile.instance(status.service):
                known[status.service] = (status, time.monotonic())

    def tell(self, processes: Sequence[ProcessState]) -> None:
        """Report what supervisord says; call it a few times a second."""
        if self._linked is not None:
            self._linked[1].tell(processes)

    def close(self) -> None:
        """Report a last time, withdraw and leave."""
        self._stop.set()
        if self._joining.is_alive():
            self._joining.join()
        self._opened.close()


class SupervisorReport(Closing):
    """Publishes the state of the supervised processes; ``logs`` is the folder of their logs."""

    def __init__(self, session: Session, profile: Profile, logs: Path) -> None:
        self._profile, self._logs = profile, logs
        service, instance = SUPERVISOR[0], profile.instance(SUPERVISOR[1])
        self._health = Health(service, instance)
        self._router: tuple[int, ProcessUsage] | None = None
        self._presence = session.presence(service, instance=instance)
        self._reporter = HealthReporter(session, self._health)
        self._presence.ready()

    def tell(self, processes: Sequence[ProcessState]) -> None:
        """Take over what supervisord says; call it a few times a second."""
        self._health.set_processes(
            [
                SupervisedProcess(
                    one.service,
                    self._profile.instance(one.service),
                    one.state.lower(),
                    one.pid,
                    one.restarts,
                    max(0.0, one.uptime_s),
                )
                for one in processes
            ]
        )
        self._health.set_counts({f"{one.service}.hung": one.hangs for one in processes})
        self._measure_router(processes)
        down = [one for one in processes if one.state not in _FINE]
        # A process is "starting" until its first heartbeat.
        if any(one.state != "STARTING" or one.restarts for one in down):
            first = next(one for one in down if one.state != "STARTING" or one.restarts)
            self._health.fail(
                ProcessDown(
                    f"{first.service} does not run: {first.why or first.state.lower()}",
                    remedy=f"it is started again by itself; see {self._logs / first.service}.log",
                )
            )
        elif not down:
            said = [f"{len(processes)} processes run"]
            said += [f"{one.service} was started again: {one.why}" for one in recent(processes)]
            self._health.set_state(ServiceState.READY, "; ".join(said))

    def _measure_router(self, processes: Sequence[ProcessState]) -> None:
        """The router has no status of its own: its memory and processor time are told here."""
        pid = next((one.pid for one in processes if one.service == ROUTER[0]), 0)
        if not pid:
            return
        if self._router is None or self._router[0] != pid:
            self._router = pid, ProcessUsage(pid)
        for name, value in self._router[1].gauges().items():
            self._health.gauge(f"{ROUTER[0]}.{name}", value)

    def close(self) -> None:
        """Report a last time and withdraw."""
        self._presence.not_ready()
        self._health.set_state(ServiceState.STOPPING, "the station stops")
        self._reporter.close()
        self._presence.close()
