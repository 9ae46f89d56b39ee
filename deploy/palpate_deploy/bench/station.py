"""The station of a benchmark: its profile at free addresses, and the wait until it is ready."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from palpate.errors import LinkError
from palpate_deploy.station.host import free_endpoint, join, private_profile
from palpate_deploy.station.profile import Profile

SETTLE_S = 0.4
"""Time that new subscriptions, or the last messages of a source, need to travel [s]."""

_READY_S = 20.0


def gateway_station(sensors: Sequence[dict[str, Any]]) -> Profile:
    """The profile ``bench`` with its router alone, at ``link.connect[0]``, and these sensors."""
    profile = private_profile("bench", gateway={"sensors": sensors}, log={"level": "warning"})
    return profile.model_copy(update={"processes": ("router",)})


def free_port() -> int:
    """A free port of this host."""
    return int(free_endpoint().rpartition(":")[2])


def wait_ready(profile: Profile, services: set[str]) -> None:
    """Wait until services are ready."""
    deadline = time.monotonic() + _READY_S
    with join(profile, wait_s=_READY_S) as session:
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
