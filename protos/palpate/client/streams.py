"""Streams of a client: messages as an iterator, or given to a callback in a thread of palpate's.

Both go on by themselves when the router, the gateway or the service was gone and is back; what
was published meanwhile is lost, and old messages are never delivered as new ones.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Generic, Self, TypeVar

from palpate import clock
from palpate.bus import Cancellation, ReceivedMessage, Subscriber
from palpate.config import check_duration
from palpate.errors import (
    ConfigError,
    LinkError,
    PalpateError,
    SensorChanged,
    StaleError,
    StreamTimeout,
    printable,
)
from palpate.process import Closing

M = TypeVar("M")
T = TypeVar("T")

OnError = Callable[[PalpateError], None]

_log = logging.getLogger(__name__)

TURN_S = 0.25
"""How long is waited before it is looked whether a stream was closed, a call cancelled [s]."""

_SAY_AGAIN_S = 10.0
"""How often a failing callback is logged [s]; each failure is counted."""

_END_S = 5.0


def check_depth(depth: int) -> None:
    """Check how many messages of a stream are kept for a slow consumer.

    Raises:
        ConfigError: None.
    """
    if depth < 1:
        raise ConfigError(f"depth = {depth} keeps nothing", remedy="give 1 or more")


def is_cancelled() -> bool:
    """Whether the caller of what runs in this thread has left."""
    current = Cancellation.current()
    return current is not None and current.cancelled.is_set()


class SameSensor:
    """Notices when messages under one name come from another sensor than before.

    Args:
        key: Theirs, for errors.
    """

    def __init__(self, key: str) -> None:
        self._key = key
        self._serial = ""

    def check(self, message: object) -> None:
        """Look whose message this is; another sensor's from now on is what is expected.

        Raises:
            SensorChanged: It is another's than the last one's.
        """
        serial: str = getattr(message, "sensor_serial", "")
        if not serial or serial == self._serial:
            return
        before, self._serial = self._serial, serial
        if before:
            raise SensorChanged(
                f"{self._key} is of sensor {printable(serial)} now, before it was of "
                f"{printable(before)}",
                remedy="if it was exchanged, go on: this is told once; else look who else has its "
                "name: palpate fleet",
            )


class Stream(Closing, Generic[M]):
    """Messages of one sensor, the newest first to come: ``for estimate in stream``.

    Ends when it or its client is closed, and belongs to one thread; ``close`` may be called from
    any. A consumer that is slower than the sensor skips messages (``dropped``), and so are those
    older than ``max_age_s`` skipped (``stale``). After ``timeout_s`` without a usable one it
    raises, and when messages begin to come from another sensor; asked again, it goes on.

    Args:
        subscriber: Belongs to this stream from now on.
        max_age_s: Age of the oldest reading that is delivered [s]; inf = any.
        timeout_s: Longest silence [s]; None = it waits for ever.
        wall_clock_error_s: How far another host's wall clock may be from this one's [s].
        client: Whose stream it is; it stays open while the stream is in use.

    Raises:
        ConfigError: A time is not positive.
    """

    def __init__(
        self,
        subscriber: Subscriber[M],
        *,
        max_age_s: float,
        timeout_s: float | None,
        wall_clock_error_s: float = clock.WALL_CLOCK_ERROR_S,
        client: object = None,
    ) -> None:
        self._client = client
        self._max_age_s = check_duration(max_age_s, "max_age_s", most=math.inf)
        self.timeout_s = (
            math.inf if timeout_s is None else check_duration(timeout_s, "timeout_s", most=math.inf)
        )
        self._wall_clock_error_s = wall_clock_error_s
        self._subscriber = subscriber
        self._closed = threading.Event()
        self._same = SameSensor(subscriber.key)
        self._stale = 0
        self._watch: Watch[M] | None = None
        self.newest: ReceivedMessage[M] | None = None
        """What was returned last; belongs to the thread that asks for the next."""

    @property
    def counters(self) -> dict[str, int]:
        """Those of the subscriber, and ``stale``."""
        return {"dropped": 0, **self._subscriber.counters, "stale": self._stale}

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> M:
        """The next message.

        Raises:
            StreamTimeout: None came within ``timeout_s``.
            StaleError: Some came, all of them too old, or stamped in the future.
            SensorChanged: It is the first of another sensor in the place of the one before.
            LinkError: The client is closed.
        """
        end_s = time.monotonic() + self.timeout_s
        stale: StaleError | None = None
        while not self._closed.is_set():
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                raise stale or self._silence()
            try:
                received = self._subscriber.next(min(left_s, TURN_S))
                self.check_age(received)
                self._same.check(received.message)
            except StreamTimeout:
                continue
            except StaleError as error:
                self._stale += 1
                stale = error
            except LinkError:
                if self._closed.is_set():
                    break
                raise
            else:
                self.newest = received
                return received.message
        raise StopIteration

    def check_age(self, received: ReceivedMessage[M]) -> None:
        """Check that a message may be used now.

        Raises:
            StaleError: It is older than ``max_age_s``, or stamped in the future.
        """
        stamp = self._subscriber.topic.stamp_of(received.message)
        age_s = clock.elapsed_s(received.received_monotonic_ns)
        if stamp is not None:
            stamped_s = clock.checked_age_s(stamp, wall_clock_error_s=self._wall_clock_error_s)
            age_s = max(age_s, stamped_s)
        if age_s > self._max_age_s:
            name, key = self._subscriber.topic.name, self._subscriber.key
            raise StaleError(
                f"every {name} on {key} within {self.timeout_s:g} s was too old, the last one "
                f"{age_s:.3f} s where {self._max_age_s:g} s is allowed",
                remedy="do not act on them; check the sensor and its service: palpate status",
            )

    def _silence(self) -> StreamTimeout:
        return StreamTimeout(
            f"no {self._subscriber.topic.name} on {self._subscriber.key} within "
            f"{self.timeout_s:g} s",
            remedy="check that its publisher runs: palpate status; the stream goes on when it does",
        )

    def call(self, callback: Callable[[M], None], *, on_error: OnError | None = None) -> Watch[M]:
        """Call a function with each message, in a thread of palpate's; see ``Watch``."""
        self._watch = Watch(self, callback, on_error)
        return self._watch

    @property
    def closed(self) -> bool:
        """Whether it has ended."""
        return self._closed.is_set()

    def close(self) -> None:
        """End the iteration."""
        if not self._closed.is_set():
            self._closed.set()
            self._subscriber.close()

    def wait_for_calls(self) -> None:
        """After ``close``: wait until no callback runs any more."""
        if self._watch is not None:
            self._watch.close()


