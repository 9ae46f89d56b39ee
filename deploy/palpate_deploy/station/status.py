"""``palpate status``: what should run, what does, and what each process reports of itself."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from palpate.bus import Session, endpoints
from palpate.bus.presence import other_stations
from palpate.census import PATIENCE_S, ROUTER, ProcessReport, take_census
from palpate.config import LinkConfig
from palpate.errors import PalpateError, printable
from palpate.messages import (
    SensorState,
    ServiceRequest,
    ServiceState,
    Status,
)
from palpate_deploy.station.logs import FAILED, cell
from palpate_deploy.station.troubles import (
    Trouble,
    ask_through_router,
    expectation,
    lifeless,
    process_name,
    troubles,
)
from palpate_gateway.clock.stamps import ClockQuality
from palpate_gateway.clock.wall_clock import WallDiscipline

_QUALITY = "clock_quality"
_SMALL_PPM = 0.5


def clock_lines(status: Status) -> list[str]:
    """Lines on the clocks of the sensors and on the host's wall clock."""
    gauges = status.gauges
    lines = []
    for name in sorted(gauges):
        head, dot, tail = name.rpartition(".")
        if tail != _QUALITY:
            continue
        sensor = head or " ".join(status.sensors) or status.service
        lines.append(f"clock of {sensor}: {_sensor_clock(status, head + dot)}")
    if "wall_synchronised" in gauges:
        kept = WallDiscipline(gauges["wall_synchronised"] > 0.5, gauges.get("wall_error_s", 0.0))
        lines.append(f"wall clock: {wall_words(kept)}")
    if steps := status.counters.get("wall_steps", 0):
        times = "once" if steps == 1 else f"{steps} times"
        lines.append(f"wall clock: it was set {times} since the start of {status.service}")
    return lines


def wall_words(kept: WallDiscipline | None) -> str:
    """Whether and how well the wall clock is synchronised, for people."""
    if kept is None:
        return "whether it is synchronised is not known on this host"
    if not kept.synchronised:
        return "not synchronised (chrony, NTP, PTP): compare times of this host only"
    return f"synchronised to {duration_words(kept.error_s)}, by the kernel's estimate"


def duration_words(seconds: float) -> str:
    """A short duration for people: ``12 us``, ``3.4 ms``, ``1.2 s``."""
    if seconds < 1e-3:
        return f"{1e6 * seconds:.0f} us"
    return f"{1e3 * seconds:.1f} ms" if seconds < 1.0 else f"{seconds:.1f} s"


def _sensor_clock(status: Status, prefix: str) -> str:
    gauges = status.gauges
    try:
        quality = ClockQuality(int(gauges[prefix + _QUALITY]))
    except ValueError:  # of a newer palpate
        return f"quality {gauges[prefix + _QUALITY]:g}"
    if quality is ClockQuality.ARRIVAL:
        return "the device sends none; stamps are times of arrival"
    drift_ppm = gauges.get(prefix + "clock_drift_ppm", 0.0)
    delay_s = gauges.get(prefix + "clock_delay_p50_s")
    words = ["settling" if quality is ClockQuality.SETTLING else "followed"]
    if abs(drift_ppm) >= _SMALL_PPM:
        words.append(f"{abs(drift_ppm):.0f} ppm {'fast' if drift_ppm > 0 else 'slow'}")
    if delay_s is not None:
        words.append(f"frames arrive {duration_words(delay_s)} after their stamps")
    if quality is ClockQuality.ODD:
        words.append("too much for a quartz: check the configured rate")
    if steps := status.counters.get(prefix + "clock_steps", 0):
        words.append(f"it stopped and went on {'once' if steps == 1 else f'{steps} times'}")
    return ", ".join(words)


_ANSWER_S = 1.0

_COLOURS = {
    ServiceState.STARTING: "yellow",
    ServiceState.READY: "green",
    ServiceState.DEGRADED: "red",
    ServiceState.FINISHED: "cyan",
    ServiceState.STOPPING: "yellow",
}

_SENSOR_COLOURS = {  # of all others yellow
    SensorState.LIVE: "green",
    SensorState.ZERO_LOST: "red",
    SensorState.LOST: "red",
    SensorState.ENDED: "cyan",
}

# Counters that the table shows; --json shows all.
_SHOWN_COUNTERS = (
    "frames_published",
    "frames_received",
    "fields_received",
    "estimates_published",
    "recorded_electrodes",
    "recorded_features",
    "recorded_field",
    "simulations_complete",
)
TROUBLE = (
    "lost", "missed", "missing", "dropped", "overflow", "rejected", "stale", "unknown", "failed",
    "wrong", "silences", "stuck", "dead", "untared", "invalid", "no_model", "refused", "skew",
    "finite", "unpublishable", "reordered", "other_session", "unannounced", "failures",
)  # fmt: skip
"""Parts of the names of counters that count what went wrong."""


def ask_status(session: Session, *, timeout_s: float = _ANSWER_S) -> list[Status]:
    """Status of every process of the station; invalid replies are left out."""
    answers = session.query_all(endpoints.STATUS, ServiceRequest(), timeout_s=timeout_s)
    return [answer for answer in answers if not isinstance(answer, PalpateError)]


def nothing_runs(session: Session) -> str:
    """What is told of a session's station if no process of it answers."""
    told = f"no process of station {session.station!r} runs: start it with `palpate up`"
    if others := other_stations(session.alive(station="*"), session.station):
        told += f", or name another one that this router sees: --station {' | '.join(others)}"
    return told


