"""A lab's certificates, and a router that asks for them, for tests of several rooms."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

from palpate.bus import run_router
from palpate.config import LinkConfig, Role
from palpate_deploy.station.certificates import issue, make_authority


def make_certificates(folder: Path) -> Path:
    """An authority in a new folder, with a certificate for each role; returns the folder."""
    make_authority(folder)
    for role in Role:
        issue(folder, role)
    return folder


@contextlib.contextmanager
def router_of(link: LinkConfig, *, patience_s: float) -> Iterator[None]:
    """A router at the endpoint that a link connects to, while the block runs."""
    stop = threading.Event()
    router = threading.Thread(
        target=run_router,
        args=(link.connect, stop),
        kwargs={"link": link.as_role(Role.ROUTER)},
        daemon=True,
    )
    router.start()
    try:
        yield
    finally:
        stop.set()
        router.join(patience_s)
