"""The recorder service: writes what is published on the bus to disk; no publisher waits for it."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate.bus import Delivery, Session, Tap
from palpate.bus.tares import TareBook
from palpate.bus.topics import TARE, TOPICS, Topic
from palpate.config import LinkConfig
from palpate.errors import LinkError, PalpateError, RecordingError, StreamTimeout
from palpate.health import Health, HealthReporter
from palpate.heartbeat import beat
from palpate.messages import ServiceState, Tare
from palpate.process import avoid_pauses
from palpate_services.config import RecorderConfig
from palpate_services.recorder.writer import FindTare, RecordFiles

_log = logging.getLogger(__name__)

SERVICE = "recorder"

_BATCH_S = 0.05
"""Samples are taken in batches: to wake up for each one would cost more than to write it [s]."""

_TARES_WAIT_S = 1.0
"""How long, in all, frames wait for the tares that they name [s]; what comes meanwhile queues."""

_CHECK_AFTER = 100
"""Samples after which the disk is checked even though more samples wait."""


def run_recorder(
    config: RecorderConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "recorder",
    health: Health | None = None,
    write_all: bool = False,
) -> list[Path]:
    """Record until ``stop`` is set; then write the samples that have arrived and close the files.

    The arguments are those of ``run_estimating``; ``health`` receives state and counters, None = it
    makes its own. ``write_all``: However long it takes; else those are counted as lost for which
    ``drain_s`` leaves no time.

    Returns:
        The records, in the order in which they were begun; one may not have been finished.

    Raises:
        ConfigError: A bundle that does not exist.
        LinkError: The bus cannot be joined.
        RecordingError: The folder of the records cannot be made.
    """
    topics = _topics(config.topics)
    health = health or Health(SERVICE, instance)
    with Session.open(link, station=station) as session:
        find_tare = _first_tares(TareBook(session)) if TARE in topics else None
        files = RecordFiles(config, station, health, find_tare)
        presence = session.presence(SERVICE, instance=instance)
        tap = session.tap(
            topics,
            sensor=config.sensor,
            delivery=Delivery(config.delivery),
            capacity=config.capacity,
        )
        files.start()
        with HealthReporter(session, health, refresh=QueueReport(tap, files, health).refresh):
            try:
                avoid_pauses()
                presence.ready()
                while not stop.wait(_BATCH_S):
                    _drain(tap, files, lambda: not stop.is_set())
                presence.not_ready()
                health.set_state(ServiceState.STOPPING, "draining")
                now_s = time.monotonic()
                until_s = now_s + config.drain_s
                # Live streams go on and never let it run dry, so half of the time is kept for what
                # has come when the tap closes.
                while _drain(tap, files, lambda: time.monotonic() < now_s + config.drain_s / 2):
                    time.sleep(_BATCH_S)
                tap.close()
                with contextlib.suppress(LinkError):  # it is closed, and nothing waits any more
                    _drain(tap, files, lambda: write_all or time.monotonic() < until_s)
            finally:
                tap.close()
                _count_the_rest(tap, health)
                files.close()
    return files.opened


class QueueReport:
    """Tells health how many messages wait; the recorder is DEGRADED while some are lost there."""

    def __init__(self, tap: Tap, files: RecordFiles, health: Health) -> None:
        self._tap, self._files, self._health = tap, files, health
        self._lost = 0
        self._losing = False

    def refresh(self) -> None:
        """Take over the counters of the queue; in the thread that reports."""
        counters = self._tap.counters
        self._health.set_counts(counters)
        self._health.gauge("queue_messages", float(self._tap.waiting))
        lost = counters.get("overflow", 0)
        if lost > self._lost:
            self._losing = True
            self._health.fail(
                RecordingError(
                    "messages come faster than they are written, and some are not recorded",
                    remedy="record fewer topics, see [recorder] topics, or relieve disk and host",
                )
            )
        elif self._losing:
            self._losing = False
            self._files.other_trouble_is_over()
        self._lost = lost


def _first_tares(book: TareBook) -> FindTare:
    """Looks up tares, and waits for the first ones: readers need a tare before its frames.

    Whoever joins a running station hears frames some 0.1 s before the gateway's answer.
    """
    left_s = _TARES_WAIT_S

    def find(sensor: str, tare_id: int) -> Tare | None:
        nonlocal left_s
        tare = book.find(sensor, tare_id)
        if tare is not None or left_s <= 0:
            return tare
        beat()
        began_s = time.monotonic()
        with contextlib.suppress(PalpateError):  # it is asked for further, and recorded then
            tare = book.baseline(sensor, tare_id, timeout_s=left_s, patient=True)
        left_s -= time.monotonic() - began_s
        return tare

    return find


def _drain(tap: Tap, files: RecordFiles, may_go_on: Callable[[], bool]) -> int:
    """Record the waiting samples while it ``may_go_on``; their number."""
    came = 0
    beat()
    try:
        while may_go_on():
            files.write(tap.next(0.0))
            came += 1
            if came % _CHECK_AFTER == 0:
                beat()
                files.tick()
    except StreamTimeout:
        files.tick(idle=came == 0)
    return came


def _count_the_rest(tap: Tap, health: Health) -> None:
    """Count what a closed tap still holds: more than a stopping recorder had time to write."""
    left = 0
    with contextlib.suppress(LinkError):  # nothing waits any more
        while True:
            tap.next(0.0)
            left += 1
    if left:
        health.count("lost_at_stop", left)
        _log.error("%d messages that had arrived are not recorded: recorder.drain_s", left)


def _topics(names: tuple[str, ...]) -> list[Topic[Any]]:
    return [topic for name, topic in TOPICS.items() if (name in names if names else topic.recorded)]
