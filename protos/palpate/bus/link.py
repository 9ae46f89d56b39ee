"""The session of a process on the bus."""

from __future__ import annotations

import atexit
import contextlib
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from functools import partial
from typing import Any, Self, TypeVar

import zenoh

from palpate.bus.attachments import OnTimings
from palpate.bus.claims import ClaimWatch, SensorClaims
from palpate.bus.delivery import Delivery
from palpate.bus.endpoints import STATUS, Endpoint
from palpate.bus.foreign import ForeignPublisher, ForeignSubscriber, ForeignToken
from palpate.bus.no_router import no_router
from palpate.bus.presence import AliveService, CallerToken, CallerWatch, Presence, alive
from palpate.bus.pubsub import Publisher, ReceivedMessage, Subscriber
from palpate.bus.query import (
    LOOK_S,
    ask,
    ask_again,
    first_reply,
    is_served,
    no_reply,
    raise_errors,
)
from palpate.bus.queryable import Queryable, QueryAnswer, single_reply
from palpate.bus.ring import Alarm
from palpate.bus.tap import Tap
from palpate.bus.topics import (
    CLAIM_ROOT,
    SensorClaim,
    Topic,
    caller_key,
    claims_key,
    parse_claim_key,
    sensor_key,
    service_key,
)
from palpate.bus.zenoh_session import (
    Declared,
    check_process,
    close_zenoh,
    is_inherited,
    open_zenoh,
    while_open,
)
from palpate.config import LinkConfig, check_name
from palpate.errors import ConfigError, LinkError, PalpateError, WireError
from palpate.process import Closing

_OBSERVER_WAIT_S = 1.0
"""How long a session that has joined looks for its router once more [s]."""

_LOOK_S = 1.0
"""How long a look at the tokens of others may take [s]."""

_LEAVE_S = 1.0
"""How long a session that found no router waits until it has left [s]."""

_YOUNG_S = 2.0
"""Within this time the links of a session to all processes of its station have come up [s]."""

_SETTLED_S = 0.2
"""A young session whose links have not changed for so long is taken to have all of them [s]."""

M = TypeVar("M")
Q = TypeVar("Q")
R = TypeVar("R")


K = TypeVar("K", bound=Declared)


_open: set[Session] = set()
"""Held until they are closed: Zenoh's session would live on, and nobody could close it."""


@atexit.register
def _close_all() -> None:
    """Close what is still open: Zenoh's threads would call into an interpreter that is gone."""
    for session in list(_open):
        session.close()


