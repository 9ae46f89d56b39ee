"""``palpate status``: which processes run, and what each reports: state, counters, clocks."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from palpate.bus import AliveService, Session, endpoints
from palpate.config import LinkConfig
from palpate.errors import PalpateError
from palpate.messages import (
    SensorState,
    ServiceRequest,
    ServiceState,
    Status,
)
from palpate_deploy.station.logs import FAILED
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
        lines.append(f"clock of {sensor}: {_sensor_clock(gauges, head + dot)}")
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


def _sensor_clock(gauges: Mapping[str, float], prefix: str) -> str:
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
_TROUBLE = (
    "lost", "missed", "missing", "dropped", "overflow", "rejected", "stale", "unknown", "failed",
    "wrong", "silences", "stuck", "dead",
)  # fmt: skip


def ask_status(session: Session, *, timeout_s: float = _ANSWER_S) -> list[Status]:
    """Status of every process of the station; invalid replies are left out."""
    answers = session.query_all(endpoints.STATUS, ServiceRequest(), timeout_s=timeout_s)
    return [answer for answer in answers if not isinstance(answer, PalpateError)]


def show_status(link: LinkConfig, station: str, *, as_json: bool) -> int:
    """Print presence and status of a station.

    Returns:
        0; 1 if no process runs, one does not reply, or one is degraded.

    Raises:
        LinkError: There is no router.
    """
    with Session.open(link, station=station) as session:
        present = session.alive()
        answers = {(s.service, s.instance): s for s in ask_status(session)}
        router = session.has_router()
    if as_json:
        print(json.dumps(_as_json(station, router, present, answers), indent=2))
    else:
        console = Console()
        console.print(_table(station, present, answers))
        for status in answers.values():
            for line in clock_lines(status):
                console.print(line, markup=False, highlight=False, soft_wrap=True)
    degraded = any(s.state is ServiceState.DEGRADED for s in answers.values())
    silent = any((p.service, p.instance) not in answers for p in present)
    return FAILED if not present or degraded or silent else 0


def shown_counters(status: Status) -> str:
    """The most important counters: the flow of messages, and everything that went wrong."""
    return "  ".join(
        f"{name} {count:,}"
        for name, count in sorted(status.counters.items())
        if name in _SHOWN_COUNTERS or (count and any(word in name for word in _TROUBLE))
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


def _table(
    station: str, present: Iterable[AliveService], answers: dict[tuple[str, str], Status]
) -> Table:
    table = Table(title=f"station {station}", title_justify="left")
    for column in ("process", "ready", "state", "up", "sensors", "says", "counters"):
        table.add_column(column, overflow="fold")
    for process in present:
        name = process.service
        if process.instance != process.service:
            name += f"/{process.instance}"
        ready = "[green]yes[/]" if process.ready else "[yellow]no[/]"
        status = answers.get((process.service, process.instance))
        if status is None:
            table.add_row(name, ready, "[red]no answer[/]", "", "", "", "")
            continue
        says = escape(status.message)
        if status.last_error is not None and status.state is ServiceState.DEGRADED:
            error = status.last_error
            says = f"{escape(error.message)} [dim](fix: {escape(error.remedy)})[/]"
        table.add_row(
            name,
            ready,
            state_text(status.state),
            duration_text(status.uptime_s),
            _sensors(status),
            says,
            shown_counters(status),
        )
    if not table.row_count:
        table.caption = f"no process of station {station!r} runs: start it with `palpate up`"
    return table


def _sensors(status: Status) -> str:
    """Each sensor with its state and its message, as rich markup."""
    lines = []
    for sensor in status.sensor_states:
        state = sensor.state.name.lower().replace("_", " ")
        colour = _SENSOR_COLOURS.get(sensor.state, "yellow")
        said = f" [dim]({escape(sensor.message)})[/]" if sensor.message else ""
        lines.append(f"{escape(sensor.name)} [{colour}]{state}[/]{said}")
    return "\n".join(lines) or " ".join(status.sensors)


def _as_json(
    station: str,
    router: bool,
    present: Iterable[AliveService],
    answers: dict[tuple[str, str], Status],
) -> dict[str, Any]:
    processes = []
    for process in present:
        status = answers.get((process.service, process.instance))
        entry = {key: getattr(process, key) for key in ("service", "instance", "ready")}
        processes.append(entry | ({} if status is None else _status_json(status)))
    return {"station": station, "router": router, "processes": processes}


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
        "counters": dict(status.counters),
        "gauges": dict(status.gauges),
        "last_error": error
        and {
            "code": error.code.name.lower(),
            "message": error.message,
            "remedy": error.remedy,
        },
    }
