"""Publishing and subscribing: typed messages of one topic."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import zenoh

from palpate import clock
from palpate.bus.attachments import timings_of
from palpate.bus.continuity import Continuity
from palpate.bus.delivery import Delivery, FifoQueue
from palpate.bus.ring import Alarm, Ring, is_wake, subscription_closed, undeclare
from palpate.bus.topics import (
    Priority,
    StreamAddress,
    Topic,
    check_schema,
    check_size,
    parse_key,
)
from palpate.bus.zenoh_session import Declared, check_process, said, while_open
from palpate.errors import LinkError, StaleError, StreamTimeout, WireError
from palpate.messages import StageTimings, Stamp

MOST_SOURCES = 256
"""A subscriber follows so many sources at most: anybody may invent names."""

FORGOTTEN_NS = 10_000_000_000
"""A source that is silent for this long makes room for another [ns]."""

_RING = 4096
"""Small messages that may wait in Zenoh's ring until a consumer looks: a second of 40 fingers."""

_RING_LARGE = 512
"""The same for fields, of up to 100 kB each."""

_LEAD_S = 0.0014
"""So long before the next frame of a sensor is due a waiting consumer gets ready for what comes of
it [s]: all consumers before the frame, so that none is in the way of another's work on it."""

_MARGIN_S = 0.0003
_LEAD_MOST_S = 0.0025
"""Who needs long to get ready, with a large network on a slow host, begins earlier, so that this
ends ``_MARGIN_S`` before the frame; not earlier than this, which would be a waste [s]."""

_PAUSE_LEAST_S, _PAUSE_MOST_S = 0.004, 0.05
"""After a shorter pause the consumer still is ready; for a longer one it would be a waste [s]."""

M = TypeVar("M")


class Publisher(Generic[M], Declared):
    """Publishes one topic of one sensor or service. Made by ``Session.publisher``."""

    def __init__(
        self, session: zenoh.Session, topic: Topic[M], key: str, *, lossless: bool
    ) -> None:
        self.topic = topic
        self.key = key
        self._publisher = session.declare_publisher(
            key,
            encoding=zenoh.Encoding(topic.encoding),
            # A frozen subscriber must not stall acquisition: drop. Replay must lose nothing: block.
            congestion_control=(
                zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
            ),
            priority=(
                zenoh.Priority.DATA if lossless else getattr(zenoh.Priority, topic.priority.name)
            ),
            # Not express: an express message takes a whole transmit batch, so twenty sensors that
            # publish in the same millisecond fill the queue and lose frames. A frame that finds
            # an idle link leaves at once either way.
            express=False,
            reliability=zenoh.Reliability.RELIABLE,
        )
        self._encode = topic.codec.encode

    def encode(self, message: M) -> bytes:
        """Check and encode, for ``put_payload``.

        Raises:
            WireError: The message breaks the contract.
        """
        return self._encode(message)

    def put(self, message: M) -> None:
        """Check, encode and publish.

        Raises:
            WireError: The message breaks the contract.
            LinkError: The session is closed.
        """
        self.put_payload(self._encode(message))

    def put_payload(self, payload: bytes, *, attachment: bytes | None = None) -> None:
        """Publish a payload that is already encoded; of an estimate, with its timings.

        Raises:
            WireError: It is larger than a message may be and would be lost (reason ``"size"``).
            LinkError: The session is closed.
        """
        check_process()
        check_size(payload, self.topic.codec.schema, remedy="publish a smaller message")
        try:
            if self.closed:
                raise zenoh.ZError("the publisher is closed")
            self._publisher.put(payload, attachment=attachment)
        except (zenoh.ZError, RuntimeError) as error:  # RuntimeError: it is being undeclared
            raise LinkError(
                f"cannot publish on {self.key}: {said(error)}", remedy="open the session again"
            ) from error

    @while_open()
    def matched(self) -> bool:
        """Whether anyone subscribes at present.

        Raises:
            LinkError: The session is closed.
        """
        status: Any = self._publisher.matching_status  # stub says bool, 1.10 gives a status object
        return bool(getattr(status, "matching", status))

    def close(self) -> None:
        """Undeclare; another thread that publishes gets a ``LinkError``."""
        self.closed = True
        undeclare(self._publisher)


