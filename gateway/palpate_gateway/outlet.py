"""Where a sensor's messages leave for the bus: what is refused there, and how long they took."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from palpate.bus import Publisher
from palpate.errors import WireError
from palpate.health import Health
from palpate_gateway.pipeline import Outgoing

_ENCODERS_DECIDE = "the frame was not published; this is a defect of the device driver"

_KEPT = 512
"""Of so many readings the times are kept."""


class Outlet:
    """Publishes what a pipeline gives; belongs to the thread that reads, but for ``gauges``.

    Args:
        publishers: A publisher for each stream.
        health: Told of messages that cannot be encoded.
        stop: Ends a wait for a recorded message's time.
        claim: Called with the name of its stream before each message; raises where another sensor
            publishes that.
    """

    def __init__(
        self,
        publishers: dict[str, Publisher[Any]],
        health: Health,
        *,
        stop: threading.Event,
        claim: Callable[[str], None],
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._publishers = publishers
        self._health = health
        self._stop = stop
        self._claim = claim
        self._reasons: set[str] = set()
        self._took_ns: deque[int] = deque(maxlen=_KEPT)

    @property
    def refuses(self) -> bool:
        """Whether messages could not be encoded."""
        return bool(self._reasons)

    def gauges(self) -> dict[str, float]:
        """Median and 99 % of the time from a reading's arrival in this process to the bus [s]."""
        took_ns = list(self._took_ns)
        if not took_ns:
            return {}
        p50, p99 = np.percentile(took_ns, (50, 99)) * 1e-9
        return {"publish_p50_s": float(p50), "publish_p99_s": float(p99)}

    def put_read(self, items: list[Outgoing], read_ns: int) -> None:
        """Publish what became of readings.

        Args:
            items: The messages.
            read_ns: When the device's ``read`` had brought the readings, host monotonic clock [ns].
        """
        if self.put(items) and not items[0].due_ns:
            self._took_ns.append(time.monotonic_ns() - read_ns)

    def put(self, items: list[Outgoing]) -> bool:
        """Publish messages, each when it is due; whether there were any, and all are out."""
        for item in items:
            if item.due_ns:
                wait_s = (item.due_ns - time.monotonic_ns()) * 1e-9
                if wait_s > 0 and self._stop.wait(wait_s):
                    return False
            self._claim(item.topic)
            publisher = self._publishers[item.topic]
            try:
                if isinstance(item.message, bytes):
                    publisher.put_payload(item.message)
                else:
                    publisher.put(item.message)
            except WireError as error:
                self.counters["frames_rejected"] += 1
                self._tell_refused(error)
        return bool(items)

    def _tell_refused(self, error: WireError) -> None:
        """Tell once of each reason: a defect comes with every frame."""
        if error.reason not in self._reasons:
            self._reasons.add(error.reason)
            told = WireError(error.problem, remedy=_ENCODERS_DECIDE, reason=error.reason)
            self._health.fail(told)
