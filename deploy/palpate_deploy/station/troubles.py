"""What is wrong at a station: what is missing, what does not answer, what is not ready, and why."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from palpate.census import ROUTER, ProcessReport
from palpate.messages import ServiceState, SupervisedProcess


@dataclass(frozen=True, slots=True)
class Trouble:
    """One thing that is wrong: with which process, what, and what to do about it."""

    service: str
    instance: str
    problem: str
    remedy: str


def troubles(census: Iterable[ProcessReport]) -> list[Trouble]:
    """Everything that is wrong at a station; empty = all that should run is ready, or finished."""
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
        if (wrong := _wrong(report, supervised.get(name))) is not None:
            found.append(Trouble(*name, *wrong))
    return found


def process_name(service: str, instance: str) -> str:
    """Name of a process for people: the instance only where there may be several."""
    return service if instance == service else f"{service}/{instance}"


def _wrong(report: ProcessReport, supervised: SupervisedProcess | None) -> tuple[str, str] | None:
    """Problem and remedy of one process; None = there is none."""
    status = report.status
    if (report.service, report.instance) == ROUTER and status is None:
        return None if report.alive else ("is not connected", "look at its log; ask again")
    if status is None and not report.alive:
        if supervised is None:
            return "does not run", "start it with `palpate up`, or take it out of the profile"
        if supervised.state == "exited":  # a finite source at its end: others are started again
            return None
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
