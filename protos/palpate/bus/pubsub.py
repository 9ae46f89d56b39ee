"""Publishing and subscribing: typed messages of one topic, or undecoded ones of many (a tap).

A slow consumer behind a plain queue works through ever older frames. So an estimator subscribes
with ``NEWEST``, a recorder with ``QUEUE``, and an offline replay with ``EVERY``.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, TypeVar

import zenoh

from palpate import clock
from palpate.bus.timings import timings_of
from palpate.bus.topics import StreamAddress, Topic, check_schema, check_size, parse_key
from palpate.errors import LinkError, StaleError, StreamTimeout, WireError
from palpate.messages import Origin, StageTimings
from palpate.process import Closing

T = TypeVar("T")


class Delivery(Enum):
    """What happens to messages that arrive faster than they are consumed.

    ``NEWEST``: per key only the newest few (one by default) wait; older ones are counted as
    ``dropped``.
    ``QUEUE``: first in, first out; beyond the capacity the newcomer is counted as ``overflow``.
    ``EVERY``: first in, first out; beyond the capacity the *sender* waits. Offline replay only.
    """

    NEWEST = "newest"
    QUEUE = "queue"
    EVERY = "every"


class NewestQueue(Generic[T]):
    """Keeps the newest items of each key; serves keys in the order of their oldest waiting item.

    ``depth`` items may wait per key. With more than one, a consumer that was delayed for a moment
    catches up without loss; it has to check the age of items itself.
    """

    def __init__(self, counters: Counter[str], depth: int) -> None:
        self._waiting: dict[str, deque[T]] = {}
        self._lost: Counter[str] = Counter()
        self._order: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._counters = counters
        self._depth = depth

    def put(self, key: str, item: T) -> None:
        """Add an item and drop the oldest of its key if too many wait; never blocks."""
        with self._lock:
            items = self._waiting.setdefault(key, deque())
            # Every waiting item has one turn in `_order`. The turn of a dropped item stays for its
            # successor, so `get` never finds a key without an item.
            full = len(items) == self._depth
            if full:
                items.popleft()
                self._lost[key] += 1
                self._counters["dropped"] += 1
            items.append(item)
        if not full:
            self._order.put(key)

    def get(self, timeout_s: float) -> tuple[T, int] | None:
        """Next item, and how many of its key were dropped so far; None = none in time."""
        try:
            key = self._order.get(timeout=timeout_s)
        except queue.Empty:
            return None
        with self._lock:
            return self._waiting[key].popleft(), self._lost[key]

    def close(self) -> None:
        """Does nothing: this queue never blocks a sender."""


class FifoQueue(Generic[T]):
    """First in, first out, bounded; a full queue counts the newcomer or makes the sender wait."""

    def __init__(self, counters: Counter[str], capacity: int, *, sender_waits: bool) -> None:
        self._items: deque[tuple[T, int]] = deque()
        self._lost: Counter[str] = Counter()
        self._capacity = capacity
        self._sender_waits = sender_waits
        self._changed = threading.Condition()
        self._closed = False
        self._counters = counters

    def put(self, key: str, item: T) -> None:
        """Add an item; blocks while the queue is full only if the sender shall wait."""
        with self._changed:
            while self._sender_waits and len(self._items) >= self._capacity and not self._closed:
                self._changed.wait(0.5)
            if len(self._items) >= self._capacity:
                self._lost[key] += 1
                self._counters["overflow"] += 1
                return
            self._items.append((item, self._lost[key]))
            self._changed.notify_all()

    def get(self, timeout_s: float) -> tuple[T, int] | None:
        """Next item, and how many of its key were dropped before it; None = none in time."""
        with self._changed:
            if not self._changed.wait_for(lambda: bool(self._items), timeout_s):
                return None
            item = self._items.popleft()
            if self._sender_waits:
                self._changed.notify_all()
            return item

    def close(self) -> None:
        """Release a sender that waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


DeliveryQueue = NewestQueue[T] | FifoQueue[T]


def queue_for(
    delivery: Delivery, capacity: int, counters: Counter[str], *, depth: int = 1
) -> DeliveryQueue[T]:
    """The queue for a kind of delivery; ``depth`` is for ``NEWEST``."""
    if delivery is Delivery.NEWEST:
        return NewestQueue(counters, depth)
    return FifoQueue(counters, capacity, sender_waits=delivery is Delivery.EVERY)


M = TypeVar("M")


