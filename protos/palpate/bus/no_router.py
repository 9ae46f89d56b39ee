"""Why there is no link to a router: nothing listens, it is none, or a certificate is refused."""

from __future__ import annotations

import contextlib
import socket
import ssl

from palpate.config import LinkConfig, TlsConfig, endpoint_host_port
from palpate.errors import LinkError


class RouterRefuses(LinkError):
    """A router listens there, and one of the two certificates is not accepted."""


class RouterAbsent(LinkError):
    """Nothing listens where a router is looked for."""


_PROBE_S = 1.0
"""How long is looked for what listens where no link came about [s]."""


def no_router(link: LinkConfig) -> LinkError:
    """The error that says why there is no link to a router where ``link`` looks for it."""
    for endpoint in link.connect:
        if (found := _why_no_link(link, endpoint)) is not None:
            return found
    return RouterAbsent(
        f"no router at {', '.join(link.connect)}",
        remedy="start one with `palpate up`, or name yours with --connect",
    )


def _why_no_link(link: LinkConfig, endpoint: str) -> LinkError | None:
    """What listens at an endpoint and does not link; None = nothing does."""
    protocol, _, place = endpoint.partition("/")
    host, port = endpoint_host_port(endpoint)
    try:
        with socket.create_connection((host, port), timeout=_PROBE_S) as plain:
            if protocol == "tls" and link.tls is not None:
                _shake_hands(link.tls, plain, host)
    except ssl.SSLCertVerificationError as error:
        return RouterRefuses(
            f"the certificate of {endpoint} does not hold here: {error.verify_message}",
            remedy="take both certificates from one authority: palpate certs show FOLDER",
        )
    except ssl.SSLError as error:
        if "ALERT" in (error.reason or ""):
            why = str(error.reason).partition("ALERT_")[2].replace("_", " ").lower()
            return RouterRefuses(
                f"{endpoint} refuses the certificate {link.tls and link.tls.certificate}: {why}",
                remedy="see when it ends and whose it is: palpate certs show FOLDER; issue "
                "another by the authority of that router: palpate certs issue",
            )
        return LinkError(
            f"what listens at {endpoint} does not speak TLS",
            remedy=f"without certificates connect to tcp/{place}",
        )
    except (OSError, UnicodeError):  # UnicodeError: no host can have such a name
        return None
    hint = f"connect to tls/{place} if it wants certificates; " if protocol == "tcp" else ""
    return LinkError(
        f"something listens at {endpoint}, but no link comes about: it hangs, or is no router of "
        "this kind",
        remedy=f"{hint}look at it with `palpate status`, or name your router with --connect",
    )


def _shake_hands(tls: TlsConfig, plain: socket.socket, host: str) -> None:
    """Show the certificate as a link does; raises what either side has against it."""
    context = ssl.create_default_context(cafile=str(tls.root_ca_certificate))
    context.load_cert_chain(tls.certificate, tls.private_key)
    with context.wrap_socket(plain, server_hostname=host) as shown:
        # In TLS 1.3 a refusal comes only after the handshake; else the router waits for us.
        with contextlib.suppress(TimeoutError):
            shown.recv(1)
