"""The router: it introduces the processes of a station to one another."""

from __future__ import annotations

import json
import logging
import os
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import zenoh

from palpate.bus.access import DOOR_PROTOCOL, DOOR_ROOT, ROLE_OF, log_refusals
from palpate.bus.link import open_zenoh, zenoh_config
from palpate.config import LinkConfig
from palpate.heartbeat import FILE_VARIABLE, beat
from palpate.process import Closing

_log = logging.getLogger(__name__)

_PERIOD_S = 0.5
_ANSWER_S = 1.0


def run_router(
    listen: Sequence[str], stop: threading.Event, *, link: LinkConfig | None = None
) -> None:
    """Run the router at endpoints, e.g. ``("tcp/127.0.0.1:7447",)``, until ``stop`` is set.

    Lease and certificates are those of ``link``; None = defaults.

    Raises:
        LinkError: A port is in use.
    """
    base = link or LinkConfig()
    config = LinkConfig(connect=(), listen=tuple(listen), lease_s=base.lease_s, tls=base.tls)
    if config.has_roles:
        log_refusals()
    # Beside its heartbeat, where its supervisor clears up after a router that is killed.
    beside = os.path.dirname(os.environ.get(FILE_VARIABLE, "")) or None
    with tempfile.TemporaryDirectory(prefix="palpate-router-", dir=beside) as folder:
        door = f"{DOOR_PROTOCOL}/{Path(folder) / 'door'}"
        raw = open_zenoh(config, "router", also_listen=(door,))
        try:
            with _Visitor(raw, door) as visitor, _GuestLog(raw, roles=config.has_roles):
                while not stop.wait(_PERIOD_S):
                    if visitor.is_answered():
                        beat()
        finally:
            raw.close()


class _GuestLog(Closing):
    """Writes into the log who comes and goes, by which certificate; without ``roles`` nothing."""

    def __init__(self, router: zenoh.Session, *, roles: bool) -> None:
        self._listener = None
        if roles:
            self._listener = router.info.declare_link_events_listener(self._on_event, history=True)

    def _on_event(self, event: zenoh.LinkEvent) -> None:
        link, name = event.link, event.link.auth_identifier
        if str(link.dst).startswith(DOOR_PROTOCOL) or str(link.src).startswith(DOOR_PROTOCOL):
            return
        came = event.kind == zenoh.SampleKind.PUT
        role = ROLE_OF.get(name or "")
        if role is None and came:
            _log.warning(
                "%s joins with the certificate %r, which has no role: all that it sends is refused",
                link.dst,
                name,
            )
        else:
            _log.info("%s %s: %s", link.dst, "joins" if came else "leaves", role or name)

    def close(self) -> None:
        """Stop writing."""
        if self._listener is not None:
            self._listener.undeclare()


class _Visitor(Closing):
    """A client of the router, in its own process, that asks it through a link as any other does.

    The router works in threads of Zenoh: that it is waited for here proves nothing. The link is a
    Unix socket that only this user can reach: whatever certificates the station's links need.
    """

    def __init__(self, router: zenoh.Session, door: str) -> None:
        self._key = f"{DOOR_ROOT}/{router.zid()}"
        self._queryable = router.declare_queryable(
            self._key, zenoh.handlers.Callback(self._reply, indirect=False)
        )
        settings = zenoh_config(LinkConfig(connect=(), wait_for_router_s=_ANSWER_S), "client")
        settings.insert_json5("connect/endpoints", json.dumps([door]))
        self._session = zenoh.open(settings)

    def _reply(self, query: zenoh.Query) -> None:
        query.reply(self._key, b"")

    def is_answered(self) -> bool:
        """Whether the router passes on a question, and its answer."""
        replies = self._session.get(self._key, timeout=_ANSWER_S)
        return any(reply.ok is not None for reply in replies)

    def close(self) -> None:
        """Leave."""
        self._session.close()
        self._queryable.undeclare()
