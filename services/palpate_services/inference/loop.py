"""The life of an estimating service on the bus: load, join, answer, drain, leave."""

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
from palpate.messages import Origin, ServiceState, Stamp
from palpate.process import avoid_pauses
from palpate_services.config import AnswererConfig
from palpate_services.inference.estimates import TARE_UNKNOWN, Freshness, Refusal
from palpate_services.inference.model import Runtime, load
from palpate_services.inference.repository import resolve

M = TypeVar("M")
E = TypeVar("E")

Answer = Callable[[str, M], E | str]
"""From the name of a sensor and a message of it to the estimate, or to the reason (as it is
counted) why there is none."""

_COUNT_PERIOD_NS = 200_000_000
_GAUGE_PERIOD_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Line(Generic[M, E]):
    """What a service makes of what.

    Attributes:
        service: Its name, which is also the task of its bundle.
        source: What it answers.
        target: What it answers with.
        received: Name of the counter of messages that came.
    """

    service: str
    source: Topic[M]
    target: Topic[E]
    received: str


class Pace:
    """Lets the first message of each period pass, by the clock of the messages.

    Not by the clock of this process: a replay, however fast, must give the same estimates again.

    Args:
        rate_hz: Messages a second and sensor at most [Hz]; None = all.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = None if rate_hz is None else max(1, round(1e9 / rate_hz))
        self._last: dict[str, int] = {}

    def early(self, sensor: str, stamp: Stamp) -> bool:
        """Whether this period had its message."""
        if self._period_ns is None:
            return False
        return self._last.get(sensor) == stamp.monotonic_ns // self._period_ns

    def passed(self, sensor: str, stamp: Stamp) -> None:
        """A message of this period was answered."""
        if self._period_ns is not None:
            self._last[sensor] = stamp.monotonic_ns // self._period_ns


class Answerer(Generic[M, E]):
    """Answers messages with estimates and counts those it does not answer. Use from one thread.

    Args:
        line: What it makes of what.
        session: Where estimates are published.
        config: What it is told.
        health: Hears of every event.
        answer: Makes the estimate.
        rate_hz: Estimates a second and sensor at most [Hz]; None = no limit.
    """

    def __init__(
        self,
        line: Line[M, E],
        session: Session,
        config: AnswererConfig,
        health: Health,
        answer: Answer[M, E],
        *,
        rate_hz: float | None = None,
    ) -> None:
        self._line = line
        self._session = session
        self._health = health
        self._make = answer
        self._lossless = config.delivery == "every"
        self._sensors = frozenset(config.sensors)
        self._freshness = Freshness(config)
        self._pace = Pace(rate_hz)
        self._publishers: dict[str, Publisher[E]] = {}
        self._counts: Counter[str] = Counter()
        self._latencies_ns: list[int] = []
        self._busy_ns = 0
        self._counted_ns = self._gauged_ns = time.monotonic_ns()

    def answer(self, received: ReceivedMessage[M]) -> None:
        """Publish the estimate of a message, or count why there is none."""
        sensor = received.sensor
        if self._sensors and sensor not in self._sensors:
            return
        began_ns = time.monotonic_ns()
        self._counts[self._line.received] += 1
        stamp = self._line.source.stamp_of(received.message)
        assert stamp is not None, "every message that is answered has a stamp"
        reason = self._serve(sensor, stamp, received.message)
        ended_ns = time.monotonic_ns()
        self._busy_ns += ended_ns - began_ns
        if reason is not None:
            self._counts[reason] += 1
            return
        self._counts["estimates_published"] += 1
        # From the reading itself where its clock is ours and its time is now, else from arrival.
        live = stamp.origin is not Origin.REPLAYED and stamp.clock_id == clock.CLOCK_ID
        since_ns = stamp.monotonic_ns if live else received.received_monotonic_ns
        self._latencies_ns.append(ended_ns - since_ns)

    def _serve(self, sensor: str, stamp: Stamp, message: M) -> str | None:
        if (reason := self._freshness.refusal(stamp)) is not None:
            return reason
        if self._pace.early(sensor, stamp):
            return "skipped_rate"
        answer = self._make(sensor, message)
        if isinstance(answer, str):
            return str(answer)
        try:
            self._publisher(sensor).put(answer)
        except WireError as error:  # a finite answer that the contract still does not allow
            return f"unpublishable_{error.reason}"
        self._pace.passed(sensor, stamp)
        return None

    def _publisher(self, sensor: str) -> Publisher[E]:
        publisher = self._publishers.get(sensor)
        if publisher is None:
            target = self._line.target
            publisher = self._session.publisher(target, sensor=sensor, lossless=self._lossless)
            self._publishers[sensor] = publisher
            self._health.set_sensors(tuple(sorted(self._publishers)))
        return publisher

    def report(self, *, last: bool = False) -> None:
        """Hand counters and gauges over to health; call it often, it paces itself.

        Args:
            last: Hand over everything now.
        """
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


_WORDS: dict[str, tuple[ErrorCode, str, str]] = {
    Refusal.UNTARED: (
        ErrorCode.INVALID_REQUEST,
        "the frame was taken before any tare, or with another than its gateway knows",
        "tare the untouched sensor and ask with a later frame: palpate tare",
    ),
    Refusal.INVALID_CHANNELS: (
        ErrorCode.INVALID_REQUEST,
        "at least one electrode of the frame is marked bad",
        "ask with another frame; look at the sensor: palpate status",
    ),
    Refusal.WRONG_SENSOR: (
        ErrorCode.INVALID_REQUEST,
        "the served bundle was made for another type of sensor",
        "serve a bundle for this sensor type",
    ),
    Refusal.WRONG_MESH: (
        ErrorCode.WRONG_CONTRACT,
        "the field is one of another mesh than the served bundle's",
        "serve the bundle of this mesh, or compute the field on the bundle's",
    ),
    Refusal.NON_FINITE: (
        ErrorCode.INTERNAL,
        "the model has no finite answer to this input",
        "serve another bundle; report this one to whoever made it",
    ),
    TARE_UNKNOWN: (
        ErrorCode.NOT_FOUND,
        "nobody knows the tare that the frame names",
        "check the sensor's name and that its gateway runs, or tare and ask with a later frame",
    ),
}


def answered(answer: E | str, health: Health) -> E:
    """The estimate, counted as ``asked``.

    Args:
        answer: The estimate, or the reason why there is none.
        health: Counts questions, and refusals as ``asked_<reason>``.

    Raises:
        RemoteError: There is none; it says why and what to do.
    """
    health.count("asked")
    if not isinstance(answer, str):
        return answer
    health.count(f"asked_{answer}")
    code, problem, remedy = _WORDS[answer]
    raise RemoteError(problem, remedy=remedy, code=code)


_WAIT_S = 0.1  # how long a silent bus keeps the loop from looking at the stop event
_QUIET_S = 0.05  # a stopping service has drained when nothing came for this long


def serve(
    line: Line[M, E],
    config: AnswererConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str,
    make: Callable[[Session, Runtime, Health], Answer[M, E]],
    rate_hz: float | None = None,
) -> None:
    """Serve until ``stop`` is set; then withdraw, answer what has come, and leave.

    Args:
        line: What is made of what.
        config: What the service is told.
        link: How to join the bus.
        station: The station to serve.
        stop: Set it to end.
        instance: Name of this process among several of its kind.
        make: Gives what makes the estimates, and declares what else the service answers.
        rate_hz: Estimates a second and sensor at most [Hz]; None = no limit.

    Raises:
        ConfigError: There is no such bundle.
        BundleError: The bundle breaks its contract.
        MissingExtraError: ONNX Runtime is not installed.
        LinkError: The bus cannot be joined.
    """
    runtime = load(read_bundle(resolve(config.bundle)), line.service)
    health = Health(line.service, instance)
    with Session.open(link, station=station) as session:
        presence = session.presence(line.service, instance=instance)
        session.queryable(
            endpoints.MODEL, lambda _: runtime.metadata(), service=line.service, instance=instance
        )
        answer = make(session, runtime, health)
        answerer = Answerer(line, session, config, health, answer, rate_hz=rate_hz)
        messages = session.subscriber(
            line.source,
            sensor=config.sensors[0] if len(config.sensors) == 1 else "*",
            delivery=Delivery(config.delivery),
            depth=config.keep_newest,
        )
        with HealthReporter(session, health, refresh=lambda: _take_over(messages, health)):
            manifest = runtime.manifest
            health.set_state(ServiceState.READY, f"serving {manifest.name}:{manifest.version}")
            avoid_pauses()
            presence.ready()
            while not stop.is_set():
                try:
                    answerer.answer(messages.next(_WAIT_S))
                except StreamTimeout:
                    pass
                answerer.report()
            presence.not_ready()
            health.set_state(ServiceState.STOPPING, "draining")
            deadline = time.monotonic() + config.drain_s
            try:
                while time.monotonic() < deadline:
                    answerer.answer(messages.next(_QUIET_S))
            except StreamTimeout:
                pass
            messages.close()
            answerer.report(last=True)


def _take_over(messages: Subscriber[M], health: Health) -> None:
    health.set_counts(
        {
            _COUNTED.get(name, name): count
            for name, count in messages.counters.items()
            if name not in _OWN
        }
    )


_COUNTED = {"dropped": "dropped_newest_wins"}
_OWN = frozenset({"received", "delivered"})
