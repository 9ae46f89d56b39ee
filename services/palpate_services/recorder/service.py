"""The recorder: everything that is said on the bus goes to disk, and nothing waits for it."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

from palpate.bus import Delivery, Session, Tap
from palpate.bus.topics import TOPICS, Topic
from palpate.config import LinkConfig
from palpate.errors import ConfigError, StreamTimeout
from palpate.health import Health, HealthReporter
from palpate.messages import ServiceState
from palpate.process import avoid_pauses
from palpate_services.config import RecorderConfig
from palpate_services.recorder.writer import RecordKeeper

log = logging.getLogger(__name__)

SERVICE = "recorder"

_NAP_S = 0.05
"""Samples are taken in batches: waking up for each one would cost more than writing it."""

_LOOK_AFTER = 100
"""Samples after which the disk is looked at even though more are waiting."""


def run_recorder(
    config: RecorderConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "recorder",
) -> None:
    """Record until ``stop`` is set; then write what has come and close the files.

    Args:
        config: What is recorded, and where.
        link: How to join the bus.
        station: The station to record.
        stop: Set it to end.
        instance: Name of this process among several recorders.

    Raises:
        ConfigError: An unknown topic, or a bundle that does not exist.
        LinkError: The bus cannot be joined.
        RecordingError: The folder of the records cannot be made.
    """
    topics = _topics(config.topics)
    health = Health(SERVICE, instance)
    keeper = RecordKeeper(config, station, health)
    with Session.open(link, station=station) as session:
        presence = session.presence(SERVICE, instance=instance)
        tap = session.tap(
            topics,
            sensor=config.sensor,
            delivery=Delivery(config.delivery),
            capacity=config.capacity,
        )
        keeper.start()
        with HealthReporter(session, health, refresh=lambda: health.set_counts(tap.counters)):
            try:
                avoid_pauses()
                presence.ready()
                while not stop.wait(_NAP_S):
                    _drain(tap, keeper)
                presence.not_ready()
                if health.state is not ServiceState.DEGRADED:
                    health.set_state(ServiceState.STOPPING, "draining")
                deadline = time.monotonic() + config.drain_s
                while _drain(tap, keeper) and time.monotonic() < deadline:
                    time.sleep(_NAP_S)
            finally:
                tap.close()
                keeper.close()


def _drain(tap: Tap, keeper: RecordKeeper) -> int:
    """Record what waits; how many samples that were."""
    came = 0
    try:
        while True:
            keeper.write(tap.next(0.0))
            came += 1
            if came % _LOOK_AFTER == 0:
                keeper.tick()
    except StreamTimeout:
        keeper.tick(idle=came == 0)
    return came


def _topics(names: tuple[str, ...]) -> list[Topic[Any]]:
    if unknown := sorted(set(names) - set(TOPICS)):
        raise ConfigError(
            f"recorder.topics names the unknown topic {unknown[0]!r}",
            remedy=f"known topics: {', '.join(TOPICS)}",
        )
    return [topic for name, topic in TOPICS.items() if (name in names if names else topic.recorded)]
