"""What is broken, how it is mended, and what must hold: the table of the chaos run.

The goals are those of the serving reference (A5) where it names one; ``own`` marks the others.
"""

from __future__ import annotations

import contextlib
import os
import random
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from tests.chaos.station import (
    CABLE,
    FOLDER,
    ROUTER,
    SENSOR,
    SOLVER,
    SUPERVISED,
    UNIT,
    ChaosStation,
    host,
    send,
)

from palpate.config import Role

Undo = Callable[[], None]
Act = Callable[[ChaosStation], Undo | None]

RESTARTED_S = 6.0
"""RestartSec of the units, and the cold start of a whole stack that is aimed at (G9) [s]."""

HUNG_UP_S = 20.0 + 2.0 + RESTARTED_S
"""WatchdogSec and TimeoutAbortSec of the station's unit come before it [s]."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One kind of fault.

    Attributes:
        name: For people.
        target: What is broken: two faults at once have different ones; ``unit`` is all of it.
        act: Breaks it; returns what mends it, None = the station mends itself.
        lasts_s: Time until it is mended [s].
        back: What tells that it is over: ``stream`` (estimates), ``ready NAME`` (its token),
            ``state NAME`` (its status), ``answers`` (the finite elements).
        goal_s: Within which time it must be over, after the fault or after it was mended [s].
        seen: What tells that somebody notices: ``token NAME``, ``state NAME``, ``lost`` (sensor),
            ``stale`` (no fresh estimate), ``steps`` (of the clock); empty = nobody need.
        seen_goal_s: Within which time [s].
        log: A regular expression that the journal or a log must have afterwards.
        own: Whether the goal is this project's own.
    """

    name: str
    target: str
    act: Act
    lasts_s: float
    back: str
    goal_s: float
    seen: str = ""
    seen_goal_s: float = 0.0
    log: str = ""
    own: bool = False


def _signal(name: str, number: signal.Signals) -> Act:
    def act(station: ChaosStation) -> None:
        pid = station.process_of(name).pid
        send(pid, number)
        station.broken.append(pid)

    return act


def _kill_worker(station: ChaosStation) -> None:
    send(station.worker().pid, signal.SIGKILL)


def _systemctl(*words: str) -> Act:
    def act(station: ChaosStation) -> None:
        station.run("systemctl", "--no-block", *words)

    return act


def _cable(station: ChaosStation) -> Undo:
    host("ip", "link", "set", CABLE, "down")
    return lambda: host("ip", "link", "set", CABLE, "up")


def _freeze_client(station: ChaosStation) -> Undo:
    client = _stranger(station, "listen", Role.ROBOT)
    assert client.stdout is not None
    client.stdout.readline()
    send(client.pid, signal.SIGSTOP)

    def end() -> None:
        client.kill()
        client.wait()

    return end


def _act_of_stranger(what: str, role: Role) -> Act:
    def act(station: ChaosStation) -> Undo:
        stranger = _stranger(station, what, role)

        def end() -> None:
            said, _ = stranger.communicate(timeout=120.0)
            with open(station.work / "strangers.jsonl", "a", encoding="utf-8") as file:
                file.write(said.strip() + "\n")

        return end

    return act


def _stranger(station: ChaosStation, what: str, role: Role) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.chaos.strangers", what, ROUTER]
    return subprocess.Popen(
        [*command, str(station.certificates / role), SENSOR], stdout=subprocess.PIPE, text=True
    )


def _fill(station: ChaosStation) -> Undo:
    filler = station.disk / "filler"
    with open(filler, "wb") as file:
        room = os.statvfs(station.disk)
        with contextlib.suppress(OSError):
            os.posix_fallocate(file.fileno(), 0, (room.f_bavail - 16) * room.f_frsize)
        with contextlib.suppress(OSError):  # and the last blocks
            while os.write(file.fileno(), bytes(4096)):
                pass
    return filler.unlink


def _limit_files(station: ChaosStation) -> Undo:
    """Every write to a file fails for the recorder."""
    pid = station.process_of("recorder").pid
    _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, hard))

    def end() -> None:
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, hard))

    return end


def _read_only(station: ChaosStation) -> Undo:
    """What the recorder has open stays open, so it is killed; the next one finds the folder so."""
    main = station.process_of("up").pid
    # With its processes: umount looks itself up in /proc.
    inside = ("nsenter", f"--target={main}", "--mount", "--pid")
    runs = f"{FOLDER}/runs"
    host(*inside, "mount", "--bind", runs, runs)
    host(*inside, "mount", "-o", "remount,bind,ro", runs)
    send(station.process_of("recorder").pid, signal.SIGKILL)
    return lambda: host(*inside, "umount", "--lazy", runs)


def _hang_disk(station: ChaosStation) -> Undo:
    where = str(station.disk)
    host("fsfreeze", "--freeze", where)
    return lambda: host("fsfreeze", "--unfreeze", where)


def _jump(offset_s: float) -> Act:
    def act(station: ChaosStation) -> Undo:
        station.set_clock(offset_s)
        return lambda: station.set_clock(0.0)

    return act


def _silence(station: ChaosStation) -> Undo:
    emulators = station.find("emulate biotac-bridge")
    for process in emulators:
        send(process.pid, signal.SIGSTOP)

    def end() -> None:
        for process in emulators:
            send(process.pid, signal.SIGCONT)

    return end


def _unplug(station: ChaosStation) -> Undo:
    station.unplug()
    return station.plug


