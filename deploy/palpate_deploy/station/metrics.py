"""The process ``metrics``: statuses of a station as metrics for Prometheus, on loopback.

Every counter of a status is a counter here, every gauge a gauge, with the labels ``station``,
``service``, ``instance`` and ``sensor``. Latencies are ``palpate_latency_seconds`` with the labels
``stage`` and ``quantile``. A process that says nothing disappears.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

from palpate.bus import Session
from palpate.census import ROUTER, SUPERVISOR
from palpate.config import LinkConfig, endpoint_host_port
from palpate.errors import LinkError
from palpate.health import Health, HealthReporter
from palpate.heartbeat import beat
from palpate.messages import SensorState, ServiceState, Status
from palpate.process import require
from palpate_deploy.station.activity import quantile_part, sensor_part
from palpate_deploy.station.observation import ObservedProcess, StationObserver
from palpate_deploy.station.profile import MetricsConfig

if TYPE_CHECKING:
    from prometheus_client.core import Metric

F = TypeVar("F")

SERVICE = "metrics"
SERIES_MOST = 5000
"""More are left out and counted: names come from other processes, and may be invented."""

_PERIOD_S = 1.0
_NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_]{0,99}")
_UNITS = {"_s": "_seconds", "_hz": "_hertz"}
_OF_PROCESS = ("station", "service", "instance")
_OF_SENSOR = (*_OF_PROCESS, "sensor")


def run_metrics(
    config: MetricsConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = SERVICE,
) -> None:
    """Serve the metrics of a station over HTTP until ``stop`` is set.

    Raises:
        LinkError: The bus cannot be joined, or the port is in use.
        MissingExtraError: prometheus_client is not installed.
    """
    require("prometheus_client", extra="metrics")
    from prometheus_client import CollectorRegistry, start_http_server

    health = Health(SERVICE, instance)
    collector = StationCollector(station, health)
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    with Session.open(link, station=station) as session:
        presence = session.presence(SERVICE, instance=instance)
        host, port = endpoint_host_port(f"tcp/{config.listen}")
        try:
            server, thread = start_http_server(port, host, registry=registry)
        except OSError as error:
            raise LinkError(
                f"metrics cannot be served at {config.listen}: {error.strerror or error}",
                remedy="choose another port: [metrics] listen in the profile",
            ) from error
        try:
            with StationObserver(session) as observer, HealthReporter(session, health):
                health.set_state(ServiceState.READY, f"http://{config.listen}/metrics")
                presence.ready()
                while not stop.is_set():
                    beat()
                    collector.update(observer.look())
                    stop.wait(_PERIOD_S)
                presence.not_ready()
                health.set_state(ServiceState.STOPPING)
        finally:
            server.shutdown()
            server.server_close()
            thread.join(timeout=2.0)


class StationCollector:
    """What Prometheus gets: the last observation of a station. Safe to use from several threads."""

    def __init__(self, station: str, health: Health) -> None:
        self._station, self._health = station, health
        self._observed: Sequence[ObservedProcess] = ()

    def update(self, observed: Sequence[ObservedProcess]) -> None:
        """Take over a new observation."""
        self._observed = observed

    def collect(self) -> Iterator[Metric]:
        """Called for each request; metrics as prometheus_client wants them."""
        self._health.count("scrapes")
        series = _Series()
        for one in self._observed:
            self._process(series, one)
        yield from series.families.values()
        yield series.left_out_metric(self._station)

    def _process(self, series: _Series, observed: ObservedProcess) -> None:
        report, status = observed.report, observed.report.status
        process = (self._station, report.service, report.instance)
        routes = (report.service, report.instance) == ROUTER and report.alive
        series.gauge(
            "process_up", _OF_PROCESS, process, float(status is not None or routes),
            "1 = the process answers; 0 = it should run, and is missing or does not answer.",
        )  # fmt: skip
        if status is None:
            return
        for state in ServiceState:
            series.gauge(
                "process_state", (*_OF_PROCESS, "state"), (*process, state.name.lower()),
                float(status.state is state), "1 for the state of the process.",
            )  # fmt: skip
        series.gauge(
            "process_uptime_seconds", _OF_PROCESS, process, status.uptime_s,
            "Since the process was ready to count.",
        )  # fmt: skip
        for model in status.models:
            name, _, version = model.rpartition(":")
            series.gauge(
                "model_info", (*_OF_PROCESS, "model", "version"), (*process, name, version), 1.0,
                "A bundle that the process serves.",
            )  # fmt: skip
        for child in status.processes:
            series.counter(
                "process_restarts", _OF_PROCESS, (self._station, child.service, child.instance),
                child.restarts, "How often the supervisor started the process again.",
            )  # fmt: skip
        for sensor in status.sensor_states:
            for known in SensorState:
                series.gauge(
                    "sensor_state", (*_OF_SENSOR, "state"),
                    (*process, sensor.name, known.name.lower()),
                    float(sensor.state is known), "1 for the state of the sensor.",
                )  # fmt: skip
        self._figures(series, process, status)

    def _figures(self, series: _Series, process: tuple[str, str, str], status: Status) -> None:
        """Every counter and gauge."""
        instances = {child.service: child.instance for child in status.processes}

        def labels(sensor: str) -> tuple[str, ...]:
            # A supervisor speaks for others: what stands in front is the name of a process.
            if sensor and status.service == SUPERVISOR[0]:
                return (self._station, sensor, instances.get(sensor, sensor), "")
            return (*process, sensor)

        for name, count in sorted(status.counters.items()):
            sensor, own = sensor_part(name, status)
            series.counter(own, _OF_SENSOR, labels(sensor), count)
        for name, value in sorted(status.gauges.items()):
            sensor, own = sensor_part(name, status)
            of = labels(sensor)
            if (part := quantile_part(own)) is not None:
                stage, percentile = part
                series.gauge(
                    "latency_seconds", (*_OF_SENSOR, "stage", "quantile"),
                    (*of, stage, f"0.{percentile.rstrip('0')}"), value,
                    "Latency of a stage in the last second; stage latency = from the reading.",
                )  # fmt: skip
                continue
            for short, long in _UNITS.items():
                if own.endswith(short):
                    own = own.removesuffix(short) + long
            series.gauge(own, _OF_SENSOR, of, value)


class _Series:
    """Metrics that are being gathered, by name; what cannot be exported is counted."""

    def __init__(self) -> None:
        self.families: dict[str, Metric] = {}
        self.left_out = 0
        self._labels: dict[str, tuple[str, ...]] = {}
        self._seen: set[tuple[str, tuple[str, ...]]] = set()

    def gauge(
        self,
        name: str,
        labels: tuple[str, ...],
        values: tuple[str, ...],
        value: float,
        text: str = "A gauge of a status; the unit is part of the name.",
    ) -> None:
        """Add one value of a gauge; ``text`` describes the metric."""
        from prometheus_client.core import GaugeMetricFamily

        family = self._family(GaugeMetricFamily, name, labels, values, text)
        if family is not None:
            family.add_metric(values, value)

    def counter(
        self,
        name: str,
        labels: tuple[str, ...],
        values: tuple[str, ...],
        count: int,
        text: str = "A counter of a status, since the process started.",
    ) -> None:
        """Add one value of a counter; its metric ends in ``_total``."""
        from prometheus_client.core import CounterMetricFamily

        family = self._family(CounterMetricFamily, name, labels, values, text)
        if family is not None:
            family.add_metric(values, count)

    def left_out_metric(self, station: str) -> Metric:
        """How many were left out; it is no series of its own, so that it is never left out."""
        from prometheus_client.core import GaugeMetricFamily

        text = f"Series that were not exported: more than {SERIES_MOST}, or an unusable name."
        family = GaugeMetricFamily("palpate_exporter_left_out", text, labels=("station",))
        family.add_metric((station,), self.left_out)
        return family

    def _family(
        self,
        kind: Callable[..., F],
        name: str,
        labels: tuple[str, ...],
        values: tuple[str, ...],
        text: str,
    ) -> F | None:
        """The metric to which one more series may be added; None = it may not."""
        family: Any = self.families.get(name)
        fits = family is None or (type(family) is kind and self._labels[name] == labels)
        new = (name, values) not in self._seen
        if not fits or not new or len(self._seen) >= SERIES_MOST or not _NAME.fullmatch(name):
            self.left_out += 1
            return None
        if family is None:
            family = kind(f"palpate_{name}", text, labels=labels)
            self.families[name], self._labels[name] = cast("Metric", family), labels
        self._seen.add((name, values))
        return cast(F, family)
