"""``palpate bench restart``: each process is killed, made to hang and told to end, many times.

A station of its own runs under its supervisor. A trial ends when the process publishes again, as
others see it: the gateway a frame, a service an estimate of a later frame, the recorder a record
that grows, the router a client that joins and hears an estimate. At the end the supervisor must
have restarted exactly what was broken here.

The floor is the same without palpate's code: a bare program under a bare supervisord, which has to
notice the dead process and start another, and the imports of the foreign packages. supervisord
starts it a second later, so a restart of ours may take less than the floor.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from palpate.bus import Delivery, Session, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, SYNTHESIS, Topic
from palpate.errors import LinkError, PalpateError
from palpate.heartbeat import LIMIT_S
from palpate.messages import ServiceRequest
from palpate_deploy.bench.results import finish, progress_bar
from palpate_deploy.station.host import join, private_profile
from palpate_deploy.station.lifetime import start_child, stop_child
from palpate_deploy.station.logs import FAILED
from palpate_deploy.station.processes import service_named
from palpate_deploy.station.profile import Profile, Service
from palpate_deploy.station.supervision import ProcessState, Supervisor

_IMPORTS: dict[str, tuple[str, ...]] = {
    "router": ("zenoh",),
    "gateway": ("zenoh", "numpy", "pydantic", "google.protobuf"),
    "features": ("zenoh", "numpy", "pydantic", "google.protobuf", "onnxruntime"),
    "field": ("zenoh", "numpy", "pydantic", "google.protobuf", "onnxruntime"),
    "synthesis": ("zenoh", "numpy", "pydantic", "google.protobuf", "onnxruntime"),
    "recorder": ("zenoh", "numpy", "pydantic", "google.protobuf", "mcap.writer", "rerun"),
    "fem": ("zenoh", "numpy", "pydantic", "google.protobuf"),
    "metrics": ("zenoh", "numpy", "pydantic", "google.protobuf", "prometheus_client"),
    "web": ("zenoh", "numpy", "pydantic", "google.protobuf", "waitress"),
}

# It writes its process id and goes on for ever.
_PROGRAM = """
import os, time
with open("pid.new", "w") as file:
    file.write(str(os.getpid()))
os.replace("pid.new", "pid")
while True:
    time.sleep(60)
