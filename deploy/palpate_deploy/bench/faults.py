"""``palpate bench faults``: what a station does when something around it goes wrong.

Each row breaks one thing from outside, in a station of its own, and measures what others notice of
it. The goals are those of the serving reference (A5). Processes that are killed or hang have a
benchmark of their own (``palpate bench restart``), as have exchanged models (``bench swap``).
"""

from __future__ import annotations

import contextlib
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from palpate import clock
from palpate.bus import Delivery
from palpate.bus.topics import ELECTRODES, FEATURES, STATUS
from palpate.errors import ConfigError, PalpateError, StaleError, StreamTimeout
from palpate.messages import SensorState, ServiceState
from palpate.process import resident_bytes
from palpate_deploy.bench.fault_station import (
    RECOVERY_S,
    SENSOR,
    FaultStation,
    Figures,
    seconds_until,
)
from palpate_deploy.bench.results import finish, progress_bar
from palpate_deploy.bench.strangers import bad_sequences, hostile_payloads, query_flood

FAKETIME = (
    "/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1",
    "/usr/lib/aarch64-linux-gnu/faketime/libfaketime.so.1",
)
"""Where Debian's package ``libfaketime`` puts its library."""

LOST = SensorState.LOST


@dataclass(frozen=True, slots=True)
class FaultResult:
    """One row.

    Attributes:
        fault: What was broken.
        goal: What must hold.
        met: Whether it did; None = it could not be tried on this host, ``why`` says why.
        figures: What was measured; names end in the unit.
        why: Why it was not tried, or what ended the trial.
    """

    fault: str
    goal: str
    met: bool | None
    figures: Figures
    why: str = ""


@dataclass(frozen=True, slots=True)
class FaultTrial:
    """A row before it is tried: ``run`` gets the duration of its quiet parts [s]."""

    name: str
    goal: str
    run: Callable[[float], tuple[bool, Figures]]


class _Untried(Exception):
    """This host cannot try a row."""


def router_killed(seconds: float) -> tuple[bool, Figures]:
    """The router is gone for five seconds: links between processes go on, new ones resume."""
    with FaultStation() as station:
        names = ("features", "recorder", "gateway")
        before = {name: station.pid(name) for name in names}
        mark = station.observer.mark()
        station.kill("router", signal.SIGKILL)
        time.sleep(5.0)
        station.start("router")
        started_s = time.monotonic()
        back_s = seconds_until(station.observer.session.has_router)
        with station.fresh_session() as session:

            def all_there() -> bool:
                return {one.service for one in session.alive() if one.ready} >= set(names)

            joined_s = time.monotonic() - started_s
            found_s = joined_s + seconds_until(all_there)
        station.check(*names)
        same = before == {name: station.pid(name) for name in names}
        account = station.observer.account(mark)
    met = found_s <= 2.0 and same and account.lost == 0
    return met, {"resumed_s": back_s, "all_found_s": found_s, **account.figures()}


