"""Sessions of Zenoh: their settings, and why one does not open."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import ssl
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import zenoh

from palpate.bus import access
from palpate.bus.no_router import no_router
from palpate.bus.topics import (
    MAX_MESSAGE_BYTES,
)
from palpate.config import LinkConfig, TlsConfig
from palpate.errors import ConfigError, LinkError
from palpate.process import Closing

_log = logging.getLogger(__name__)

INDIRECT_WAIT_S = 60.0
"""Without direct links opening blocks until the router answers; it gives up after this time [s]."""

LOSSLESS_STALL_S = 60.0
"""How long a lossless (replay) publisher may be blocked before its link is closed."""


def zenoh_config(link: LinkConfig, mode: str) -> zenoh.Config:
    """Settings of a session of ``mode`` ``"peer"``, ``"client"`` or ``"router"``.

    Raises:
        ConfigError: A router is to be reached without certificates, although roles are asked for,
            or one of them cannot be read.
    """
    _check_certificates(link)
    client = mode == "client"
    wait_s = INDIRECT_WAIT_S if link.wait_for_router_s < 0 else link.wait_for_router_s
    settings: dict[str, Any] = {
        "mode": mode,
        # A peer retries in the background without end; Session.open waits and names what is
        # missing. A client cannot open without its router.
        "connect": {
            "endpoints": list(link.connect),
            "timeout_ms": round(wait_s * 1000) if client else -1,
            "exit_on_failure": client,
            "retry": {
                "period_init_ms": 200,
                "period_max_ms": 1000,
                "period_increase_factor": 1.5,
            },
        },
        "listen": {
            "endpoints": [] if client else list(link.listen),
            "timeout_ms": 0,
            "exit_on_failure": True,
        },
        # The router introduces peers to one another; their data then flows on direct links.
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {
                "enabled": True,
                "autoconnect": {"router": [], "peer": ["router", "peer"]},
            },
        },
        # Do not wait for peers that may not exist; Session.open waits for the router itself.
        "open": {"return_conditions": {"connect_scouted": False, "declares": True}},
        "timestamping": {"enabled": False},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "tx": {
                    "lease": round(link.lease_s * 1000),
                    "keep_alive": 4,
                    "queue": {
                        # Express messages take a batch each: with the default of two, twenty
                        # sensors that publish in the same millisecond lose frames.
                        "size": {"real_time": 16, "data_high": 16},
                        "congestion_control": {
                            "drop": {"wait_before_drop": 2000},
                            "block": {"wait_before_close": round(LOSSLESS_STALL_S * 1e6)},
                        },
                    },
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }
    if link.tls is not None:
        settings["transport"]["link"]["tls"] = {
            "root_ca_certificate": str(link.tls.root_ca_certificate),
            "enable_mtls": True,
            "listen_certificate": str(link.tls.certificate),
            "listen_private_key": str(link.tls.private_key),
            "connect_certificate": str(link.tls.certificate),
            "connect_private_key": str(link.tls.private_key),
            # A certificate that has expired ends the links that it opened, too.
            "close_link_on_expiration": True,
        }
        if link.tls.roles:
            # Somebody with a certificate may announce a listener without: nobody connects there.
            settings["transport"]["link"]["protocols"] = ["tls", access.DOOR_PROTOCOL]
            settings |= access.settings()
    return zenoh.Config.from_json5(json.dumps(settings))


def _check_certificates(link: LinkConfig) -> None:
    if link.certificates is not None:
        raise ConfigError(
            f"{link.certificates} holds certificates by role, and this process has no role",
            remedy="name the folder of one role: --tls FOLDER/operator",
        )
    plain = [end for end in link.connect if not end.startswith("tls/")]
    if link.has_roles and plain:
        raise ConfigError(
            f"{plain[0]} shows no certificate, so that nothing it says would be believed",
            remedy=f"connect to tls/{plain[0].partition('/')[2]}, or set tls.roles = false",
        )
    if link.tls is not None:
        _read_certificates(link.tls)


def _read_certificates(tls: TlsConfig) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    readings: dict[Path, Callable[[], None]] = {
        tls.root_ca_certificate: lambda: context.load_verify_locations(tls.root_ca_certificate),
        tls.certificate: lambda: context.load_verify_locations(tls.certificate),
        # Without a password, OpenSSL would ask for one at the terminal.
        tls.private_key: lambda: context.load_cert_chain(
            tls.certificate, tls.private_key, password=lambda: b"-"
        ),
    }
    for path, read in readings.items():
        what = "private key" if path == tls.private_key else "certificate"
        try:
            read()
        except ssl.SSLError as error:  # also of a key that is of another certificate
            why = (error.reason or "no such thing in it").replace("_", " ").lower()
        except OSError as error:
            why = error.strerror or str(error)
        else:
            continue
        raise ConfigError(
            f"{path} cannot be used as {what}: {why}",
            remedy="name a folder as palpate certs issue makes it: palpate certs show FOLDER",
        )


_opened = False
_inherited = False


def _note_fork() -> None:
    global _inherited
    _inherited = _opened


os.register_at_fork(after_in_child=_note_fork)


def is_inherited() -> bool:
    """Whether this process was forked from one that had opened a session.

    Zenoh's threads do not exist here: a session, that one or a new one, would wait for ever.
    """
    return _inherited


def check_process() -> None:
    """Refuse to use Zenoh in a process where it would wait for ever; see ``is_inherited``.

    Raises:
        LinkError: A session was opened before a fork.
    """
    if _inherited:
        raise LinkError(
            "a session was opened before a fork, and none works in the forked process",
            remedy='start processes with multiprocessing.get_context("spawn"), or open the client '
            "in the child only",
        )


_PLACE = re.compile(r" at /\S+\.rs:\d+\.?")


def said(error: Exception) -> str:
    """What Zenoh says of an error, without the places in its source."""
    return _PLACE.sub("", str(error))


class Declared(Closing):
    """What a session has declared: closed with it, and forgotten by it if it was closed before."""

    closed = False
    """Whether it was closed."""


@contextlib.contextmanager
def while_open() -> Iterator[None]:
    """A block, or as a decorator a function, that uses a session which others may close.

    Raises:
        LinkError: It is closed, or was opened before a fork.
    """
    check_process()
    try:
        yield
    except zenoh.ZError as error:
        raise LinkError(
            f"the session is closed, or Zenoh refuses: {said(error)}",
            remedy="open the session again",
        ) from error


_IN_USE = re.compile(r"Address already in use|EADDRINUSE|os error 98|os error 48")


def open_zenoh(link: LinkConfig, mode: str, *, also_listen: Sequence[str] = ()) -> zenoh.Session:
    """Open a Zenoh session and translate why it does not open.

    ``also_listen`` are endpoints of any protocol of Zenoh that are not offered to others.

    Raises:
        LinkError: A port is in use, a client finds no router, or another session was opened before
            a fork.
        ConfigError: Its certificates cannot be used.
    """
    global _opened
    check_process()
    _opened = True  # also if it does not open: threads of Zenoh run from now on
    config = zenoh_config(link, mode)
    if also_listen:
        config.insert_json5("listen/endpoints", json.dumps([*link.listen, *also_listen]))
    try:
        return zenoh.open(config)
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
            f"cannot join the bus: {said(error)}", remedy="check the [link] table of the profile"
        ) from error


def close_zenoh(session: zenoh.Session) -> None:
    """Close a Zenoh session; where its router hangs, it is given up, with a warning.

    In a forked process nothing happens: the session is its parent's.
    """
    if is_inherited():
        return
    try:
        session.close()
    except zenoh.ZError:
        _log.warning("left the bus without its answer: its router hangs")
