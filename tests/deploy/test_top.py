"""``palpate top``: rates, ages, latencies, losses, memory of every process and sensor."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import pty
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial

import pytest
from rich.console import Console

from palpate.bus import Session
from palpate.census import ProcessReport
from palpate.codec import STATUS
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, LinkError, printable
from palpate.health import Health, HealthReporter
from palpate.messages import (
    GAUGE_MAX,
    UPTIME_MAX_S,
    ErrorReply,
    SensorState,
    SensorStatus,
    ServiceState,
    Status,
    SupervisedProcess,
)
from palpate_deploy.station import fleet, observation
from palpate_deploy.station.activity import (
    DropCount,
    process_activities,
    sensor_activities,
    sensor_part,
)
from palpate_deploy.station.fleet import StationSummary
from palpate_deploy.station.observation import ObservedProcess, StationObserver
from palpate_deploy.station.status import _print, show_status, shown_counters
from palpate_deploy.station.tare import take_tare
from palpate_deploy.station.top import _as_json, run_top, screen
from palpate_deploy.station.troubles import troubles
from palpate_deploy.station.web.snapshot import snapshot
from palpate_services.inference.estimates import EstimateRefusal

PATIENCE_S = 20.0

FEATURES = Status(
    "features",
    "features",
    ServiceState.READY,
    10**12,
    0,
    60.0,
    "1",
    {"frames_received": 500, "estimates_published": 490, "stale": 10, "dropped_newest_wins": 0},
    {
        "latency_p50_s": 1.2e-3,
        "latency_p99_s": 3.4e-3,
        "infer_p50_s": 4e-4,
        "infer_p99_s": 9e-4,
        "process_rss_bytes": 123e6,
        "process_cpu_ratio": 0.07,
        "process_threads": 16.0,
        "process_open_files": 32.0,
        "queue_messages": 2.0,
    },
    models=("features-twin:1",),
)
GATEWAY = Status(
    "gateway",
    "gateway",
    ServiceState.READY,
    10**12,
    0,
    60.0,
    "1",
    {"thumb.frames_published": 500, "thumb.silences": 3, "ring.frames_published": 400},
    {"thumb.tare_age_s": 61.0, "thumb.publish_p50_s": 3e-4, "ring.tare_drift_counts": 7.0},
    sensor_states=(
        SensorStatus("thumb", SensorState.LIVE, 4 * 10**11, (), "E7 has drifted: tare again"),
        SensorStatus("ring", SensorState.LOST, 9 * 10**11, (), "silent for 40 ms"),
    ),
)
SUPERVISOR = Status(
    "supervisor",
    "supervisor",
    ServiceState.DEGRADED,
    10**12,
    0,
    60.0,
    "1",
    gauges={"router.process_rss_bytes": 7e7},
    processes=(
        SupervisedProcess("features", "features", "running", 4711, 2, 60.0),
        SupervisedProcess("router", "router", "running", 4700, 0, 60.0),
        SupervisedProcess("fem", "fem", "backoff", 0, 7, 0.0),
        SupervisedProcess("synthesis", "synthesis", "running", 4712, 1, 60.0),
    ),
)


def observed() -> list[ObservedProcess]:
    found = [
        ObservedProcess(
            ProcessReport(one.service, one.instance, True, True, one),
            0.5,
            {name: 100.0 for name in one.counters if "stale" not in name} | {"stale": 2.0},
        )
        for one in (FEATURES, GATEWAY, SUPERVISOR)
    ]
    return [
        *found,
        ObservedProcess(ProcessReport("fem", "fem", False, False, None)),
        ObservedProcess(ProcessReport("field", "field", True, True, None)),
        ObservedProcess(ProcessReport("router", "router", True, True, None)),
        ObservedProcess(ProcessReport("synthesis", "synthesis", False, False, None)),
    ]


def test_figures_of_every_process() -> None:
    features, gateway, _, fem, field, router, hung = process_activities(observed())
    assert (features.in_hz, features.out_hz) == (100.0, 100.0)
    assert features.latencies["latency"].p99_s == 3.4e-3
    assert features.latencies["infer"].p50_s == 4e-4
    assert features.drops == {"stale": DropCount(10, 2.0)}
    assert (features.restarts, features.pid, features.queue_messages) == (2, 4711, 2)
    assert (features.uses.rss_bytes, features.uses.threads) == (123e6, 16)
    assert features.models == ("features-twin:1",)
    assert (gateway.out_hz, gateway.drops) == (200.0, {})
    assert (fem.state, fem.restarts) == ("backoff", 7)
    assert (field.state, field.in_hz) == ("silent", None)
    assert (hung.state, hung.pid, hung.restarts) == ("silent", 4712, 1)
    assert (router.state, router.uses.rss_bytes, router.pid) == ("routes", 7e7, 4700)


LOSSES = (
    *(one.value for one in EstimateRefusal if one is not EstimateRefusal.SKIPPED_RATE),
    "sensors_refused", "unpublishable_location", "asked_no_model", "tares_refused",
    "dropped_newest_wins", "overflow", "lost_on_bus", "reordered", "other_session", "unannounced",
    "rejected_names", "lost_disk_full", "invalid_parse", "lost_with_record", "disk_failures",
    "missing_frames", "frames_rejected", "silences", "device_lost", "invalid_samples",
)  # fmt: skip
"""Counters of what is lost, refused or not delivered, of every service."""


@pytest.mark.parametrize("name", LOSSES)
def test_every_reason_of_a_loss_is_shown(name: str) -> None:
    status = dataclasses.replace(FEATURES, counters={name: 7, "received": 9, "skipped_rate": 3})
    (one,) = process_activities(
        [ObservedProcess(ProcessReport("features", "features", True, True, status))]
    )
    assert one.drops == {name: DropCount(7, 0.0)}
    assert shown_counters(status) == f"{name} 7"


def test_figures_of_every_sensor() -> None:
    thumb, ring = sensor_activities(observed())
    assert (thumb.name, thumb.state, thumb.rate_hz, thumb.tare_age_s) == (
        "thumb",
        "live",
        100.0,
        61.0,
    )
    assert thumb.message == "E7 has drifted: tare again"
    assert thumb.publish.p50_s == 3e-4
    assert thumb.drops == {"silences": DropCount(3, 100.0)}
    assert thumb.state_age_s == pytest.approx(600.0)
    assert (ring.state, ring.tare_drift_counts, ring.message) == ("lost", 7.0, "silent for 40 ms")
    assert ring.tare_age_s is None


def test_figures_of_a_process_are_not_those_of_its_only_sensor() -> None:
    """A gateway with one sensor puts no name in front of its figures."""
    status = dataclasses.replace(
        GATEWAY,
        counters={"silences": 3, "questions_refused_full": 2, "gauges_not_finite": 1},
        sensor_states=GATEWAY.sensor_states[:1],
    )
    seen = [ObservedProcess(ProcessReport("gateway", "gateway", True, True, status))]
    (gateway,), (thumb,) = process_activities(seen), sensor_activities(seen)
    assert thumb.drops.keys() == {"silences"}
    assert gateway.drops.keys() == {"questions_refused_full", "gauges_not_finite"}
    assert sensor_part("waiting_questions", status) == ("", "waiting_questions")


@pytest.mark.parametrize("width", [80, 160])
def test_the_picture_shows_all_of_it(width: int) -> None:
    text = io.StringIO()
    console = Console(file=text, width=width, force_terminal=False)
    console.print(screen("lab", observed(), width))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    features = next(line for line in lines if line.startswith("features "))
    assert features.split()[:12] == (
        ["features", "ready", "100", "100", "1.2", "3.4", "2", "7", "123", "16", "1:00", "2"]
    )
    everything = " ".join(text.getvalue().split())
    for words in (
        "fem backoff",
        "field silent",
        "router routes",
        "thumb live 10:00 100 0.3 - 1:01 - E7 has drifted:",
        "ring lost",
        "p50/p99 ms infer features 0.4/0.9",
        "features lost: stale 10 (+2.0/s)",
        "thumb lost: silences 3",
        "field: lives and does not answer",
        "fem: does not serve: its supervisor says backoff, started again 7 times",
        "synthesis silent",
        "synthesis: runs and cannot be reached",
    ):
        assert words in everything
    assert ("features-twin:1" in everything) == (width > 100)


@pytest.mark.parametrize("acts", ["\x1b]0;owned\x07\x1b[2J", "[/]", "[red]"])
def test_no_text_of_a_process_acts_on_the_terminal(acts: str) -> None:
    name = acts if acts.isprintable() else "x"  # names hold printable characters only
    hostile = dataclasses.replace(
        FEATURES,
        service=f"f{name}",
        state=ServiceState.DEGRADED,
        counters={f"lost{acts}": 1, f"thumb{acts}.missing": 1},
        gauges={f"s{acts}_p50_s": 1.0, f"thumb{acts}.clock_quality": 2.0},
        sensors=(f"thumb{acts}",),
        message=f"says {acts}",
        last_error=ErrorReply(ErrorCode.INTERNAL, f"bundle {acts}", f"remedy {acts}", 0.0),
        models=(f"m{name}:1",),
    )
    hostile = STATUS.decode(STATUS.encode(hostile))
    report = ProcessReport(hostile.service, f"i{acts}", True, True, hostile)
    seen = [ObservedProcess(report)]
    text = io.StringIO()
    console = Console(file=text, width=400)
    _print(console, "lab", "", [report], troubles([report]))
    console.print(screen("lab", seen, 400))
    summary = StationSummary("lab", process_activities(seen), (), (), troubles([report]))
    fleet._print(console, [summary])
    shown = text.getvalue()
    assert all(char == "\n" or char.isprintable() for char in shown)
    told = printable(acts)
    assert shown.count(f"bundle {told}") == shown.count(f"fix: remedy {told}") == 3
    for words in (f"lost{told} 1", f"thumb{told}", f"s{told}", f"clock of thumb{told}: "):
        assert words in shown


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_largest_numbers_that_a_status_may_hold_hide_nothing_else(sign: float) -> None:
    numbers = sign * GAUGE_MAX
    names = {"clock_quality", "clock_drift_ppm", "wall_synchronised", "wall_error_s", "tare_age_s"}
    seen = []
    for one in observed():
        if (status := one.report.status) is not None:
            status = dataclasses.replace(
                status,
                uptime_s=UPTIME_MAX_S,
                counters=dict.fromkeys(status.counters, 2**64 - 1),
                gauges=dict.fromkeys([*status.gauges, *names], numbers),
            )
            status = STATUS.decode(STATUS.encode(status))
        report = dataclasses.replace(one.report, status=status)
        seen.append(dataclasses.replace(one, report=report))
    text = io.StringIO()
    console = Console(file=text, width=160)
    console.print(screen("lab", seen, 160))
    shown = text.getvalue()
    assert max(map(len, shown.splitlines())) <= 160
    begins = {tuple(line.split()[:2]) for line in shown.splitlines()}
    assert {("features", "ready"), ("supervisor", "degraded"), ("thumb", "live")} <= begins
    assert f"{2**64 - 1:,}" in shown
    assert f"{1e3 * numbers:.0e}/{1e3 * numbers:.0e}" in shown
    _print(console, "lab", "", [one.report for one in seen], [])
    listed = text.getvalue().removeprefix(shown)
    assert max(map(len, listed.splitlines())) <= 160
    assert f"frames_received {2**64 - 1:,}" in listed
    for value in (_as_json("lab", seen), snapshot("lab", seen, router=True, own=("web", "web"))):
        json.dumps(value, allow_nan=False)


def test_rates_are_of_the_last_seconds_and_forget_a_restart() -> None:
    heard = observation._Heard(dataclasses.replace(FEATURES, monotonic_ns=0))
    for second in range(1, 8):
        counters = {"frames_received": 500 + 100 * second}
        heard.hear(
            dataclasses.replace(
                FEATURES, monotonic_ns=second * 10**9, uptime_s=60.0 + second, counters=counters
            )
        )
    assert heard.rates_hz() == {"frames_received": pytest.approx(100.0)}
    again = dataclasses.replace(
        FEATURES, monotonic_ns=9 * 10**9, uptime_s=0.1, counters={"frames_received": 5}
    )
    heard.hear(again)
    assert heard.rates_hz() == {}
    later = dataclasses.replace(
        again, monotonic_ns=10 * 10**9, uptime_s=1.1, counters={"frames_received": 55}
    )
    heard.hear(later)
    assert heard.rates_hz() == {"frames_received": pytest.approx(50.0)}


@pytest.fixture
def services(link: LinkConfig) -> Iterator[dict[str, tuple[Session, Health]]]:
    """Three processes that count 100 frames a second."""
    with ExitStack() as stack:
        running = {}
        for name in ("features", "gateway", "recorder"):
            session = stack.enter_context(Session.open(link))
            health = Health(name, name)
            health.set_state(ServiceState.READY)
            stack.enter_context(
                HealthReporter(
                    session,
                    health,
                    period_s=0.2,
                    refresh=partial(health.count, "frames_received", 20),
                )
            )
            session.presence(name, instance=name).ready()
            running[name] = session, health
        yield running


def test_an_observer_follows_a_station(
    services: dict[str, tuple[Session, Health]], link: LinkConfig, wait_until: Callable[..., float]
) -> None:
    with (
        Session.open(link.model_copy(update={"direct": False})) as session,
        StationObserver(session, expected=[("fem", "fem")]) as observer,
    ):
        observer.ask(0.5)

        def all_flow() -> bool:
            found = {one.report.service: one for one in observer.look()}
            return all(found[name].rates_hz.get("frames_received", 0.0) > 0.0 for name in services)

        wait_until(all_flow, PATIENCE_S, "all flow")
        found = {one.report.service: one for one in observer.look()}
        assert found.keys() == {*services, "fem", "router"}
        assert not found["fem"].report.alive
        services["recorder"][0].close()
        wait_until(
            lambda: "recorder" not in {one.report.service for one in observer.look()},
            PATIENCE_S,
            "the recorder is forgotten",
        )


def test_one_picture_for_scripts(
    services: dict[str, tuple[Session, Health]],
    link: LinkConfig,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_top(link, "lab", as_json=True) == 0
    told = json.loads(capsys.readouterr().out)
    assert [one["service"] for one in told["processes"]] == [
        "features", "gateway", "recorder", "router",
    ]  # fmt: skip
    assert told["processes"][0]["in_hz"] > 0.0
    assert told["processes"][0]["uses"]["rss_bytes"] > 1e6
    assert run_top(link, "lab", once=True) == 0
    assert "features" in capsys.readouterr().out
    assert run_top(link, "elsewhere", once=True) == 1
    assert "no process of station 'elsewhere' runs" in capsys.readouterr().out


def test_a_wrong_station_is_told_which_are_there(
    services: dict[str, tuple[Session, Health]],
    link: LinkConfig,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for look in (partial(run_top, once=True), partial(show_status, as_json=False)):
        assert look(link, "elsewhere") == 1
        assert "--station lab" in capsys.readouterr().out
    with pytest.raises(LinkError, match="no process of station 'elsewhere' runs") as told:
        take_tare(link, "elsewhere", "finger", frames=2, timeout_s=5.0)
    assert told.value.remedy.endswith("--station or station=: lab")


def test_it_ends_with_q(services: dict[str, tuple[Session, Health]], link: LinkConfig) -> None:
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update(TERM="xterm", COLUMNS="80", LINES="24")
        command = [sys.executable, "-m", "palpate_deploy", "top", "--connect", link.connect[0]]
        os.execv(sys.executable, command)
    shown = b""
    asked = False
    deadline = time.monotonic() + 3 * PATIENCE_S
    while time.monotonic() < deadline:
        if not select.select([terminal], [], [], 0.5)[0]:
            continue
        try:
            shown += os.read(terminal, 65536)
        except OSError:  # the command has ended
            break
        if b"recorder" in shown and not asked:
            os.write(terminal, b"q")
            asked = True
    assert asked, shown
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert b"features" in shown
