"""The watch over processes: who hangs is ended, who does not is left alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from supervisor.states import ProcessStates

from palpate.heartbeat import FILE_VARIABLE, START_S, Pulse, read_pulse
from palpate_deploy.station import watch
from palpate_deploy.station.logs import FAILED, USAGE
from palpate_deploy.station.watch import HangWatch, Silence, cannot_serve

PATIENCE_S = 30.0
PID = 4711
SECOND_NS = 1_000_000_000

HANGING = """
import faulthandler, signal, sys, threading, time
from palpate.heartbeat import beat

def a_timer_that_goes_on():
    while True:
        time.sleep(0.01)

def a_driver_that_does_not_return():
    threading.Event().wait()

faulthandler.register(signal.SIGUSR1, all_threads=True)
threading.Thread(target=a_timer_that_goes_on, daemon=True).start()
for turn in range(int(sys.argv[1])):
    beat(0.5)
    time.sleep(0.02)
a_driver_that_does_not_return()
"""


def _pulse(at_s: float, *, pid: int = PID, allowed_s: float = 5.0) -> Pulse:
    return Pulse(pid, round(at_s * SECOND_NS), round(allowed_s * SECOND_NS))


def _looks(silence: Silence, pulse: Pulse | None, times_s: Iterator[float]) -> None:
    for now_s in times_s:
        silence.look(pulse, now_s)


def _from(start_s: float, end_s: float, step_s: float = 0.1) -> Iterator[float]:
    return (start_s + step_s * k for k in range(round((end_s - start_s) / step_s) + 1))


def test_silence_counts_from_the_last_beat() -> None:
    silence = Silence(PID, 100.0)
    _looks(silence, _pulse(100.0), _from(100.0, 104.9))
    assert silence.beaten
    assert not silence.hangs
    _looks(silence, _pulse(104.9), _from(104.9, 109.8))
    assert not silence.hangs
    _looks(silence, _pulse(104.9), _from(109.9, 110.1))
    assert silence.hangs
    assert silence.silent_s == pytest.approx(5.1, abs=0.15)


def test_a_beat_may_ask_for_more_time() -> None:
    silence = Silence(PID, 0.0)
    _looks(silence, _pulse(0.1, allowed_s=20.0), _from(0.1, 19.9))
    assert not silence.hangs
    _looks(silence, _pulse(0.1, allowed_s=20.0), _from(20.0, 20.5))
    assert silence.hangs


def test_a_process_that_starts_has_more_time() -> None:
    silence = Silence(PID, 0.0)
    stale = _pulse(50.0, pid=PID + 1)  # of the process before it
    _looks(silence, stale, _from(0.0, START_S - 1.0))
    assert not silence.beaten
    assert not silence.hangs
    _looks(silence, None, _from(START_S - 1.0, START_S + 1.0))
    assert silence.hangs


@pytest.mark.parametrize("pause_s", [6.0, 3600.0])
def test_a_watcher_that_was_paused_kills_nobody(pause_s: float) -> None:
    """The host was suspended, and the watcher is the first to run again."""
    silence = Silence(PID, 0.0)
    _looks(silence, _pulse(0.0), _from(0.0, 1.0))
    _looks(silence, _pulse(0.0), _from(1.0 + pause_s, 3.0 + pause_s))
    assert not silence.hangs
    _looks(silence, _pulse(3.0 + pause_s), _from(3.1 + pause_s, 5.0 + pause_s))
    assert not silence.hangs
    _looks(silence, _pulse(3.0 + pause_s), _from(5.1 + pause_s, 9.0 + pause_s))
    assert silence.hangs, "but one that really hangs is noticed after it"


class _Station:
    """A process as supervisord shows it, and the watch over it."""

    def __init__(self, folder: Path, turns: int) -> None:
        self.file = folder / "features"
        self.child = subprocess.Popen(
            [sys.executable, "-c", HANGING, str(turns)],
            env={**os.environ, FILE_VARIABLE: str(self.file)},
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        config = SimpleNamespace(name="features", startsecs=1)
        self.process: Any = SimpleNamespace(
            pid=self.child.pid, state=ProcessStates.RUNNING, config=config, backoff=0
        )
        self.lines: list[str] = []
        self.watch = HangWatch(folder, lambda: [self.process], self.lines.append)

    def look_until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline
            self.watch.look()
            time.sleep(0.02)

    def reap(self) -> dict[str, Any]:
        _, status = os.waitpid(self.child.pid, 0)
        self.watch.ended(self.process, status)
        self.process.pid = 0
        (report,) = self.watch.report()
        return report

    def ended(self) -> bool:
        # Not waited for: until then the id stays that of our child.
        return os.waitid(os.P_PID, self.child.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


@pytest.fixture
def hanging(tmp_path: Path) -> Iterator[Callable[[int], _Station]]:
    """Starts a process that hangs after some turns."""
    stations: list[_Station] = []

    def start(turns: int) -> _Station:
        stations.append(_Station(tmp_path, turns))
        return stations[-1]

    yield start
    for station in stations:
        if station.process.pid:
            station.child.kill()
            station.child.wait()
        assert station.child.stderr is not None
        station.child.stderr.close()


def test_a_loop_that_hangs_is_killed_and_says_where(hanging: Callable[[int], _Station]) -> None:
    station = hanging(10)
    station.look_until(lambda: read_pulse(station.file) is not None)
    station.look_until(station.ended)
    report = station.reap()
    assert report["exit_status"] == -signal.SIGKILL
    assert report["hangs"] == 1
    assert report["served"]
    assert report["why"].startswith("hung: no heartbeat for 0.")
    (line,) = station.lines
    assert "features" in line
    assert str(station.child.pid) in line
    assert station.child.stderr is not None
    assert "a_driver_that_does_not_return" in station.child.stderr.read()


def test_a_hang_that_passed_is_not_why_it_ends_later(
    hanging: Callable[[int], _Station], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It goes on while it is being asked where it hangs, and is not killed."""
    monkeypatch.setattr(watch, "_STACKS_S", PATIENCE_S)
    station = hanging(1_000_000)
    station.look_until(lambda: read_pulse(station.file) is not None)
    os.kill(station.child.pid, signal.SIGSTOP)
    station.look_until(lambda: bool(station.lines))
    assert "hung: no heartbeat" in station.lines[0]
    before = read_pulse(station.file)
    os.kill(station.child.pid, signal.SIGCONT)
    station.look_until(lambda: read_pulse(station.file) != before)
    station.watch.look()
    station.child.kill()
    report = station.reap()
    assert (report["hangs"], report["why"]) == (0, "ended by SIGKILL")


