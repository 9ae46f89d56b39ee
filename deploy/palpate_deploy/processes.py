"""The processes of a station: what each runs, and how one is run."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from palpate.errors import ConfigError
from palpate_deploy import logs
from palpate_deploy.parent import end_with_parent
from palpate_deploy.profile import Profile, Service

_log = logging.getLogger(__name__)

START_ORDER: tuple[Service, ...] = (
    "router",
    "recorder",
    "synthesis",
    "field",
    "features",
    "fem",
    "gateway",
)
"""Listeners first; stopped in reverse, so that what the gateway last sent is still recorded."""


def command_line(service: Service, profile: Path) -> list[str]:
    """Command that runs one process of a profile, with this very Python.

    Args:
        service: Which.
        profile: The resolved profile's file.
    """
    return [sys.executable, "-m", "palpate_deploy", "run", service, "--profile", str(profile)]


def run_service(service: Service, profile: Profile) -> None:
    """Be one process of a profile until ``SIGTERM`` or ``SIGINT``, or until its source ends.

    Raises:
        PalpateError: It cannot start or go on; the process ends and the supervisor restarts it.
    """
    logs.configure(profile.log.level, profile.log.format)
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    end_with_parent()
    _log.info("%s starts, station %s", service, profile.station)
    _RUN[service](profile, stop)
    _log.info("%s ends", service)


def _run_router(profile: Profile, stop: threading.Event) -> None:
    from palpate.bus import run_router

    run_router(profile.router.listen, stop, link=profile.link)


def _run_gateway(profile: Profile, stop: threading.Event) -> None:
    from palpate_gateway import node
    from palpate_gateway.one_core import stay_on_one_core

    if profile.gateway.pace != "fast":
        stay_on_one_core(profile.gateway.core)
    node.run(profile.gateway, profile.link, profile.station, stop)


def _run_features(profile: Profile, stop: threading.Event) -> None:
    from palpate_services import features

    features.run(profile.features, profile.link, profile.station, stop)


def _run_field(profile: Profile, stop: threading.Event) -> None:
    from palpate_services import field

    field.run(profile.field, profile.link, profile.station, stop)


def _run_synthesis(profile: Profile, stop: threading.Event) -> None:
    from palpate_services import synthesis

    synthesis.run(profile.synthesis, profile.link, profile.station, stop)


def _run_recorder(profile: Profile, stop: threading.Event) -> None:
    from palpate_services import recorder

    recorder.run(profile.recorder, profile.link, profile.station, stop)


def _run_fem(profile: Profile, stop: threading.Event) -> None:
    from palpate_fem.service import node

    node.run(profile.fem, profile.link, profile.station, stop)


_RUN: dict[Service, Callable[[Profile, threading.Event], None]] = {
    "router": _run_router,
    "gateway": _run_gateway,
    "features": _run_features,
    "field": _run_field,
    "synthesis": _run_synthesis,
    "recorder": _run_recorder,
    "fem": _run_fem,
}


def service_named(name: str) -> Service:
    """A service by name.

    Raises:
        ConfigError: There is no such service.
    """
    for service in _RUN:
        if service == name:
            return service
    raise ConfigError(f"service {name!r} does not exist", remedy=f"one of: {', '.join(_RUN)}")
