"""``palpate probe``: what a cluster asks of one process, answered by exit statuses."""

from __future__ import annotations

import os
import time
from pathlib import Path

from palpate.bus import Session
from palpate.errors import ConfigError, LinkError
from palpate.heartbeat import FILE_VARIABLE, read_pulse
from palpate_deploy.station.processes import role_of, service_named
from palpate_deploy.station.profile import Profile

_WAIT_S = 3.0


def why_not_live() -> str:
    """Why the process whose heartbeat is in ``$_PALPATE_HEARTBEAT`` does not live; empty = it does.

    Raises:
        ConfigError: The variable is not set.
    """
    name = os.environ.get(FILE_VARIABLE)
    if not name:
        raise ConfigError(
            f"{FILE_VARIABLE} is not set, so that there is no heartbeat to look at",
            remedy="set it to the same file for the process and for this command, as "
            "palpate install --kubernetes does",
        )
    pulse = read_pulse(Path(name))
    if pulse is None:
        return "it has not beaten yet"
    silent_s = (time.monotonic_ns() - pulse.beaten_ns) * 1e-9
    allowed_s = pulse.allowed_ns * 1e-9
    if silent_s > allowed_s:
        return f"it has not beaten for {silent_s:.1f} s, and had {allowed_s:.1f} s"
    return ""


def why_not_ready(name: str, profile: Profile) -> str:
    """Why one process of a profile does not serve; empty = it does.

    Raises:
        ConfigError: There is no such process.
    """
    service = service_named(name)
    link = profile.link.as_role(role_of(service))
    link = link.model_copy(update={"direct": False, "wait_for_router_s": _WAIT_S})
    try:
        with Session.open(link, station=profile.station) as session:
            if service == "router":
                return ""
            instance = profile.instance(service)
            found = [
                one for one in session.alive() if (one.service, one.instance) == (service, instance)
            ]
    except LinkError as error:
        return error.problem
    if not found:
        return f"{service} {instance!r} is not seen from the router"
    return "" if found[0].ready else f"{service} {instance!r} does not show that it is ready"
