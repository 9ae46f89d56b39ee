"""``palpate up`` of a spare: its router is elsewhere, and may be away for long."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.bus import Session, run_router
from palpate.bus.topics import STATUS
from palpate.census import SUPERVISOR
from palpate.health import Health, HealthReporter
from palpate.messages import ServiceState, Status
from palpate_deploy.station.host import free_endpoint
from palpate_deploy.station.profile import Profile, parse_profile
from palpate_deploy.station.supervision import ProcessState
from palpate_deploy.station.up import StationLink

WaitUntil = Callable[[Callable[[], bool], float, str], float]

PATIENCE_S = 60.0
FINE = ProcessState("features", "RUNNING", 10, 9.0, 0, 0, True, 0, "")


@pytest.fixture
def spare() -> Profile:
    """Of a station whose router does not run; through it goes all."""
    link = {"connect": [free_endpoint()], "direct": False}
    values = {"station": "arm1", "replica": "b", "processes": ["features"], "link": link}
    return parse_profile(values, where="spare.toml")


def test_what_is_told_while_the_router_is_away_does_not_wait_for_it(
    spare: Profile, tmp_path: Path, wait_until: WaitUntil
) -> None:
    known: dict[str, tuple[Status, float]] = {}
    stop = threading.Event()
    with StationLink(spare, tmp_path) as link:
        wait_until(lambda: "no router" in link.absent, PATIENCE_S, "it says what is missing")
        link.take(known)
        link.tell([FINE])
        assert not known
        router = threading.Thread(target=run_router, args=(spare.link.connect, stop))
        router.start()
        try:
            joining = spare.link.model_copy(update={"wait_for_router_s": PATIENCE_S})
            with Session.open(joining, station="arm1") as session:
                said = session.subscriber(STATUS, service=SUPERVISOR[0])
                with HealthReporter(session, Health("features", "features-b")):

                    def heard() -> bool:
                        link.take(known)
                        link.tell([FINE])
                        return "features" in known

                    wait_until(heard, PATIENCE_S, "its processes are heard")
                    while (status := said.next(PATIENCE_S).message).state != ServiceState.READY:
                        pass
                    assert status.instance == "supervisor-b"
                    assert [one.instance for one in status.processes] == ["features-b"]
            assert not link.absent
        finally:
            stop.set()
            router.join()


@pytest.mark.slow
def test_a_spare_stops_in_order_while_its_router_is_away(spare: Profile, tmp_path: Path) -> None:
    path = tmp_path / "spare.toml"
    (endpoint,) = spare.link.connect
    path.write_text(
        'station = "arm1"\nreplica = "b"\nprocesses = ["recorder"]\n'
        f'[link]\nconnect = ["{endpoint}"]\ndirect = false\n',
        encoding="utf-8",
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate_deploy", "up", "--profile", str(path)],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        lines = iter(process.stdout.readline, "")
        assert any(line.startswith("not linked: no router") for line in lines)
        process.send_signal(signal.SIGTERM)
        assert [*lines][-1] == "stopped\n"
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
