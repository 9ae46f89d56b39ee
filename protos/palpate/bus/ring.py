"""Samples of a subscription in Zenoh's own ring: no thread between the link and the consumer.

A callback of Zenoh costs a second change of threads, and every change costs a wake-up of a core and
a turn at the interpreter lock. Only, a ring has no wait with a time limit. So an alarm ends the
waits: at the deadline it puts an empty sample into the ring, by a publication that does not leave
this session.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import Protocol

import zenoh

from palpate.bus.zenoh_session import Declared, is_inherited
from palpate.errors import LinkError
from palpate.process import Closing

_WAKE = "palpate/wake"

_LOOK_S = 0.05
"""After it woke somebody, the alarm looks for new deadlines within this time [s]."""

_IN_USE_S = 1.0
"""How long ``undeclare`` waits for other threads [s]."""


def is_wake(sample: zenoh.Sample) -> bool:
    """Whether a sample only ends a wait; every subscriber of the session gets it."""
    return len(sample.payload) == 0 and str(sample.encoding) == _WAKE


class _Declared(Protocol):
    """What is declared on a session of Zenoh."""

    def undeclare(self) -> None:
        """Take it back."""


def undeclare(declared: _Declared) -> None:
    """Undeclare what other threads may be using, or undeclaring, at this moment.

    A Zenoh object refuses to be undeclared while another thread is in one of its calls. One that
    stays in it (a lossless sender whose receiver hangs) is left to the end of the session. Nothing
    happens to one that is undeclared already, and in a forked process.
    """
    if is_inherited():
        return
    give_up_s = time.monotonic() + _IN_USE_S
    with contextlib.suppress(zenoh.ZError):  # undeclared before, or the session is closed
        while True:
            try:
                declared.undeclare()
                return
            except RuntimeError:  # "Already borrowed"
                if time.monotonic() >= give_up_s:
                    return
                time.sleep(0.001)


def subscription_closed(key: str) -> LinkError:
    """What a subscriber says to those who take messages after it was closed."""
    return LinkError(f"the subscription to {key} is closed", remedy="open the session again")


class _Sleeper(Protocol):
    """What an alarm wakes, until it is closed."""

    closed: bool

    def wake(self) -> None:
        """End the wait."""


class Alarm(Declared):
    """Wakes those who wait, each at its deadline: one thread for a session. Thread-safe."""

    def __init__(self) -> None:
        self._deadlines: dict[_Sleeper, float] = {}
        self._next_s = math.inf
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def set(self, sleeper: _Sleeper, deadline_s: float) -> None:
        """Wake a sleeper at an instant [s, monotonic]; inf = not any more."""
        # Usually the thread sleeps until an earlier instant already, and nothing is locked.
        self._deadlines[sleeper] = deadline_s
        if sleeper.closed:  # perhaps after it was forgotten, by a wait that ended
            self.forget(sleeper)
        elif deadline_s < self._next_s:
            with self._changed:
                if self._thread is None and not self.closed:
                    self._thread = threading.Thread(target=self._run, name="alarm", daemon=True)
                    self._thread.start()
                self._changed.notify()

    def forget(self, sleeper: _Sleeper) -> None:
        """A sleeper is closed."""
        self._deadlines.pop(sleeper, None)

    def _run(self) -> None:
        with self._changed:
            while not self.closed:
                now_s, look_s = time.monotonic(), math.inf
                for sleeper, deadline_s in list(self._deadlines.items()):
                    if deadline_s <= now_s:
                        self.set(sleeper, math.inf)
                        sleeper.wake()
                        # It soon sets its next alarm, and need not wake this thread for that.
                        look_s = now_s + _LOOK_S
                self._next_s = min(self._earliest(), look_s)
                # One that was set meanwhile saw the old instant and did not notify.
                if self._earliest() < self._next_s:
                    continue
                timeout_s = self._next_s - time.monotonic()
                self._changed.wait(None if timeout_s == math.inf else max(0.0, timeout_s))
                self._next_s = -math.inf

    def _earliest(self) -> float:
        return min(list(self._deadlines.values()), default=math.inf)

    def close(self) -> None:
        """End the thread; nobody is woken any more."""
        with self._changed:
            self.closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(timeout=2)


class Ring(Closing):
    """The newest samples of a key, ``capacity`` at most; older ones are dropped uncounted.

    Only one thread may wait at a time.
    """

    def __init__(self, session: zenoh.Session, key: str, *, capacity: int, alarm: Alarm) -> None:
        self.capacity = capacity
        self._session = session
        self._key = key
        self.closed = False
        self.polled = 0
        """How many samples ``poll`` has taken, those that end waits included."""
        self._wake_key = key.replace("*", "wake")
        self._alarm = alarm
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(capacity))
        self._samples: zenoh.handlers.Handler[zenoh.Sample] = self._subscriber.handler

    def poll(self) -> zenoh.Sample | None:
        """The oldest sample in the ring; None = there is none.

        Raises:
            LinkError: The session or the subscriber was closed.
        """
        try:
            while (sample := self._samples.try_recv()) is not None:
                self.polled += 1
                if not is_wake(sample):
                    return sample
        except zenoh.ZError as error:
            raise subscription_closed(self._key) from error
        return None

    def wait(self, timeout_s: float) -> zenoh.Sample | None:
        """The next sample; None = none within ``timeout_s``.

        Raises:
            LinkError: The session or the subscriber was closed.
        """
        deadline_s = time.monotonic() + timeout_s
        self._alarm.set(self, deadline_s)
        try:
            while is_wake(sample := self._samples.recv()):
                if time.monotonic() >= deadline_s:
                    return None
                self._alarm.set(self, deadline_s)
            return sample
        except zenoh.ZError as error:
            raise subscription_closed(self._key) from error
        finally:
            self._alarm.set(self, math.inf)

    def wake(self) -> None:
        """End a wait."""
        try:
            self._session.put(
                self._wake_key,
                b"",
                encoding=zenoh.Encoding(_WAKE),
                allowed_destination=zenoh.Locality.SESSION_LOCAL,
            )
        except zenoh.ZError:  # the session is closed, and the wait has ended
            pass

    def close(self) -> None:
        """Undeclare; one that waits gets a ``LinkError``."""
        self.closed = True
        self._alarm.forget(self)
        undeclare(self._subscriber)
