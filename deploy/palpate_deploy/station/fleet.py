"""``palpate fleet``: every station that can be reached from one router, a line for each."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field

from rich.console import Console
from rich.table import Table
from rich.text import Text

from palpate.bus import Session
from palpate.bus.topics import duty_root
from palpate.config import LinkConfig
from palpate.errors import printable
from palpate_deploy.station.activity import (
    ProcessActivity,
    SensorActivity,
    process_activities,
    sensor_activities,
)
from palpate_deploy.station.logs import FAILED, cell
from palpate_deploy.station.observation import RATES_S, StationObserver
from palpate_deploy.station.status import duration_text
from palpate_deploy.station.troubles import Trouble, process_name, troubles

_log = logging.getLogger(__name__)

_ASK_S = 2.0
_STATIONS_MOST = 256


@dataclass(frozen=True, slots=True)
class StationSummary:
    """One station of a site, as its processes describe themselves.

    Attributes:
        station: Its name.
        processes: Its processes.
        sensors: Its sensors.
        simulators: Who answers for which simulated fingertip, as ``sensor``, ``instance``, ``host``
            and ``digest`` of what its answers depend on.
        troubles: What is wrong; empty = all is well.
    """

    station: str
    processes: Sequence[ProcessActivity]
    sensors: Sequence[SensorActivity]
    simulators: Sequence[dict[str, str]] = field(default_factory=list)
    troubles: Sequence[Trouble] = ()


def show_fleet(link: LinkConfig, *, as_json: bool) -> int:
    """Print every station that is seen from a router; 1 if there is none, or anything is wrong.

    Raises:
        LinkError: There is no router.
    """
    found = look_at_fleet(link)
    if as_json:
        print(json.dumps({"stations": [asdict(one) for one in found]}, indent=2))
    else:
        _print(Console(), found)
    return FAILED if not found or any(one.troubles for one in found) else 0


def look_at_fleet(link: LinkConfig) -> list[StationSummary]:
    """Every station with a living process, by name; takes three to six seconds.

    Of more than 256 the first are asked, and a warning is logged.

    Raises:
        LinkError: There is no router.
    """
    through = link.model_copy(update={"direct": False})
    with Session.open(through) as session:
        seen = sorted({one.station for one in session.alive(station="*")})
    names = seen[:_STATIONS_MOST]
    if len(seen) > len(names):
        _log.warning("%d stations are seen; the first %d by name are asked", len(seen), len(names))
    with ExitStack() as stack, ThreadPoolExecutor(max(1, len(names))) as pool:
        sessions = {
            name: stack.enter_context(Session.open(through, station=name)) for name in names
        }
        observers = {
            name: stack.enter_context(StationObserver(one)) for name, one in sessions.items()
        }
        for asked in [pool.submit(one.ask, _ASK_S) for one in observers.values()]:
            asked.result()
        time.sleep(RATES_S)
        return [_summary(name, sessions[name], observers[name]) for name in names]


def _summary(name: str, session: Session, observer: StationObserver) -> StationSummary:
    # Of other hosts' routers only those say something of themselves that belong to a site; the one
    # that is asked here is no process of every station.
    observed = [
        one
        for one in observer.look()
        if one.report.service != "router" or one.report.status is not None
    ]
    return StationSummary(
        name,
        process_activities(observed),
        sensor_activities(observed),
        [
            {
                "sensor": one.sensor,
                "instance": one.instance,
                "host": one.host,
                "digest": one.serial,
            }
            for one in session.holders(duty_root("simulate"), "*")
        ],
        troubles(one.report for one in observed),
    )


def _print(console: Console, found: Sequence[StationSummary]) -> None:
    table = Table(title="stations", title_justify="left")
    for column in ("station", "well", "sensors", "estimates", "models", "simulates"):
        table.add_column(column, overflow="fold")
    for one in found:
        well = sum(process.state in ("ready", "finished") for process in one.processes)
        colour = "green" if not one.troubles else "red"
        table.add_row(
            cell(one.station),
            f"[{colour}]{well} of {len(one.processes)}[/]",
            "\n".join(_sensor(sensor) for sensor in one.sensors) or "-",
            "\n".join(_estimates(process) for process in one.processes if process.models) or "-",
            "\n".join(
                sorted({cell(model) for process in one.processes for model in process.models})
            )
            or "-",
            "\n".join(
                cell(f"{by['sensor']}: {by['instance']} ({by['digest'][:8]})")
                for by in one.simulators
            )
            or "-",
        )
    if not found:
        table.caption = "no station is seen from this router"
    console.print(table)
    for one in found:
        for trouble in one.troubles:
            name = process_name(trouble.service, trouble.instance)
            line = f"{one.station}: {name}: {trouble.problem}"
            console.print(Text(printable(line), style="red"), soft_wrap=True)
            console.print(Text(printable(f"  fix: {trouble.remedy}")), soft_wrap=True)


def _sensor(sensor: SensorActivity) -> str:
    rate = "-" if sensor.rate_hz is None else f"{sensor.rate_hz:.0f}/s"
    words = [sensor.name, sensor.state.replace("_", " "), rate]
    if sensor.tare_age_s is not None:
        words.append(f"tare {duration_text(sensor.tare_age_s)}")
    elif sensor.tactile:
        words.append("no tare")
    return cell(" ".join(words))


def _estimates(process: ProcessActivity) -> str:
    name = process_name(process.service, process.instance)
    if process.message.startswith("standby"):
        return cell(f"{name} stands by")
    return cell(f"{name} {'-' if process.out_hz is None else f'{process.out_hz:.0f}/s'}")