def subscriber_frozen(seconds: float) -> tuple[bool, Figures]:
    """A robot's client is stopped: nobody else may notice, and nothing may pile up."""
    rounds = 3
    with FaultStation() as station:
        pids = {name: station.pid(name) for name in ("gateway", "features", "router")}
        quiet, frozen, grew = [], [], Counter[str]()
        for index in range(rounds):
            mark = station.observer.mark()
            time.sleep(seconds)
            quiet.append(station.observer.account(mark))
            station.start_client(f"client{index}")
            time.sleep(2.0)
            resident = {name: resident_bytes(pid) for name, pid in pids.items()}
            mark = station.observer.mark()
            station.kill(f"client{index}", signal.SIGSTOP)
            time.sleep(seconds)
            frozen.append(station.observer.account(mark))
            for name, pid in pids.items():
                grew[name] = max(grew[name], resident_bytes(pid) - resident[name])
            station.kill(f"client{index}", signal.SIGKILL)
        medians = [
            sorted(account.p99_s for account in side)[rounds // 2] for side in (quiet, frozen)
        ]
    lost = sum(account.lost for account in frozen)
    ratio = medians[1] / medians[0]
    figures: Figures = {
        "p99_quiet_s": medians[0],
        "p99_frozen_s": medians[1],
        "p99_ratio": ratio,
        "lost": lost,
        "longest_gap_s": max(account.longest_gap_s for account in frozen),
        **{f"{name}_grew_bytes": count for name, count in grew.items()},
    }
    return ratio <= 1.1 and lost == 0 and max(grew.values()) < 8 << 20, figures


def _small_disk(folder: Path, size_mib: int) -> tuple[str, ...]:
    """Words that run a command with a small disk of its own at a folder."""
    script = f'mount -t tmpfs -o size={size_mib}m tmpfs "$1" && shift && exec "$@"'
    return (
        "unshare",
        "--user",
        "--map-root-user",
        "--mount",
        "sh",
        "-c",
        script,
        "sh",
        str(folder),
    )


def _disk_trial(
    seconds: float, break_it: Callable[[Path, int], None], mend: Callable[[Path, int], None]
) -> tuple[bool, Figures]:
    with tempfile.TemporaryDirectory(prefix="palpate-disk-") as name:
        folder = Path(name)
        with FaultStation(
            recorder={"out": name, "min_free_bytes": 2 << 20},
            prefix={"recorder": _small_disk(folder, 24)},
        ) as station:
            pid = station.pid("recorder")
            inside = Path(f"/proc/{pid}/root{name}")
            if not list(inside.glob("*.mcap*")):
                raise _Untried("this host allows no file systems of one's own (unshare --mount)")
            says = station.observer.session.subscriber(STATUS, service="recorder")
            mark = station.observer.mark()
            time.sleep(seconds)
            quiet = station.observer.account(mark)
            mark = station.observer.mark()
            break_it(inside, pid)
            told_s = seconds_until(lambda: _state_said(says) is ServiceState.DEGRADED)
            time.sleep(seconds)
            broken = station.observer.account(mark)
            mend(inside, pid)
            resumed_s = seconds_until(lambda: _state_said(says) is ServiceState.READY)
            time.sleep(1.0)
            station.check("recorder", "features", "gateway")
            status = station.stop_one("recorder")
    ratio = broken.p99_s / quiet.p99_s
    figures: Figures = {
        "told_s": told_s,
        "resumed_s": resumed_s,
        "p99_ratio": ratio,
        "recorder_exit_status": status,
        **broken.figures(),
    }
    return told_s <= 1.5 and resumed_s < RECOVERY_S and broken.lost == 0 and status == 0, figures


def _state_said(says: Any) -> ServiceState | None:
    """The newest state that a process has published; None = nothing new."""
    state = None
    with contextlib.suppress(StreamTimeout):
        while True:
            state = says.next(0.0).message.state
    return state


def disk_full(seconds: float) -> tuple[bool, Figures]:
    """The disk of the records is full, and has space again."""

    def fill(inside: Path, pid: int) -> None:
        with contextlib.suppress(OSError), open(inside / "filler", "wb", buffering=0) as file:
            while file.write(bytes(1 << 20)):
                pass

    return _disk_trial(seconds, fill, lambda inside, pid: (inside / "filler").unlink())


def disk_refuses(seconds: float) -> tuple[bool, Figures]:
    """Every write to a file fails for the recorder (a limit of the system), and works again."""

    def limit(pid: int, size: int) -> None:
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, hard))

    return _disk_trial(
        seconds,
        lambda inside, pid: limit(pid, 1),
        lambda inside, pid: limit(pid, resource.RLIM_INFINITY),
    )


def wall_clock_jumps(seconds: float) -> tuple[bool, Figures]:
    """The wall clock of the station jumps by an hour, forth and back, and then runs fast."""
    library = next((path for path in FAKETIME if Path(path).is_file()), None)
    if library is None:
        raise _Untried("libfaketime is not installed (Debian: apt install libfaketime)")
    with tempfile.TemporaryDirectory(prefix="palpate-clock-") as name:
        told = Path(name) / "time"
        told.write_text("+0\n", encoding="ascii")
        words = (
            "env",
            f"LD_PRELOAD={library}",
            f"FAKETIME_TIMESTAMP_FILE={told}",
            "FAKETIME_CACHE_DURATION=1",
            "FAKETIME_DONT_FAKE_MONOTONIC=1",
            "DONT_FAKE_MONOTONIC=1",
        )
        fake = dict.fromkeys(("gateway", "features", "recorder"), words)
        with FaultStation(prefix=fake) as station:
            mark = station.observer.mark()
            time.sleep(4 * seconds)
            # The library slows every process that waits; without jumps this is the same.
            quiet = station.observer.account(mark)
            mark = station.observer.mark()
            for offset in ("+3600", "-3600", "+0", "+0 x1.0005"):
                time.sleep(seconds)
                # In one step: the library reads the file once a second.
                part = told.with_suffix(".new")
                part.write_text(f"{offset}\n", encoding="ascii")
                part.replace(told)
            time.sleep(seconds)
            station.check("gateway", "features", "recorder")
            account = station.observer.account(mark)
            counters = station.counters("gateway")
            dropped = station.refusals()
    steps = counters.get("wall_steps", 0)
    figures: Figures = {
        "wall_steps_told": steps,
        "refused": dropped,
        "youngest_s": account.youngest_s,
        "quiet_lost": quiet.lost,
        **account.figures(),
    }
    sound = account.lost <= quiet.lost and account.disordered == 0 and account.youngest_s >= 0.0
    return sound and steps >= 3, figures