class Watch(Closing, Generic[M]):
    """Calls ``callback`` with each message of a stream, in a thread of its own.

    An exception of the callback, ``SystemExit`` too, is logged and counted, and the stream goes on.
    ``on_end`` is called once, in the same thread, after the last message. ``on_error`` is called
    in the same thread when the stream was silent or stale for its ``timeout_s``, and again for each
    further one, and when another sensor is in its place; then, too, it goes on.

    ``counters``: those of the stream, ``called``, ``silences`` and ``callback_errors``.
    """

    def __init__(
        self,
        stream: Stream[M],
        callback: Callable[[M], None],
        on_error: OnError | None = None,
        on_end: Callable[[], None] | None = None,
    ) -> None:
        self._stream = stream
        self._callback = callback
        self._on_error = on_error
        self._on_end = on_end
        self._counts: Counter[str] = Counter({"called": 0, "silences": 0, "callback_errors": 0})
        self._said_s = -math.inf
        self._thread = threading.Thread(target=self._run, name="palpate callback", daemon=True)
        self._thread.start()

    @property
    def counters(self) -> dict[str, int]:
        """Events since it was made."""
        return {**self._stream.counters, **self._counts}

    def _run(self) -> None:
        self._call_each()
        if self._on_end is not None:
            self._on_end()

    def _call_each(self) -> None:
        while True:
            try:
                message = next(self._stream)
            except StopIteration:
                return
            except (StreamTimeout, StaleError) as error:
                self._counts["silences"] += 1
                if self._on_error is not None:
                    self._call(self._on_error, error)
            except SensorChanged as error:
                _log.warning("%s", error)
                if self._on_error is not None:
                    self._call(self._on_error, error)
            except PalpateError as error:  # the client is closed
                if self._on_error is not None:
                    self._call(self._on_error, error)
                return
            else:
                self._counts["called"] += 1
                self._call(self._callback, message)

    def _call(self, function: Callable[[T], None], argument: T) -> None:
        try:
            function(argument)
        except BaseException:
            # The user's code: nothing of it may end the stream, and nothing of it may vanish.
            self._counts["callback_errors"] += 1
            now_s = time.monotonic()
            if now_s - self._said_s >= _SAY_AGAIN_S:
                self._said_s = now_s
                _log.exception(
                    "callback %r failed, %d times so far", function, self._counts["callback_errors"]
                )

    def close(self) -> None:
        """Call no more; waits for a call that is running, except when it is the caller."""
        self._stream.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(_END_S)
