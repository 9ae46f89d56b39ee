"""What the command of a unit says to systemd: only a station whose processes live is alive."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from tests.install.cases import VIRTUAL
from tests.install.conftest import Install
from tests.install.service_manager import NoticeBoard, UnitFile

from palpate.heartbeat import LIMIT_S
from palpate_deploy.station.host import free_endpoint
from palpate_services.inference.repository import available

pytestmark = pytest.mark.slow

PATIENCE_S = 120.0
"""Far more than it takes: this host may be busy."""

LIMIT = 20
"""``WatchdogSec`` of the units [s]."""


@pytest.fixture
def board(tmp_path: Path) -> Iterator[NoticeBoard]:
    """The service manager's socket."""
    with NoticeBoard(tmp_path / "notify") as board:
        yield board


@pytest.fixture
def station(
    root: Path, profile: Path, tmp_path: Path, install: Install, board: NoticeBoard
) -> Iterator[subprocess.Popen[bytes]]:
    """The command of an installed unit, with its environment, until it says that it is ready."""
    if not any(name.startswith("features-twin:") for name in available()):
        pytest.skip("bundle features-twin is not there")
    profile.write_text(f'{VIRTUAL}[router]\nlisten = ["{free_endpoint()}"]\n')
    install()
    unit = UnitFile.read(root / "etc/systemd/system/palpate@lab.service")
    assert unit.one("WatchdogSec") == str(LIMIT)
    _, *words = unit.command
    command = [word.replace("/etc/palpate", f"{root}/etc/palpate") for word in words]
    (root / "var/lib/palpate/lab").mkdir(parents=True)
    text = (root / "etc/palpate/lab.toml").read_text("utf-8")
    (root / "etc/palpate/lab.toml").write_text(text.replace("/var/lib", f"{root}/var/lib"))
    given = {k: v.replace("/var/lib", f"{root}/var/lib") for k, v in unit.environment.items()}
    manager = {"NOTIFY_SOCKET": str(board.path), "WATCHDOG_USEC": str(LIMIT * 1_000_000)}
    with open(tmp_path / "journal", "wb") as journal:
        process = subprocess.Popen(
            [sys.executable, "-m", "palpate_deploy", *command],
            cwd=root / "var/lib/palpate/lab",
            env={**os.environ, **given, **manager},
            stdout=journal,
            stderr=subprocess.STDOUT,
        )
    try:
        board.wait_for("READY=1", PATIENCE_S)
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        try:
            process.wait(PATIENCE_S)
        finally:
            process.kill()


def _process_of(root: Path, service: str) -> int:
    """Process id of the newest of a service; 0 = none."""
    found = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            line = (folder / "cmdline").read_bytes().decode(errors="replace")
        except OSError:
            continue
        if f"run\0{service}\0" in line and str(root) in line:
            found = max(found, int(folder.name))
    return found


def test_ready_comes_after_every_process_and_a_hung_one_is_replaced(
    station: subprocess.Popen[bytes], board: NoticeBoard, root: Path
) -> None:
    board.wait_for("STATUS=4 of 4 processes run", PATIENCE_S)
    lines = [line for _, line in board.lines]
    said = [line for line in lines[lines.index("READY=1") :] if line.startswith("STATUS=")]
    assert said[0] == "STATUS=4 of 4 processes run"  # of the same look at the processes
    old = _process_of(root, "features")
    stopped_s = time.monotonic()
    os.kill(old, signal.SIGSTOP)
    board.wait_for("STATUS=3 of 4 processes run", PATIENCE_S, began_s=stopped_s)
    board.wait_for("STATUS=4 of 4 processes run", PATIENCE_S, began_s=stopped_s)
    assert _process_of(root, "features") not in (0, old)
    # The station itself has been alive all the time.
    alive_s = [at_s for at_s, line in board.lines if line == "WATCHDOG=1"]
    gaps_s = [b - a for a, b in pairwise(alive_s)]
    assert max(gaps_s) < LIMIT
    asked_s = time.monotonic()
    station.terminate()
    board.wait_for("STOPPING=1", PATIENCE_S, began_s=asked_s)
    assert station.wait(PATIENCE_S) == 0


def test_station_that_hangs_is_not_alive_and_says_where(
    station: subprocess.Popen[bytes], board: NoticeBoard, tmp_path: Path
) -> None:
    station.send_signal(signal.SIGUSR1)  # as WatchdogSignal of the unit
    journal = tmp_path / "journal"
    deadline = time.monotonic() + PATIENCE_S
    while "most recent call first" not in journal.read_text("utf-8", errors="replace"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    board.wait_for("WATCHDOG=1", PATIENCE_S, began_s=time.monotonic())
    station.send_signal(signal.SIGSTOP)
    time.sleep(1.0)  # what was on its way arrives
    stopped_s = time.monotonic()
    time.sleep(LIMIT_S)
    assert not board.since(stopped_s, "WATCHDOG=1")
    station.send_signal(signal.SIGCONT)
    board.wait_for("WATCHDOG=1", PATIENCE_S, began_s=time.monotonic())


def test_supervisor_that_hangs_ends_the_station(
    station: subprocess.Popen[bytes], board: NoticeBoard, root: Path
) -> None:
    """So that systemd starts it again: its processes may hang unseen meanwhile."""
    children = Path(f"/proc/{station.pid}/task/{station.pid}/children").read_text().split()
    (supervisord,) = [
        int(pid) for pid in children if b"supervisord" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    os.kill(supervisord, signal.SIGSTOP)
    assert station.wait(PATIENCE_S) == 1
    assert _process_of(root, "features") == 0
