"""What each process and sensor of a station does, in figures: for ``palpate top`` and machines."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from palpate.census import ROUTER
from palpate.messages import SensorStatus, Status, SupervisedProcess
from palpate_deploy.station.observation import ObservedProcess
from palpate_deploy.station.status import TROUBLE
from palpate_deploy.station.troubles import RUNNING

_QUANTILE = re.compile(r"(.+)_p(50|99)_s")
_IN = frozenset({"frames_received", "fields_received", "received"})
_OUT = frozenset({"frames_published", "estimates_published", "simulations_complete"})
_WRITTEN = "recorded_"
_OF_PROCESS = ("wall_", "process_", "questions_", "waiting_questions", "gauges_not_finite")
"""Begins of the names of figures that are of a gateway, and of no sensor of it."""


@dataclass(frozen=True, slots=True)
class StageLatency:
    """Latency of one stage: median and 99th percentile of the last second [s]; None = not told."""

    p50_s: float | None = None
    p99_s: float | None = None


@dataclass(frozen=True, slots=True)
class DropCount:
    """Messages that were dropped, refused or lost for one reason, and how many a second."""

    count: int
    rate_hz: float


@dataclass(frozen=True, slots=True)
class HostShare:
    """What a process uses of its host; None = not told.

    ``cpu_ratio`` is its processor time per time (1 = one core), ``rss_bytes`` its resident memory.
    """

    cpu_ratio: float | None = None
    rss_bytes: float | None = None
    threads: int | None = None
    open_files: int | None = None


@dataclass(frozen=True, slots=True)
class ProcessActivity:
    """One process.

    Attributes:
        state: Its own word, in lower case; ``missing`` = it does not run, ``silent`` = it runs and
            does not answer, ``routes`` = the router.
        status_age_s: Time since its status came [s].
        restarts: How often its supervisor started it again; None = there is no supervisor.
        models: Bundles that it serves, as ``name:version``.
        in_hz: Messages that come [1/s]; None = not told.
        out_hz: Messages that it publishes or records [1/s]; None = not told.
        queue_messages: Messages that wait; None = not told.
        latencies: By stage; ``latency`` is that of the whole way from the reading.
        drops: What was lost on the way, by counter; only what has happened.
        uses: What it uses of its host.
    """

    service: str
    instance: str
    state: str
    ready: bool
    status_age_s: float | None = None
    uptime_s: float | None = None
    restarts: int | None = None
    pid: int | None = None
    models: Sequence[str] = ()
    in_hz: float | None = None
    out_hz: float | None = None
    queue_messages: int | None = None
    latencies: Mapping[str, StageLatency] = field(default_factory=dict)
    drops: Mapping[str, DropCount] = field(default_factory=dict)
    uses: HostShare = HostShare()
    message: str = ""


@dataclass(frozen=True, slots=True)
class SensorActivity:
    """One sensor of a gateway.

    Attributes:
        gateway: Instance of its gateway.
        state: In lower case, e.g. ``live``.
        state_age_s: How long it has been in this state [s].
        rate_hz: Frames published [1/s].
        drops: What was lost on the way, by counter; only what has happened.
        publish: From the arrival of a reading to its message on the bus.
        tare_age_s: Age of the tare in force [s]; None = there is none.
        tare_drift_counts: Drift of the worst electrode when last untouched [counts].
        message: What is wrong or to be done, for people; a live sensor may have to be tared.
        tactile: Whether it is a BioTac, which is tared; other sensors have no tare.
    """

    name: str
    gateway: str
    state: str
    state_age_s: float
    rate_hz: float | None = None
    drops: Mapping[str, DropCount] = field(default_factory=dict)
    publish: StageLatency = field(default_factory=StageLatency)
    tare_age_s: float | None = None
    tare_drift_counts: float | None = None
    message: str = ""
    tactile: bool = False


def process_activities(observed: Iterable[ObservedProcess]) -> list[ProcessActivity]:
    """Figures of every process."""
    processes = list(observed)
    supervised: dict[tuple[str, str], tuple[SupervisedProcess, Status]] = {}
    for one in processes:
        if (status := one.report.status) is not None:
            for child in status.processes:
                supervised[child.service, child.instance] = child, status
    return [
        _process(one, *supervised.get((one.report.service, one.report.instance), (None, None)))
        for one in processes
    ]


def sensor_activities(observed: Iterable[ObservedProcess]) -> list[SensorActivity]:
    """Figures of every sensor, in the order of their gateways."""
    return [
        _sensor(one, status, sensor)
        for one in observed
        if (status := one.report.status) is not None
        for sensor in status.sensor_states
    ]


def sensor_part(name: str, status: Status) -> tuple[str, str]:
    """Sensor and own name of a counter or gauge; no sensor (``""``) if it is of the process.

    A gateway with several sensors puts the sensor's name in front: ``thumb.tare_age_s``.
    """
    sensor, dot, rest = name.rpartition(".")
    if dot:
        return sensor, rest
    if len(status.sensor_states) == 1 and not name.startswith(_OF_PROCESS):
        return status.sensor_states[0].name, name
    return "", name


def quantile_part(name: str) -> tuple[str, str] | None:
    """Stage and percentile of a latency gauge, e.g. ``infer`` and ``50`` of ``infer_p50_s``."""
    found = _QUANTILE.fullmatch(name)
    return None if found is None else (found[1], found[2])


def _process(
    observed: ObservedProcess, supervised: SupervisedProcess | None, supervisor: Status | None
) -> ProcessActivity:
    report, status = observed.report, observed.report.status
    restarts = None if supervised is None else supervised.restarts
    pid = None if supervised is None else supervised.pid
    if status is None:
        router = (report.service, report.instance) == ROUTER
        state = ("routes" if router else "silent") if report.alive else "missing"
        if not report.alive and supervised is not None:
            # Where it has served and is gone from the bus, it hangs or has lost its link.
            state = "silent" if supervised.state == RUNNING else supervised.state
        gauges: Mapping[str, float] = {}
        if router and supervisor is not None:
            prefix = f"{ROUTER[0]}."
            found = supervisor.gauges.items()
            gauges = {k.removeprefix(prefix): v for k, v in found if k.startswith(prefix)}
        uptime_s = supervised.uptime_s if supervised is not None else None
        return ProcessActivity(
            report.service,
            report.instance,
            state,
            report.ready,
            uptime_s=uptime_s,
            restarts=restarts,
            pid=pid,
            uses=_uses(gauges),
        )
    rates = observed.rates_hz
    latencies = _latencies(
        (rest, value)
        for name, value in status.gauges.items()
        for sensor, rest in [sensor_part(name, status)]
        if not sensor
    )
    queue = status.gauges.get("queue_messages")
    return ProcessActivity(
        report.service,
        report.instance,
        status.state.name.lower(),
        report.ready,
        observed.age_s,
        status.uptime_s,
        restarts,
        pid,
        tuple(status.models),
        _flow(rates, lambda name: name in _IN),
        _flow(rates, _is_out),
        None if queue is None else round(queue),
        latencies,
        _drops(
            ((name, n) for name, n in status.counters.items() if not sensor_part(name, status)[0]),
            rates,
        ),
        _uses(status.gauges),
        status.message,
    )


def _sensor(observed: ObservedProcess, status: Status, sensor: SensorStatus) -> SensorActivity:
    def own(names: Mapping[str, float]) -> Iterator[tuple[str, float]]:
        for name, value in names.items():
            of, rest = sensor_part(name, status)
            if of == sensor.name:
                yield rest, value

    gauges = dict(own(status.gauges))
    rates = dict(own(observed.rates_hz))
    counters = [(name, int(count)) for name, count in own(status.counters)]
    return SensorActivity(
        sensor.name,
        observed.report.instance,
        sensor.state.name.lower(),
        max(0.0, 1e-9 * (status.monotonic_ns - sensor.since_monotonic_ns)),
        rates.get("frames_published"),
        _drops(counters, rates),
        _latencies(gauges.items()).get("publish", StageLatency()),
        gauges.get("tare_age_s"),
        gauges.get("tare_drift_counts"),
        sensor.message,
        "warm_up" in gauges,
    )


def _uses(gauges: Mapping[str, float]) -> HostShare:
    threads, files = gauges.get("process_threads"), gauges.get("process_open_files")
    return HostShare(
        gauges.get("process_cpu_ratio"),
        gauges.get("process_rss_bytes"),
        None if threads is None else round(threads),
        None if files is None else round(files),
    )


def _latencies(gauges: Iterable[tuple[str, float]]) -> dict[str, StageLatency]:
    found: dict[str, dict[str, float]] = {}
    for name, value in gauges:
        if (part := quantile_part(name)) is not None:
            found.setdefault(part[0], {})[part[1]] = value
    return {stage: StageLatency(of.get("50"), of.get("99")) for stage, of in sorted(found.items())}


def _is_out(name: str) -> bool:
    """Whether a counter is of messages that went out; those of a gateway name their sensor."""
    own = name.rpartition(".")[2]
    return own in _OUT or (own.startswith(_WRITTEN) and own != "recorded_bytes")


def _flow(rates_hz: Mapping[str, float], counts: Callable[[str], bool]) -> float | None:
    found = [rate for name, rate in rates_hz.items() if counts(name)]
    return sum(found) if found else None


def _drops(
    counters: Iterable[tuple[str, int]], rates_hz: Mapping[str, float]
) -> dict[str, DropCount]:
    return {
        name: DropCount(count, rates_hz.get(name, 0.0))
        for name, count in sorted(counters)
        if count and any(word in name for word in TROUBLE)
    }