@dataclass(frozen=True, slots=True)
class ReceivedMessage(Generic[M]):
    """A valid message, where it came from and when.

    Attributes:
        payload: Its bytes as they arrived.
        station: Station that published it.
        sensor: Sensor, or ``service/instance`` for a service's topic.
        received_monotonic_ns: When this process saw it first, host monotonic clock [ns]. With
            ``NEWEST`` that is when it looked or was waiting; else when it arrived.
        attachment: What travelled beside the payload; of an estimate, its timings.
        decode_s: How long its decoding took [s].
        stamp: Stamp of the message; an estimate's is its source's; None where it has none.
    """

    message: M
    payload: bytes
    station: str
    sensor: str
    received_monotonic_ns: int
    attachment: bytes = b""
    decode_s: float = 0.0
    stamp: Stamp | None = None

    @property
    def timings(self) -> StageTimings | None:
        """Where the time of an estimate went; None = its service does not say."""
        return timings_of(self.attachment)


Arrival = tuple[zenoh.Sample, int, int]
"""A sample, when it came [ns, monotonic], and how many of its key were dropped here before it."""

HoldersOf = Callable[[str], frozenset[int]]
"""Which runs of gateways hold a sensor of this name, by their claims; empty = unannounced."""


def _sampled_s(received: ReceivedMessage[Any]) -> float:
    """When that was sampled of which a message tells, if just now; else when it came [s]."""
    stamp, came_ns = received.stamp, received.received_monotonic_ns
    if stamp is not None and stamp.clock_id == clock.CLOCK_ID:
        if 0 <= came_ns - stamp.monotonic_ns < _PAUSE_LEAST_S * 1e9:
            return stamp.monotonic_ns * 1e-9
    return came_ns * 1e-9


class _Source(Generic[M]):
    """What a subscriber keeps of one key."""

    __slots__ = ("address", "continuity", "newest", "problem", "seen_ns", "waiting")

    def __init__(
        self, address: StreamAddress, continuity: Continuity[ReceivedMessage[M]] | None
    ) -> None:
        self.address = address
        self.continuity = continuity
        self.waiting: deque[ReceivedMessage[M]] = deque()
        self.newest: ReceivedMessage[M] | None = None
        self.problem: WireError | None = None
        self.seen_ns = 0


class _Queued:
    """Samples that a callback of Zenoh puts into a queue."""

    def __init__(
        self, session: zenoh.Session, key: str, waiting: FifoQueue[Any], counters: Counter[str]
    ) -> None:
        self._waiting: FifoQueue[tuple[zenoh.Sample, int]] = waiting
        self._counters = counters
        self._key = key
        self._subscriber = session.declare_subscriber(key, self._on_sample)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        # Zenoh's thread: enqueue and nothing else; an exception here would vanish.
        if not is_wake(sample):
            self._counters["received"] += 1
            self._waiting.put(str(sample.key_expr), (sample, time.monotonic_ns()))

    @property
    def waiting(self) -> int:
        return len(self._waiting)

    def poll(self) -> Arrival | None:
        return self.wait(0.0)

    def wait(self, timeout_s: float) -> Arrival | None:
        item = self._waiting.get(timeout_s)
        if item is None and self._waiting.closed:
            raise subscription_closed(self._key)
        return None if item is None else (*item[0], item[1])

    def close(self) -> None:
        self._waiting.close()
        undeclare(self._subscriber)


class _Ringed:
    """Samples from Zenoh's ring."""

    def __init__(self, ring: Ring, counters: Counter[str]) -> None:
        self._ring = ring
        self._counters = counters
        self.close = ring.close

    waiting = 0  # whoever asks has looked, and taken all

    def poll(self) -> Arrival | None:
        return self._arrival(self._ring.poll())

    def wait(self, timeout_s: float) -> Arrival | None:
        return self._arrival(self._ring.wait(timeout_s))

    def _arrival(self, sample: zenoh.Sample | None) -> Arrival | None:
        if sample is None:
            return None
        arrived_ns = time.monotonic_ns()
        self._counters["received"] += 1
        return sample, arrived_ns, 0


