"""A page of a device's own web server."""

from __future__ import annotations

import http.client
import time
import urllib.request
from typing import Final

from palpate.errors import DeviceError

_AT_ONCE: Final = 65536
_REMEDY: Final = (
    "open this address in a browser: check address, cable and that the device has power"
)


def read_page(url: str, *, timeout_s: float, most_bytes: int) -> bytes:
    """What the page holds.

    Args:
        url: Its address.
        timeout_s: How long its head may keep silent, and how long all of it may take [s].
        most_bytes: A longer page is refused.

    Raises:
        DeviceError: There is no such page, or it is too long, or takes too long.
    """
    until = time.monotonic() + timeout_s
    # A proxy of this host's user knows no sensor in the laboratory.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    page = bytearray()
    try:
        with opener.open(url, timeout=timeout_s) as reply:
            # Piece by piece: the socket's timeout starts anew with every byte that trickles in.
            while piece := reply.read1(_AT_ONCE):
                page += piece
                if len(page) > most_bytes:
                    raise DeviceError(
                        f"{url}: more than {most_bytes} bytes",
                        remedy="this is no sensor's page; check the address",
                    )
                if time.monotonic() > until:
                    raise DeviceError(f"{url}: not read within {timeout_s:g} s", remedy=_REMEDY)
    except DeviceError:
        raise
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise DeviceError(f"{url}: {error}", remedy=_REMEDY) from error
    return bytes(page)
