"""Ports of the router: free or taken, before anything is started."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterable

from palpate.config import endpoint_host_port
from palpate.errors import LinkError


def check_free(endpoints: Iterable[str]) -> None:
    """Check that a router can listen there.

    Raises:
        LinkError: A port is in use, or the address is not this host's.
    """
    for endpoint in endpoints:
        host, port = endpoint_host_port(endpoint)
        if port == 0:
            continue
        try:
            _bind(host, port)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                other = port + 1 if port < 65535 else 7447
                raise LinkError(
                    f"{host}:{port} is in use",
                    remedy="another `palpate up`? Look with `palpate status --connect "
                    f"{endpoint}`, or choose another port: [router] listen in the profile, or "
                    f"PALPATE_ROUTER__LISTEN='[\"tcp/{host}:{other}\"]'",
                ) from error
            raise LinkError(
                f"the router cannot listen at {endpoint}: {error.strerror or error}",
                remedy="set [router] listen to an address of this host",
            ) from error


def free_endpoint() -> str:
    """A loopback endpoint that nothing listens at now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _bind(host: str, port: int) -> None:
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    with socket.socket(family, kind, protocol) as probe:
        # As the router does: a port whose last connection just closed is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(address)
        probe.listen(1)
