"""Joining the bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, Self, TypeVar

import zenoh

from palpate.bus.endpoints import Endpoint
from palpate.bus.opening import no_router, open_zenoh
from palpate.bus.presence import Alive, CallerToken, CallerWatch, Presence, alive
from palpate.bus.publish import Publisher
from palpate.bus.query import (
    Queryable,
    QueryAnswer,
    ask,
    first_reply,
    raise_errors,
    single_reply,
)
from palpate.bus.queues import Delivery
from palpate.bus.subscribe import Subscriber, Tap
from palpate.bus.topics import Topic, caller_key, sensor_key, service_key
from palpate.closing import Closing
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
        key = self._key(topic, sensor, service, instance)
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
        endpoint: Endpoint[Q, R],
        handler: Callable[[Q], R],
        *,
        sensor: str | None = None,
        service: str = "",
        instance: str = "",
        capacity: int = 16,
        workers: int = 1,
    ) -> Queryable:
        """Answer each question with one reply.

        Args:
            endpoint: From ``palpate.bus.endpoints``.
            handler: Returns the reply; may raise any ``PalpateError``.
            sensor: Name of the sensor.
            service: Name of the service, for a service's endpoint.
            instance: Name of its instance.
            capacity: Questions that may wait; more are refused.
            workers: Questions that are handled at the same time.
        """
        key = self._key(endpoint, sensor, service, instance)
        return self._keep(
            Queryable(
                self._raw, key, endpoint, single_reply(handler), capacity=capacity, workers=workers
            )
        )

    def stream_queryable(
        self,
        endpoint: Endpoint[Q, R],
        handler: Callable[[Q, QueryAnswer[R]], None],
        *,
        sensor: str,
        capacity: int = 16,
    ) -> Queryable:
        """Answer each question about a sensor with several replies, from any thread."""
        key = self._key(endpoint, sensor, "", "")
        return self._keep(Queryable(self._raw, key, endpoint, handler, capacity=capacity))

    def query(
        self,
        endpoint: Endpoint[Q, R],
        request: Q,
        *,
        sensor: str | None = None,
        service: str = "*",
        instance: str = "*",
        timeout_s: float = 1.0,
    ) -> R:
        """Ask an endpoint of a sensor, or of a service.

        Raises:
            LinkError: Nobody serves it.
            StreamTimeout: No answer in time.
            RemoteError: The service's typed error.
            WireError: The answer breaks the contract.
        """
        key = self._key(endpoint, sensor, service, instance)
        replies = ask(self._raw, key, endpoint, request, timeout_s=timeout_s, everyone=True)
        return first_reply(list(replies), key)

    def query_all(
        self,
        endpoint: Endpoint[Q, R],
        request: Q,
        *,
        sensor: str | None = None,
        service: str = "*",
        instance: str = "*",
        timeout_s: float = 1.0,
    ) -> list[R | PalpateError]:
        """Every answer; errors are returned, not raised."""
        key = self._key(endpoint, sensor, service, instance)
        replies = ask(self._raw, key, endpoint, request, timeout_s=timeout_s, everyone=True)
        return list(replies)

    def query_stream(
        self, endpoint: Endpoint[Q, R], request: Q, *, sensor: str, timeout_s: float
    ) -> Iterator[R]:
        """The replies of a sensor's endpoint as they come; raises the errors of ``query``."""
        key = self._key(endpoint, sensor, "", "")
        replies = ask(self._raw, key, endpoint, request, timeout_s=timeout_s, everyone=False)
        return raise_errors(replies, key)

    def caller_token(self, request_id: str) -> CallerToken:
        """Show that this process waits for an answer, until it is closed or this process dies."""
        return CallerToken(self._raw, caller_key(self.station, request_id))

    def watch_callers(self, on_gone: Callable[[str], None]) -> None:
        """Call ``on_gone`` with the ``caller_key`` of every caller that waits no longer."""
        self._keep(CallerWatch(self._raw, caller_key(self.station, "*"), on_gone))

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
        what: Topic[Any] | Endpoint[Any, Any],
        sensor: str | None,
        service: str,
        instance: str,
        station: str | None = None,
    ) -> str:
        where = self.station if station is None else station
        if what.per_service:
            return service_key(where, service, instance, what.name)
        if sensor is None:
            raise TypeError(f"{what.name!r} needs a sensor")
        return sensor_key(where, sensor, what.name)
