"""Opening a Zenoh session, and being the router."""

from __future__ import annotations

import re
import threading
from collections.abc import Sequence

import zenoh

from palpate.bus.settings import zenoh_config
from palpate.config import LinkConfig
from palpate.errors import LinkError

_IN_USE = re.compile(r"Address already in use|EADDRINUSE|os error 98|os error 48")


def no_router(link: LinkConfig) -> LinkError:
    """The error that says that there is no router where ``link`` looks for it."""
    return LinkError(
        f"no router at {', '.join(link.connect)}",
        remedy="start one with `palpate up`, or name yours with --connect",
    )


def open_zenoh(link: LinkConfig, mode: str) -> zenoh.Session:
    """Open a Zenoh session and translate why it does not open.

    Raises:
        LinkError: A port is in use, or a client finds no router.
    """
    try:
        return zenoh.open(zenoh_config(link, mode))
    except zenoh.ZError as error:
        if _IN_USE.search(str(error)):
            raise LinkError(
                f"port in use: {', '.join(link.listen)}",
                remedy=(
                    "another palpate runs there (palpate status); stop it or choose another "
                    "port for the listener"
                ),
            ) from error
        if mode == "client":
            raise no_router(link) from error
        raise LinkError(
            f"cannot join the bus: {error}", remedy="check the [link] table of the profile"
        ) from error


def run_router(
    listen: Sequence[str], stop: threading.Event, *, link: LinkConfig | None = None
) -> None:
    """Be the router until ``stop`` is set.

    Args:
        listen: Endpoints, e.g. ``("tcp/127.0.0.1:7447",)``.
        stop: Set it to end.
        link: Lease and certificates; None = defaults.

    Raises:
        LinkError: A port is in use.
    """
    base = link or LinkConfig()
    config = LinkConfig(connect=(), listen=tuple(listen), lease_s=base.lease_s, tls=base.tls)
    raw = open_zenoh(config, "router")
    try:
        stop.wait()
    finally:
        raw.close()
