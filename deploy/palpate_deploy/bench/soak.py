"""``palpate bench soak``: a whole station for half an hour; does anything grow, is anything lost?

The station runs under its supervisor, as users run it: several virtual fingers, all estimating
services, a recorder that rotates and removes old records every few minutes, and a client that takes
every estimate. Its processes are looked at from outside, every two seconds.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import tomli_w
from rich.console import Console
from rich.table import Table

from palpate.bus import Delivery, Session, Subscriber
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, SYNTHESIS
from palpate.errors import ConfigError, ErrorCode, RemoteError, StreamTimeout
from palpate.files.atomic import written_whole
from palpate.process import check_installed, require, stop_on_signals
from palpate_deploy.bench.growth import (
    BINS,
    MEGABYTE,
    Growth,
    History,
    Verdict,
    growths,
    processes_below,
    use_of,
)
from palpate_deploy.bench.results import finish, progress_bar
from palpate_deploy.station.host import join, private_profile
from palpate_deploy.station.logs import FAILED
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import Profile, plain_values
from palpate_deploy.station.status import ask_status

SAMPLE_S = 2.0
WARM_UP_SHARE = 1 / 3
WARM_UP_MOST_S = 600.0
"""Caches, arenas and the first record fill in this time [s], or in a third of a shorter run."""

ROTATE_S = 120.0
KEEP_BYTES = 256 << 20

_START_S = 120.0
_ATTEMPTS = 5
_ENDED_S = 5.0
"""Frames that have not come for so long have ended [s]."""

_ON_THE_WAY = 100
"""So many frames may wait for their features."""

_TOPICS = (ELECTRODES, FEATURES, FIELD, SYNTHESIS)
_LOSSES = ("lost", "overflow", "dropped", "disk_failures", "view_failed", "removal_failures")


@dataclass(frozen=True, slots=True)
class SoakResult:
    """A long run of a whole station.

    Attributes:
        minutes: Duration after the start [min].
        warm_up_minutes: How much of it the verdicts leave out [min].
        fingers: Virtual fingers.
        processes: Growth by process.
        received: Messages that the client got, by topic.
        lost: What the client missed, and what any process counted as lost, both after the warm-up;
            and 1 for each stream of a finger of which nothing came, and each process that was not
            there all the time.
        disk_peak_mb: Most that records and views took [MB]; ``disk_limit_mb`` is what the settings
            allow: what is kept, and the record that is being written with its view.
        disk_mb_per_h: What the recorder wrote in an hour, with the views [MB/h].
        removed_records: Records that the recorder removed.
    """

    minutes: float
    warm_up_minutes: float
    fingers: int
    processes: dict[str, Growth]
    received: dict[str, int]
    lost: dict[str, int]
    disk_peak_mb: float
    disk_limit_mb: float
    disk_mb_per_h: float
    removed_records: int

    @property
    def fine(self) -> bool:
        """Whether nothing is seen to grow, nothing was lost and the disk is bounded."""
        return (
            all(growth.fine for growth in self.processes.values())
            and not self.lost
            and self.disk_peak_mb <= self.disk_limit_mb
        )

    @property
    def met(self) -> bool:
        """Whether the goal is met: of every process it is known that it does not grow."""
        return self.fine and self.decided

    @property
    def decided(self) -> bool:
        """Whether the run was long enough to tell the growth of every process."""
        return all(one.verdict is not Verdict.UNDECIDED for one in self.processes.values())


class _Client:
    """A robot's client that takes every message of all fingers, in threads of its own."""

    def __init__(self, session: Session) -> None:
        self.received: Counter[tuple[str, str]] = Counter()  # by topic and sensor
        self.begun_s = time.monotonic()
        self._holes = 0
        self._first: dict[str, int] = {}
        self._newest: dict[str, tuple[int, float]] = {}  # sequence and arrival [s]
        self._answered: dict[str, int] = {}
        self._stop = threading.Event()
        self._streams = {
            topic.name: session.subscriber(topic, delivery=Delivery.QUEUE) for topic in _TOPICS
        }
        self._threads = [
            threading.Thread(target=self._take, args=item, name=f"soak-{item[0]}", daemon=True)
            for item in self._streams.items()
        ]
        for thread in self._threads:
            thread.start()

    def _take(self, name: str, stream: Subscriber[Any]) -> None:
        while not self._stop.is_set():
            try:
                received = stream.next(0.5)
            except StreamTimeout:
                continue
            sensor = received.sensor
            if name == ELECTRODES.name:
                sequence = received.message.stamp.sequence
                self._first.setdefault(sensor, sequence)
                self._newest[sensor] = sequence, time.monotonic()
            elif name == FEATURES.name:
                # A tare leaves a hole, which the bus does not count; here it comes at the start.
                sequence = received.message.source.sequence
                hole = sequence - self._answered.get(sensor, sequence - 1) - 1
                self._holes += max(hole, 0)
                self._answered[sensor] = sequence
            self.received[name, sensor] += 1

    def lost(self) -> Counter[str]:
        """What did not arrive, by topic and cause; fields and syntheses are of some frames only."""
        lost: Counter[str] = Counter()
        for name, stream in self._streams.items():
            counters = stream.counters
            lost[f"client {name} overflow"] = counters.get("overflow", 0)
            if name == ELECTRODES.name:
                lost[f"client {name} lost_on_bus"] = counters.get("lost_on_bus", 0)
        # A stream that has ended leaves no hole.
        without, ended = self._holes, 0
        for sensor, (newest, arrived_s) in self._newest.copy().items():  # the threads go on
            first = self._first[sensor]
            behind = newest - self._answered.get(sensor, first - 1)
            without += behind if behind > _ON_THE_WAY else 0
            if (silent_s := time.monotonic() - arrived_s) > _ENDED_S:
                rate_hz = (newest - first) / max(arrived_s - self.begun_s, SAMPLE_S)
                ended += max(round(silent_s * rate_hz), 1)
        lost["client frames without features"] = without
        lost["client electrodes ended"] = ended
        return lost

    def close(self) -> None:
        """Stop the threads."""
        self._stop.set()
        for thread in self._threads:
            thread.join(5.0)


