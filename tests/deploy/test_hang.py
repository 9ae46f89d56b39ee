"""A station in which processes hang: they are replaced; and it stops, whatever hangs."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.bus import Delivery, Session
from palpate.bus.topics import FEATURES
from palpate.client import Client
from palpate.config import LinkConfig
from palpate.process import state_folder
from palpate_deploy.station import lifetime, supervision
from palpate_deploy.station.host import private_profile, running_folders
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import load_profile

ProcessIds = Callable[[Path], dict[str, int]]
WaitUntil = Callable[[Callable[[], bool], float, str], float]

pytestmark = pytest.mark.slow

PATIENCE_S = 60.0
"""Far more than the ten seconds that are promised: this host may be busy."""

ALL = {"router", "gateway", "features", "recorder"}


def _estimate_arrives(link: LinkConfig) -> None:
    """Wait for the estimate of a frame that is taken from now on."""
    began_ns = time.monotonic_ns()
    deadline = time.monotonic() + PATIENCE_S
    with Session.open(link, station="test") as session:
        stream = session.subscriber(FEATURES, sensor="finger", delivery=Delivery.NEWEST)
        while stream.next(PATIENCE_S).message.source.monotonic_ns <= began_ns:
            assert time.monotonic() < deadline


@pytest.mark.essential
def test_processes_that_hang_are_replaced_and_do_not_delay_the_end(
    up: subprocess.Popen[bytes],
    station: tuple[Path, LinkConfig],
    tmp_path: Path,
    process_ids: ProcessIds,
    wait_until: WaitUntil,
) -> None:
    _, link = station
    _estimate_arrives(link)
    before = process_ids(tmp_path)
    os.kill(before["features"], signal.SIGSTOP)
    wait_until(
        lambda: process_ids(tmp_path).get("features", 0) not in (0, before["features"]),
        PATIENCE_S,
        "features is replaced",
    )
    _estimate_arrives(link)
    now = process_ids(tmp_path)
    assert {name for name in before if before[name] != now.get(name)} == {"features"}
    for service in ALL - {"features"}:
        os.kill(now[service], signal.SIGSTOP)

    def all_new() -> bool:
        newest = process_ids(tmp_path)
        return newest.keys() >= ALL and all(
            newest[name] != now[name] for name in ALL - {"features"}
        )

    wait_until(all_new, PATIENCE_S, "router, gateway and recorder are replaced")
    _estimate_arrives(link)
    assert process_ids(tmp_path)["features"] == now["features"]
    log = next(state_folder().rglob("supervisord.log")).read_text(encoding="utf-8")
    assert log.count("hung: no heartbeat") == len(ALL)
    # And the station ends in order with one that hangs again.
    os.kill(process_ids(tmp_path)["recorder"], signal.SIGSTOP)
    up.send_signal(signal.SIGTERM)
    assert up.wait(timeout=PATIENCE_S) == 0
    assert process_ids(tmp_path) == {}
    assert not list((tmp_path / "runs").glob("*.part")), "the stopped recorder closed its record"


@pytest.mark.parametrize("end", [signal.SIGSTOP, signal.SIGKILL])
def test_nobody_is_left_by_a_supervisor_that_hangs_or_is_killed(
    up: subprocess.Popen[bytes],
    station: tuple[Path, LinkConfig],
    tmp_path: Path,
    process_ids: ProcessIds,
    end: signal.Signals,
) -> None:
    """Not even a process that could not be told to end; a new start is the service manager's."""
    _estimate_arrives(station[1])
    pids = process_ids(tmp_path)
    os.kill(pids["features"], signal.SIGSTOP)
    os.kill(pids["supervisord"], end)
    assert up.wait(timeout=2 * PATIENCE_S) == 1
    assert process_ids(tmp_path) == {}


def test_one_late_answer_does_not_shorten_the_end(
    monkeypatch: pytest.MonkeyPatch, wait_until: WaitUntil
) -> None:
    """Processes have their time to drain, unless supervisord is mute when they are to end."""
    ends_s = []

    def stop_child(process: subprocess.Popen[bytes], orderly_s: float) -> None:
        ends_s.append(orderly_s)
        lifetime.stop_child(process, orderly_s)

    monkeypatch.setattr(supervision, "stop_child", stop_child)
    monkeypatch.setattr(supervision, "_ANSWER_S", 0.5)
    profile = private_profile("virtual").model_copy(update={"processes": ("router", "gateway")})
    with supervision.Supervisor(profile, "late") as supervisor:

        def answers() -> bool:
            try:
                return len(supervisor.processes()) == 2
            except supervision.SupervisorError:
                return False

        os.kill(supervisor._process.pid, signal.SIGSTOP)
        try:
            assert not answers()
        finally:
            os.kill(supervisor._process.pid, signal.SIGCONT)
        wait_until(answers, PATIENCE_S, "it answers again")
        assert supervisor.folder in running_folders()
    assert supervisor.folder not in running_folders()
    assert ends_s == [2 * supervision.STOP_WAIT_S + 5]


def test_every_process_drains_and_ends_with_status_0(
    station: tuple[Path, LinkConfig], bundle: str, tmp_path: Path, wait_until: WaitUntil
) -> None:
    path, link = station
    profile = load_profile(path)
    with FiniteRun("drain") as run:
        run.start_profile(profile)
        with Client(link.connect[0], station="test", timeout_s=PATIENCE_S) as robot:
            robot.features("finger", max_age_s=1.0)
        with Session.open(link, station="test") as session:

            def ready() -> set[str]:
                return {one.service for one in session.alive() if one.ready}

            wait_until(lambda: ready() == ALL - {"router"}, PATIENCE_S, "all are ready")
            # While the finger is read: frames and estimates are on their way.
            for service in ("features", "recorder", "gateway"):
                os.kill(run.pid(service), signal.SIGTERM)
                wait_until(
                    lambda service=service: service not in ready(),  # type: ignore[misc]
                    PATIENCE_S,
                    f"{service} withdraws",
                )
                assert run.wait(service, PATIENCE_S) == 0
        os.kill(run.pid("router"), signal.SIGTERM)
        assert run.wait("router", PATIENCE_S) == 0
    (record,) = (tmp_path / "runs").glob("*.mcap")
    assert record.stat().st_size > 0
    assert not list((tmp_path / "runs").glob("*.part"))