def _of_processes() -> Iterator[Fault]:
    backs = {"router": "stream", "gateway": "stream", "features": "stream"}
    for name in SUPERVISED:
        back = backs.get(name, f"ready {name}")
        seen = "stale" if name == "router" else f"token {name}"
        for what, number, goal_s, seen_s, said in (
            ("kill", signal.SIGKILL, 3.0, 0.1, "ended by SIGKILL"),
            ("hang", signal.SIGSTOP, 10.0, 1.5, "hung"),
        ):
            yield Fault(f"{what} {name}", name, _signal(name, number), 0.0, back, goal_s, seen,
                        seen_s, rf"{name}: .*{said}")  # fmt: skip


def catalogue() -> tuple[Fault, ...]:
    """All kinds of fault."""
    unit, fem = "unit", "fem"
    main_killed = rf"{UNIT}.service: Main process exited, code=killed, status=9/KILL"
    return (
        *_of_processes(),
        Fault("kill fem", fem, _signal(fem, signal.SIGKILL), 0.0, "ready fem", 3.0, "token fem",
              0.1, rf"{SOLVER}.service: Main process exited, code=killed"),
        Fault("hang fem", fem, _signal(fem, signal.SIGSTOP), 0.0, "ready fem", 10.0, "token fem",
              1.5, rf"{SOLVER}.service: Watchdog timeout"),
        Fault("kill a solver of fem", fem, _kill_worker, 0.0, "answers", 3.0,
              log=r"worker|solver", own=True),
        Fault("kill supervisord", unit, _signal("supervisord", signal.SIGKILL), 0.0, "stream",
              RESTARTED_S, "stale", 0.1, "supervisord is gone", own=True),
        Fault("hang supervisord", unit, _signal("supervisord", signal.SIGSTOP), 0.0, "stream",
              HUNG_UP_S, "", 0.0, "supervisord does not answer", own=True),
        Fault("kill palpate up", unit, _signal("up", signal.SIGKILL), 0.0, "stream", RESTARTED_S,
              "stale", 0.1, main_killed, own=True),
        Fault("hang palpate up", unit, _signal("up", signal.SIGSTOP), 0.0, "stream", HUNG_UP_S,
              "", 0.0, rf"{UNIT}.service: Watchdog timeout", own=True),
        Fault("systemctl restart", unit, _systemctl("restart", UNIT), 0.0, "stream",
              RESTARTED_S + 2.0, "stale", 0.1, r"Stopping palpate@", own=True),
        Fault("systemctl kill, all at once", unit, _systemctl("kill", "--signal=KILL", UNIT), 0.0,
              "stream", RESTARTED_S, "stale", 0.1, main_killed, own=True),
        Fault("cable pulled for 5 s", "network", _cable, 5.0, "stream", 2.0, "stale", 0.1),
        Fault("disk full", "disk", _fill, 6.0, "state recorder", 3.0, "state recorder", 1.0,
              r"recorder.*(full|MB are free|No space)", own=True),
        Fault("disk refuses to write", "disk", _limit_files, 6.0, "state recorder", 3.0,
              "state recorder", 1.0, r"File too large|refuse", own=True),
        Fault("disk read-only when the recorder starts", "disk", _read_only, 6.0,
              "state recorder", 3.0, "state recorder", 3.0, r"Read-only", own=True),
        Fault("disk hangs for 3 s", "disk", _hang_disk, 3.0, "state recorder", 3.0, own=True),
        Fault("wall clock +1 h, and back", "clock", _jump(3600.0), 8.0, "stream", 0.2, "steps",
              2.0, r"wall clock was set by"),
        Fault("wall clock -1 h, and back", "clock", _jump(-3600.0), 8.0, "stream", 0.2, "steps",
              2.0, r"wall clock was set by"),
        Fault("sensor silent for 3 s", "sensor", _silence, 3.0, "stream", 1.0, "lost", 0.07,
              r"gateway.*(silen|lost|LOST)"),
        Fault("sensor unplugged for 3 s", "sensor", _unplug, 3.0, "stream", 1.0, "lost", 0.07,
              r"gateway.*(lost|gone|LOST|silen)"),
        Fault("400 simulations asked at once", "questions", _act_of_stranger("flood", Role.ROBOT),
              0.0, "answers", 1.0),
        Fault("5000 malformed frames", "payloads", _act_of_stranger("malformed", Role.GATEWAY),
              0.0, "stream", 1.0, "rejected", 2.0),
        Fault("a client frozen for 8 s", "client", _freeze_client, 8.0, "stream", 0.2),
    )  # fmt: skip


FREQUENT = ("kill gateway", "kill features", "kill recorder")
"""Drawn twice as often: the reference wants many of these."""

PAIR_SHARE = 0.15
_SEPARATE = ("unit", "clock", "client")
_PART = 2


def schedule(seed: int, only: str = "") -> Iterator[tuple[Fault, Fault | None, float]]:
    """Faults without end: one, the one that comes during it (None = none), the pause after [s].

    Each kind comes once before any comes twice. Those that start the unit again are kept apart, so
    that others meet a station that is up.
    """
    rng = random.Random(seed)
    faults = tuple(one for one in catalogue() if only in one.name)
    while True:
        waiting = [*faults, *(one for one in faults if one.name in FREQUENT)]
        rng.shuffle(waiting)
        since_unit = _PART
        while waiting:
            fit = [one for one in waiting if one.target != "unit" or since_unit >= _PART]
            fault = fit[0] if fit else waiting[0]
            waiting.remove(fault)
            since_unit = 0 if fault.target == "unit" else since_unit + 1
            second = None
            if fault.target not in _SEPARATE and rng.random() < PAIR_SHARE:
                others = [
                    one
                    for one in faults
                    if one.target not in (*_SEPARATE, fault.target) and one.lasts_s == 0.0
                ]
                second = rng.choice(others) if others else None
            yield fault, second, rng.uniform(3.0, 6.0)
