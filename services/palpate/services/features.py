"""The features service: electrodes in, force and contact location out. The newest frame wins."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter

import numpy as np

from palpate.protos import clock
from palpate.protos.bundle import read_bundle
from palpate.protos.codec import MODEL_METADATA, SERVICE_REQUEST
from palpate.protos.config import LinkConfig
from palpate.protos.errors import StreamTimeout, WireError
from palpate.protos.health import Health, HealthReporter
from palpate.protos.messages import (
    NO_TARE,
    ElectrodeFrame,
    FeatureEstimate,
    Origin,
    ServiceState,
    Stamp,
)
from palpate.protos.pauses import avoid_pauses
from palpate.protos.session import Delivery, Publisher, Received, Session
from palpate.protos.tares import TareBook
from palpate.protos.topics import ELECTRODES, FEATURES
from palpate.services.baselines import Baselines
from palpate.services.config import FeaturesConfig
from palpate.services.estimator import Refusal, estimate
from palpate.services.repository import resolve
from palpate.services.runtime import Runtime, load

log = logging.getLogger(__name__)

SERVICE = "features"
TASK = "features"

_COUNT_PERIOD_NS = 200_000_000
_GAUGE_PERIOD_NS = 1_000_000_000
_WAIT_S = 0.1  # how long a silent bus keeps the loop from looking at the stop event
_QUIET_S = 0.05  # a stopping service has drained when nothing came for this long


class FeatureAnswerer:
    """Answers frames with estimates and counts those it does not answer. Use from one thread.

    Args:
        runtime: The loaded bundle.
        session: Where estimates are published.
        config: How electrodes become features.
        health: Hears of every event.
    """

    def __init__(
        self, runtime: Runtime, session: Session, config: FeaturesConfig, health: Health
    ) -> None:
        self._runtime = runtime
        self._session = session
        self._config = config
        self._health = health
        self._lossless = config.delivery == "every"
        self._sensors = frozenset(config.sensors)
        book = TareBook(session, query_timeout_s=config.tare_timeout_s)
        self._baselines = Baselines(book, patient=self._lossless)
        self._publishers: dict[str, Publisher[FeatureEstimate]] = {}
        self._counts: Counter[str] = Counter()
        self._latencies_ns: list[int] = []
        self._busy_ns = 0
        self._counted_ns = self._gauged_ns = time.monotonic_ns()

    def answer(self, received: Received[ElectrodeFrame]) -> None:
        """Publish the estimate of a frame, or count why there is none."""
        sensor = received.sensor
        if self._sensors and sensor not in self._sensors:
            return
        began_ns = time.monotonic_ns()
        self._counts["frames_received"] += 1
        frame = received.message
        reason = self._serve(sensor, frame)
        ended_ns = time.monotonic_ns()
        self._busy_ns += ended_ns - began_ns
        if reason is not None:
            self._counts[reason] += 1
            return
        self._counts["estimates_published"] += 1
        # From the reading itself where its clock is ours and its time is now, else from arrival.
        stamp = frame.stamp
        live = stamp.origin is not Origin.REPLAYED and stamp.clock_id == clock.CLOCK_ID
        since_ns = stamp.monotonic_ns if live else received.received_monotonic_ns
        self._latencies_ns.append(ended_ns - since_ns)

    def _serve(self, sensor: str, frame: ElectrodeFrame) -> str | None:
        if (reason := self._too_old(frame.stamp)) is not None:
            return reason
        tare = None
        if frame.tare_id != NO_TARE:
            tare, waited = self._baselines.find(sensor, frame.tare_id)
            if tare is None:
                return "tare_unknown"
            if waited and (reason := self._too_old(frame.stamp)) is not None:
                return reason
        answer = estimate(frame, tare, self._runtime)
        if isinstance(answer, Refusal):
            return answer.value
        try:
            self._publisher(sensor).put(answer)
        except WireError as error:  # a finite answer that the contract still does not allow
            return f"unpublishable_{error.reason}"
        return None

    def _too_old(self, stamp: Stamp) -> str | None:
        if stamp.origin is Origin.REPLAYED:
            return None if self._config.accept_replayed else "replayed_refused"
        limit_s = self._config.max_age_s
        return "stale" if limit_s is not None and clock.age_s(stamp) > limit_s else None

    def _publisher(self, sensor: str) -> Publisher[FeatureEstimate]:
        publisher = self._publishers.get(sensor)
        if publisher is None:
            publisher = self._session.publisher(FEATURES, sensor=sensor, lossless=self._lossless)
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


def run(
    config: FeaturesConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "features",
) -> None:
    """Serve until ``stop`` is set; then withdraw, answer what has come, and leave.

    Args:
        config: How electrodes become features.
        link: How to join the bus.
        station: The station to serve.
        stop: Set it to end.
        instance: Name of this process among several of its kind.

    Raises:
        ConfigError: There is no such bundle.
        BundleError: The bundle breaks its contract.
        MissingExtraError: ONNX Runtime is not installed.
        LinkError: The bus cannot be joined.
    """
    runtime = load(read_bundle(resolve(config.bundle)), TASK)
    health = Health(SERVICE, instance)
    with Session.open(link, station=station) as session:
        presence = session.presence(SERVICE, instance=instance)
        session.service_queryable(
            "model",
            service=SERVICE,
            instance=instance,
            request=SERVICE_REQUEST,
            reply=MODEL_METADATA,
            handler=lambda _: runtime.metadata(),
        )
        answerer = FeatureAnswerer(runtime, session, config, health)
        frames = session.subscriber(
            ELECTRODES,
            sensor=config.sensors[0] if len(config.sensors) == 1 else "*",
            delivery=Delivery(config.delivery),
            depth=config.keep_newest,
        )

        def take_over() -> None:
            counters = frames.counters
            health.set_counts(
                {
                    _COUNTED.get(name, name): count
                    for name, count in counters.items()
                    if name not in _OWN
                }
            )

        with HealthReporter(session, health, refresh=take_over):
            manifest = runtime.manifest
            health.set_state(ServiceState.READY, f"serving {manifest.name}:{manifest.version}")
            avoid_pauses()
            presence.ready()
            while not stop.is_set():
                try:
                    answerer.answer(frames.next(_WAIT_S))
                except StreamTimeout:
                    pass
                answerer.report()
            presence.not_ready()
            health.set_state(ServiceState.STOPPING, "draining")
            deadline = time.monotonic() + config.drain_s
            try:
                while time.monotonic() < deadline:
                    answerer.answer(frames.next(_QUIET_S))
            except StreamTimeout:
                pass
            frames.close()
            answerer.report(last=True)


_COUNTED = {"dropped": "dropped_newest_wins"}
_OWN = frozenset({"received", "delivered"})
