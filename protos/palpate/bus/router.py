"""The router: it introduces the processes of a station to one another, and joins it to a site.

A site is a router that those of several stations connect up to. Streams cross only while somebody
on the other side subscribes to them. At a site the name of a station belongs to one router: it
claims the name, and a second one of that name does not connect until the first is gone.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import zenoh

from palpate.bus.access import DOOR_PROTOCOL, DOOR_ROOT, ROLE_OF
from palpate.bus.claims import SensorClaims
from palpate.bus.link import Session
from palpate.bus.topics import STATION_ROOT
from palpate.bus.zenoh_session import close_zenoh, open_zenoh, zenoh_config
from palpate.config import LinkConfig
from palpate.errors import ClaimedElsewhere, ConfigError, LinkError
from palpate.heartbeat import FILE_VARIABLE, beat
from palpate.process import Closing

_log = logging.getLogger(__name__)

_PERIOD_S = 0.5
_ANSWER_S = 1.0
_SITE_S = 2.0
"""How long a starting router waits for the site, to learn whether its name is free [s]."""


@dataclass(slots=True)
class SiteLink:
    """How a station's router connects up to a site, and what came of it.

    Attributes:
        connect: Endpoints of the site's router.
        station: Name of the station, which is claimed there.
        connected: Whether it is connected at present.
        refusal: Why it does not connect: another station has this name; None = it may.
    """

    connect: tuple[str, ...]
    station: str
    connected: bool = False
    refusal: ClaimedElsewhere | None = None


def run_router(
    listen: Sequence[str],
    stop: threading.Event,
    *,
    link: LinkConfig | None = None,
    site: SiteLink | None = None,
) -> None:
    """Run the router at endpoints, e.g. ``("tcp/127.0.0.1:7447",)``, until ``stop`` is set.

    Lease and certificates are those of ``link``; None = defaults. With ``site`` it connects up,
    unless another station has its name there. To begin or to end that, it is opened again: the
    links of its station are back within two seconds.

    Raises:
        LinkError: A port is in use.
    """
    base = link or LinkConfig()
    config = LinkConfig(connect=(), listen=tuple(listen), lease_s=base.lease_s, tls=base.tls)
    with ExitStack() as stack:
        guard = None if site is None else stack.enter_context(_NameGuard(site, config))
        if guard is not None:
            guard.wait(stop)
        while not stop.is_set():
            _run_once(config, stop, guard)


def _run_once(config: LinkConfig, stop: threading.Event, guard: _NameGuard | None) -> None:
    """Run until ``stop`` is set, or until whether to connect up changes."""
    connects = guard is not None and guard.may_connect()
    if guard is not None and connects:
        config = config.model_copy(update={"connect": guard.site.connect})
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
                    if guard is not None:
                        guard.site.connected = bool(raw.info.routers_zid())
                        if guard.may_connect() != connects:
                            return
        finally:
            close_zenoh(raw)


class _NameGuard(Closing):
    """Claims the name of a station at a site, as a client of the site's router."""

    def __init__(self, site: SiteLink, config: LinkConfig) -> None:
        self.site = site
        update = {"connect": site.connect, "listen": (), "direct": False}
        self._link = config.model_copy(update={**update, "wait_for_router_s": _ANSWER_S})
        self._claims: SensorClaims | None = None
        self._closed = threading.Event()
        # A client cannot open without its router, which may be away for long.
        self._thread = threading.Thread(target=self._run, name="name at the site", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                session = Session.open(self._link, station=self.site.station)
            except (LinkError, ConfigError):  # also while its certificates are renewed
                self._closed.wait(_PERIOD_S)
                continue
            with session:
                claims = session.claims(
                    instance=_ROUTER, lease_s=self._link.lease_s, root=STATION_ROOT
                )
                claims.want(_ROUTER)
                self._claims = claims
                self._closed.wait()

    def wait(self, stop: threading.Event) -> None:
        """Wait until it is known whether the name is free, or the site does not answer."""
        for _ in range(round(_SITE_S / _LOOK_S)):
            held = self._claims is not None and self._claims.holds(_ROUTER)
            if held or not self.may_connect() or stop.wait(_LOOK_S):
                return

    def may_connect(self) -> bool:
        """Whether no other station of this name is known; writes into the log when that changes."""
        if self._claims is None:
            return True
        self._claims.holds(_ROUTER)
        refusal = self._claims.refusal(_ROUTER)
        if refusal is not None and self.site.refusal is None:
            _log.error("%s", refusal)
        elif refusal is None and self.site.refusal is not None:
            _log.warning("the name %s is free again: connecting to the site", self.site.station)
        self.site.refusal = refusal
        return refusal is None

    def close(self) -> None:
        """Withdraw the claim."""
        self._closed.set()
        self._thread.join(_CLOSE_S)


_ROUTER = "router"
_LOOK_S = 0.05
_CLOSE_S = 5.0


class _GuestLog(Closing):
    """Writes into the log who comes and goes, by which certificate; without ``roles`` nothing.

    The id is that of ``refusals``.
    """

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
                "%s joins with the certificate %r, which has no role: all that it sends is refused "
                "(id %s)",
                link.dst,
                name,
                link.zid,
            )
        else:
            words = "joins" if came else "leaves"
            _log.info("%s %s: %s (id %s)", link.dst, words, role or name, link.zid)

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
        close_zenoh(self._session)
        self._queryable.undeclare()