def show_status(
    link: LinkConfig,
    station: str,
    *,
    as_json: bool,
    profile: str | None = None,
    alive: bool = False,
    timeout_s: float = PATIENCE_S,
) -> int:
    """Print what should run at a station and what does, with its status.

    What should run is said by ``profile`` (name or path), by the station's supervisor, and by the
    run of this host that uses this router. A process that does not answer is asked again for
    ``timeout_s`` [s].

    Returns:
        0; 1 if no process runs, or one is missing, does not answer or is not ready. With ``alive``
        one that answers is well whatever it says: see ``troubles.lifeless``.

    Raises:
        LinkError: There is no router.
        ConfigError: There is no such profile.
    """
    said = expectation(link, station, profile)
    with ask_through_router(link, station, said) as session:
        expected = frozenset() if said is None else said.processes
        census = take_census(session, expected=expected, timeout_s=timeout_s)
        router = session.has_router()
        nothing = "" if census else nothing_runs(session)
    source = "" if said is None else said.source
    if not source and any(one.status is not None and one.status.processes for one in census):
        source = "the supervisor of the station"
    found = troubles(census, said)
    if as_json:
        print(json.dumps(_as_json(station, router, source, census, found), indent=2))
    else:
        _print(Console(), station, source, census, found)
        if nothing:
            print(printable(nothing))
    wrong = lifeless(census, said) if alive else found
    return FAILED if wrong or not census else 0


def _print(
    console: Console,
    station: str,
    source: str,
    census: Sequence[ProcessReport],
    found: Sequence[Trouble],
) -> None:
    console.print(_table(station, census))
    for process in census:
        for line in clock_lines(process.status) if process.status is not None else ():
            console.print(printable(line), markup=False, highlight=False, soft_wrap=True)
    for one in found:
        problem = f"{process_name(one.service, one.instance)}: {one.problem}"
        console.print(Text(printable(problem), style="red"), soft_wrap=True)
        console.print(Text(printable(f"  fix: {one.remedy}")), soft_wrap=True)
    if census and not source:
        console.print(
            "what should run here is not known: no `palpate up` answers; name a --profile",
            style="yellow",
            soft_wrap=True,
        )


def shown_counters(status: Status) -> str:
    """The most important counters: the flow of messages, and everything that went wrong."""
    return "  ".join(
        f"{name} {count:,}"
        for name, count in sorted(status.counters.items())
        if name in _SHOWN_COUNTERS or (count and any(word in name for word in TROUBLE))
    )


def state_text(state: ServiceState) -> str:
    """A state with its colour, as rich markup."""
    return f"[{_COLOURS[state]}]{state.name.lower()}[/]"


def duration_text(seconds: float) -> str:
    """A duration for people: ``12 s``, ``3:05``, ``2:03:05``."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _table(station: str, census: Iterable[ProcessReport]) -> Table:
    table = Table(title=f"station {station}", title_justify="left")
    for column in ("process", "ready", "state", "up", "sensors", "says", "counters"):
        table.add_column(column, overflow="fold")
    for process in census:
        name = cell(process_name(process.service, process.instance))
        ready = "[green]yes[/]" if process.ready else "[yellow]no[/]"
        status = process.status
        if status is None:
            state = "[green]routes[/]" if (process.service, process.instance) == ROUTER else ""
            if not process.alive:
                state = "[red]missing[/]"
            table.add_row(name, ready, state or "[red]no answer[/]", "", "", "", "")
            continue
        table.add_row(
            name,
            ready,
            state_text(status.state),
            duration_text(status.uptime_s),
            _sensors(status),
            cell(status.message),
            cell(shown_counters(status)),
        )
    return table


def _sensors(status: Status) -> str:
    """Each sensor with its state and its message, as rich markup."""
    lines = []
    for sensor in status.sensor_states:
        state = sensor.state.name.lower().replace("_", " ")
        colour = _SENSOR_COLOURS.get(sensor.state, "yellow")
        said = f" [dim]({cell(sensor.message)})[/]" if sensor.message else ""
        lines.append(f"{cell(sensor.name)} [{colour}]{state}[/]{said}")
    return "\n".join(lines) or cell(" ".join(status.sensors))


def _as_json(
    station: str,
    router: bool,
    source: str,
    census: Iterable[ProcessReport],
    found: Sequence[Trouble],
) -> dict[str, Any]:
    processes = []
    for process in census:
        entry = {key: getattr(process, key) for key in ("service", "instance", "alive", "ready")}
        status = process.status
        processes.append(entry | ({} if status is None else _status_json(status)))
    return {
        "station": station,
        "router": router,
        "expected_by": source or None,
        "troubles": [asdict(one) for one in found],
        "processes": processes,
    }


def _status_json(status: Status) -> dict[str, Any]:
    error = status.last_error
    return {
        "state": status.state.name.lower(),
        "uptime_s": round(status.uptime_s, 3),
        "version": status.version,
        "sensors": list(status.sensors),
        "sensor_states": [
            {
                "name": sensor.name,
                "state": sensor.state.name.lower(),
                "since_monotonic_ns": sensor.since_monotonic_ns,
                "faults": {f.kind.name.lower(): list(f.channels) for f in sensor.faults},
                "message": sensor.message,
            }
            for sensor in status.sensor_states
        ],
        "message": status.message,
        "models": list(status.models),
        "processes": [asdict(one) for one in status.processes],
        "counters": dict(status.counters),
        "gauges": dict(status.gauges),
        "last_error": error
        and {
            "code": error.code.name.lower(),
            "message": error.message,
            "remedy": error.remedy,
        },
    }
