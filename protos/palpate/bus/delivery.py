"""Where messages wait for a consumer that is slower than their source.

A slow consumer behind a plain queue works through ever older frames. So an estimator subscribes
with ``NEWEST``, a recorder with ``QUEUE``, and an offline replay with ``EVERY``.
"""

from __future__ import annotations

import queue
import threading
from collections import Counter, deque
from enum import Enum
from typing import Generic, TypeVar

T = TypeVar("T")

MOST_KEYS = 1024
"""Of so many keys at most is known how many messages were dropped."""


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
            items = self._waiting.get(key)
            if items is None:
                if len(self._waiting) >= MOST_KEYS:
                    self._forget()
                items = self._waiting[key] = deque()
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

    def _forget(self) -> None:
        """Forget keys of which nothing waits: somebody may invent ever new ones."""
        self._waiting = {key: items for key, items in self._waiting.items() if items}
        self._lost = Counter({key: self._lost[key] for key in self._waiting})

    def __len__(self) -> int:
        """How many items wait."""
        with self._lock:
            return sum(map(len, self._waiting.values()))

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
        self.closed = False
        self._counters = counters

    def put(self, key: str, item: T) -> None:
        """Add an item; blocks while the queue is full only if the sender shall wait."""
        with self._changed:
            while self._sender_waits and len(self._items) >= self._capacity and not self.closed:
                self._changed.wait(0.5)
            if len(self._items) >= self._capacity:
                if key in self._lost or len(self._lost) < MOST_KEYS:
                    self._lost[key] += 1
                self._counters["overflow"] += 1
                return
            self._items.append((item, self._lost[key]))
            self._changed.notify_all()

    def get(self, timeout_s: float) -> tuple[T, int] | None:
        """Next item, and how many of its key were dropped before it.

        None = none in time, or it is closed; what waited then can still be taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._items or self.closed, timeout_s)
            if not self._items:
                return None
            item = self._items.popleft()
            if self._sender_waits:
                self._changed.notify_all()
            return item

    def __len__(self) -> int:
        """How many items wait."""
        return len(self._items)

    def close(self) -> None:
        """Release a sender and a consumer that wait."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


DeliveryQueue = NewestQueue[T] | FifoQueue[T]


def queue_for(delivery: Delivery, capacity: int, counters: Counter[str]) -> DeliveryQueue[T]:
    """The queue for a kind of delivery; with ``NEWEST`` one item of a key waits."""
    if delivery is Delivery.NEWEST:
        return NewestQueue(counters, depth=1)
    return FifoQueue(counters, capacity, sender_waits=delivery is Delivery.EVERY)
