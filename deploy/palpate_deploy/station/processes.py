"""The processes of a station: what each runs, and a finite run of them."""

from __future__ import annotations

import contextlib
import faulthandler
import functools
import logging
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Self

from palpate.config import LinkConfig, Role
from palpate.errors import ConfigError, PalpateError
from palpate.process import check_installed, stop_on_signals
from palpate_deploy.station import logs
from palpate_deploy.station.host import end_run, new_run_folder, write_profile
from palpate_deploy.station.lifetime import end_with_parent, start_child, stop_child
from palpate_deploy.station.profile import Profile, Service

if TYPE_CHECKING:
    from palpate_deploy.station.certificates import IssuedCertificate

_log = logging.getLogger(__name__)

START_ORDER: tuple[Service, ...] = (
    "router",
    "metrics",
    "web",
    "recorder",
    "ros_bridge",
    "synthesis",
    "field",
    "features",
    "fem",
    "gateway",
)
"""Listeners first; stopped in reverse, so that the gateway's last messages are still recorded."""


def command_line(service: Service, profile: Path) -> list[str]:
    """Command that runs one process of a profile's file, with this very Python."""
    return [sys.executable, "-m", "palpate_deploy", "run", service, "--profile", str(profile)]


def run_service(service: Service, profile: Profile) -> None:
    """Be one process of a profile until ``SIGTERM`` or ``SIGINT``, or until its source ends.

    Raises:
        PalpateError: It cannot start or go on; the process ends and the supervisor restarts it.
    """
    logs.configure(profile.log.level, profile.log.format, station=profile.station, service=service)
    # Where a process hangs that is about to be killed, its log must show.
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    stop = stop_on_signals()
    end_with_parent()
    _log.info("%s starts, station %s", service, profile.station)
    link = profile.link.as_role(role_of(service))
    with _refusal_log() if link.has_roles else contextlib.nullcontext():
        _run(service, profile, link, stop)
    _log.info("%s ends", service)


def _refusal_log() -> contextlib.AbstractContextManager[object]:
    from palpate.bus.refusals import RefusalLog

    return RefusalLog()


def role_of(service: Service) -> Role:
    """The role that a process has in its certificate."""
    if service == "router":
        return Role.ROUTER
    return Role.GATEWAY if service == "gateway" else Role.SERVICE


def check_certificates(profile: Profile, *, private: bool) -> list[IssuedCertificate]:
    """Check that the certificates of a profile's processes hold; ``private`` as they are read.

    Returns:
        One for each role; empty = the profile names none.

    Raises:
        ConfigError: One is missing, not accepted by others, or of another role.
        MissingExtraError: What reads certificates is not installed.
    """
    link = profile.link
    ours: list[IssuedCertificate] = []
    if not link.has_tls:
        return ours
    check_installed("cryptography", extra="security")
    from palpate_deploy.station.certificates import read_certificate

    for role in dict.fromkeys(role_of(service) for service in profile.processes):
        tls = link.as_role(role).tls
        assert tls is not None
        one = read_certificate(tls, private=private)
        if one.problem:
            raise ConfigError(
                f"{tls.certificate}: {one.problem}", remedy="issue another: palpate certs issue"
            )
        if tls.roles and one.role is not role:
            raise ConfigError(
                f"{tls.certificate} is that of a {one.role}, a {role} needs its own",
                remedy="make a folder for each role: [link] certificates",
            )
        if ours and one.authority != ours[0].authority:
            raise ConfigError(
                f"{tls.certificate} and {ours[0].folder} are of different authorities",
                remedy="issue all of them by one: palpate certs issue",
            )
        ours.append(one)
    return ours


def _run(service: Service, profile: Profile, link: LinkConfig, stop: threading.Event) -> None:
    if service == "router":
        from palpate_deploy.station.site import run_station_router

        run_station_router(profile, link, stop)
        return
    if service == "gateway" and profile.gateway.pace != "fast":
        from palpate_gateway.one_core import stay_on_one_core

        stay_on_one_core(profile.gateway.core)
    run = _entry_point(service, profile)
    table, instance = getattr(profile, service), profile.instance(service)
    run(table, link, profile.station, stop, instance=instance)


def _entry_point(service: Service, profile: Profile) -> Callable[..., object]:
    """The function that runs a service, of which only its own room is imported."""
    if service == "gateway":
        from palpate_gateway.service import node as gateway

        return gateway.run
    if service == "fem":
        from palpate_fem.service import node as fem

        return fem.run
    if service == "recorder":
        from palpate_services.recorder.service import run_recorder

        return run_recorder
    if service == "ros_bridge":
        from palpate_services.ros_bridge import run_ros_bridge

        return run_ros_bridge
    if service == "metrics":
        from palpate_deploy.station.metrics import run_metrics

        return run_metrics
    if service == "web":
        from palpate_deploy.station.web.process import run_web

        return run_web
    from palpate_services.inference.services import run_estimating

    return functools.partial(run_estimating, models=profile.models)


