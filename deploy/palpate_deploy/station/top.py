"""``palpate top``: every process and sensor of a station, refreshed in place."""

from __future__ import annotations

import contextlib
import json
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from palpate.census import ROUTER
from palpate.config import LinkConfig
from palpate.errors import printable
from palpate_deploy.station.activity import (
    DropCount,
    ProcessActivity,
    SensorActivity,
    StageLatency,
    process_activities,
    sensor_activities,
)
from palpate_deploy.station.logs import FAILED, cell
from palpate_deploy.station.observation import RATES_S, ObservedProcess, StationObserver
from palpate_deploy.station.status import duration_text, nothing_runs
from palpate_deploy.station.troubles import (
    Expectation,
    Trouble,
    ask_through_router,
    expectation,
    process_name,
    troubles,
)

_ASK_S = 2.0
_WIDE = 110
_QUIT = frozenset("qQ\x03\x1b")

_STAGES = {
    "arrival_age": "age", "waiting": "waiting", "decode": "decode", "tare": "tare",
    "infer": "infer", "encode": "encode",
}  # fmt: skip
"""Stages of an estimate, in the order of its way."""

_STATE_COLOURS = {
    "ready": "green", "live": "green", "routes": "green",
    "finished": "cyan", "ended": "cyan",
    "degraded": "red", "missing": "red", "silent": "red", "lost": "red", "zero_lost": "red",
}  # fmt: skip


def run_top(
    link: LinkConfig,
    station: str,
    *,
    profile: str | None = None,
    period_s: float = 1.0,
    once: bool = False,
    as_json: bool = False,
) -> int:
    """Show a station until ``q`` or Ctrl-C; with ``once`` or ``as_json`` a single time.

    Returns:
        0; a single look at a station where something is wrong: 1.

    Raises:
        LinkError: There is no router.
        ConfigError: There is no such profile.
    """
    said = expectation(link, station, profile or None)
    expected = frozenset() if said is None else said.processes
    console = Console()
    with (
        ask_through_router(link, station, said) as session,
        StationObserver(session, expected=expected) as observer,
    ):
        observer.ask(_ASK_S)
        if once or as_json or not console.is_terminal:
            time.sleep(RATES_S)
            observed = observer.look()
            if as_json:
                print(json.dumps(_as_json(station, observed, said), indent=2))
            else:
                console.print(screen(station, observed, console.width, said))
            found = troubles((one.report for one in observed), said)
            nobody = all((one.report.service, one.report.instance) == ROUTER for one in observed)
            if nobody and not as_json:
                print(printable(nothing_runs(session)))
            return FAILED if found or nobody else 0
        with _keys() as key, Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                shown = screen(station, observer.look(), console.width, said)
                live.update(shown, refresh=True)
                if key(period_s) in _QUIT:
                    break
    return 0


@contextlib.contextmanager
def _keys() -> Iterator[Callable[[float], str | None]]:
    """A function that waits for a key for a time [s] and returns it, or None."""
    descriptor = sys.stdin.fileno()
    if not os.isatty(descriptor):
        yield lambda wait_s: time.sleep(wait_s)
        return
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor)
    try:

        def key(wait_s: float) -> str | None:
            if not select.select([descriptor], [], [], wait_s)[0]:
                return None
            return os.read(descriptor, 1).decode(errors="replace") or "q"

        yield key
    except KeyboardInterrupt:
        pass
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def screen(
    station: str,
    observed: Sequence[ObservedProcess],
    width: int,
    said: Expectation | None = None,
) -> Group:
    """A station as one picture of ``width`` characters; ``said`` is for ``troubles``."""
    processes, sensors = process_activities(observed), sensor_activities(observed)
    found = troubles((one.report for one in observed), said)
    well = sum(one.state in ("ready", "routes", "finished") for one in processes)
    title = Text(f"station {station}   {well} of {len(processes)} processes well   ")
    title.append(time.strftime("%H:%M:%S"), style="dim")
    title.append("   q quits", style="dim")
    parts: list[RenderableType] = [title, _process_table(processes, wide=width >= _WIDE)]
    if sensors:
        parts.append(_sensor_table(sensors))
    if (stages := _stage_table(processes)) is not None:
        parts.append(stages)
    parts += [*_drop_lines(processes, sensors), *_trouble_lines(found)]
    return Group(*parts)


def _table(*columns: str) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), header_style="bold", pad_edge=False)
    for column in columns:
        name, _, side = column.partition(">")
        # Only words for people give way where the terminal is narrow.
        table.add_column(name, justify="right" if side else "left", no_wrap=name != "says")
    return table