def soak_profile(folder: Path, fingers: int, *, fem: bool) -> Profile:
    """A station with so many virtual fingers, whose recorder rotates and removes quickly."""
    sensors = [
        {
            "name": f"finger{number}",
            "driver": "virtual",
            "options": {"seed": 7 + number, "unit": "biotac-2"},
        }
        for number in range(1, fingers + 1)
    ]
    profile = private_profile(
        "virtual",
        gateway={"sensors": sensors},
        recorder={
            "out": str(folder / "records"),
            "rotate_s": ROTATE_S,
            "rotate_bytes": KEEP_BYTES // 4,
            "keep_bytes": KEEP_BYTES,
        },
        log={"level": "warning"},
    )
    if fem:
        profile = profile.model_copy(update={"processes": (*profile.processes, "fem")})
    return profile


def measure_soak(
    minutes: float, fingers: int, *, fem: bool
) -> tuple[SoakResult, dict[str, History], list[tuple[float, int]]]:
    """Run the station, and look at it; returns also the samples, and the disk's over time.

    Raises:
        RemoteError: The station does not become ready.
        LinkError: It has no router.
    """
    with ExitStack() as stack:
        stop = stop_on_signals()
        run = stack.enter_context(FiniteRun("bench-soak"))
        profile = soak_profile(run.folder, fingers, fem=fem)
        path = run.folder / "station.toml"
        path.write_text(tomli_w.dumps(plain_values(profile)), encoding="utf-8")
        run.start_module("up", "__main__", "up", "--profile", path)
        session = stack.enter_context(join(profile, wait_s=_START_S))
        _wait_ready(session, profile, run.log("up"))
        client = _Client(session)
        stack.callback(client.close)
        bar = stack.enter_context(progress_bar())
        warm_up_s = min(60.0 * minutes * WARM_UP_SHARE, WARM_UP_MOST_S)
        watched = _Watch(run.pid("up"), profile, session, client, warm_up_s)
        task = bar.add_task("soak", total=minutes)
        while (gone_s := watched.look()) < 60.0 * minutes:
            bar.update(task, completed=gone_s / 60.0)
            run.check(["up"])
            if stop.wait(SAMPLE_S):
                raise KeyboardInterrupt  # the station is stopped on the way out
        return watched.result(fingers), watched.histories, watched.disk