class Session(Closing):
    """A process's connection to the bus. Best used as a context manager.

    A process that ends with an open Zenoh session is aborted or hangs, so those that are still open
    at its end are closed then.

    Methods take the name of a ``sensor`` for its topics and endpoints; for those of a process, the
    names of its ``service`` and ``instance``. Where many can be meant, ``"*"`` stands for any. Each
    raises a ``LinkError`` where the session is closed, or was opened before a fork of the process.
    """

    def __init__(self, raw: zenoh.Session, station: str, link: LinkConfig) -> None:
        self._raw = raw
        self._link = link
        self._opened_s = time.monotonic()
        self.station = station
        self.wall_clock_error_s = link.wall_clock_error_s
        self._alarm: Alarm | None = None
        self._claim_watches: dict[str, ClaimWatch] = {}
        self._observing: Session | None = None
        self._observing_lock = threading.Lock()
        self._declaring = threading.Lock()
        self._declared: list[Declared] = []
        self._answering: list[Queryable] = []
        self._answered: Counter[str] = Counter()  # of those that do not answer any more
        _open.add(self)

    @classmethod
    def open(cls, link: LinkConfig, *, station: str = "lab") -> Self:
        """Join the bus; the session uses the keys of ``station`` by default.

        Raises:
            LinkError: No router within ``link.wait_for_router_s``, a port is in use, or a session
                was opened before a fork.
            ConfigError: Its certificates cannot be used.
        """
        raw = open_zenoh(link, "peer" if link.links_directly else "client")
        # Zenoh opens a peer at once and looks for the router in the background.
        if link.wait_for_router_s >= 0 and link.connect:
            deadline = time.monotonic() + link.wait_for_router_s
            while not raw.info.routers_zid() and not raw.info.peers_zid():
                if time.monotonic() > deadline:
                    # Not out of the caller's time: where the router hangs, this takes 10 s.
                    leaving = threading.Thread(target=close_zenoh, args=(raw,), name="leaving")
                    leaving.start()
                    leaving.join(_LEAVE_S)
                    raise no_router(link)
                time.sleep(0.02)
        return cls(raw, station, link)

    @while_open()
    def publisher(
        self,
        topic: Topic[M],
        *,
        sensor: str | None = None,
        service: str = "",
        instance: str = "",
        lossless: bool = False,
    ) -> Publisher[M]:
        """Publish a topic of a sensor or of a process.

        A ``lossless`` publisher waits for slow subscribers instead of dropping: for offline replay
        only.
        """
        key = self._key(topic, sensor, service, instance)
        return self._keep(Publisher(self._raw, topic, key, lossless=lossless))

    @while_open()
    def subscriber(
        self,
        topic: Topic[M],
        *,
        sensor: str = "*",
        service: str = "*",
        station: str | None = None,
        delivery: Delivery = Delivery.NEWEST,
        capacity: int = 4096,
        depth: int = 1,
        sensors: Collection[str] = (),
        announced: bool = False,
        rehearse: Callable[[ReceivedMessage[M]], None] | None = None,
    ) -> Subscriber[M]:
        """Subscribe to a topic of a station; None = the session's own.

        ``delivery`` says what happens to messages that come faster than they are taken. With
        ``QUEUE`` and ``EVERY`` ``capacity`` of them may wait, with ``NEWEST`` ``depth`` per sensor.
        Of ``sensor="*"`` those named in ``sensors`` are followed; with ``announced`` those that a
        gateway has claimed, and when a claim passes, the new holder at once; else any.
        With ``NEWEST``, ``rehearse`` is called with the last message shortly before the next one is
        due, while a consumer waits: see ``Subscriber``.
        """
        key = self._key(topic, sensor, service, "*", station)
        return self._keep(
            Subscriber(
                self._raw,
                topic,
                key,
                delivery=delivery,
                alarm=self._get_alarm(),
                capacity=capacity,
                depth=depth,
                wall_clock_error_s=self.wall_clock_error_s,
                sensors=sensors,
                holders_of=self._holders_of(station) if announced else None,
                rehearse=rehearse,
            )
        )

    def _holders_of(self, station: str | None) -> Callable[[str], frozenset[int]]:
        where = self.station if station is None else station
        if where not in self._claim_watches:
            self._claim_watches[where] = self._keep(ClaimWatch(self._raw, where))
        return self._claim_watches[where].holders

    def _get_alarm(self) -> Alarm:
        if self._alarm is None:
            self._alarm = self._keep(Alarm())
        return self._alarm

    @while_open()
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
        keys = [self._key(topic, sensor, "*", "*", station) for topic in topics]
        return self._keep(Tap(self._raw, keys, delivery=delivery, capacity=capacity))

    @property
    def zid(self) -> str:
        """Zenoh's id of this session."""
        return str(self._raw.zid())

    @while_open()
    def foreign_subscriber(self, key: str) -> ForeignSubscriber:
        """Receive raw samples under a key expression that is not palpate's."""
        return self._keep(ForeignSubscriber(self._raw, key))

    @while_open()
    def foreign_publisher(self, key: str) -> ForeignPublisher:
        """Publish bytes under a key that is not palpate's."""
        return self._keep(ForeignPublisher(self._raw, key))

    @while_open()
    def foreign_token(self, key: str) -> ForeignToken:
        """Declare a liveliness token that is not palpate's."""
        return self._keep(ForeignToken(self._raw, key))

    @while_open()
    def foreign_tokens(self, key: str) -> list[str]:
        """Keys of the liveliness tokens that match a key expression that is not palpate's."""
        replies = self._raw.liveliness().get(key, timeout=1.0)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

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
        """Answer each question with what ``handler`` returns, or with the error it raises.

        ``capacity`` questions may wait, more are refused; ``workers`` are handled at once.
        """
        return self.stream_queryable(
            endpoint,
            single_reply(handler),
            sensor=sensor,
            service=service,
            instance=instance,
            capacity=capacity,
            workers=workers,
        )

    @while_open()
    def stream_queryable(
        self,
        endpoint: Endpoint[Q, R],
        handler: Callable[[Q, QueryAnswer[R]], None],
        *,
        sensor: str | None = None,
        service: str = "",
        instance: str = "",
        capacity: int = 16,
        workers: int = 1,
    ) -> Queryable:
        """Answer each question with several replies, or with their timings; from any thread."""
        key = self._key(endpoint, sensor, service, instance)
        queryable = Queryable(self._raw, key, endpoint, handler, capacity=capacity, workers=workers)
        if endpoint is not STATUS:
            with self._declaring:
                self._sum_up_answered()
                self._answering.append(queryable)
        return self._keep(queryable)

    def questions(self) -> tuple[dict[str, int], int]:
        """Counters of all questions to this session but those about its status; how many wait."""
        with self._declaring:
            self._sum_up_answered()
            counters = self._answered.copy()
            for queryable in self._answering:
                counters.update(queryable.counters)
            return dict(counters), sum(one.waiting for one in self._answering)

    def _sum_up_answered(self) -> None:
        """Keep only the counters of what is closed; with the lock."""
        for one in self._answering:
            if one.closed:
                self._answered.update(one.counters)
        self._answering = [one for one in self._answering if not one.closed]

    def query(
        self,
        endpoint: Endpoint[Q, R],
        request: Q,
        *,
        sensor: str | None = None,
        service: str = "*",
        instance: str = "*",
        timeout_s: float = 1.0,
        on_timings: OnTimings | None = None,
    ) -> R:
        """Ask an endpoint of one sensor, or of a service.

        A refusal that says when to ask again is followed within ``timeout_s``. ``on_timings`` is
        called with the timings of an estimate, if the service says them.

        Raises:
            ConfigError: Not the name of one sensor, no time, or values that cannot be sent.
            LinkError: Nobody serves it, or its answer was lost.
            StreamTimeout: No answer in time.
            RemoteError: The service's typed error.
            WireError: The answer breaks the contract, or the request is too large.
        """
        if sensor is not None:
            check_name(sensor, "sensor")
        key = self._key(endpoint, sensor, service, instance)

        def once(left_s: float) -> R:
            replies = self._ask(key, endpoint, request, timeout_s=left_s, on_timings=on_timings)
            with contextlib.closing(replies):  # one that hangs does not delay those that answer
                return first_reply(replies)

        return ask_again(once, timeout_s)

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
        replies = self._ask(key, endpoint, request, timeout_s=timeout_s, silence=False)
        return list(replies)

    def query_stream(
        self,
        endpoint: Endpoint[Q, R],
        request: Q,
        *,
        sensor: str | None = None,
        service: str = "*",
        instance: str = "*",
        timeout_s: float,
    ) -> Iterator[R]:
        """The replies of an endpoint as they come; raises the errors of ``query``.

        A refusal is raised at once, however soon one may ask again.
        """
        if sensor is not None:
            check_name(sensor, "sensor")
        key = self._key(endpoint, sensor, service, instance)
        replies = self._ask(key, endpoint, request, timeout_s=timeout_s, everyone=False)
        return raise_errors(replies)

    def serves(self, endpoint: Endpoint[Any, Any], *, sensor: str) -> bool:
        """Whether somebody is known at present to answer this endpoint of a sensor."""
        key = self._key(endpoint, check_name(sensor, "sensor"), "", "")
        return is_served(self._asking(), key, LOOK_S)

    @while_open()
    def _ask(
        self,
        key: str,
        endpoint: Endpoint[Q, R],
        request: Q,
        *,
        timeout_s: float,
        everyone: bool = True,
        silence: bool = True,
        on_timings: OnTimings | None = None,
    ) -> Generator[R | PalpateError]:
        """The replies; with ``silence`` their absence is an error among them."""
        settle_s = _YOUNG_S if self._young() else 0.0
        asking = self._asking()
        nobody = partial(
            no_reply,
            asking,
            key,
            roles=self._link.has_roles,
            device=endpoint.device,
            station=self.station,
        )
        return ask(
            asking,
            key,
            endpoint,
            request,
            timeout_s=timeout_s,
            everyone=everyone,
            settle_s=settle_s,
            silence=nobody if silence else None,
            on_timings=on_timings,
        )

    @while_open()
    def caller_token(self, request_id: str) -> CallerToken:
        """Show that this process waits for an answer, until it is closed or this process dies."""
        return CallerToken(self._raw, caller_key(self.station, request_id))

    @while_open()
    def watch_callers(self, on_gone: Callable[[str, float], None]) -> None:
        """Call ``on_gone`` for every caller that waits no longer.

        It gets its ``caller_key``, and since when it is gone [s, monotonic].
        """
        self._keep(CallerWatch(self._raw, caller_key(self.station, "*"), on_gone))

    @while_open()
    def presence(self, service: str, *, instance: str) -> Presence:
        """Declare this process alive; call ``ready`` on the result when it serves."""
        return self._keep(Presence(self._raw, self.station, service, instance))

    @while_open()
    def claims(
        self,
        *,
        session_id: int = 0,
        instance: str,
        lease_s: float,
        root: str = CLAIM_ROOT,
        shared: bool = False,
    ) -> SensorClaims:
        """Claims of the process ``instance`` at this station; see ``SensorClaims``.

        ``session_id`` is that of its stamps; 0 = it makes none, and gets one by chance.
        """
        info = self._raw.info
        return self._keep(
            SensorClaims(
                self._raw,
                self.station,
                session_id=session_id or secrets.randbelow(2**64 - 1) + 1,
                instance=instance,
                lease_s=lease_s,
                root=root,
                shared=shared,
                joined=lambda: bool(info.routers_zid() or info.peers_zid()),
            )
        )

    @while_open()
    def holders(self, root: str, sensor: str) -> list[SensorClaim]:
        """Who holds a claim on a sensor of this station, in order of their instances.

        Complete as `alive` is: links to others come up late on a busy host.
        """
        key = claims_key(self.station, sensor, held_only=True, root=root)
        found = set()
        for view in self._views():
            for reply in view.liveliness().get(key, timeout=_LOOK_S):
                if reply.ok is not None:
                    with contextlib.suppress(WireError):  # anybody may declare tokens
                        found.add(parse_claim_key(str(reply.ok.key_expr)))
        return sorted(found, key=lambda one: one.instance)

    @while_open()
    def alive(self, *, station: str | None = None) -> list[AliveService]:
        """Which processes are alive, and which of them are ready; complete as soon as it is open.

        A peer learns of the others while its links to them come up, and the router knows them all.
        Without the router it is what this session has learned.
        """
        return alive(self._views(), self.station if station is None else station)

    def _views(self) -> list[zenoh.Session]:
        """Sessions that together know the tokens of all."""
        views = [self._raw]
        with contextlib.suppress(LinkError, ConfigError):  # no router, or other certificates
            observer = self.observer()
            if observer is not self:
                views.append(observer._raw)
        return views

    def observer(self) -> Session:
        """A session through which questions reach every process of the station at once.

        Its questions go through the router, which knows every process. It is opened when first
        needed, and closed with this one, which it may be itself.

        Raises:
            LinkError: There is no router, or this session is closed.
            ConfigError: Its certificates cannot be used by now.
        """
        if not self._link.links_directly or not self._link.connect:
            return self
        check_process()  # before the lock, which a thread that is not here may hold
        if self._raw.is_closed():
            raise LinkError("the session is closed", remedy="open the session again")
        with self._observing_lock:
            if self._observing is None:
                update = {"direct": False, "wait_for_router_s": _OBSERVER_WAIT_S}
                link = self._link.model_copy(update=update)
                self._observing = Session.open(link, station=self.station)
            return self._observing

    def _asking(self) -> zenoh.Session:
        """The Zenoh session through which a question reaches whoever serves it.

        A young session does not know all of them yet, and would say that nobody does. To ask once
        more after silence could tare a finger twice, so the way is chosen before. The router may
        not know a process, either, whose link to it broke and comes back; so a young session also
        waits until somebody is known (``settle_s`` of ``ask``).
        """
        if not self._young():
            return self._raw
        try:
            return self.observer()._raw
        except (LinkError, ConfigError):  # only peers, or other certificates by now
            return self._raw

    def _young(self) -> bool:
        return time.monotonic() - self._opened_s <= _YOUNG_S

    @while_open()
    def has_router(self) -> bool:
        """Whether a router is connected at present."""
        return bool(self._raw.info.routers_zid())

    def close(self) -> None:
        """Leave the bus; takes up to 10 s where the router hangs. In a forked process: nothing.

        One that was opened less than 2 s ago first waits until its links have come up, which takes
        0.2 s as a rule.
        """
        if not is_inherited():
            for one in reversed(self._declared):
                with contextlib.suppress(zenoh.ZError):  # undeclared before, or the session is gone
                    one.close()
            self._declared.clear()
            if self._observing is not None:
                self._observing.close()
            self._settle()
            close_zenoh(self._raw)
        _open.discard(self)  # last: after Ctrl-C in here it is closed at the end of the process

    def _settle(self) -> None:
        """Wait for the links of a young session: one that comes up while Zenoh closes never ends.

        Behind it the whole session lives on: its sockets here and at the others, and its threads.
        """
        if self._raw.is_closed() or not (self._link.links_directly and self._link.connect):
            return
        links: set[tuple[str, str]] = set()
        changed_s = time.monotonic()
        while self._young() and time.monotonic() - changed_s < _SETTLED_S:
            found = {(str(one.src), str(one.dst)) for one in self._raw.info.links()}
            if found != links:
                links, changed_s = found, time.monotonic()
            time.sleep(0.02)

    def _keep(self, thing: K) -> K:
        with self._declaring:
            self._declared = [one for one in self._declared if not one.closed]
            self._declared.append(thing)
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
