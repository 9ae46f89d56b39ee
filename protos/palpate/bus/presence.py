"""Presence: which processes are alive, and which are ready, by liveliness tokens."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import zenoh

from palpate.bus.topics import live_key
from palpate.bus.zenoh_session import Declared
from palpate.config import is_name
from palpate.process import Closing

_LOOK_S = 1.0
_GONE_KNOWN = 1024


@dataclass(frozen=True, slots=True)
class AliveService:
    """A process that is alive, and whether it is ready to serve."""

    station: str
    service: str
    instance: str
    ready: bool


class Presence(Declared):
    """Declares that this process is alive and, after ``ready``, that it serves.

    Other processes see both end within milliseconds when this process dies, and within the lease
    of the link when its host freezes.
    """

    def __init__(self, session: zenoh.Session, station: str, service: str, instance: str) -> None:
        self._liveliness = session.liveliness()
        self._ready_key = live_key(station, service, instance, "ready")
        self._alive = self._liveliness.declare_token(live_key(station, service, instance, "alive"))
        self._ready: zenoh.LivelinessToken | None = None

    def ready(self) -> None:
        """Declare that this process serves."""
        if self._ready is None:
            self._ready = self._liveliness.declare_token(self._ready_key)

    def not_ready(self) -> None:
        """Withdraw ``ready``; the first step of stopping."""
        if self._ready is not None:
            self._ready.undeclare()
            self._ready = None

    def close(self) -> None:
        """Withdraw both."""
        self.closed = True
        self.not_ready()
        self._alive.undeclare()


def alive(
    views: Iterable[zenoh.Session], station: str, *, timeout_s: float = 1.0
) -> list[AliveService]:
    """All processes that are alive at a station (``"*"`` = any), by what any of the views knows.

    Tokens with names that no process of palpate can have are passed over.
    """
    found: dict[tuple[str, str, str], bool] = {}
    key = live_key(station, "*", "*", "*")
    for view in views:
        for reply in view.liveliness().get(key, timeout=timeout_s):
            if reply.ok is None:
                continue
            *_, where, service, instance, what = str(reply.ok.key_expr).split("/")
            # Two tokens of a process come in any order, and "alive" comes alone until it serves.
            name = (where, service, instance)
            if not all(map(is_name, name)):
                continue
            found[name] = found.get(name, False) or what == "ready"
    return [AliveService(*name, ready) for name, ready in sorted(found.items())]


_STATIONS_MOST = 16
"""So many other stations are told of; names come from other processes, and may be invented."""


def other_stations(found: Iterable[AliveService], station: str) -> list[str]:
    """The stations of the processes that were ``found``; none if some are of ``station``."""
    names = {one.station for one in found}
    return [] if station in names else sorted(names)[:_STATIONS_MOST]


class CallerToken(Closing):
    """A caller's token: while it exists, the caller waits for an answer."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._token = session.liveliness().declare_token(key)

    def close(self) -> None:
        """Withdraw the token."""
        with contextlib.suppress(zenoh.ZError):  # the session is gone, and the token with it
            self._token.undeclare()


class CallerWatch(Declared):
    """Calls ``on_gone``, in a thread of its own, for every token that has vanished.

    It gets the token's key and when it vanished [s, monotonic]. A caller that asks again with the
    same request id declares its token again: an answer that was begun after the token vanished
    belongs to the new call. ``key`` names the tokens, with a ``"*"``.
    """

    def __init__(
        self, session: zenoh.Session, key: str, on_gone: Callable[[str, float], None]
    ) -> None:
        self._session = session
        self._on_gone = on_gone
        self._vanished: queue.SimpleQueue[tuple[str, float] | None] = queue.SimpleQueue()
        self._worker = threading.Thread(target=self._run, name=f"callers {key}", daemon=True)
        self._worker.start()
        self._subscriber = session.liveliness().declare_subscriber(
            key, self._on_sample, history=True
        )

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._vanished.put((str(sample.key_expr), time.monotonic()))

    def _run(self) -> None:
        while (vanished := self._vanished.get()) is not None:
            key, when_s = vanished
            try:
                # The end of a token may be reported after the request of the next call, whose
                # token was declared before that request and is found here.
                found = self._session.liveliness().get(key, timeout=_LOOK_S)
                if not any(reply.ok is not None for reply in found):
                    self._on_gone(key, when_s)
            except zenoh.ZError:  # the session is closing
                return

    def close(self) -> None:
        """Stop watching."""
        self.closed = True
        self._subscriber.undeclare()
        self._vanished.put(None)
        self._worker.join(timeout=2)


class GoneCallers:
    """Callers that have left: a question may wait while its caller does. Safe in all threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._gone_s: OrderedDict[str, float] = OrderedDict()

    def add(self, key: str, when_s: float) -> None:
        """Remember what ``CallerWatch`` tells; of very many the first ones are forgotten."""
        with self._lock:
            self._gone_s[key] = when_s
            if len(self._gone_s) > _GONE_KNOWN:
                self._gone_s.popitem(last=False)

    def since(self, key: str) -> float | None:
        """When the token of this key vanished [s, monotonic]; None = not that anybody knows."""
        with self._lock:
            return self._gone_s.get(key)
