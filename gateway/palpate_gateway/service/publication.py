"""The end of a sensor's way: its messages go to the bus, and their latency is measured."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from palpate.bus import Publisher
from palpate.errors import WireError
from palpate.health import Health
from palpate.heartbeat import Turns
from palpate.log import about
from palpate.messages import Tare
from palpate_gateway.clock.stamps import DueMessage

_log = logging.getLogger(__name__)

_ENCODERS_DECIDE = "the frame was not published; this is a defect of the device driver"

LATE_S = 75.0
"""A device that opens or takes its zero, and the put of a lossless replay, end within this time
[s]; a thread that takes longer hangs."""

_YIELD: Callable[[], object] = getattr(os, "sched_yield", lambda: None)
"""The gateway's threads share one core (``one_core``): Zenoh's thread shall send a frame before
this one goes on, which then judges the sensor's condition for a while."""

_KEPT = 512
"""Number of messages whose latencies are kept."""

_PRESENT_NS = 2_000_000_000
"""Latencies after which nothing came for longer are past [ns], and told no more."""


class MessagePublisher:
    """Publishes the messages of a pipeline.

    Belongs to the thread that reads the sensor; only ``gauges`` may be called from others.

    Args:
        publishers: A publisher for each stream.
        health: Receives the errors of messages that cannot be encoded.
        stop: Ends a wait for a recorded message's time.
        claim: Called with the name of its stream before each message; raises where another gateway
            or sensor publishes that stream.
        turns: Those of the thread: a recorded message may be due much later.
        name: Name of the sensor, for the log.
    """

    def __init__(
        self,
        publishers: dict[str, Publisher[Any]],
        health: Health,
        *,
        stop: threading.Event,
        claim: Callable[[str], None],
        turns: Turns | None = None,
        name: str = "",
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._publishers = publishers
        self._health = health
        self._stop = stop
        self._claim = claim
        self._turns = turns or Turns()
        self._name = name
        self._reasons: set[str] = set()
        self._latencies_ns: deque[int] = deque(maxlen=_KEPT)
        self._timed_ns = 0
        self._last: tuple[Publisher[Any], Any] | None = None

    @property
    def has_rejected(self) -> bool:
        """Whether messages could not be encoded."""
        return bool(self._reasons)

    def gauges(self) -> dict[str, float]:
        """Median and 99 % of the latency from a reading's arrival in this process to the bus [s].

        Stamping and encoding are inside, transport to this process is not. Empty while none comes.
        """
        latencies_ns = list(self._latencies_ns)
        if not latencies_ns or time.monotonic_ns() - self._timed_ns > _PRESENT_NS:
            return {}
        p50, p99 = np.percentile(latencies_ns, (50, 99)) * 1e-9
        return {"publish_p50_s": float(p50), "publish_p99_s": float(p99)}

    def put(self, item: DueMessage, *, read_ns: int = 0) -> None:
        """Publish a message when it is due; it is left out if ``stop`` is set before.

        ``read_ns`` is when the device's ``read`` with its reading had returned, by the host's
        monotonic clock [ns]; 0 = it came of no reading.
        """
        if item.due_ns:
            wait_s = (item.due_ns - time.monotonic_ns()) * 1e-9
            if wait_s > 0:
                self._turns.next(wait_s + LATE_S)
                if self._stop.wait(wait_s):
                    return
        self._claim(item.topic)
        publisher = self._publishers[item.topic]
        message = item.message
        try:
            if isinstance(message, bytes):
                publisher.put_payload(message)
            else:
                publisher.put(message)
                self._last = publisher, message
            _YIELD()
        except WireError as error:
            self.counters["frames_rejected"] += 1
            self._report_once(error, message)
        # A recorded message waits until it is due: its latency would be that of the recording.
        if read_ns and not item.due_ns:
            self._timed_ns = time.monotonic_ns()
            self._latencies_ns.append(self._timed_ns - read_ns)
        if isinstance(message, Tare):
            tared = about(self._name, message.stamp, tare_id=message.tare_id)
            _log.info("sensor %s is tared", self._name, extra=tared)

    def rehearse(self) -> None:
        """Encode the last message once more, and publish nothing.

        Shortly before the next one is due this brings code and data back into the processor's
        caches, from which other processes have displaced them (ADR 4).
        """
        if self._last is not None:
            publisher, message = self._last
            publisher.encode(message)

    def _report_once(self, error: WireError, message: object) -> None:
        """Report each reason once: a defect of a driver comes with every frame."""
        if error.reason not in self._reasons:
            self._reasons.add(error.reason)
            frame = about(self._name, getattr(message, "stamp", None))
            _log.error("sensor %s: not published: %s", self._name, error, extra=frame)
            self._health.fail(
                WireError(
                    f"sensor {self._name!r}: {error.problem}",
                    remedy=_ENCODERS_DECIDE,
                    reason=error.reason,
                )
            )
