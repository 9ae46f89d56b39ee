"""Presence: who is alive, and who is ready, by liveliness tokens."""

from __future__ import annotations

from dataclasses import dataclass

import zenoh

from palpate.protos.closing import Closing
from palpate.protos.topics import live_key


@dataclass(frozen=True, slots=True)
class Alive:
    """A process that is there, and whether it is ready to serve."""

    station: str
    service: str
    instance: str
    ready: bool


class Presence(Closing):
    """Declares that this process is alive, and when it says so, ready.

    Both vanish for others within milliseconds when the process dies, and within the link's lease
    when its host freezes.
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
        """Withdraw it; done first when a process stops."""
        if self._ready is not None:
            self._ready.undeclare()
            self._ready = None

    def close(self) -> None:
        """Withdraw both."""
        self.not_ready()
        self._alive.undeclare()


def alive(session: zenoh.Session, station: str, *, timeout_s: float = 1.0) -> list[Alive]:
    """Everyone who is alive at a station (``"*"`` = any)."""
    found: dict[tuple[str, str, str], bool] = {}
    key = live_key(station, "*", "*", "*")
    for reply in session.liveliness().get(key, timeout=timeout_s):
        if reply.ok is None:
            continue
        *_, where, service, instance, what = str(reply.ok.key_expr).split("/")
        name = (where, service, instance)
        found[name] = found.get(name, False) or what == "ready"
    return [Alive(*name, ready) for name, ready in sorted(found.items())]
