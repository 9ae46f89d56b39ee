"""Namespaces as hosts: what crosses a cable, and that nothing of a lab is left behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from palpate_deploy.bench import fleet
from palpate_deploy.bench.hosts import HostLab, namespaces, remove_leftovers, why_no_hosts

pytestmark = pytest.mark.skipif(bool(why_no_hosts()), reason=f"no hosts here: {why_no_hosts()}")

PATIENCE_S = 120.0

LAB = """
import subprocess, time
from palpate_deploy.bench.hosts import HostLab
with HostLab() as lab:
    host = lab.add("one")
    sleeper = subprocess.Popen(host.inside(["sleep", "1000"]))
    print(sleeper.pid, flush=True)
    {then}
"""


def of(pid: int) -> list[str]:
    return [name for name in namespaces() if name.startswith(f"palpate-lab-{pid}-")]


@contextlib.contextmanager
def lab(then: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A lab in a process of its own, and the process that sleeps in it."""
    process = subprocess.Popen(
        [sys.executable, "-c", LAB.format(then=then)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert process.stdout is not None
        yield process, int(process.stdout.readline())
    finally:
        process.kill()
        process.wait(PATIENCE_S)
        remove_leftovers()


def lives(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    return False


@pytest.mark.parametrize(
    ("then", "sent"),
    [("time.sleep(1000)", signal.SIGINT), ("raise ValueError('by design')", None)],
    ids=["ctrl-c", "failure"],
)
def test_nothing_is_left_of_a_lab(then: str, sent: signal.Signals | None) -> None:
    with lab(then) as (process, sleeper):
        if sent is not None:
            assert len(of(process.pid)) == 2
            process.send_signal(sent)
        assert process.wait(PATIENCE_S) != 0
        assert of(process.pid) == []
        assert not lives(sleeper)


def test_what_a_killed_lab_left_is_removed_by_the_next() -> None:
    with lab("time.sleep(1000)") as (process, sleeper):
        process.kill()
        process.wait(PATIENCE_S)
        assert len(of(process.pid)) == 2
        with HostLab() as next_lab:
            assert of(process.pid) == []
            assert not lives(sleeper)
            assert next_lab.site in of(os.getpid())
            assert remove_leftovers() == []  # that of a living process stays
    assert of(os.getpid()) == []


def test_a_pulled_cable_loses_packets_and_comes_back() -> None:
    with HostLab() as one:
        host, other = one.add("a"), one.add("b")

        def reaches(address: str) -> bool:
            code = f"import socket; socket.create_connection(({address!r}, 9), 1)"
            done = subprocess.run(
                host.inside([sys.executable, "-c", code]), capture_output=True, check=False
            )
            # Nobody listens there: a host that is reached refuses.
            return b"ConnectionRefusedError" in done.stderr

        assert reaches(host.site)
        assert not reaches(other.address)  # the site does not forward
        one.plug(host, plugged=False)
        assert not reaches(host.site)
        one.plug(host, plugged=True)
        deadline = time.monotonic() + PATIENCE_S
        while not reaches(host.site):
            assert time.monotonic() < deadline


@pytest.mark.slow
def test_a_stream_crosses_only_for_a_subscriber() -> None:
    """Counted on the cable, with mutual TLS and both routers between."""
    found = fleet.measure_scale(1, 3.0)
    phases = found["phases"]
    assert phases["electrodes"]["received"] > 0
    # 100 frames a second of more than 100 bytes, and keep-alives otherwise.
    assert phases["electrodes"]["bytes_hz_each"] > 5 * phases["nobody"]["bytes_hz_each"]
    assert phases["features"]["bytes_hz_each"] > 5 * phases["nobody"]["bytes_hz_each"]
    assert phases["electrodes"]["heard_stations"] == 1
    assert of(os.getpid()) == []


ROUTER = """
import sys, threading
from palpate.bus import run_router
from palpate.config import LinkConfig, TlsConfig
where, certificates = sys.argv[1:]
link = LinkConfig(connect=(), listen=("tls/127.0.0.1:0",), tls=TlsConfig.of_folder(certificates))
run_router((where,), threading.Event(), link=link)
"""

SERVICE = """
import sys, time
from palpate.bus import Session, endpoints
from palpate.messages import ServiceRequest, ServiceState, Status
from palpate_deploy.bench.fleet_parts import link_to
with Session.open(link_to(sys.argv[1], sys.argv[2])) as session:
    answer = Status("features", "features", ServiceState.READY, 1, 1, 1.0, "1")
    session.queryable(
        endpoints.STATUS, lambda _: answer, service="features", instance="features"
    )
    print("up", flush=True)
    time.sleep(1000)
"""

ASKER = """
import sys, time
from palpate.bus import Session, endpoints
from palpate.errors import PalpateError
from palpate.messages import ServiceRequest
from palpate_deploy.bench.fleet_parts import link_to
with Session.open(link_to(sys.argv[1], sys.argv[2])) as session:
    time.sleep(float(sys.argv[3]))
    for _ in range(200):
        try:
            found = session.query(endpoints.STATUS, ServiceRequest(), service="features")
            print(found.service)
            break
        except PalpateError as error:
            time.sleep(0.1)
"""


@pytest.mark.parametrize("after_s", [0.0, 4.0], ids=["at once", "when it has settled"])
def test_two_hosts_at_one_router_reach_one_another(tmp_path: Path, after_s: float) -> None:
    """Their listeners are on loopback, where the other one cannot reach them."""
    with contextlib.ExitStack() as stack:
        one = fleet.Fleet(tmp_path, stack)
        first, second = one.lab.add("first"), one.lab.add("second")
        certificates = str(one.certificates)
        where = f"tls/0.0.0.0:{fleet.PORT}"
        one.start(
            one.lab.at_site([sys.executable, "-c", ROUTER, where, f"{certificates}/router"]),
            "router",
        )
        one.start(
            first.inside(
                [sys.executable, "-c", SERVICE, fleet.up_to(first), f"{certificates}/service"]
            ),
            "service",
        )
        asked = subprocess.run(
            second.inside(
                [
                    *(sys.executable, "-c", ASKER, fleet.up_to(second)),
                    *(f"{certificates}/robot", str(after_s)),
                ]
            ),
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE_S,
        )
        assert asked.stdout.strip() == "features", asked.stderr
