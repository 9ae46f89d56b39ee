"""What should run at a station: by its profile, or by the folder of its run on this host."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.bus import Session
from palpate.census import ROUTER, SUPERVISOR, ProcessName
from palpate.config import LinkConfig, endpoint_host_port, is_loopback
from palpate.errors import LinkError
from palpate_deploy.station.host import running_folders
from palpate_deploy.station.profile import load_profile


@dataclass(frozen=True, slots=True)
class Expectation:
    """The processes that should run, and in one line who says so."""

    source: str
    processes: frozenset[ProcessName]


def expectation_of(profile: str) -> Expectation:
    """What a profile, given by name or path, starts.

    Raises:
        ConfigError: There is no such profile, or it is wrong.
    """
    names = load_profile(profile).processes
    return Expectation(f"profile {profile}", frozenset((name, name) for name in names))


def expectation_here(connect: Iterable[str], station: str) -> Expectation | None:
    """What a run on this host started, whose station and router are these; None = there is none.

    Only the runs of this user are seen. The station's supervisor says the same on the bus, but a
    supervisor that does not answer is missed only by who knows that there should be one.
    """
    wanted = {_place(endpoint) for endpoint in connect}
    for folder in reversed(running_folders()):
        values = _profile(folder)
        listens = values.get("router", {}).get("listen", ())
        connects = values.get("link", {}).get("connect", ())
        places = {_place(endpoint) for endpoint in (*listens, *connects)}
        if values.get("station") != station or not places & wanted:
            continue
        names = {(name, name) for name in values.get("processes", ())}
        if (folder / "supervisord.conf").exists():
            names.add(SUPERVISOR)
        return Expectation(f"run {folder.name} on this host", frozenset(names))
    return None


def ask_through_router(link: LinkConfig, station: str, said: Expectation | None) -> Session:
    """Join a station through its router alone, which knows every process at once.

    Raises:
        LinkError: There is no router, or it does not answer although ``said`` knows a run.
    """
    try:
        return Session.open(link.model_copy(update={"direct": False}), station=station)
    except LinkError as error:
        if said is None or ROUTER not in said.processes:
            raise
        raise LinkError(
            f"the router at {', '.join(link.connect)} does not answer, but should: {said.source}",
            remedy="it starts, or hangs and is started again by itself: ask again in ten seconds",
        ) from error


def _profile(folder: Path) -> dict[str, Any]:
    """Plain values of a run's profile; without checks, it may be of another version."""
    try:
        return tomllib.loads((folder / "profile.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _place(endpoint: str) -> tuple[str, int]:
    """Host and port; every name of the own host is the same place."""
    try:
        host, port = endpoint_host_port(endpoint)
    except ValueError:
        return endpoint, 0
    return ("loopback" if is_loopback(host) or host in ("0.0.0.0", "::") else host), port