def _wait_ready(session: Session, profile: Profile, log: Path) -> None:
    wanted = set(profile.processes) - {"router"}
    deadline = time.monotonic() + _START_S
    while wanted - {one.service for one in session.alive() if one.ready}:
        if time.monotonic() > deadline:
            raise RemoteError(
                f"the station is not ready within {_START_S:g} s",
                remedy=f"see {log}",
                code=ErrorCode.UNAVAILABLE,
            )
        time.sleep(0.2)


class _Watch:
    """Samples of a running station since its begin; losses count after ``warm_up_s``."""

    def __init__(
        self, root: int, profile: Profile, session: Session, client: _Client, warm_up_s: float
    ) -> None:
        self.histories: dict[str, History] = {}
        self.disk: list[tuple[float, int]] = []
        self._root = root
        self._profile = profile
        self._session = session
        self._client = client
        self._warm_up_s = warm_up_s
        self._begun_s = time.monotonic()
        self._before: Counter[str] | None = None
        self._received_before: Counter[tuple[str, str]] = Counter()
        self._totals()  # the first question takes a megabyte of each process, which is no growth

    def look(self) -> float:
        """Take a sample; returns how long it has been going on [s]."""
        now_s = time.monotonic() - self._begun_s
        for name, pid in processes_below(self._root).items():
            use = use_of(pid)
            if use is not None:
                self.histories.setdefault(name, History()).add(now_s, pid, use)
        self.disk.append((now_s, _size(self._profile.recorder.out)))
        if self._before is None and now_s >= self._warm_up_s:
            self._before = self._losses(self._totals())
            self._received_before = self._client.received.copy()
        return now_s

    def result(self, fingers: int) -> SoakResult:
        """The verdicts."""
        totals = self._totals()
        lost = self._losses(totals)
        lost.subtract(self._before or Counter())
        received = self._client.received.copy()
        names = [sensor.name for sensor in self._profile.gateway.sensors]
        for key in product((topic.name for topic in _TOPICS), names):
            lost[f"client all {key[0]} of {key[1]}"] += received[key] <= self._received_before[key]
        seconds, size = self.disk[-1]
        processes = growths(self.histories, self._warm_up_s)
        for name, history in self.histories.items():
            there = name in processes and history.times_s[-1] >= seconds
            lost[f"{name} not there all the time"] += not there
        by_topic: Counter[str] = Counter()
        for (name, _), count in received.items():
            by_topic[name] += count
        written = size + totals["recorder removed_bytes"]
        recorder = self._profile.recorder
        return SoakResult(
            minutes=seconds / 60.0,
            warm_up_minutes=self._warm_up_s / 60.0,
            fingers=fingers,
            processes=processes,
            received=dict(by_topic),
            lost={name: count for name, count in sorted(lost.items()) if count > 0},
            disk_peak_mb=max(size for _, size in self.disk) / MEGABYTE,
            # Old records are removed when a new one begins: it and its view come on top.
            disk_limit_mb=(recorder.keep_bytes + 2 * recorder.rotate_bytes) / MEGABYTE,
            disk_mb_per_h=written / MEGABYTE / seconds * 3600.0,
            removed_records=totals["recorder removed_records"],
        )

    def _totals(self) -> Counter[str]:
        """Counters of all processes; a process that does not answer is asked again.

        One that never does has lost something: its counters. The rest of a long run is kept.
        """
        totals: Counter[str] = Counter()
        wanted = set(self._profile.processes) - {"router"}
        for _ in range(_ATTEMPTS):
            for status in ask_status(self._session, timeout_s=5.0):
                wanted.discard(status.service)
                for name, count in status.counters.items():
                    totals[f"{status.service} {name}"] = count
            if not wanted:
                return totals
        return totals + Counter(f"{name} counters lost: no answer" for name in wanted)

    def _losses(self, totals: Counter[str]) -> Counter[str]:
        told = {k: n for k, n in totals.items() if any(word in k for word in _LOSSES)}
        return Counter(told) + self._client.lost()


def _size(folder: Path) -> int:
    """Bytes of a folder's files."""
    total = 0
    for path in folder.glob("*"):
        with contextlib.suppress(OSError):  # removed or renamed meanwhile
            total += path.stat().st_size
    return total


