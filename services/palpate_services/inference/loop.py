"""What all estimating services share: from the bundle to the loop that publishes estimates.

::

    messages of a topic -> newest of each sensor -> estimate -> topic of the estimates
                                                 -> counter of the reason why there is none
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from palpate import clock
from palpate.bus import Delivery, Publisher, ReceivedMessage, Session, Subscriber, endpoints
from palpate.bus.topics import Topic
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, RemoteError, StreamTimeout, WireError
from palpate.files.bundle import read_bundle
from palpate.health import Health, HealthReporter
from palpate.heartbeat import beat
from palpate.messages import Origin, ServiceState, Stamp
from palpate.process import avoid_pauses
from palpate_services.config import EstimatingConfig
from palpate_services.inference.estimates import AgeLimit, EstimateRefusal
from palpate_services.inference.model import Runtime, load
from palpate_services.inference.repository import resolve

M = TypeVar("M")
E = TypeVar("E")

EstimateFrom = Callable[[str, M], E | EstimateRefusal]
"""From a sensor's name and one of its messages to the estimate, or to why there is none."""

_COUNT_PERIOD_NS = 200_000_000
_GAUGE_PERIOD_NS = 1_000_000_000
_WAIT_S = 0.1  # how long a bus without messages delays the next look at the stop event
_QUIET_S = 0.05  # a stopping service has drained when no message came for this long

# Counters of the subscriber that are reported under another name, and those that are not: the
# publisher below counts these itself.
_RENAMED = {"dropped": "dropped_newest_wins"}
_COUNTED_HERE = frozenset({"received", "delivered"})

_ERRORS: dict[EstimateRefusal, tuple[ErrorCode, str, str]] = {
    EstimateRefusal.UNTARED: (
        ErrorCode.INVALID_REQUEST,
        "the frame was taken before any tare, or with another tare than its gateway knows",
        "tare the untouched sensor and send a later frame: palpate tare",
    ),
    EstimateRefusal.INVALID_CHANNELS: (
        ErrorCode.INVALID_REQUEST,
        "at least one electrode of the frame is marked bad",
        "send another frame; check the sensor: palpate status",
    ),
    EstimateRefusal.WRONG_SENSOR: (
        ErrorCode.INVALID_REQUEST,
        "the served bundle was made for another type of sensor",
        "serve a bundle for this sensor type",
    ),
    EstimateRefusal.WRONG_MESH: (
        ErrorCode.WRONG_CONTRACT,
        "the field belongs to another mesh than the served bundle's",
        "serve the bundle of this mesh, or compute the field on the bundle's mesh",
    ),
    EstimateRefusal.NON_FINITE: (
        ErrorCode.INTERNAL,
        "the model has no finite output for this input",
        "serve another bundle, and report this one to its maker",
    ),
    EstimateRefusal.TARE_UNKNOWN: (
        ErrorCode.NOT_FOUND,
        "no gateway knows the tare that the frame names",
        "check the sensor's name and that its gateway runs, or tare and send a later frame",
    ),
}


@dataclass(frozen=True, slots=True)
class ServiceRoute(Generic[M, E]):
    """From which topic to which topic a service, named like its task, estimates.

    ``received`` is the name of its counter of received messages.
    """

    service: str
    source: Topic[M]
    target: Topic[E]
    received: str