def test_a_process_runs_from_its_first_beat(hanging: Callable[[int], _Station]) -> None:
    station = hanging(1)
    station.watch.look()
    assert station.process.config.startsecs > 1e6
    station.look_until(lambda: read_pulse(station.file) is not None)
    station.watch.look()
    assert station.process.config.startsecs == 0
    station.child.kill()
    report = station.reap()
    assert (report["hangs"], report["why"]) == (0, "ended by SIGKILL")


def test_a_process_that_is_to_stop_goes_on_first(hanging: Callable[[int], _Station]) -> None:
    station = hanging(1_000_000)
    station.look_until(lambda: read_pulse(station.file) is not None)
    os.kill(station.child.pid, signal.SIGSTOP)
    station.process.state = ProcessStates.STOPPING
    os.kill(station.child.pid, signal.SIGTERM)
    station.look_until(station.ended)
    assert station.reap()["exit_status"] == -signal.SIGTERM
    assert not station.lines, "one that stops is supervisord's to end"


def test_only_a_configuration_that_never_worked_ends_the_station() -> None:
    assert cannot_serve(served=False, exit_status=USAGE, why="ended with status 2")
    assert not cannot_serve(served=True, exit_status=USAGE, why="ended with status 2")
    assert not cannot_serve(served=False, exit_status=FAILED, why="ended with status 1")
    assert not cannot_serve(served=False, exit_status=0, why="")
