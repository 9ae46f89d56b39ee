"""The station of a benchmark: its profile at free addresses, and the wait until it is ready."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from palpate.bus import Session
from palpate.config import LinkConfig
from palpate.errors import LinkError
from palpate_deploy.station.host import free_endpoint
from palpate_deploy.station.profile import Profile, changed, load_profile

SETTLE_S = 0.4
"""Time that new subscriptions, or the last messages of a source, need to travel [s]."""

_READY_S = 20.0


def gateway_station(sensors: Sequence[dict[str, Any]]) -> Profile:
    """The profile ``bench`` with its router alone, at ``link.connect[0]``, and these sensors."""
    endpoint = free_endpoint()
    return changed(
        load_profile("bench").model_copy(update={"processes": ("router",)}),
        router={"listen": (endpoint,)},
        link={"connect": (endpoint,)},
        gateway={"sensors": sensors},
        log={"level": "warning"},
    )


def free_port() -> int:
    """A free port of this host."""
    return int(free_endpoint().rpartition(":")[2])


def wait_ready(profile: Profile, services: set[str]) -> None:
    """Wait until services are ready.

    Raises:
        LinkError: They are not in time.
    """
    link = LinkConfig(connect=profile.link.connect, wait_for_router_s=_READY_S)
    deadline = time.monotonic() + _READY_S
    with Session.open(link, station=profile.station) as session:
        while True:
            missing = services - {one.service for one in session.alive() if one.ready}
            if not missing:
                break
            if time.monotonic() > deadline:
                raise LinkError(
                    f"{', '.join(sorted(missing))} not ready within {_READY_S:g} s",
                    remedy="see the logs of the benchmark in the run's folder",
                )
            time.sleep(0.05)
    time.sleep(SETTLE_S)  # subscriptions travel after presence
