"""What should run at a station, and what is wrong: missing, silent or not ready, and why."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from palpate.bus import Session
from palpate.bus.no_router import RouterAbsent, RouterRefuses
from palpate.census import ROUTER, SUPERVISOR, ProcessName, ProcessReport
from palpate.config import LinkConfig, endpoint_host_port, is_loopback
from palpate.errors import LinkError
from palpate.messages import ServiceState, SupervisedProcess
from palpate_deploy.station.host import run_pid, running_folders
from palpate_deploy.station.profile import load_profile

RUNNING = "running"
"""What a supervisor says of a process that has served and has not ended."""


@dataclass(frozen=True, slots=True)
class Expectation:
    """What should run.

    Attributes:
        source: In one line, who says so.
        processes: The processes that should run.
        pid: Process id of the ``palpate up`` that runs them on this host; 0 = none is known.
    """

    source: str
    processes: frozenset[ProcessName]
    pid: int = 0


def expectation_of(profile: str) -> Expectation:
    """What a profile, given by name or path, starts.

    Raises:
        ConfigError: There is no such profile, or it is wrong.
    """
    loaded = load_profile(profile)
    names = frozenset((name, loaded.instance(name)) for name in loaded.processes)
    return Expectation(f"profile {profile}", names)


def expectation_here(connect: Iterable[str], station: str) -> Expectation | None:
    """What a run on this host started, whose station and router are these; None = there is none.

    Only the runs of this user are seen. The station's supervisor says the same on the bus, but a
    supervisor that does not answer is missed only by who knows that there should be one.
    """
    wanted = {_place(endpoint) for endpoint in connect}
    for folder in reversed(running_folders()):
        values = _profile(folder)
        listens = values.get("router", {}).get("listen", ())
        connects = values.get("link", {}).get("connect", ())
        places = {_place(endpoint) for endpoint in (*listens, *connects)}
        if values.get("station") != station or not places & wanted:
            continue
        replica = values.get("replica", "")
        services = [*values.get("processes", ())]
        if (folder / "supervisord.conf").exists():
            services.append(SUPERVISOR[0])
        names = {
            (name, f"{name}-{replica}" if replica and name != ROUTER[0] else name)
            for name in services
        }
        return Expectation(f"run {folder.name} on this host", frozenset(names), run_pid(folder))
    return None


def expectation(link: LinkConfig, station: str, profile: str | None) -> Expectation | None:
    """What should run: what ``profile`` says if one is named, else a run on this host.

    A profile does not say who starts it: its supervisor is expected where a run here has one.

    Raises:
        ConfigError: There is no such profile, or it is wrong.
    """
    here = expectation_here(link.connect, station)
    if profile is None:
        return here
    said = expectation_of(profile)
    if here is None:
        return said
    supervisors = {name for name in here.processes if name[0] == SUPERVISOR[0]}
    return replace(said, processes=said.processes | supervisors, pid=here.pid)


def ask_through_router(link: LinkConfig, station: str, said: Expectation | None) -> Session:
    """Join a station through its router alone, which knows every process at once.

    Raises:
        LinkError: There is no router, or it does not answer although ``said`` knows a run.
    """
    try:
        return Session.open(link.model_copy(update={"direct": False}), station=station)
    except RouterRefuses:
        raise
    except LinkError as error:
        if said is None or ROUTER not in said.processes:
            raise
        where = ", ".join(link.connect)
        if said.pid:
            raise LinkError(
                f"the router at {where} does not answer, but should: {said.source}",
                remedy="it starts, or hangs and is started again by itself: ask again in ten "
                "seconds",
            ) from error
        if isinstance(error, RouterAbsent):
            raise RouterAbsent(
                f"no router at {where}: the station of {said.source} does not run, or cannot be "
                "reached from here",
                remedy="start it with `palpate up` of this profile, or with `systemctl start` "
                "where it is installed",
            ) from error
        raise


def _profile(folder: Path) -> dict[str, Any]:
    """Plain values of a run's profile; without checks, it may be of another version."""
    try:
        return tomllib.loads((folder / "profile.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _place(endpoint: str) -> tuple[str, str, int]:
    """Protocol, host and port; every name of the own host is the same place."""
    try:
        host, port = endpoint_host_port(endpoint)
    except ValueError:
        return endpoint, "", 0
    here = is_loopback(host) or host in ("0.0.0.0", "::")
    return endpoint.partition("/")[0], "loopback" if here else host, port


@dataclass(frozen=True, slots=True)
class Trouble:
    """One thing that is wrong: with which process, what, and what to do about it."""

    service: str
    instance: str
    problem: str
    remedy: str


def troubles(census: Iterable[ProcessReport], said: Expectation | None = None) -> list[Trouble]:
    """Everything that is wrong at a station; empty = all that should run is ready, or finished.

    ``said`` may know a supervisor on this host that cannot be reached, and nobody else reports.
    """
    reports = list(census)
    supervised = {
        (one.service, one.instance): one
        for report in reports
        if report.status is not None
        for one in report.status.processes
    }
    found = []
    for report in reports:
        name = report.service, report.instance
        wrong = _wrong(report, supervised.get(name), 0 if said is None else said.pid)
        if wrong is not None:
            found.append(Trouble(*name, *wrong))
    return found


def lifeless(census: Iterable[ProcessReport], said: Expectation | None = None) -> list[Trouble]:
    """Those of the troubles that a new start of the station may end: missing or mute processes.

    Of what ``said`` names, where that is known: another process may be of another host. One that
    its supervisor has started again is left to it.
    """
    reports = list(census)
    mute = {(one.service, one.instance) for one in reports if one.status is None}
    for report in reports:
        for one in () if report.status is None else report.status.processes:
            if one.restarts and one.state != RUNNING:
                mute.discard((one.service, one.instance))
    if said is not None:
        mute &= said.processes
    return [one for one in troubles(reports, said) if (one.service, one.instance) in mute]


def process_name(service: str, instance: str) -> str:
    """Name of a process for people: the instance only where there may be several."""
    return service if instance == service else f"{service}/{instance}"


def _wrong(
    report: ProcessReport, supervised: SupervisedProcess | None, supervisor_pid: int
) -> tuple[str, str] | None:
    """Problem and remedy of one process; None = there is none."""
    status = report.status
    if (report.service, report.instance) == ROUTER and status is None:
        return None if report.alive else ("is not connected", "look at its log; ask again")
    if status is None and not report.alive:
        if report.service == SUPERVISOR[0] and supervisor_pid:
            return (
                f"runs as process {supervisor_pid} and cannot be reached",
                f"one that is stopped goes on after `kill -CONT {supervisor_pid}`; end one that "
                "hangs, and start it again with `palpate up`",
            )
        if supervised is None:
            return "does not run", "start it with `palpate up`, or take it out of the profile"
        if supervised.state == "exited":  # a finite source at its end: others are started again
            return None
        if supervised.state == RUNNING:
            return (
                "runs and cannot be reached",
                "one that hangs is replaced, most within 10 s: ask again; if it stays, see its log",
            )
        times = f", started again {supervised.restarts} times" if supervised.restarts else ""
        return (
            f"does not serve: its supervisor says {supervised.state}{times}",
            "see its log in the folder that `palpate up` has named",
        )
    if status is None:
        return (
            "lives and does not answer",
            "it hangs or its host is overloaded; look at its load and its log, and ask again",
        )
    if status.state is ServiceState.FINISHED:
        return None
    if status.state is ServiceState.DEGRADED and status.last_error is not None:
        return status.last_error.message, status.last_error.remedy
    said = f": {status.message}" if status.message else ""
    if status.state is not ServiceState.READY:
        return f"is {status.state.name.lower()}{said}", "ask again in a few seconds"
    if not report.ready:
        return f"does not show that it is ready{said}", "ask again in a few seconds"
    return None
