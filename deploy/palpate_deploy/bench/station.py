"""The small station of a benchmark: a router and a gateway, at addresses that are free."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from palpate_deploy.ports import free_endpoint
from palpate_deploy.profile import Profile, changed, load_profile


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
    """A port of this host that nothing uses."""
    return int(free_endpoint().rpartition(":")[2])
