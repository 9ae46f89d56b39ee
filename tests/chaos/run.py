"""``make chaos``: an installed station for half an hour, while one thing after another breaks.

python -m tests.chaos.run --minutes 30 --seed 1     (as root; needs debootstrap and a network)

A Debian with a systemd that runs, palpate installed in it, a robot on another host: see
``station`` and ``observer``. What is broken, and when, follows from the seed (``faults``). The
result goes into docs/results/chaos.json, from which docs/make_chaos.py makes the page. The exit
status is 1 if a goal is missed. Interrupted, it leaves nothing but the image.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tests.chaos import debian
from tests.chaos.faults import Fault, Undo, schedule
from tests.chaos.observer import FRESH_S, read_now
from tests.chaos.station import ROUTER, SUPERVISED, ChaosStation
from tests.install.booted import groups, remove_group
from tests.install.debian import ROOT

from palpate_deploy.bench.growth import Use, use_of

OUT = ROOT / "docs" / "results" / "chaos.json"
WORK = Path("/var/cache/palpate-chaos")

PATIENCE_S = 90.0
"""So long a station may take until all is well again, before the next fault comes anyway."""

_WELL_S = 1.0
_LOOK_S = 0.1
_START_S = 420.0
_WARM_S = 10.0
_ALL = {*SUPERVISED, "fem", "supervisor"} - {"router"}


@dataclass(slots=True)
class Event:
    """A fault that was done; times of the monotonic clock [ns].

    Attributes:
        fault: Its name.
        tried_ns: Just before it was done, which may take longer than its first effect.
        begun_ns: When it was done.
        mended_ns: When it was mended; without that ``begun_ns``.
        well_ns: When all was well again; 0 = not in time.
        pair: Whether another one came during it, or it came during another one.
    """

    fault: str
    tried_ns: int
    begun_ns: int
    mended_ns: int
    well_ns: int = 0
    pair: bool = False


@dataclass(slots=True)
class Run:
    """What the program itself notes; the rest is the robot's."""

    began_ns: int = 0
    ended_ns: int = 0
    events: list[Event] = field(default_factory=list)
    uses: dict[str, dict[str, Any]] = field(default_factory=dict)
    zombies: dict[str, int] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)
    load: list[float] = field(default_factory=list)
    undone: list[str] = field(default_factory=list)