class RateLimit:
    """Lets the first message of each period pass, by the clock of the messages.

    The clock of this process would not do: a replay at any speed must give the same estimates.
    ``rate_hz`` limits the messages a second and sensor [Hz]; None = all pass.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = None if rate_hz is None else max(1, round(1e9 / rate_hz))
        self._last: dict[str, int] = {}

    def reached(self, sensor: str, stamp: Stamp) -> bool:
        """Whether a message of this period was already answered."""
        if self._period_ns is None:
            return False
        return self._last.get(sensor) == stamp.monotonic_ns // self._period_ns

    def note(self, sensor: str, stamp: Stamp) -> None:
        """A message of this period was answered."""
        if self._period_ns is not None:
            self._last[sensor] = stamp.monotonic_ns // self._period_ns


class EstimatePublisher(Generic[M, E]):
    """Publishes an estimate for each message, or counts why there is none. Use from one thread.

    ``health`` gets counters and gauges; ``estimate`` makes the estimate; ``rate_hz`` limits the
    estimates a second and sensor [Hz], None = no limit.
    """

    def __init__(
        self,
        route: ServiceRoute[M, E],
        session: Session,
        config: EstimatingConfig,
        health: Health,
        estimate: EstimateFrom[M, E],
        *,
        rate_hz: float | None = None,
    ) -> None:
        self._route = route
        self._session = session
        self._health = health
        self._estimate = estimate
        self._lossless = config.delivery == "every"
        self._sensors = frozenset(config.sensors)
        self._age_limit = AgeLimit(config)
        self._rate_limit = RateLimit(rate_hz)
        self._publishers: dict[str, Publisher[E]] = {}
        self._counts: Counter[str] = Counter()
        self._latencies_ns: list[int] = []
        self._busy_ns = 0
        self._counted_ns = self._gauged_ns = time.monotonic_ns()

    def take(self, received: ReceivedMessage[M]) -> None:
        """Publish the estimate of a message, or count why there is none."""
        sensor = received.sensor
        if self._sensors and sensor not in self._sensors:
            return
        began_ns = time.monotonic_ns()
        self._counts[self._route.received] += 1
        stamp = self._route.source.stamp_of(received.message)
        assert stamp is not None, "every message of these topics has a stamp"
        reason = self._publish(sensor, stamp, received.message)
        ended_ns = time.monotonic_ns()
        self._busy_ns += ended_ns - began_ns
        if reason is not None:
            self._counts[reason] += 1
            return
        self._counts["estimates_published"] += 1
        # Latency counts from the reading, so that it holds the way through gateway and bus. Only
        # where the stamp is of another clock, or long past (a replay), it counts from the arrival.
        live = stamp.origin is not Origin.REPLAYED and stamp.clock_id == clock.CLOCK_ID
        since_ns = stamp.monotonic_ns if live else received.received_monotonic_ns
        self._latencies_ns.append(ended_ns - since_ns)

    def _publish(self, sensor: str, stamp: Stamp, message: M) -> str | None:
        """Publish one estimate; the counter of the reason if there is none."""
        if (refusal := self._age_limit.refusal(stamp)) is not None:
            return refusal.value
        if self._rate_limit.reached(sensor, stamp):
            return EstimateRefusal.SKIPPED_RATE.value
        estimate = self._estimate(sensor, message)
        if isinstance(estimate, EstimateRefusal):
            return estimate.value
        try:
            self._publisher(sensor).put(estimate)
        except WireError as error:  # finite, and still not allowed by the message contract
            return f"unpublishable_{error.reason}"
        self._rate_limit.note(sensor, stamp)
        return None

    def _publisher(self, sensor: str) -> Publisher[E]:
        publisher = self._publishers.get(sensor)
        if publisher is None:
            target = self._route.target
            publisher = self._session.publisher(target, sensor=sensor, lossless=self._lossless)
            self._publishers[sensor] = publisher
            self._health.set_sensors(tuple(sorted(self._publishers)))
        return publisher

    def report(self, *, last: bool = False) -> None:
        """Hand counters and gauges to health at their own periods; with ``last`` now."""
        now_ns = time.monotonic_ns()
        if last or now_ns - self._counted_ns >= _COUNT_PERIOD_NS:
            self._counted_ns = now_ns
            counts, self._counts = self._counts, Counter()
            for name, count in counts.items():
                self._health.count(name, count)
        period_ns = now_ns - self._gauged_ns
        if last or period_ns >= _GAUGE_PERIOD_NS:
            self._gauged_ns = now_ns
            self._health.gauge("busy_ratio", self._busy_ns / max(period_ns, 1))
            self._busy_ns = 0
            if self._latencies_ns:
                p50, p99 = np.percentile(self._latencies_ns, (50, 99)) * 1e-9
                self._health.gauge("latency_p50_s", float(p50))
                self._health.gauge("latency_p99_s", float(p99))
                self._latencies_ns = []


def reply(estimate: E | EstimateRefusal, health: Health) -> E:
    """The reply to a request for one estimate.

    Requests are counted as ``asked``, refused ones also as ``asked_<reason>``.

    Raises:
        RemoteError: There is none; it says why and what to do.
    """
    health.count("asked")
    if not isinstance(estimate, EstimateRefusal):
        return estimate
    health.count(f"asked_{estimate.value}")
    code, problem, remedy = _ERRORS[estimate]
    raise RemoteError(problem, remedy=remedy, code=code)


def serve(
    route: ServiceRoute[M, E],
    config: EstimatingConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str | None,
    prepare: Callable[[Session, Runtime, Health], EstimateFrom[M, E]],
    rate_hz: float | None = None,
) -> None:
    """Serve until ``stop`` is set; then withdraw, answer what has already come, and leave.

    ``route`` says from which topic to which; ``prepare`` returns what makes the estimates, and may
    declare endpoints of the service; ``rate_hz`` limits the estimates a second and sensor [Hz]. The
    other arguments and the errors are those of ``run_estimating``.
    """
    instance = instance or route.service
    # Before the bus is joined: no message may wait while the model loads and warms up.
    runtime = load(read_bundle(resolve(config.bundle)), route.service)
    health = Health(route.service, instance)
    with Session.open(link, station=station) as session:
        presence = session.presence(route.service, instance=instance)
        session.queryable(
            endpoints.MODEL, lambda _: runtime.metadata(), service=route.service, instance=instance
        )
        estimate = prepare(session, runtime, health)
        publisher = EstimatePublisher(route, session, config, health, estimate, rate_hz=rate_hz)
        messages = session.subscriber(
            route.source,
            sensor=config.sensors[0] if len(config.sensors) == 1 else "*",
            delivery=Delivery(config.delivery),
            depth=config.keep_newest,
        )
        with HealthReporter(session, health, refresh=lambda: _copy_counters(messages, health)):
            manifest = runtime.manifest
            health.set_state(ServiceState.READY, f"serving {manifest.name}:{manifest.version}")
            avoid_pauses()
            # Ready only now: clients that wait for readiness must find subscriptions and endpoints.
            presence.ready()
            while not stop.is_set():
                beat()
                try:
                    publisher.take(messages.next(_WAIT_S))
                except StreamTimeout:
                    pass
                publisher.report()
            # Withdrawn first, so that no client relies on this service while it drains.
            presence.not_ready()
            health.set_state(ServiceState.STOPPING, "draining")
            deadline = time.monotonic() + config.drain_s
            try:
                while time.monotonic() < deadline:
                    publisher.take(messages.next(_QUIET_S))
            except StreamTimeout:
                pass
            messages.close()
            publisher.report(last=True)


def _copy_counters(messages: Subscriber[M], health: Health) -> None:
    """Copy what the subscriber counted (drops, losses on the bus) into the service's status."""
    health.set_counts(
        {
            _RENAMED.get(name, name): count
            for name, count in messages.counters.items()
            if name not in _COUNTED_HERE
        }
    )