class Publisher(Generic[M], Closing):
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
        check_size(payload, self.topic.codec.schema, remedy="publish a smaller message")
        try:
            self._publisher.put(payload, attachment=attachment)
        except zenoh.ZError as error:
            raise LinkError(
                f"cannot publish on {self.key}: {error}", remedy="open the session again"
            ) from error

    def matched(self) -> bool:
        """Whether anyone subscribes at present."""
        status: Any = self._publisher.matching_status  # stub says bool, 1.10 gives a status object
        return bool(getattr(status, "matching", status))

    def close(self) -> None:
        """Undeclare."""
        self._publisher.undeclare()


@dataclass(frozen=True, slots=True)
class ReceivedMessage(Generic[M]):
    """A valid message, where it came from and when.

    Attributes:
        payload: Its bytes as they arrived.
        station: Station that published it.
        sensor: Sensor, or ``service/instance`` for a service's topic.
        received_monotonic_ns: Arrival in this process, host monotonic clock [ns].
        attachment: What travelled beside the payload; of an estimate, its timings.
        decode_s: How long its decoding took [s].
    """

    message: M
    payload: bytes
    station: str
    sensor: str
    received_monotonic_ns: int
    attachment: bytes = b""
    decode_s: float = 0.0

    @property
    def timings(self) -> StageTimings | None:
        """Where the time of an estimate went; None = its service does not say."""
        return timings_of(self.attachment)


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

    @property
    def schema(self) -> str:
        """Full name of the message, from the encoding."""
        return self.encoding.partition(";")[2]


