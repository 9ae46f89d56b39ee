"""What stands between Zenoh's callback and the consumer: three promises, three queues.

A slow consumer behind a plain queue works through ever older frames; so an estimator takes
``NEWEST``, a recorder ``QUEUE``, and an offline replay ``EVERY``.
"""

from __future__ import annotations

import queue
import threading
from collections import Counter, deque
from enum import Enum
from typing import Generic, Protocol, TypeVar

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


class Waiting(Protocol[T]):
    """A queue between the bus and one consumer."""

    def put(self, key: str, item: T) -> None:
        """Called by the bus; never raises, and blocks only for ``EVERY``."""

    def get(self, timeout_s: float) -> tuple[T, int] | None:
        """Next item and how many of its key were lost here so far; None = none came in time."""

    def close(self) -> None:
        """Release a blocked sender."""


class NewestWins(Generic[T]):
    """Per key only the newest items wait; keys are served in the order in which they waited.

    Args:
        counters: Where dropped items are counted.
        depth: Items that may wait per key. More than one lets a consumer that was held up for a
            moment catch up without loss; how old an item may be is the consumer's to check.
    """

    def __init__(self, counters: Counter[str], depth: int) -> None:
        self._waiting: dict[str, deque[T]] = {}
        self._lost: Counter[str] = Counter()
        self._order: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._counters = counters
        self._depth = depth

    def put(self, key: str, item: T) -> None:
        """See ``Waiting.put``."""
        with self._lock:
            items = self._waiting.get(key)
            if items is None:
                items = self._waiting[key] = deque()
            full = len(items) == self._depth
            if full:
                items.popleft()
                self._lost[key] += 1
                self._counters["dropped"] += 1
            items.append(item)
        if not full:  # else the turn of the dropped item is this one's
            self._order.put(key)

    def get(self, timeout_s: float) -> tuple[T, int] | None:
        """See ``Waiting.get``."""
        try:
            key = self._order.get(timeout=timeout_s)
        except queue.Empty:
            return None
        with self._lock:
            return self._waiting[key].popleft(), self._lost[key]

    def close(self) -> None:
        """Nothing to release."""


class Fifo(Generic[T]):
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
        """See ``Waiting.put``."""
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
        """See ``Waiting.get``."""
        with self._changed:
            if not self._items:
                self._changed.wait_for(lambda: bool(self._items), timeout_s)
            if not self._items:
                return None
            item = self._items.popleft()
            if self._sender_waits:
                self._changed.notify_all()
            return item

    def close(self) -> None:
        """See ``Waiting.close``."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


def waiting_for(
    delivery: Delivery, capacity: int, counters: Counter[str], *, depth: int = 1
) -> Waiting[T]:
    """The queue that keeps ``delivery``'s promise; ``depth`` is for ``NEWEST``."""
    if delivery is Delivery.NEWEST:
        return NewestWins(counters, depth)
    return Fifo(counters, capacity, sender_waits=delivery is Delivery.EVERY)