def run_soak(
    *, minutes: float, fingers: int, fem: bool, out: Path | None, as_json: bool, save: bool
) -> int:
    """Measure, print, and write JSON and a picture.

    Returns:
        1 if something grows or was lost, or if the run was too short to tell.

    Raises:
        PalpateError: The station does not start or a process of it ends.
        MissingExtraError: matplotlib is not installed, and there is something to draw.
    """
    if 60.0 * minutes * (1 - WARM_UP_SHARE) < 3 * BINS * SAMPLE_S:
        raise ConfigError(
            f"{minutes:g} minutes are too short to see growth", remedy="give 2 minutes or more"
        )
    if out is not None:
        check_installed("matplotlib", extra="training")
    result, histories, disk = measure_soak(minutes, fingers, fem=fem)
    values = {
        "soak": asdict(result),
        "soak.goal_met": result.met,
        "soak.long_enough": result.decided,
    }
    finish("soak", values, lambda: show(result), as_json=as_json, save=save, out=out)
    if out is not None:
        draw(histories, disk, result, out.with_suffix(".png"))
    return 0 if result.met else FAILED


def show(result: SoakResult) -> None:
    """Print it for people."""
    table = Table(
        title=f"{result.fingers} fingers for {result.minutes:.0f} minutes, of which "
        f"{result.warm_up_minutes:.0f} warm-up",
        title_justify="left",
    )
    for column in ("process", "MB", "MB/h", "+-", "memory", "threads", "descriptors"):
        table.add_column(column, justify="left" if column in ("process", "memory") else "right")
    for name, one in result.processes.items():
        table.add_row(
            name,
            f"{one.rss_mb:.1f}",
            f"{one.slope_mb_per_h:+.2f}",
            f"{one.slope_ci95_mb_per_h:.2f}",
            one.verdict if not one.restarts else f"restarted {one.restarts} times",
            "{} -> {}".format(*one.threads),
            "{} -> {}".format(*one.descriptors),
        )
    console = Console(highlight=False)
    console.print(table)
    lost = ", ".join(f"{name} {count}" for name, count in result.lost.items()) or "nothing"
    got = ", ".join(f"{count:,} {name}" for name, count in sorted(result.received.items()))
    console.print(f"the client got {got}; lost after the warm-up: {lost}", soft_wrap=True)
    console.print(
        f"records and views took {result.disk_peak_mb:.0f} MB at most, "
        f"{result.disk_limit_mb:.0f} are allowed; {result.disk_mb_per_h:.0f} MB/h were written, "
        f"{result.removed_records} records removed",
        soft_wrap=True,
    )
    if not result.decided:
        console.print("some slopes are not known well enough: run it for longer", soft_wrap=True)


def draw(
    histories: Mapping[str, History],
    disk: Sequence[tuple[float, int]],
    result: SoakResult,
    picture: Path,
) -> None:
    """Draw memory of all processes, and the disk, over time.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure_module = require("matplotlib.figure", extra="training")
    figure = figure_module.Figure(figsize=(11, 7), facecolor="white", layout="constrained")
    memory, room = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    for name, history in sorted(histories.items()):
        minutes = [time_s / 60.0 for time_s in history.times_s]
        memory.plot(minutes, [use.rss_bytes / MEGABYTE for use in history.uses], lw=1, label=name)
    memory.axvspan(
        0.0, result.warm_up_minutes, color="#eeeeee", zorder=0, label="warm-up, not counted"
    )
    memory.set_ylabel("resident memory [MB]")
    memory.set_ylim(bottom=0)
    memory.legend(ncols=4, fontsize=9, frameon=False, loc="lower right")
    room.plot([at / 60.0 for at, _ in disk], [size / MEGABYTE for _, size in disk], lw=1)
    room.axhline(result.disk_limit_mb, color="#d1495b", lw=1, ls="--", label="allowed")
    room.legend(fontsize=9, frameon=False, loc="lower right")
    room.set_ylabel("records [MB]")
    room.set_xlabel("time [min]")
    memory.set_title("memory of each process of a station")
    room.set_title("records and views on the disk")
    with written_whole(picture) as partial:
        figure.savefig(partial, dpi=110, format="png")
