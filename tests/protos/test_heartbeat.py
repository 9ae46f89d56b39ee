"""The heartbeat: what a file says, what systemd is told, and what the router's loop asks."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from palpate import heartbeat
from palpate.bus import router as router_module
from palpate.config import LinkConfig
from palpate.heartbeat import LIMIT_S, Heartbeat, Pulse, ServiceManager, Turns, read_pulse

NOBODY = ServiceManager({})


def test_a_file_tells_who_beat_when_and_for_how_long(tmp_path: Path) -> None:
    file = tmp_path / "features"
    assert read_pulse(file) is None
    heart = Heartbeat(file, NOBODY)
    assert read_pulse(file) is None, "a process that has only been started has not beaten"
    before_ns = time.monotonic_ns()
    heart.beat()
    first = read_pulse(file)
    assert first is not None
    assert (first.pid, first.allowed_ns) == (os.getpid(), round(LIMIT_S * 1e9))
    assert before_ns <= first.beaten_ns <= time.monotonic_ns()
    heart.beat(30.0)
    second = read_pulse(file)
    assert second is not None
    assert second.beaten_ns > first.beaten_ns
    assert second.allowed_ns == 30_000_000_000


def test_the_beat_of_an_earlier_process_does_not_count(tmp_path: Path) -> None:
    file = tmp_path / "features"
    Heartbeat(file, NOBODY).beat()
    Heartbeat(file, NOBODY)
    assert read_pulse(file) is None


@pytest.mark.parametrize("content", [b"", b"\0" * 23, b"\0" * 4096])
def test_a_file_without_a_whole_beat_is_no_pulse(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "features"
    file.write_bytes(content)
    assert read_pulse(file) is None


def test_the_loop_of_a_process_finds_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "features"
    monkeypatch.setenv(heartbeat.FILE_VARIABLE, str(file))
    monkeypatch.setattr(heartbeat, "_of_this_process", None)
    heartbeat.beat()
    pulse = read_pulse(file)
    assert isinstance(pulse, Pulse)
    assert pulse.pid == os.getpid()


@pytest.fixture
def systemd(tmp_path: Path) -> socket.socket:
    """The socket of a service manager, in the file ``notify``."""
    receiver = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    receiver.bind(str(tmp_path / "notify"))
    receiver.setblocking(False)
    return receiver


def _said(receiver: socket.socket) -> list[list[str]]:
    datagrams = []
    while True:
        try:
            datagrams.append(receiver.recv(4096).decode().splitlines())
        except BlockingIOError:
            return datagrams


def test_systemd_hears_ready_once_and_then_of_every_second(
    tmp_path: Path, systemd: socket.socket
) -> None:
    manager = ServiceManager(
        {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "20000000"}
    )
    for now_ms in range(0, 3001, 10):
        manager.alive(now_ms * 1_000_000)
    said = _said(systemd)
    assert said[0] == ["READY=1", "WATCHDOG_USEC=20000000", "WATCHDOG=1"]
    assert said[1:] == [["WATCHDOG_USEC=20000000", "WATCHDOG=1"]] * 3
    manager.alive(3_010_000_000, within_s=60.0)  # what may take long begins now
    manager.alive(3_020_000_000)
    assert _said(systemd) == [["WATCHDOG_USEC=60000000", "WATCHDOG=1"]]


def test_ready_is_said_again_until_systemd_has_heard_it(
    tmp_path: Path, systemd: socket.socket
) -> None:
    hidden = tmp_path / "hidden"
    (tmp_path / "notify").rename(hidden)
    manager = ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "notify")})
    manager.alive(0)
    assert _said(systemd) == []
    hidden.rename(tmp_path / "notify")
    manager.alive(1)
    manager.alive(2_000_000_000)
    assert _said(systemd) == [["READY=1"]]


def test_the_watchdog_of_the_parent_is_not_ours(tmp_path: Path, systemd: socket.socket) -> None:
    where = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
    manager = ServiceManager({**where, "WATCHDOG_PID": str(os.getppid())})
    manager.alive(0)
    manager.alive(5_000_000_000)
    assert _said(systemd) == [["READY=1"]]
    assert not heartbeat.without_watch({**where, heartbeat.FILE_VARIABLE: "x"})


def test_turns_are_late_only_between_two_of_them() -> None:
    turns = Turns()
    assert not turns.are_late(), "a thread that was not started does not hang"
    turns.next(60.0)
    assert not turns.are_late()
    turns.next(-1.0)
    assert turns.are_late()
    turns.next(float("inf"))
    assert not turns.are_late(), "nor does one that has ended"


def test_a_process_that_stood_still_gives_its_threads_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = 100.0
    monkeypatch.setattr("palpate.heartbeat.time.monotonic", lambda: now_s)
    turns = Turns()
    turns.next(2.0)
    now_s += 30.0  # SIGSTOP, and SIGCONT
    assert not turns.are_late()
    for _ in range(4):
        now_s += 0.5
        assert not turns.are_late(), "its turn has begun again"
    now_s += 0.1
    assert turns.are_late()


def test_the_router_beats_only_while_it_answers(
    router: Callable[[], AbstractContextManager[LinkConfig]], monkeypatch: pytest.MonkeyPatch
) -> None:
    beats, answers = threading.Semaphore(0), threading.Event()
    answers.set()
    monkeypatch.setattr(router_module, "_PERIOD_S", 0.01)
    monkeypatch.setattr(router_module, "_ANSWER_S", 0.05)
    monkeypatch.setattr(router_module, "beat", beats.release)
    reply = router_module._Visitor._reply

    def reply_or_not(visitor: router_module._Visitor, query: object) -> None:
        if answers.is_set():
            reply(visitor, query)  # type: ignore[arg-type]

    monkeypatch.setattr(router_module._Visitor, "_reply", reply_or_not)
    with router():
        assert beats.acquire(timeout=20)
        answers.clear()
        time.sleep(0.2)  # of the questions that were answered already
        while beats.acquire(blocking=False):
            pass
        assert not beats.acquire(timeout=0.3)
        answers.set()
        assert beats.acquire(timeout=20)
