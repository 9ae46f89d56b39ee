"""A census of a station: every process that lives or should live, with what it says of itself."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

from palpate.bus import Session, endpoints
from palpate.errors import LinkError, PalpateError
from palpate.messages import ServiceRequest, Status

ProcessName = tuple[str, str]
"""Names of service and instance."""

ROUTER: ProcessName = ("router", "router")
"""The router: it has no token and no status, and lives if this process is connected to it."""

SUPERVISOR: ProcessName = ("supervisor", "supervisor")
"""The process that keeps the others running and says which should run: ``palpate up``."""

PATIENCE_S = 5.0
"""How long a census waits for a process that does not answer [s]; without one it takes 20 ms."""

_ROUND_S = 1.0
_PAUSE_S = 0.05


@dataclass(frozen=True, slots=True)
class ProcessReport:
    """One process of a station.

    Attributes:
        service: What it serves, e.g. ``gateway``.
        instance: Its name among several of its kind.
        alive: Whether it shows that it is alive.
        ready: Whether it shows that it is ready to serve.
        status: What it answers when asked; None = it does not answer.
    """

    service: str
    instance: str
    alive: bool
    ready: bool
    status: Status | None


def take_census(
    session: Session, *, expected: Iterable[ProcessName] = (), timeout_s: float = PATIENCE_S
) -> list[ProcessReport]:
    """Every process of a station, in order of its name.

    These are all that show that they are alive, all that are ``expected``, and all that the
    station's supervisor says should run. Each is asked for its status, again and again until it
    has answered or ``timeout_s`` is over: a process under load may be late, and one that has just
    started may not be reachable yet.

    Raises:
        LinkError: There is no router, or it is gone or hangs and nothing is known.
    """
    observer = session.observer()
    wanted = set(expected)
    answers: dict[ProcessName, Status] = {}
    deadline = time.monotonic() + timeout_s
    while True:
        present = {(one.service, one.instance): one.ready for one in session.alive()}
        connected = observer.has_router()
        left_s = deadline - time.monotonic()
        for status in _ask(observer, min(_ROUND_S, max(left_s, _PAUSE_S))):
            answers[status.service, status.instance] = status
            wanted.update((one.service, one.instance) for one in status.processes)
        names = wanted | present.keys() | answers.keys()
        silent = (names - answers.keys() | names - present.keys()) - {ROUTER}
        lost = ROUTER in wanted and not connected
        if not (silent or lost) or time.monotonic() + _PAUSE_S > deadline:
            break
        time.sleep(_PAUSE_S)
    if not (connected or names):
        raise LinkError(
            "the router is gone or hangs, so nothing is known of the station",
            remedy="see that `palpate up` runs; this session joins again by itself",
        )
    if connected and ROUTER in wanted:
        present[ROUTER] = True
    return [
        ProcessReport(*name, name in present, present.get(name, False), answers.get(name))
        for name in sorted(names)
    ]


def _ask(observer: Session, timeout_s: float) -> list[Status]:
    replies = observer.query_all(endpoints.STATUS, ServiceRequest(), timeout_s=timeout_s)
    return [reply for reply in replies if not isinstance(reply, PalpateError)]