def sensor_silent(seconds: float) -> tuple[bool, Figures]:
    """A BioTac on a serial line stops sending, and goes on after three seconds."""
    with tempfile.TemporaryDirectory(prefix="palpate-line-") as name:
        line = f"{name}/bridge"
        sensor = {"driver": "biotac_bridge", "options": {"line": line, "source": 1, "port": 1}}
        emulator = ("biotac-bridge", "--link", line, "--fingers", 1, "--play", "press")
        with FaultStation(sensor=sensor, emulator=emulator) as station:
            time.sleep(seconds)
            session = station.observer.session
            says = session.subscriber(STATUS, service="gateway", delivery=Delivery.QUEUE)
            newest = session.subscriber(FEATURES, sensor=SENSOR)
            frames = session.subscriber(ELECTRODES, sensor=SENSOR, delivery=Delivery.QUEUE)
            time.sleep(0.5)
            station.kill("emulator", signal.SIGSTOP)
            stopped_s = time.monotonic()
            told_ns = stale_used = 0
            while time.monotonic() < stopped_s + 3.0:
                with contextlib.suppress(StreamTimeout):
                    status = says.next(0.0)
                    lost = [one for one in status.message.sensor_states if one.state is LOST]
                    if lost and not told_ns:
                        told_ns = status.received_monotonic_ns
                with contextlib.suppress(StaleError):
                    stamp = newest.latest(max_age_s=0.03).message.source
                    stale_used += clock.age_s(stamp) > 0.035  # of which reading takes a little
                time.sleep(0.002)
            last_ns = 0
            with contextlib.suppress(StreamTimeout):
                while True:
                    last_ns = frames.next(0.0).message.stamp.monotonic_ns
            station.kill("emulator", signal.SIGCONT)
            back_s = station.observer.wait_for_next(taken_after_ns=time.monotonic_ns())
            station.check("gateway", "features")
    told_s = (told_ns - last_ns) * 1e-9 if told_ns else float("inf")
    figures: Figures = {"told_lost_s": told_s, "stale_used": stale_used, "back_s": back_s}
    # A frame lasts 10 ms and is published after its last slot.
    return told_s <= 0.07 and not stale_used and back_s <= 1.0, figures


TRIALS = tuple(
    FaultTrial(name, goal, run)
    for name, goal, run in (
        (
            "router killed for 5 s",
            "all found again <= 2 s after its return, 0 lost, no process restarted",
            router_killed,
        ),
        (
            "subscriber frozen",
            "p99 of others <= 1.1 times, 0 lost, no memory piles up",
            subscriber_frozen,
        ),
        ("disk full", "told <= 1.5 s, no estimate lost, resumes by itself", disk_full),
        (
            "disk refuses to write",
            "told <= 1.5 s, no estimate lost, resumes by itself",
            disk_refuses,
        ),
        (
            "sensor silent for 3 s",
            "LOST told <= 70 ms after the last frame, nothing stale used, back <= 1 s",
            sensor_silent,
        ),
        (
            "wall clock jumps +-1 h, runs 500 ppm fast",
            "none lost by it, no negative age, each jump counted",
            wall_clock_jumps,
        ),
        (
            "repeated, old, jumping, future frames",
            "refused and told, a bad frame costs at most one good one",
            bad_sequences,
        ),
        (
            "hostile payloads, 2000 a second",
            "refused and told, no crash, no growth, <= 1 % of good frames lost",
            hostile_payloads,
        ),
        (
            "1600 questions at once",
            "each answered, the rest refused and typed, over <= 1 s, 0 lost",
            query_flood,
        ),
    )
)
"""All rows, in the order of the table."""


def run_faults(*, seconds: float, only: str, as_json: bool, save: bool, out: Path | None) -> int:
    """``palpate bench faults``, whose help explains the options; 1 if a goal is missed.

    Raises:
        ConfigError: No row's name contains ``only``.
    """
    chosen = [trial for trial in TRIALS if only in trial.name]
    if not chosen:
        raise ConfigError(
            f"no fault is named {only!r}",
            remedy=f"one of: {'; '.join(trial.name for trial in TRIALS)}",
        )
    results = []
    with progress_bar() as bar:
        task = bar.add_task("faults", total=len(chosen))
        for trial in chosen:
            bar.update(task, description=trial.name)
            results.append(_tried(trial, seconds))
            bar.advance(task)
    values = {"faults": [asdict(result) for result in results]}
    finish("faults", values, lambda: _print(results), as_json=as_json, save=save, out=out)
    return int(any(result.met is False for result in results))


def _tried(trial: FaultTrial, seconds: float) -> FaultResult:
    try:
        met, figures = trial.run(seconds)
    except _Untried as reason:
        return FaultResult(trial.name, trial.goal, None, {}, str(reason))
    except PalpateError as error:
        print(f"{trial.name}: {error}", file=sys.stderr)
        return FaultResult(trial.name, trial.goal, False, {}, str(error))
    return FaultResult(trial.name, trial.goal, met, figures)


def _print(results: list[FaultResult]) -> None:
    table = Table(title="faults around a station of one finger at 100 Hz", title_justify="left")
    for column in ("fault", "goal", "met", "measured"):
        table.add_column(column, overflow="fold")
    words = {True: "[green]yes[/]", False: "[red]no[/]", None: "[yellow]not tried[/]"}
    for result in results:
        measured = ", ".join(f"{name} {_number(value)}" for name, value in result.figures.items())
        table.add_row(result.fault, result.goal, words[result.met], measured or result.why)
    Console(highlight=False).print(table)


def _number(value: float | int | str) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