class Subscriber(Generic[M], Closing):
    """Receives one topic. Made by ``Session.subscriber``; use it from one thread.

    ``counters``: ``received``, ``delivered``, ``dropped`` (newest wins), ``overflow``,
    ``lost_on_bus`` (gaps in the sequence that were not dropped here), ``reordered``, ``restarts``
    of the sender, and ``rejected_<reason>``.
    """

    def __init__(
        self,
        session: zenoh.Session,
        topic: Topic[M],
        key: str,
        *,
        delivery: Delivery,
        capacity: int,
        depth: int = 1,
        wall_clock_error_s: float = clock.WALL_CLOCK_ERROR_S,
    ) -> None:
        self.topic = topic
        self.key = key
        self._wall_clock_error_s = wall_clock_error_s
        self._counters: Counter[str] = Counter()
        self._waiting: DeliveryQueue[tuple[zenoh.Sample, int]] = queue_for(
            delivery, capacity, self._counters, depth=depth
        )
        self._newest: dict[str, tuple[zenoh.Sample, int]] = {}
        self._addresses: dict[str, StreamAddress] = {}
        # Of the last delivered message of each source: sequence, monotonic time, and how many of
        # its key this process's queue had dropped before it.
        self._last: dict[str, tuple[int, int, int]] = {}
        self._subscriber = session.declare_subscriber(key, self._on_sample)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        # Zenoh's thread: enqueue and nothing else; an exception here would vanish.
        now_ns = time.monotonic_ns()
        key = str(sample.key_expr)
        item = (sample, now_ns)
        self._counters["received"] += 1
        self._newest[key] = item
        self._waiting.put(key, item)

    @property
    def counters(self) -> dict[str, int]:
        """Events since it was declared."""
        return dict(self._counters)

    def next(self, timeout_s: float) -> ReceivedMessage[M]:
        """The next valid message that was not delivered yet; invalid ones are counted and skipped.

        Raises:
            StreamTimeout: None came within ``timeout_s``.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            item = self._waiting.get(max(0.0, deadline - time.monotonic()))
            if item is None:
                raise StreamTimeout(
                    f"no {self.topic.name} on {self.key} within {timeout_s:g} s",
                    remedy="check that its publisher runs: palpate status",
                )
            try:
                received = self._decode(*item[0])
            except WireError as error:
                self._counters[f"rejected_{error.reason}"] += 1
                continue
            if self._in_order(received, item[1]):
                self._counters["delivered"] += 1
                return received

    def latest(self, max_age_s: float, *, sensor: str | None = None) -> ReceivedMessage[M]:
        """The newest message (of a sensor), if it is not older than ``max_age_s``.

        Nothing is consumed. The age counts from the stamp (when the sensor was read); it is never
        less than the time since arrival.

        Raises:
            StaleError: It is older, invalid, or none ever came.
            ClockSkewError: It was stamped in the future (a kind of ``StaleError``).
        """
        candidates = [
            item
            for key, item in list(self._newest.items())
            if sensor is None or self._address(key).sensor == sensor
        ]
        if not candidates:
            raise StaleError(
                f"no {self.topic.name} on {self.key} has arrived yet",
                remedy="check that its publisher runs: palpate status",
            )
        sample, received_ns = max(candidates, key=lambda item: item[1])
        try:
            received = self._decode(sample, received_ns)
        except WireError as error:
            raise StaleError(
                f"the newest {self.topic.name} is invalid: {error.problem}", remedy=error.remedy
            ) from error
        stamp = self.topic.stamp_of(received.message)
        age_s = (time.monotonic_ns() - received_ns) * 1e-9
        if stamp is not None:
            stamped_s = clock.checked_age_s(stamp, wall_clock_error_s=self._wall_clock_error_s)
            age_s = max(age_s, stamped_s)
        if age_s > max_age_s:
            raise StaleError(
                f"the newest {self.topic.name} is {age_s:.3f} s old, {max_age_s:g} s is allowed",
                remedy="do not act on it; check the sensor: palpate status",
            )
        return received

    def _address(self, key: str) -> StreamAddress:
        address = self._addresses.get(key)
        if address is None:
            address = self._addresses[key] = parse_key(key)
        return address

    def _decode(self, sample: zenoh.Sample, received_ns: int) -> ReceivedMessage[M]:
        check_schema(str(sample.encoding), self.topic.codec.schema)
        address = self._address(str(sample.key_expr))
        payload = sample.payload.to_bytes()
        began_ns = time.monotonic_ns()
        message = self.topic.codec.decode(payload)
        decode_s = (time.monotonic_ns() - began_ns) * 1e-9
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        return ReceivedMessage(
            message, payload, address.station, address.sensor, received_ns, attachment, decode_s
        )

    def _in_order(self, received: ReceivedMessage[M], lost_here: int) -> bool:
        """Count gaps, restarts and duplicates in the sequence; False = do not deliver."""
        stamp = self.topic.stamp_of(received.message)
        if stamp is None:
            return True
        source = f"{received.station}/{received.sensor}"
        last = self._last.get(source)
        if last is not None:
            sequence, monotonic_ns, lost_here_before = last
            step = stamp.sequence - sequence
            if step <= 0:
                # A restarted gateway counts from 1 again, with a later clock. A replayed record
                # starts over with its old clock. A message that was only overtaken is neither: it
                # is a little older than the last by both measures.
                restarted = (
                    stamp.monotonic_ns > monotonic_ns
                    or stamp.origin is Origin.REPLAYED
                    or step < -1000
                )
                if not restarted or (step == 0 and stamp.monotonic_ns == monotonic_ns):
                    self._counters["reordered"] += 1
                    return False
                self._counters["restarts"] += 1
            elif self.topic.contiguous and step > 1:
                # A hole in the sequence is what the bus lost and what this process's own queue
                # dropped since the last delivered message; the queue has counted its part.
                lost = step - 1 - (lost_here - lost_here_before)
                if lost > 0:
                    self._counters["lost_on_bus"] += lost
        self._last[source] = (stamp.sequence, stamp.monotonic_ns, lost_here)
        return True

    def close(self) -> None:
        """Undeclare; a blocked sender is released."""
        self._waiting.close()
        self._subscriber.undeclare()


class Tap(Closing):
    """Receives undecoded samples of several topics in order of arrival. Made by ``Session.tap``."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Sequence[str],
        *,
        delivery: Delivery,
        capacity: int,
    ) -> None:
        self._counters: Counter[str] = Counter()
        self._waiting: DeliveryQueue[tuple[zenoh.Sample, int, int]] = queue_for(
            delivery, capacity, self._counters
        )
        # By default each subscriber calls back from a thread of its own, and a frame may overtake
        # the tare that was sent before it. Called from the link's thread, arrival is the order.
        in_order = zenoh.handlers.Callback(self._on_sample, indirect=False)
        self._subscribers = [session.declare_subscriber(key, in_order) for key in keys]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        monotonic_ns, wall_ns = clock.now()
        self._counters["received"] += 1
        self._waiting.put(str(sample.key_expr), (sample, monotonic_ns, wall_ns))

    @property
    def counters(self) -> dict[str, int]:
        """``received``, ``dropped``, ``overflow``, ``rejected_key``."""
        return dict(self._counters)

    def next(self, timeout_s: float) -> TapSample:
        """The next sample.

        Raises:
            StreamTimeout: None came within ``timeout_s``.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            item = self._waiting.get(max(0.0, deadline - time.monotonic()))
            if item is None:
                raise StreamTimeout(
                    f"no message within {timeout_s:g} s", remedy="check what runs: palpate status"
                )
            sample, monotonic_ns, wall_ns = item[0]
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
            )

    def close(self) -> None:
        """Undeclare; a blocked sender is released."""
        self._waiting.close()
        for subscriber in self._subscribers:
            subscriber.undeclare()