"""

_CONFIG = """
[supervisord]
nodaemon = true
logfile = supervisord.log
pidfile = supervisord.pid
[program:bare]
command = {python} -S bare.py
autorestart = true
startsecs = 0
"""

_PATIENCE_S = 30.0


def restarts_s(times: int) -> list[float]:
    """Time from SIGKILL of a bare program to the first act of the one that replaces it [s]."""
    with _bare_station() as folder:
        taken: list[float] = []
        pid = _new_pid(folder, 0)
        for _ in range(times):
            time.sleep(0.5 + 0.1 * len(taken) % 1.0)  # at any time of supervisord's second
            began_s = time.monotonic()
            os.kill(pid, signal.SIGKILL)
            pid = _new_pid(folder, pid)
            taken.append(time.monotonic() - began_s)
        return taken


def import_s(service: Service) -> float:
    """Time in which Python starts and imports the foreign packages of a process [s]."""
    command = [sys.executable, "-c", f"import {', '.join(_IMPORTS[service])}"]
    taken = []
    for _ in range(3):
        began_s = time.monotonic()
        subprocess.run(command, check=True)
        taken.append(time.monotonic() - began_s)
    return min(taken)


@contextmanager
def _bare_station() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="palpate-floor-") as name:
        folder = Path(name)
        (folder / "bare.py").write_text(_PROGRAM, encoding="utf-8")
        config = folder / "bare.conf"
        config.write_text(_CONFIG.format(python=sys.executable), encoding="utf-8")
        start = f"import os; os.chdir({name!r}); from supervisor.supervisord import main; main()"
        command = [sys.executable, "-c", start, "-n", "-s", "-c", str(config)]
        process = start_child(command, folder / "out")
        try:
            yield folder
        finally:
            stop_child(process, _PATIENCE_S)


def _new_pid(folder: Path, before: int) -> int:
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        try:
            pid = int((folder / "pid").read_text(encoding="utf-8"))
        except FileNotFoundError:
            pid = before
        if pid != before:
            return pid
        time.sleep(0.005)
    raise LinkError(
        "the bare supervisord does not start its program",
        remedy=f"run it alone: {(folder / 'out').read_text(encoding='utf-8')[-300:]}",
    )


Fault = Literal["kill", "hang", "end"]
SIGNALS: dict[Fault, signal.Signals] = {
    "kill": signal.SIGKILL,
    "hang": signal.SIGSTOP,
    "end": signal.SIGTERM,
}
GOALS_S: dict[Fault, float] = {"kill": 3.0, "hang": 10.0, "end": 2.0}
"""Until it publishes again; after SIGTERM until it has ended with status 0, its files and its
session closed."""

_TRIAL_S = 60.0
_START_S = 180.0
_STEADY_S = 1.0
_POLL_S = 0.02
_SEED = 3
_STREAMS: dict[str, Topic[Any]] = {
    "gateway": ELECTRODES,
    "features": FEATURES,
    "field": FIELD,
    "synthesis": SYNTHESIS,
}


@dataclass(frozen=True, slots=True)
class Trials:
    """All trials of one process with one fault; times count from the signal [s].

    Attributes:
        service: The process.
        fault: ``kill`` (SIGKILL), ``hang`` (SIGSTOP) or ``end`` (SIGTERM).
        publishing_s: When it published again, of each trial in which it did.
        process_s: When the new process was there.
        failed: Trials in which it did not publish again in time, or did not end with status 0.
        floor_s: A bare restart under a bare supervisord, and unless it is to ``end``, bare imports;
            for ``hang`` also the time without a heartbeat that is allowed.
    """

    service: str
    fault: Fault
    publishing_s: tuple[float, ...]
    process_s: tuple[float, ...]
    failed: int
    floor_s: float

    @property
    def judged_s(self) -> tuple[float, ...]:
        """The times that the goal is for."""
        return self.process_s if self.fault == "end" else self.publishing_s

    @property
    def met(self) -> bool:
        """Whether it came back each time, and soon enough."""
        return not self.failed and max(self.judged_s, default=0.0) <= GOALS_S[self.fault]


class RestartStation:
    """The station, seen from outside."""

    def __init__(self, profile: Profile, stack: ExitStack) -> None:
        self.profile = profile
        self.supervisor = stack.enter_context(Supervisor(profile, "bench-restart"))
        self._session = stack.enter_context(join(profile, wait_s=_START_S))
        self._streams = {
            name: self._session.subscriber(topic, delivery=Delivery.NEWEST)
            for name, topic in _STREAMS.items()
            if name in profile.processes
        }

    def process(self, service: Service) -> ProcessState:
        """A process as its supervisor sees it."""
        return next(one for one in self.supervisor.processes() if one.service == service)

    def wait_until_steady(self) -> None:
        """Wait until every process runs and publishes.

        Raises:
            LinkError: One does not.
        """
        deadline_s = time.monotonic() + _START_S
        while any(one.state != "RUNNING" for one in self.supervisor.processes()):
            _check(deadline_s, "not every process runs", self.supervisor)
            time.sleep(_POLL_S)
        for service in self.profile.processes:
            since_ns = time.monotonic_ns()
            while not self.publishes(service, since_ns, 0):
                _check(deadline_s, f"{service} does not publish", self.supervisor)

    def publishes(self, service: Service, since_ns: int, pid: int) -> bool:
        """Whether a process that was broken at ``since_ns`` does its work again; waits a little.

        ``pid`` is that of the broken process: it does not count; 0 = any counts.
        """
        try:
            if service == "router":
                return self._joins_and_hears()
            if service in self._streams:
                topic = _STREAMS[service]
                stamp = topic.stamp_of(self._streams[service].next(_POLL_S).message)
                return stamp is not None and stamp.monotonic_ns > since_ns
            return self._answers(service, since_ns if pid else 0)
        except PalpateError:
            return False

    def _answers(self, service: Service, since_ns: int) -> bool:
        """Whether it answers and, being the recorder, has written into its record."""
        status = self._session.query(
            endpoints.STATUS, ServiceRequest(), service=service, timeout_s=0.2
        )
        began_ns = status.monotonic_ns - round(status.uptime_s * 1e9)
        written = status.counters.get("recorded_electrodes", 0) > 0
        return began_ns > since_ns and (written or service != "recorder")

    def _joins_and_hears(self) -> bool:
        """Whether a stranger who knows the router alone joins, and hears an estimate through it."""
        link = self.profile.link.model_copy(update={"direct": False, "wait_for_router_s": 0.2})
        topic = _STREAMS["features" if "features" in self.profile.processes else "gateway"]
        with Session.open(link, station=self.profile.station) as session:
            stream = session.subscriber(topic, delivery=Delivery.NEWEST)
            stream.next(_STEADY_S)
            return True


def _check(deadline_s: float, what: str, supervisor: Supervisor) -> None:
    if time.monotonic() > deadline_s:
        raise LinkError(
            f"the station of the benchmark does not work: {what}",
            remedy=f"see the logs in {supervisor.logs}",
        )


def run_restart(
    *, times: int, only: Sequence[str], as_json: bool, save: bool, out: Path | None
) -> int:
    """Measure and print; 1 if a process did not come back each time, or not soon enough.

    Raises:
        ConfigError: ``only`` names what is no process.
        PalpateError: The station does not start, or there is no history to append to.
    """
    with tempfile.TemporaryDirectory(prefix="palpate-restart-") as folder:
        # What the user's own stations have served must not matter here.
        profile = private_profile(
            "virtual", recorder={"out": folder}, models={"state": folder, "folder": folder}
        )
        wanted = [service_named(name) for name in only] or list(profile.processes)
        if extra := [service for service in wanted if service not in profile.processes]:
            processes = (*profile.processes, *extra)
            profile = profile.model_copy(update={"processes": processes})
        results, unprovoked = measure_restarts(profile, wanted, times)
    met = all(result.met for result in results) and not unprovoked
    values = {
        "restart": [asdict(result) | {"met": result.met} for result in results],
        "restart.unprovoked": unprovoked,
        "restart.goal_met": met,
    }
    finish(
        "restart", values, lambda: _show(results, unprovoked), as_json=as_json, save=save, out=out
    )
    return 0 if met else FAILED


def measure_restarts(
    profile: Profile, services: Sequence[Service], times: int
) -> tuple[list[Trials], dict[str, int]]:
    """All trials, and how often the supervisor restarted a process that nobody had broken."""
    bare_s = float(np.median(restarts_s(max(times, 3))))
    imports_s = {service: import_s(service) for service in services}
    pairs: list[tuple[Service, Fault]] = [(s, fault) for s in services for fault in SIGNALS]
    taken: dict[tuple[str, Fault], list[tuple[float, float]]] = {pair: [] for pair in pairs}
    rng = random.Random(_SEED)
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar())
        station = RestartStation(profile, stack)
        task = bar.add_task("killed and hung", total=times * len(pairs))
        for _ in range(times):
            # In another order each time, so that no process always follows the same fault.
            for service, fault in rng.sample(pairs, len(pairs)):
                station.wait_until_steady()
                time.sleep(_STEADY_S * (0.5 + rng.random()))
                taken[service, fault].append(_try(station, service, fault))
                bar.advance(task)
        station.wait_until_steady()
        states = {one.service: one for one in station.supervisor.processes()}
    unprovoked: dict[str, int] = {
        service: extra
        for service, state in states.items()
        if (extra := state.restarts - sum(len(taken.get((service, f), ())) for f in SIGNALS))
    }
    return [
        Trials(
            service,
            fault,
            tuple(publishing for publishing, _ in rows if publishing < _TRIAL_S),
            tuple(process for _, process in rows if process < _TRIAL_S),
            sum(publishing >= _TRIAL_S for publishing, _ in rows),
            bare_s
            + (imports_s[service] if fault != "end" else 0.0)
            + (LIMIT_S if fault == "hang" else 0.0),
        )
        for (service, fault), rows in ((pair, taken[pair]) for pair in pairs)
    ], unprovoked


def _try(station: RestartStation, service: Service, fault: Fault) -> tuple[float, float]:
    """One trial: when it published again, and when its process was there [s]."""
    pid = station.process(service).pid
    os.kill(pid, SIGNALS[fault])
    since_ns = time.monotonic_ns()

    def until(true: Callable[[], bool]) -> float:
        while (passed_s := (time.monotonic_ns() - since_ns) * 1e-9) < _TRIAL_S and not true():
            time.sleep(_POLL_S)
        return passed_s if passed_s >= _TRIAL_S else (time.monotonic_ns() - since_ns) * 1e-9

    process_s = until(lambda: station.process(service).pid not in (0, pid))
    if fault == "end" and station.process(service).exit_status != 0:
        return _TRIAL_S, process_s
    # A process that was told to end has published after that, too.
    after_ns = time.monotonic_ns() if fault == "end" else since_ns
    return until(lambda: station.publishes(service, after_ns, pid)), process_s


def _show(results: Sequence[Trials], unprovoked: dict[str, int]) -> None:
    title = "from the signal until it publishes again (SIGTERM: until it has ended)"
    table = Table(title=title, title_justify="left")
    for column in ("process", "fault", "back", "p50", "max", "goal", "floor"):
        table.add_column(column, justify="left" if column in ("process", "fault") else "right")
    for result in results:
        back = len(result.publishing_s)
        times = result.judged_s or (float("nan"),)
        colour = "green" if result.met else "red"
        table.add_row(
            result.service,
            f"{result.fault} ({SIGNALS[result.fault].name})",
            f"{back}/{back + result.failed}",
            f"{float(np.median(times)):.2f} s",
            f"[{colour}]{max(times):.2f} s[/]",
            f"{GOALS_S[result.fault]:g} s",
            f"{result.floor_s:.2f} s",
        )
    console = Console(highlight=False)
    console.print(table)
    said = ", ".join(f"{service} {count}" for service, count in unprovoked.items())
    console.print(f"restarts that nobody provoked: {said or 'none'}")
