"""Joining the bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, Self, TypeVar

import zenoh

from palpate.bus.opening import no_router, open_zenoh
from palpate.bus.presence import Alive, Asking, Departures, Presence, alive
from palpate.bus.publish import Publisher
from palpate.bus.query import Queryable, ask_all, ask_one
from palpate.bus.queues import Delivery
from palpate.bus.streams import Answer, StreamQueryable, ask_stream
from palpate.bus.subscribe import Subscriber, Tap
from palpate.bus.topics import Topic, asking_key, sensor_key, service_key
from palpate.closing import Closing
from palpate.codec import Codec
from palpate.config import LinkConfig
from palpate.errors import PalpateError

M = TypeVar("M")
Q = TypeVar("Q")
R = TypeVar("R")


class _Closable(Protocol):
    def close(self) -> None: ...


K = TypeVar("K", bound=_Closable)


class Session(Closing):
    """A process's place on the bus. Always used as a context manager.

    A process that ends with an open Zenoh session may hang in its thread shutdown; ``with`` closes
    it on every path.
    """

    def __init__(self, raw: zenoh.Session, station: str) -> None:
        self._raw = raw
        self.station = station
        self._closing: list[Callable[[], None]] = []

    @classmethod
    def open(cls, link: LinkConfig, *, station: str = "lab") -> Self:
        """Join the bus.

        Args:
            link: Where the router is and how long to wait for it.
            station: The station whose keys this session uses by default.

        Raises:
            LinkError: No router within ``link.wait_for_router_s``, or a port is in use.
        """
        raw = open_zenoh(link, "peer" if link.direct else "client")
        if link.wait_for_router_s >= 0 and link.connect:
            deadline = time.monotonic() + link.wait_for_router_s
            while not raw.info.routers_zid() and not raw.info.peers_zid():
                if time.monotonic() > deadline:
                    raw.close()
                    raise no_router(link)
                time.sleep(0.02)
        return cls(raw, station)

    def publisher(
        self,
        topic: Topic[M],
        *,
        sensor: str | None = None,
        service: str = "",
        instance: str = "",
        lossless: bool = False,
    ) -> Publisher[M]:
        """Publish a topic of a sensor (or, for a service's topic, of a service's instance).

        Args:
            topic: From ``palpate.bus.topics``.
            sensor: Name of the sensor.
            service: Name of the service, for a service's topic.
            instance: Name of its instance.
            lossless: Wait for slow subscribers instead of dropping. Offline replay only.
        """
        key = self._key(topic, sensor, service, instance, None)
        return self._keep(Publisher(self._raw, topic, key, lossless=lossless))

    def subscriber(
        self,
        topic: Topic[M],
        *,
        sensor: str = "*",
        service: str = "*",
        instance: str = "*",
        station: str | None = None,
        delivery: Delivery = Delivery.NEWEST,
        capacity: int = 4096,
        depth: int = 1,
    ) -> Subscriber[M]:
        """Subscribe to a topic; ``"*"`` = any sensor, service, instance or station.

        Args:
            topic: From ``palpate.bus.topics``.
            sensor: Name of the sensor.
            service: Name of the service, for a service's topic.
            instance: Name of its instance.
            station: Name of the station; None = the session's own.
            delivery: What happens to messages that come faster than they are taken.
            capacity: Messages that may wait, for ``QUEUE`` and ``EVERY``.
            depth: Messages that may wait per sensor, for ``NEWEST``.
        """
        key = self._key(topic, sensor, service, instance, station)
        return self._keep(
            Subscriber(self._raw, topic, key, delivery=delivery, capacity=capacity, depth=depth)
        )

    def tap(
        self,
        topics: Sequence[Topic[Any]],
        *,
        sensor: str = "*",
        station: str | None = None,
        delivery: Delivery = Delivery.QUEUE,
        capacity: int = 65536,
    ) -> Tap:
        """Receive several topics undecoded, in order of arrival."""
        keys = [(topic, self._key(topic, sensor, "*", "*", station)) for topic in topics]
        return self._keep(Tap(self._raw, keys, delivery=delivery, capacity=capacity))

    def queryable(
        self,
        endpoint: str,
        *,
        sensor: str,
        request: Codec[Q],
        reply: Codec[R],
        handler: Callable[[Q], R],
        capacity: int = 16,
        workers: int = 1,
    ) -> Queryable:
        """Answer questions about a sensor; the handler may raise any ``PalpateError``."""
        key = sensor_key(self.station, sensor, endpoint)
        return self._keep(
            Queryable(self._raw, key, request, reply, handler, capacity=capacity, workers=workers)
        )

    def service_queryable(
        self,
        endpoint: str,
        *,
        service: str,
        instance: str,
        request: Codec[Q],
        reply: Codec[R],
        handler: Callable[[Q], R],
        capacity: int = 16,
    ) -> Queryable:
        """Answer questions to a service's instance."""
        key = service_key(self.station, service, instance, endpoint)
        return self._keep(Queryable(self._raw, key, request, reply, handler, capacity=capacity))

    def query(
        self,
        endpoint: str,
        *,
        sensor: str | None = None,
        service: str = "*",
        instance: str = "*",
        request: Q,
        request_codec: Codec[Q],
        reply_codec: Codec[R],
        timeout_s: float = 1.0,
    ) -> R:
        """Ask a sensor's endpoint (``sensor`` given) or a service's.

        Raises:
            LinkError: Nobody serves it.
            StreamTimeout: No answer in time.
            RemoteError: The service's typed error.
        """
        key = self._endpoint(endpoint, sensor, service, instance)
        return ask_one(self._raw, key, request_codec, reply_codec, request, timeout_s=timeout_s)

    def query_all(
        self,
        endpoint: str,
        *,
        sensor: str | None = None,
        service: str = "*",
        instance: str = "*",
        request: Q,
        request_codec: Codec[Q],
        reply_codec: Codec[R],
        timeout_s: float = 1.0,
    ) -> list[R | PalpateError]:
        """Every answer; errors are returned, not raised."""
        key = self._endpoint(endpoint, sensor, service, instance)
        return ask_all(self._raw, key, request_codec, reply_codec, request, timeout_s=timeout_s)

    def stream_queryable(
        self,
        endpoint: str,
        *,
        sensor: str,
        request: Codec[Q],
        reply: Codec[R],
        handler: Callable[[Q, Answer[R]], None],
        capacity: int = 16,
    ) -> StreamQueryable:
        """Answer questions about a sensor with several replies each, from any thread."""
        key = sensor_key(self.station, sensor, endpoint)
        return self._keep(StreamQueryable(self._raw, key, request, reply, handler, capacity))

    def ask_stream(
        self,
        endpoint: str,
        *,
        sensor: str,
        request: Q,
        request_codec: Codec[Q],
        reply_codec: Codec[R],
        timeout_s: float,
    ) -> Iterator[R]:
        """The replies of a sensor's endpoint as they come; the errors of ``query``."""
        key = sensor_key(self.station, sensor, endpoint)
        return ask_stream(self._raw, key, request_codec, reply_codec, request, timeout_s=timeout_s)

    def asking(self, request_id: str) -> Asking:
        """Show that this process waits for an answer, until it is closed or this process dies."""
        return Asking(self._raw, asking_key(self.station, request_id))

    def watch_askers(self, on_gone: Callable[[str], None]) -> None:
        """Call ``on_gone`` with the ``asking_key`` of every caller that waits no longer."""
        self._keep(Departures(self._raw, asking_key(self.station, "*"), on_gone))

    def presence(self, service: str, *, instance: str) -> Presence:
        """Declare this process alive; call ``ready`` on the result when it serves."""
        return self._keep(Presence(self._raw, self.station, service, instance))

    def alive(self, *, station: str | None = None) -> list[Alive]:
        """Who is alive, and who is ready."""
        return alive(self._raw, self.station if station is None else station)

    def has_router(self) -> bool:
        """Whether a router is connected at present."""
        return bool(self._raw.info.routers_zid())

    def close(self) -> None:
        """Leave the bus."""
        for close in reversed(self._closing):
            try:
                close()
            except zenoh.ZError:  # already undeclared, or the session is gone
                continue
        self._closing.clear()
        self._raw.close()

    def _keep(self, thing: K) -> K:
        self._closing.append(thing.close)
        return thing

    def _key(
        self,
        topic: Topic[Any],
        sensor: str | None,
        service: str,
        instance: str,
        station: str | None,
    ) -> str:
        where = self.station if station is None else station
        if topic.per_service:
            return service_key(where, service, instance, topic.name)
        if sensor is None:
            raise TypeError(f"topic {topic.name!r} needs a sensor")
        return sensor_key(where, sensor, topic.name)

    def _endpoint(self, endpoint: str, sensor: str | None, service: str, instance: str) -> str:
        if sensor is not None:
            return sensor_key(self.station, sensor, endpoint)
        return service_key(self.station, service, instance, endpoint)