def _process_table(processes: Sequence[ProcessActivity], *, wide: bool) -> Table:
    more = ("files> ", "age> ", "pid> ", "models", "says") if wide else ()
    table = _table(
        "process", "state", "in/s> ", "out/s> ", "p50 ms> ", "p99 ms> ", "queue> ", "cpu %> ",
        "MB> ", "thr> ", "up> ", "rst> ", *more,
    )  # fmt: skip
    for one in processes:
        whole = one.latencies.get("latency", StageLatency())
        row = [
            cell(process_name(one.service, one.instance)),
            _state(one.state if one.ready or one.state != "ready" else "not ready"),
            _number(one.in_hz),
            _number(one.out_hz),
            _ms(whole.p50_s),
            _ms(whole.p99_s),
            _number(one.queue_messages),
            _number(one.uses.cpu_ratio, 100.0),
            _number(one.uses.rss_bytes, 1e-6),
            _number(one.uses.threads),
            "-" if one.uptime_s is None else duration_text(one.uptime_s),
            _number(one.restarts),
        ]
        if wide:
            row += [
                _number(one.uses.open_files),
                "-" if one.status_age_s is None else f"{one.status_age_s:.1f}",
                _number(one.pid or None),
                cell(" ".join(one.models)),
                cell(one.message),
            ]
        table.add_row(*row)
    return table


def _sensor_table(sensors: Sequence[SensorActivity]) -> Table:
    table = _table(
        "sensor", "state", "for> ", "Hz> ", "p50 ms> ", "p99 ms> ", "tare age> ", "drift> ", "says"
    )
    for one in sensors:
        table.add_row(
            cell(one.name),
            _state(one.state),
            duration_text(one.state_age_s),
            _number(one.rate_hz),
            _ms(one.publish.p50_s),
            _ms(one.publish.p99_s),
            "-" if one.tare_age_s is None else duration_text(one.tare_age_s),
            _number(one.tare_drift_counts),
            cell(one.message),
        )
    return table


def _stage_table(processes: Sequence[ProcessActivity]) -> Table | None:
    """Where the time goes: each stage of each process, median and 99th percentile."""
    timed = [(one, {k: v for k, v in one.latencies.items() if k != "latency"}) for one in processes]
    found = {stage for _, latencies in timed for stage in latencies}
    stages = [*(stage for stage in _STAGES if stage in found), *sorted(found - {*_STAGES})]
    if not stages:
        return None
    table = _table("p50/p99 ms", *(f"{_STAGES.get(stage, cell(stage))}> " for stage in stages))
    for one, latencies in timed:
        if latencies:
            cells = [latencies.get(stage) for stage in stages]
            words = ["-" if of is None else f"{_ms(of.p50_s)}/{_ms(of.p99_s)}" for of in cells]
            table.add_row(cell(process_name(one.service, one.instance)), *words)
    return table


def _drop_lines(
    processes: Sequence[ProcessActivity], sensors: Sequence[SensorActivity]
) -> Iterator[Text]:
    """What was lost on the way and why, with the rate where it goes on."""
    lines = [(process_name(one.service, one.instance), one.drops) for one in processes]
    for name, drops in [*lines, *((one.name, one.drops) for one in sensors)]:
        if drops:
            words = "  ".join(_drop(reason, of) for reason, of in drops.items())
            yield Text.assemble((printable(f"{name} lost: "), "bold"), printable(words))


def _drop(reason: str, of: DropCount) -> str:
    now = f" (+{of.rate_hz:.1f}/s)" if of.rate_hz >= 0.05 else ""
    return f"{reason} {of.count:,}{now}"


def _trouble_lines(found: Sequence[Trouble]) -> Iterator[Text]:
    for one in found:
        problem = f"{process_name(one.service, one.instance)}: {one.problem}"
        yield Text(printable(problem), style="red")
        yield Text(printable(f"  fix: {one.remedy}"))


def _state(state: str) -> str:
    return f"[{_STATE_COLOURS.get(state, 'yellow')}]{cell(state.replace('_', ' '))}[/]"


def _number(value: float | None, scale: float = 1.0) -> str:
    if value is None:
        return "-"
    scaled = scale * value
    tenths = scaled < 10.0 and abs(scaled - round(scaled)) > 0.05
    return _fixed(scaled, 1 if tenths else 0)


def _ms(seconds: float | None) -> str:
    return "-" if seconds is None else _fixed(1e3 * seconds, 1)


def _fixed(value: float, digits: int) -> str:
    """With digits after the point; an absurd value must not take the room of names and states."""
    return f"{value:.{digits}f}" if abs(value) < 1e7 else f"{value:.0e}"


def _as_json(
    station: str, observed: Sequence[ObservedProcess], said: Expectation | None = None
) -> dict[str, Any]:
    return {
        "station": station,
        "processes": [asdict(one) for one in process_activities(observed)],
        "sensors": [asdict(one) for one in sensor_activities(observed)],
        "troubles": [asdict(one) for one in troubles((one.report for one in observed), said)],
    }