def main() -> int:
    """Make the image, run in namespaces, report; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="faults whose names contain this")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--work", type=Path, default=WORK, help="folder of the image, kept")
    parser.add_argument("--inside", metavar="DISK", default="", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.inside:
        inside(given.work, given.inside, given.minutes, given.seed, given.only)
        return 0
    debian.check_host()
    say("the image: Debian, systemd, palpate of this working tree ...")
    debian.make(given.work)
    for name in ("robot", "certs", "logs", "recordings"):
        shutil.rmtree(given.work / name, ignore_errors=True)
    for name in ("run.json", "strangers.jsonl", "emulator.log"):
        (given.work / name).unlink(missing_ok=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with debian.disk(given.work) as disk:
        status = _in_namespaces(given, disk)
    if status:
        return status
    from tests.chaos.report import report  # what it needs is not there inside

    result = report(given.work, given.minutes, given.seed)
    given.out.parent.mkdir(parents=True, exist_ok=True)  # else half an hour is lost
    given.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    say(f"wrote {given.out}")
    for goal in result["goals"]:
        say(f"{'met   ' if goal['met'] else 'MISSED'} {goal['what']}: {goal['found']}")
    return int(not all(goal["met"] for goal in result["goals"]))


def _in_namespaces(given: argparse.Namespace, disk: str) -> int:
    """Run ``inside`` as the first process of namespaces: with it everything ends."""
    group = f"palpate-chaos-{os.getpid()}"
    words = ["--mount", "--net", "--pid", "--fork", "--kill-child", "--mount-proc"]
    process = subprocess.Popen(
        ["unshare", *words, sys.executable, "-m", "tests.chaos.run", "--inside", disk,
         "--minutes", str(given.minutes), "--seed", str(given.seed), "--only", given.only,
         "--work", str(given.work)],
        cwd=ROOT,
        env={**os.environ, "CHAOS_GROUP": group},
    )  # fmt: skip
    try:
        return process.wait()
    finally:
        process.kill()
        process.wait()
        remove_group(groups() / group)


def inside(work: Path, disk: str, minutes: float, seed: int, only: str) -> None:
    """Start the station and the robot, break things, and save what is needed for the report."""
    run = Run()
    robot = work / "robot"
    with ChaosStation(work / "root", work, disk, os.environ["CHAOS_GROUP"]) as station:
        say("palpate install, systemctl start ...")
        station.start()
        words = (ROUTER, str(station.certificates / "robot"), str(robot))
        observer = subprocess.Popen([sys.executable, "-m", "tests.chaos.observer", *words])
        try:
            if not _await(robot, _START_S):
                raise SystemExit(f"the station does not become well: {read_now(robot)}")
            _until(time.monotonic() + _WARM_S)
            run.began_ns = time.monotonic_ns()
            run.uses["start"] = uses(station)
            there = set(station.leavings())
            say("all is well; it begins")
            _break(station, robot, run, minutes, seed, only)
            _until(time.monotonic() + _WARM_S)
            run.ended_ns = time.monotonic_ns()
            run.uses["end"] = uses(station)
            run.zombies = dict(
                Counter(one.command or "?" for one in station.processes() if one.state == "Z")
            )
            if observer.poll() is not None:
                raise SystemExit(f"the robot ended with {observer.returncode}")
        finally:
            (work / "run.json").write_text(json.dumps(asdict(run)), encoding="utf-8")
            observer.terminate()
            observer.wait(60.0)
        say("stopping, saving logs and recordings ...")
        run.left = sorted(set(station.save()) - there)
        (work / "run.json").write_text(json.dumps(asdict(run)), encoding="utf-8")


def _break(
    station: ChaosStation, robot: Path, run: Run, minutes: float, seed: int, only: str
) -> None:
    end_s = time.monotonic() + 60.0 * minutes
    began_s = time.monotonic()
    for fault, second, pause_s in schedule(seed, only):
        if time.monotonic() > end_s:
            return
        run.load.append(os.getloadavg()[0])
        events = []
        try:
            events.append(_begin(station, fault))
            if second is not None:
                _until(time.monotonic() + 0.5)
                events.append(_begin(station, second))
        except OSError as error:  # this host cannot
            run.undone.append(f"{fault.name}: {error}")
            say(f"not done: {error}")
            if not events:
                continue
            second = None
        for event, undo in reversed(events):
            chosen = fault if event.fault == fault.name else second
            assert chosen is not None
            _until(event.begun_ns * 1e-9 + chosen.lasts_s)
            if undo is not None:
                try:
                    undo()
                except OSError as error:
                    run.undone.append(f"{event.fault}: {error}")
                event.mended_ns = time.monotonic_ns()
        _until_gone(station.broken)
        well_ns = _await(robot, PATIENCE_S)
        for event, _ in events:
            event.well_ns, event.pair = well_ns, second is not None
            run.events.append(event)
        took_s = (well_ns - events[0][0].mended_ns) * 1e-9 if well_ns else float("nan")
        names = " + ".join(event.fault for event, _ in events)
        minute = (time.monotonic() - began_s) / 60.0
        say(f"{minute:5.1f} min  {len(run.events):3}  {names}: well after {took_s:.1f} s")
        _until(time.monotonic() + pause_s)


def _begin(station: ChaosStation, fault: Fault) -> tuple[Event, Undo | None]:
    """Do it. What is being started again anyway is waited for."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        # Of what takes a while itself, the begin counts from its effect.
        before_ns = time.monotonic_ns()
        try:
            undo = fault.act(station)
        except LookupError:
            if time.monotonic() > deadline_s:
                raise OSError(f"{fault.name}: nothing to break there") from None
            time.sleep(_LOOK_S)
            continue
        begun_ns = before_ns if undo is None else time.monotonic_ns()
        return Event(fault.name, before_ns, begun_ns, begun_ns), undo


def _until_gone(broken: list[int]) -> None:
    """Wait until what was killed or stopped has been ended by whoever watches it."""
    deadline_s = time.monotonic() + PATIENCE_S
    while broken and time.monotonic() < deadline_s:
        broken[:] = [pid for pid in broken if use_of(pid) is not None]
        time.sleep(_LOOK_S)
    broken.clear()


def _until(due_s: float) -> None:
    time.sleep(max(0.0, due_s - time.monotonic()))


def _await(robot: Path, patience_s: float) -> int:
    """Wait until the robot finds all well for a second; since when [ns], 0 = it does not."""
    deadline_s = time.monotonic() + patience_s
    since_ns = 0
    while time.monotonic() < deadline_s:
        now = read_now(robot)
        well = bool(now) and (
            time.monotonic_ns() - now["at_ns"] < 2e9
            and now["age_s"] is not None
            and now["age_s"] < 5 * FRESH_S
            and _ALL <= set(now["ready"])
            and now["answered_s"] < 3.0
            # Gateway and estimating services come and go where this host is busy: the age counts.
            and not [
                one
                for one in ("recorder", "supervisor", "fem")
                if now["states"].get(one) == "DEGRADED"
            ]
        )
        if not well:
            since_ns = 0
        elif not since_ns:
            since_ns = time.monotonic_ns()
        elif time.monotonic_ns() - since_ns > _WELL_S * 1e9:
            return since_ns
        time.sleep(_LOOK_S)
    return 0


def uses(station: ChaosStation) -> dict[str, Any]:
    """Memory, threads and descriptors by process, and how many processes there are."""
    found: dict[str, Any] = {}
    for name in (*SUPERVISED, "fem", "supervisord", "up"):
        use = use_of(station.process_of(name).pid)
        assert isinstance(use, Use)
        found[name] = asdict(use)
    found["worker"] = asdict(use_of(station.worker().pid) or Use(0, 0, 0))
    return {"processes": found, "count": len(station.find("/opt/palpate"))}


def say(text: str) -> None:
    """A line on the screen."""
    sys.stderr.write(f"{time.strftime('%H:%M:%S')} {text}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
