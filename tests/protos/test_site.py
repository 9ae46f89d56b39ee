"""Routers of stations behind the router of a site: what crosses, and who may have which name."""

from __future__ import annotations

import itertools
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.bus import Delivery, Session, SiteLink, run_router
from palpate.bus import router as router_module
from palpate.bus.topics import ELECTRODES
from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import ConfigError, StationTaken, StreamTimeout

PATIENCE_S = 60.0


def until(true: Callable[[], Any]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < deadline, "it did not become true in time"
        time.sleep(0.05)


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def router(endpoint: str, site: SiteLink | None = None) -> Iterator[LinkConfig]:
    stop = threading.Event()
    link = LinkConfig(connect=(endpoint,), wait_for_router_s=PATIENCE_S)
    thread = threading.Thread(
        target=run_router, args=((endpoint,), stop), kwargs={"link": link, "site": site}
    )
    thread.start()
    try:
        Session.open(link).close()
        yield link
    finally:
        stop.set()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()


@contextmanager
def station(name: str, site: str) -> Iterator[tuple[LinkConfig, SiteLink]]:
    up = SiteLink((site,), name)
    with router(free_endpoint(), up) as link:
        yield link, up


def sends(session: Session, frame: Any, to: Any) -> bool:
    """Whether a frame that is published in one session arrives at a stream."""
    session.publisher(ELECTRODES, sensor="finger").put(frame)
    try:
        to.next(0.2)
    except StreamTimeout:
        return False
    return True


def test_a_robot_at_the_site_hears_each_station_by_its_name(examples: dict[str, Any]) -> None:
    frame = examples["ElectrodeFrame"]
    site = free_endpoint()
    with ExitStack() as stack:
        lab = stack.enter_context(router(site))
        links = {}
        for name in ("arm1", "arm2"):
            link, up = stack.enter_context(station(name, site))
            until(partial(getattr, up, "connected"))
            links[name] = link
        robot = stack.enter_context(Session.open(lab))
        heard = {
            name: robot.subscriber(ELECTRODES, station=name, delivery=Delivery.QUEUE)
            for name in links
        }
        for name, link in links.items():
            with Session.open(link, station=name) as gateway:
                until(partial(sends, gateway, frame, heard[name]))
        for name in links:
            others = heard[name].counters
            assert others.get("received", 0) > 0
        with Client(site, station="arm1") as client:
            with Session.open(links["arm1"], station="arm1") as process:
                process.presence("features", instance="features").ready()
                until(lambda: [one.service for one in client.alive()].count("features") == 1)
            with Client(site, station="arm2") as other:
                assert "features" not in [one.service for one in other.alive()]


def test_the_second_station_of_a_name_goes_on_without_the_site(examples: dict[str, Any]) -> None:
    frame = examples["ElectrodeFrame"]
    site = free_endpoint()
    with ExitStack() as stack:
        lab = stack.enter_context(router(site))
        first = ExitStack()
        stack.enter_context(first)
        _, up = first.enter_context(station("arm1", site))
        until(lambda: up.connected)
        link, second = stack.enter_context(station("arm1", site))
        until(lambda: second.refusal is not None)
        assert isinstance(second.refusal, StationTaken)
        assert "'arm1'" in second.refusal.problem
        assert not second.connected
        # Its own processes hear one another, the site does not hear them.
        robot = stack.enter_context(Session.open(lab, station="arm1"))
        heard = robot.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
        here = stack.enter_context(Session.open(link, station="arm1"))
        gateway = stack.enter_context(Session.open(link, station="arm1"))
        own = here.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
        until(lambda: sends(gateway, frame, own))
        with pytest.raises(StreamTimeout):
            heard.next(0.5)
        assert not second.connected
        # It takes the place of the first when that has ended.
        first.close()
        until(lambda: second.connected)
        assert second.refusal is None
        until(lambda: sends(gateway, frame, heard))


def test_a_name_is_claimed_although_its_certificates_were_being_renewed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nobody guarded the name from then on, and a second station of it joined the site."""
    errors = [ConfigError("the key is of another certificate", remedy="issue both again")]

    def opened(link: LinkConfig, *, station: str) -> Session:
        if errors:
            raise errors.pop()
        return Session.open(link, station=station)

    monkeypatch.setattr(router_module, "Session", SimpleNamespace(open=opened))
    site = free_endpoint()
    with router(site), station("arm1", site) as (_, first):
        until(lambda: first.connected)
        with station("arm1", site) as (_, second):
            until(lambda: second.refusal is not None)
        assert first.refusal is None


def test_a_station_starts_without_its_site_and_finds_it_later(examples: dict[str, Any]) -> None:
    frame = examples["ElectrodeFrame"]
    site = free_endpoint()
    with station("arm1", site) as (link, up):
        assert not up.connected
        with Session.open(link, station="arm1") as gateway, ExitStack() as stack:
            for _ in range(2):  # it comes, and comes again
                with router(site) as lab, Session.open(lab, station="arm1") as robot:
                    until(lambda: up.connected)
                    heard = robot.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
                    until(partial(sends, gateway, frame, heard))
                until(lambda: not up.connected)
            assert up.refusal is None
            stack.close()


def test_a_site_that_hangs_does_not_hold_its_stations(examples: dict[str, Any]) -> None:
    """Its router stands still, as a whole process; stations go on, and robots hear them again."""
    first = examples["ElectrodeFrame"]
    numbers = itertools.count(first.stamp.sequence)
    site = free_endpoint()
    code = "import sys, threading; from palpate.bus import run_router\n"
    code += "run_router((sys.argv[1],), threading.Event())"
    with ExitStack() as stack:
        process = stack.enter_context(subprocess.Popen([sys.executable, "-c", code, site]))
        stack.callback(process.kill)
        link, up = stack.enter_context(station("arm1", site))
        until(lambda: up.connected)
        lab = LinkConfig(connect=(site,), wait_for_router_s=PATIENCE_S)
        robot = stack.enter_context(Session.open(lab, station="arm1"))
        far = robot.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
        here = stack.enter_context(Session.open(link, station="arm1"))
        near = here.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
        gateway = stack.enter_context(Session.open(link, station="arm1"))

        def hears(stream: Any) -> bool:
            stamp = replace(first.stamp, sequence=next(numbers))
            return sends(gateway, replace(first, stamp=stamp), stream)

        until(lambda: hears(far))
        process.send_signal(signal.SIGSTOP)
        until(lambda: not up.connected)  # after the lease
        until(lambda: hears(near))
        process.send_signal(signal.SIGCONT)
        until(lambda: up.connected)
        assert up.refusal is None
        until(lambda: hears(far))
