"""A tap: undecoded samples of several topics in order of arrival, for a recorder."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import zenoh

from palpate import clock
from palpate.bus.delivery import Delivery, DeliveryQueue, queue_for
from palpate.bus.ring import is_wake, subscription_closed, undeclare
from palpate.bus.topics import parse_key
from palpate.bus.zenoh_session import Declared
from palpate.errors import StreamTimeout, WireError


@dataclass(frozen=True, slots=True)
class TapSample:
    """An undecoded message: what a recorder writes."""

    topic: str
    station: str
    sensor: str
    key: str
    encoding: str
    payload: bytes
    received_monotonic_ns: int
    received_wall_ns: int
    lost_here: int = 0
    """Samples of this key that found no place to wait, in all before it."""

    @property
    def schema(self) -> str:
        """Full name of the message, from the encoding."""
        return self.encoding.partition(";")[2]


class Tap(Declared):
    """Receives undecoded samples of several topics in order of arrival. Made by ``Session.tap``."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Sequence[str],
        *,
        delivery: Delivery,
        capacity: int,
    ) -> None:
        self._keys = ", ".join(keys)
        self._counters: Counter[str] = Counter()
        self._waiting: DeliveryQueue[tuple[zenoh.Sample, int, int]] = queue_for(
            delivery, capacity, self._counters
        )
        # By default each subscriber calls back from a thread of its own, and a frame may overtake
        # the tare that was sent before it. Called from the link's thread, arrival is the order.
        in_order = zenoh.handlers.Callback(self._on_sample, indirect=False)
        self._subscribers = [session.declare_subscriber(key, in_order) for key in keys]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if is_wake(sample):
            return
        monotonic_ns, wall_ns = clock.now()
        self._counters["received"] += 1
        self._waiting.put(str(sample.key_expr), (sample, monotonic_ns, wall_ns))

    @property
    def counters(self) -> dict[str, int]:
        """``received``, ``dropped``, ``overflow``, ``rejected_key``."""
        return dict(self._counters)

    @property
    def waiting(self) -> int:
        """How many samples wait."""
        return len(self._waiting)

    def next(self, timeout_s: float) -> TapSample:
        """The next sample; those that wait in a queue are there after ``close``, too.

        Raises:
            StreamTimeout: None came within ``timeout_s``.
            LinkError: None is left, and the tap or its session is closed.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            item = self._waiting.get(max(0.0, deadline - time.monotonic()))
            if item is None and self.closed:
                raise subscription_closed(self._keys)
            if item is None:
                raise StreamTimeout(
                    f"no message within {timeout_s:g} s", remedy="check what runs: palpate status"
                )
            (sample, monotonic_ns, wall_ns), lost_here = item
            key = str(sample.key_expr)
            try:
                address = parse_key(key)
            except WireError as error:
                self._counters[f"rejected_{error.reason}"] += 1
                continue
            return TapSample(
                address.topic,
                address.station,
                address.sensor,
                key,
                str(sample.encoding),
                sample.payload.to_bytes(),
                monotonic_ns,
                wall_ns,
                lost_here,
            )

    def close(self) -> None:
        """Undeclare; a blocked sender is released."""
        self.closed = True
        self._waiting.close()
        for subscriber in self._subscribers:
            undeclare(subscriber)