_NEEDED: dict[str, tuple[str, tuple[str, ...]]] = {
    "metrics": ("metrics", ("prometheus_client",)),
    "web": ("web", ("waitress",)),
    "ros_bridge": ("services", ("rosbags",)),
    "features": ("services", ("onnxruntime",)),
    "field": ("services", ("onnxruntime",)),
    "synthesis": ("services", ("onnxruntime",)),
    "fem": ("fem", ("warp", "scipy", "pymetis", "threadpoolctl", "h5py")),
}
"""Optional packages without which a process cannot start, and the extra that installs them."""


def check_packages(profile: Profile) -> None:
    """Check that every process of a profile finds its packages, without importing them.

    Raises:
        ConfigError: A sensor's driver does not exist.
        MissingExtraError: One is not installed; names the extra.
    """
    for service in profile.processes:
        extra, modules = _NEEDED.get(service, ("", ()))
        if service == "recorder" and profile.recorder.rrd:
            extra, modules = "services", ("rerun",)
        for module in modules:
            check_installed(module, extra=extra)
    if "gateway" in profile.processes:
        from palpate_gateway.drivers import load_driver

        for sensor in profile.gateway.sensors:
            load_driver(sensor.driver)


def service_named(name: str) -> Service:
    """A service by name; a ``ConfigError`` lists what there is."""
    for service in START_ORDER:
        if service == name:
            return service
    raise ConfigError(
        f"service {name!r} does not exist", remedy=f"one of: {', '.join(START_ORDER)}"
    )


STOP_WAIT_S = 60.0
"""A recorder may need this long to write what has arrived before the end of its source [s]."""


class ProcessEnded(PalpateError, RuntimeError):
    """A process of a finite run ended too early, with this exit status."""

    def __init__(self, problem: str, *, remedy: str, status: int) -> None:
        super().__init__(problem, remedy=remedy)
        self.status = status


def ended_error(name: str, status: int, log: Path) -> ProcessEnded:
    """The error of a process that ended: the last one in its log, if there is one."""
    problem, remedy = f"ended with status {status}", f"see {log}"
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("error: "):
            problem = line.removeprefix("error: ")
            if following.startswith("  fix: "):
                remedy = following.removeprefix("  fix: ")
    return ProcessEnded(f"{name}: {problem}", remedy=remedy, status=status)


class FiniteRun:
    """Processes that are started once, watched and stopped; none is restarted.

    Each writes a log of its own, and all end with this process. The run's folder bears the name.
    """

    def __init__(self, name: str) -> None:
        self.folder = new_run_folder(name)
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a process."""
        self._running[name] = start_child(command, self.log(name))

    def start_module(self, name: str, module: str, *arguments: object) -> None:
        """Start ``python -m palpate_deploy.MODULE ARGUMENTS``."""
        command = [sys.executable, "-m", f"palpate_deploy.{module}", *map(str, arguments)]
        self.start(name, command)

    def start_profile(self, profile: Profile) -> None:
        """Start every process of a profile in ``START_ORDER``."""
        # What a bench or a replay serves is nothing that a station should remember.
        models = profile.models.model_copy(update={"state": self.folder})
        path = write_profile(profile.model_copy(update={"models": models}), self.folder)
        for service in START_ORDER:
            if service in profile.processes:
                self.start(service, command_line(service, path))

    def status(self, name: str) -> int | None:
        """Exit status of a process; None while it runs."""
        return self._running[name].poll()

    def pid(self, name: str) -> int:
        """Process id of a process."""
        return self._running[name].pid

    def check(self, names: Iterable[str]) -> None:
        """Check that processes run.

        Raises:
            ProcessEnded: One has ended; the error holds what it said last.
        """
        for name in names:
            status = self.status(name)
            if status is not None:
                raise self.ended(name, status)

    def ended(self, name: str, status: int) -> ProcessEnded:
        """The error of a process that ended: the one in its log, if there is one."""
        return ended_error(name, status, self.log(name))

    def log(self, name: str) -> Path:
        """Log of a process."""
        return self.folder / "logs" / f"{name}.log"

    def stop(self) -> None:
        """Stop every process in reverse order of starting, each after the one before has ended."""
        for name in reversed(self._running):
            self.stop_one(name)
        end_run(self.folder)

    def stop_one(self, name: str) -> int:
        """Stop a process; its exit status."""
        return stop_child(self._running[name], STOP_WAIT_S)

    def wait(self, name: str, timeout_s: float) -> int | None:
        """Wait for a process to end by itself; None if it does not in time."""
        deadline = time.monotonic() + timeout_s
        while (status := self.status(name)) is None and time.monotonic() < deadline:
            time.sleep(0.02)
        return status

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