class Subscriber(Generic[M], Declared):
    """Receives one topic. Made by ``Session.subscriber``.

    Messages of each source are checked in order of arrival (``Continuity``). Safe to use from
    several threads; those that wait take turns.

    ``counters``: ``received``, ``delivered``, ``dropped`` (newest wins), ``overflow``,
    ``lost_on_bus`` (gaps in the sequence that were not dropped here), ``reordered``, ``restarts``
    of the sender, ``other_session`` (a second sender of a followed one's key), ``unannounced``
    (of a sensor that no gateway claims), ``of_others`` (of a sensor that is not wanted),
    ``rejected_names`` (beyond ``MOST_SOURCES``), and ``rejected_<reason>``.

    Of those that a wildcard key matches, only ``sensors`` are followed; if none are named, those
    that have holders.

    A consumer that waits with ``NEWEST`` for messages that come every few milliseconds gets ready
    shortly before the frame of each is due: the last one is decoded once more and handed to
    ``rehearse``, which does with it what the consumer does with a message, without effect. In the
    pause other processes displace code and data of this one from the caches; fetched only when the
    message has come, they cost it more time than the work itself (ADR 4).
    """

    def __init__(
        self,
        session: zenoh.Session,
        topic: Topic[M],
        key: str,
        *,
        delivery: Delivery,
        alarm: Alarm,
        capacity: int = 4096,
        depth: int = 1,
        wall_clock_error_s: float = clock.WALL_CLOCK_ERROR_S,
        sensors: Collection[str] = (),
        holders_of: HoldersOf | None = None,
        rehearse: Callable[[ReceivedMessage[M]], None] | None = None,
    ) -> None:
        self.topic = topic
        self.key = key
        self._encoding, self._decode = topic.encoding, topic.codec.decode
        self._newest_wins = delivery is Delivery.NEWEST
        self._trusting = delivery is Delivery.EVERY
        self._wall_clock_error_s = wall_clock_error_s
        self._sensors = frozenset(sensors)
        self._holders_of = holders_of
        self._rehearse = rehearse
        self._last: ReceivedMessage[M] | None = None
        self._ready_s = math.inf
        self._rehearsal_s = 0.0
        self._counters: Counter[str] = Counter()
        self._sources: dict[str, _Source[M]] = {}
        self._forgot_ns = 0
        # Every message that waits has one turn here. The turn of a dropped one stays for its
        # successor, so that sensors come in order of their oldest message.
        self._turns: deque[_Source[M]] = deque()
        self._lock = threading.Lock()
        self._reading = threading.Lock()
        self._waits = False
        self._ring: Ring | None = None
        self._arrivals: _Ringed | _Queued
        if delivery is Delivery.NEWEST:
            self._depth: float = depth
            kept = _RING if topic.priority <= Priority.REAL_TIME else _RING_LARGE
            self._ring = Ring(session, key, capacity=kept, alarm=alarm)
            self._arrivals = _Ringed(self._ring, self._counters)
        else:
            self._depth = math.inf
            sender_waits = delivery is Delivery.EVERY
            fifo: FifoQueue[Any] = FifoQueue(self._counters, capacity, sender_waits=sender_waits)
            self._arrivals = _Queued(session, key, fifo, self._counters)

    @property
    def counters(self) -> dict[str, int]:
        """Events since it was declared."""
        with self._lock:
            with contextlib.suppress(LinkError):  # closed: nothing more comes
                self._look()
            return dict(self._counters)

    @property
    def waiting(self) -> int:
        """How many messages wait to be taken."""
        with self._lock:
            with contextlib.suppress(LinkError):
                self._look()
            return len(self._turns) + self._arrivals.waiting

    def next(self, timeout_s: float) -> ReceivedMessage[M]:
        """The next valid message that was not delivered yet; invalid ones are counted and skipped.

        Raises:
            StreamTimeout: None came within ``timeout_s``.
            LinkError: The session was closed.
        """
        taken = self.next_batch(timeout_s, most=1)
        if taken:
            return taken[0]
        raise StreamTimeout(
            f"no {self.topic.name} on {self.key} within {timeout_s:g} s",
            remedy="check that its publisher runs: palpate status",
        )

    def next_batch(
        self, timeout_s: float, *, most: int = 64, more_s: float = 0.0
    ) -> list[ReceivedMessage[M]]:
        """The next messages, ``most`` at most; empty = none came within ``timeout_s``.

        All that wait are taken. After the first, others are waited for during ``more_s``.

        Raises:
            LinkError: The session was closed; with ``QUEUE`` and ``EVERY`` after the last message
                that had arrived.
        """
        check_process()  # also before the locks: one that was held at a fork is never released
        taken: list[ReceivedMessage[M]] = []
        try:
            self._take(taken, timeout_s, most, more_s)
        except LinkError:
            if not taken:  # else the next call says it
                raise
        return taken

    def _take(
        self, taken: list[ReceivedMessage[M]], timeout_s: float, most: int, more_s: float
    ) -> None:
        arrival: Arrival | None = None
        with self._one_reads():
            until_s = time.monotonic() + timeout_s
            while True:
                with self._lock:
                    self._waits = False
                    if arrival is not None:
                        self._check(arrival)
                    had_some = bool(taken)
                    self._collect(taken, most)
                    now_s = time.monotonic()
                    if taken and not had_some:
                        until_s = now_s + more_s if more_s else now_s
                    if len(taken) >= most or now_s >= until_s:
                        return
                    self._waits = True
                ready_s = self._ready_s
                if not now_s < ready_s < until_s:
                    arrival = self._arrivals.wait(until_s - now_s)
                    continue
                arrival = self._arrivals.wait(ready_s - now_s)
                if arrival is None:
                    self._get_ready()

    @contextlib.contextmanager
    def _one_reads(self) -> Iterator[None]:
        """One thread at a time."""
        with self._reading:
            try:
                yield
            finally:
                # Also after an exception while it waited, e.g. Ctrl-C: nobody waits any more.
                self._waits = False

    def _get_ready(self) -> None:
        """Rehearse the next message with the last one."""
        self._ready_s = math.inf
        last = self._last
        if last is None:
            return
        began_s = time.monotonic()
        self._decode(last.payload)
        if self._rehearse is not None:
            self._rehearse(last)
        # A longer one counts at once, a shorter one little by little.
        took_s = min(time.monotonic() - began_s, _LEAD_MOST_S)
        self._rehearsal_s = max(took_s, self._rehearsal_s + 0.05 * (took_s - self._rehearsal_s))

    def latest(self, max_age_s: float) -> ReceivedMessage[M]:
        """The newest valid message, if it is not older than ``max_age_s``.

        Nothing is consumed. The age counts from the stamp (when the sensor was read); it is never
        less than the time since this process saw the message. For ``NEWEST`` only: others keep
        their messages until they are taken.

        Raises:
            StaleError: It is older, or none ever came.
            ClockSkewError: It was stamped in the future (a kind of ``StaleError``).
            LinkError: The session was closed.
        """
        if not self._newest_wins:
            raise ValueError("latest() is for subscribers with Delivery.NEWEST")
        check_process()
        with self._lock:
            self._look()
            sources = list(self._sources.values())
            valid = [source.newest for source in sources if source.newest is not None]
        if not valid:
            raise self._nothing(sources)
        newest = max(valid, key=lambda message: message.received_monotonic_ns)
        age_s = self.age_s(newest)
        if age_s > max_age_s:
            raise StaleError(
                f"the newest {self.topic.name} is {age_s:.3f} s old, {max_age_s:g} s is allowed",
                remedy="do not act on it; check the sensor: palpate status",
            )
        return newest

    def age_s(self, received: ReceivedMessage[M]) -> float:
        """Age of a message [s], from its stamp, and at least the time since it was seen here.

        Raises:
            ClockSkewError: It was stamped in the future.
        """
        seen_s = clock.elapsed_s(received.received_monotonic_ns)
        if received.stamp is None:
            return seen_s
        stamp = received.stamp
        return max(seen_s, clock.checked_age_s(stamp, wall_clock_error_s=self._wall_clock_error_s))

    def _nothing(self, sources: list[_Source[M]]) -> StaleError:
        for source in sources:
            if source.problem is not None:
                return StaleError(
                    f"every {self.topic.name} on {self.key} is invalid: {source.problem.problem}",
                    remedy=source.problem.remedy,
                )
        return StaleError(
            f"no {self.topic.name} on {self.key} has arrived yet",
            remedy="check that its publisher runs: palpate status",
        )

    # All below are called with the lock.

    def _look(self) -> None:
        """Check what has arrived in the ring, unless a thread waits there: it checks it at once."""
        if self._ring is None or self._waits:
            return
        before = self._ring.polled
        arrivals: list[Arrival] = []
        while (arrival := self._arrivals.poll()) is not None:
            arrivals.append(arrival)
        if self._ring.polled - before >= self._ring.capacity:
            # A full ring has dropped what came before, nobody knows how much of which source.
            for source in self._sources.values():
                if source.continuity is not None:
                    source.continuity.drops_unknown()
        for arrival in arrivals:
            self._check(arrival)

    def _collect(self, taken: list[ReceivedMessage[M]], most: int) -> None:
        """Take the messages whose turn it is."""
        self._look()
        while len(taken) < most:
            if self._turns:
                source = self._turns.popleft()
                taken.append(source.waiting.popleft())
                self._counters["delivered"] += 1
            elif self._newest_wins:
                return
            elif (arrival := self._arrivals.poll()) is not None:
                self._check(arrival)
            else:
                return

    def _check(self, arrival: Arrival) -> None:
        """Decode a sample, compare it with its source, and let wait what may be delivered."""
        sample, arrived_ns, lost_here = arrival
        key = str(sample.key_expr)
        source = self._sources.get(key)
        if source is None:
            source = self._new_source(key, arrived_ns)
            if source is None:
                return
        source.seen_ns = arrived_ns
        try:
            if (encoding := str(sample.encoding)) != self._encoding:
                check_schema(encoding, self.topic.codec.schema)
            payload = sample.payload.to_bytes()
            began_ns = time.monotonic_ns()
            message = self._decode(payload)
            decode_s = (time.monotonic_ns() - began_ns) * 1e-9
        except WireError as error:
            self._counters[f"rejected_{error.reason}"] += 1
            source.problem = error
            return
        attached = sample.attachment
        attachment = b"" if attached is None else attached.to_bytes()
        stamp = self.topic.stamp_of(message)
        where = source.address
        new = ReceivedMessage(
            message, payload, where.station, where.sensor, arrived_ns, attachment, decode_s, stamp
        )
        if source.continuity is None or stamp is None:
            self._let_wait(source, new)
            return
        serial = getattr(message, "sensor_serial", "")
        for good in source.continuity.take(
            new, stamp, serial=serial, arrived_ns=arrived_ns, lost_here=lost_here
        ):
            self._let_wait(source, good)

    def _let_wait(self, source: _Source[M], message: ReceivedMessage[M]) -> None:
        source.newest = message
        if self._newest_wins:
            last, self._last = self._last, message
            if last is not None:
                sampled_s = _sampled_s(message)
                pause_s = sampled_s - _sampled_s(last)
                if _PAUSE_LEAST_S < pause_s < _PAUSE_MOST_S:
                    lead_s = min(max(_LEAD_S, self._rehearsal_s + _MARGIN_S), _LEAD_MOST_S)
                    self._ready_s = sampled_s + pause_s - lead_s
                else:
                    self._ready_s = math.inf
        if len(source.waiting) >= self._depth:
            source.waiting.popleft()
            self._counters["dropped"] += 1
        else:
            self._turns.append(source)
        source.waiting.append(message)

    def _new_source(self, key: str, now_ns: int) -> _Source[M] | None:
        try:
            address = parse_key(key)
        except WireError as error:
            self._counters[f"rejected_{error.reason}"] += 1
            return None
        sensor, holders_of = address.sensor, self._holders_of
        if self._sensors:
            if sensor not in self._sensors:
                self._counters["of_others"] += 1
                return None
        elif holders_of is not None and not holders_of(sensor):
            self._counters["unannounced"] += 1
            return None
        if len(self._sources) >= MOST_SOURCES:
            self._forget(now_ns)
            if len(self._sources) >= MOST_SOURCES:
                self._counters["rejected_names"] += 1
                return None
        continuity: Continuity[ReceivedMessage[M]] | None = None
        if self.topic.rate_hz:  # each event is worth something by itself, in whatever order
            continuity = Continuity(
                self._counters,
                contiguous=self.topic.contiguous,
                trusting=self._trusting,
                holders=(lambda: None) if holders_of is None else (lambda: holders_of(sensor)),
            )
        source = self._sources[key] = _Source(address, continuity)
        return source

    def _forget(self, now_ns: int) -> None:
        """Forget silent sources, once in a while: a flood of names must not cost a search each."""
        if now_ns - self._forgot_ns < FORGOTTEN_NS // 10:
            return
        self._forgot_ns = now_ns
        self._sources = {
            key: source
            for key, source in self._sources.items()
            if source.waiting or now_ns - source.seen_ns < FORGOTTEN_NS
        }

    def close(self) -> None:
        """Undeclare; a blocked sender is released, and one that waits gets a ``LinkError``."""
        self.closed = True
        self._arrivals.close()
