"""The process ``web``: serves a page with the status and the live view of a station.

The server's threads answer from memory; what is asked of the station does not depend on how many
ask, or how slowly they read.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
import os
import threading
import time
from collections.abc import Iterable, Iterator
from typing import Any

from palpate.bus import Session
from palpate.census import ROUTER
from palpate.config import LinkConfig, endpoint_host_port
from palpate.errors import LinkError, MissingExtraError
from palpate.health import Health, HealthReporter
from palpate.heartbeat import beat
from palpate.messages import ServiceState
from palpate.process import check_installed, require
from palpate_deploy.station.observation import SILENT_S, ObservedProcess, StationObserver
from palpate_deploy.station.profile import WebConfig
from palpate_deploy.station.web.application import WebApplication
from palpate_deploy.station.web.snapshot import as_json, snapshot

_log = logging.getLogger(__name__)

SERVICE = "web"

CONNECTIONS_MOST = 50
"""Further ones wait until one of these is closed."""

IDLE_S = 20
"""A connection on which nothing has gone in or out for so long is closed [s]."""

_THREADS = 4
_HEADER_BYTES_MOST = 16_384
_LOOK_S = 1.0
_TURN_S = 0.05
_POLL_S = 1.0
_NICENESS = 5  # a page may wait, the hand may not


def run_web(
    config: WebConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = SERVICE,
) -> None:
    """Serve the page of a station until ``stop`` is set.

    Raises:
        LinkError: The bus cannot be joined, or the address cannot be used.
        MissingExtraError: waitress is not installed.
    """
    require("waitress", extra="web")
    with contextlib.suppress(OSError):  # a strict unit forbids it
        os.nice(_NICENESS)
    health = Health(SERVICE, instance)
    with Session.open(link, station=station) as session, contextlib.ExitStack() as stack:
        view: Any = None
        files: Any = None
        if config.live and _has_rerun():
            from palpate_services.viewer.viewer_files import ViewerFiles
            from palpate_services.viewer.watched_view import WatchedView

            view = stack.enter_context(WatchedView(session, title=station, bundles=config.bundles))
            files = ViewerFiles()
        version = importlib.metadata.version("rerun-sdk") if view is not None else ""
        application = WebApplication(config.names, health, view, files, version)
        presence = session.presence(SERVICE, instance=instance)
        with (
            _serving(application, config),
            StationObserver(session) as observer,
            HealthReporter(session, health),
        ):
            live = "" if view is not None else ", without the live view"
            health.set_state(ServiceState.READY, f"http://{config.listen}{live}")
            presence.ready()
            looked_s = float("-inf")
            began_s, shown = time.monotonic(), False
            while not stop.wait(_TURN_S):
                beat()
                if view is not None:
                    for name, count in view.turn().items():
                        health.count(name, count)
                if time.monotonic() - looked_s >= _LOOK_S:
                    looked_s = time.monotonic()
                    observed = observer.look()
                    shown = shown or _all_told(observed) or looked_s - began_s > SILENT_S
                    if not shown:
                        continue  # who has not told yet would be shown as one that is silent
                    plain = snapshot(
                        station, observed, router=session.has_router(), own=(SERVICE, instance)
                    )
                    plain["live"] = view is not None
                    application.set_status(as_json(plain))
            presence.not_ready()
            health.set_state(ServiceState.STOPPING)


def _all_told(observed: Iterable[ObservedProcess]) -> bool:
    """Whether the status of every process that lives has come; the router has none."""
    return all(
        one.report.status is not None
        for one in observed
        if one.report.alive and (one.report.service, one.report.instance) != ROUTER
    )


def _has_rerun() -> bool:
    try:
        check_installed("rerun", extra="services")
        check_installed("rerun_cli", extra="services")
    except MissingExtraError as error:
        _log.warning("there is no live view: %s; %s", error.problem, error.remedy)
        return False
    return True


@contextlib.contextmanager
def _serving(application: WebApplication, config: WebConfig) -> Iterator[None]:
    """Serve in a thread while the block runs."""
    from waitress.channel import HTTPChannel
    from waitress.server import TcpWSGIServer, create_server

    class OneAnswer(HTTPChannel):  # type: ignore[misc]
        """A connection that is closed after one answer.

        A thread would wait for the reader of earlier answers before it made another one, as long as
        that reader liked: four of them held up everybody.
        """

        active_s: float
        """When something last went in or out, monotonic clock [s]."""

        @property
        def last_activity(self) -> float:
            """The same for waitress, by the wall clock as it is set now."""
            return time.time() - (time.monotonic() - self.active_s)

        @last_activity.setter
        def last_activity(self, _: float) -> None:
            self.active_s = time.monotonic()

        def service(self) -> None:
            self.requests[0].headers["CONNECTION"] = "close"
            super().service()

    # Its remarks on queues of requests are about threads of ours, not about the station.
    logging.getLogger("waitress.queue").setLevel(logging.ERROR)
    host, port = endpoint_host_port(f"tcp/{config.listen}")
    channels: dict[int, Any] = {}
    try:
        server = create_server(
            application,
            map=channels,
            host=host,
            port=port,
            threads=_THREADS,
            connection_limit=CONNECTIONS_MOST,
            max_request_header_size=_HEADER_BYTES_MOST,
            max_request_body_size=_HEADER_BYTES_MOST,
            clear_untrusted_proxy_headers=True,
            ident=None,
        )
    except (OSError, ValueError) as error:
        raise LinkError(
            f"the page cannot be served at {config.listen}: "
            f"{getattr(error, 'strerror', None) or error}",
            remedy="choose an address of this host and a free port: [web] listen in the profile",
        ) from error
    # A name, e.g. localhost, may have several addresses.
    servers = [one for one in channels.values() if isinstance(one, TcpWSGIServer)]
    for one in servers:
        one.channel_class = OneAnswer
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            server.asyncore.loop(timeout=_POLL_S, map=channels, use_poll=True, count=1)
            # waitress would wait until the socket takes more, which one that is not read never does
            for idle in [
                one
                for one in channels.values()
                if isinstance(one, OneAnswer) and time.monotonic() - one.active_s > IDLE_S
            ]:
                idle.handle_close()
        server.task_dispatcher.shutdown()

    thread = threading.Thread(target=serve, name="web", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        servers[0].pull_trigger()  # any wakes the loop, which is that of all
        thread.join(timeout=5.0)
        server.asyncore.close_all(channels)
