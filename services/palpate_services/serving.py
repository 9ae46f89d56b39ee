"""The life of an estimating service on the bus: load, join, answer, drain, leave."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from palpate.bus import Delivery, Session, Subscriber, endpoints
from palpate.config import LinkConfig
from palpate.errors import StreamTimeout
from palpate.files.bundle import read_bundle
from palpate.health import Health, HealthReporter
from palpate.messages import ServiceState
from palpate.pauses import avoid_pauses
from palpate_services.answering import Answer, Answerer, Line
from palpate_services.config import AnswererConfig
from palpate_services.repository import resolve
from palpate_services.runtime import Runtime, load

M = TypeVar("M")
E = TypeVar("E")

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
