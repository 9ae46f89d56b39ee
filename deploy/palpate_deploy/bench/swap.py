"""``palpate bench swap``: bundles are loaded and rolled back while frames come; none may be lost.

A private station serves fingers at a fixed rate, first undisturbed, then while one bundle after the
other is loaded from disk and rolled back. Of every tared frame there must be exactly one estimate,
and its bytes must be those that one of the bundles makes of that frame: runtime, manifest and
threshold of two bundles never meet in one estimate.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from palpate.admin import read_token, token_file
from palpate.bus import Delivery, ReceivedMessage, Session, Subscriber, endpoints
from palpate.bus.tares import TareBook
from palpate.bus.topics import ELECTRODES, FEATURES
from palpate.client.models import ModelAdmin
from palpate.codec import FEATURE_ESTIMATE
from palpate.errors import LinkError, StreamTimeout
from palpate.files.bundle import read_bundle, write_bundle
from palpate.messages import NO_TARE, ElectrodeFrame, FeatureEstimate, ServiceRequest
from palpate_deploy.bench.results import finish, progress_bar
from palpate_deploy.bench.station import SETTLE_S, wait_ready
from palpate_deploy.station.host import join, private_profile
from palpate_deploy.station.logs import FAILED
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import Profile
from palpate_services.inference.estimates import EstimateRefusal, estimate
from palpate_services.inference.model import Runtime, load
from palpate_services.inference.repository import Repository, resolve

FIRST, OTHER = "features-virtual", "features-twin"
"""The bundle that serves at the start, and the one whose copies are loaded in its place."""

COPIES = 3
"""Copies that are loaded in turn: more than a service keeps, so that each is read from the disk."""

ROLL_BACK_GOAL_S = 0.1
LEAST_SHARE = 0.5
"""So much of the frames that are due must have come, or nothing is known: a gateway that hangs."""
_NAME = "swapped"
_STATION = "bench"
_START_S = 30.0
_WAITING_MOST = 1 << 16
_NO_REASONS = ("frames_received", "estimates_published", "commands_obeyed", "questions_")


@dataclass(frozen=True, slots=True)
class Account:
    """What became of the frames of one part of the run.

    ``frames`` are those that had a tare; ``lost`` got no estimate, ``repeated`` more than one,
    ``mixed`` one that no bundle makes of them; ``bundles`` counts estimates by bundle;
    ``gap_max_s`` is the longest time between two estimates of a finger [s]; ``reasons`` are the
    counters of the service that grew meanwhile.
    """

    frames: int
    lost: int
    repeated: int
    mixed: int
    gap_max_s: float
    bundles: dict[str, int] = field(default_factory=dict)
    reasons: dict[str, int] = field(default_factory=dict)


class Witness:
    """Takes every frame and every estimate of a station, in threads of its own."""

    def __init__(self, session: Session) -> None:
        self.frames: list[ReceivedMessage[ElectrodeFrame]] = []
        self.estimates: list[ReceivedMessage[FeatureEstimate]] = []
        self._stop = threading.Event()
        streams: list[tuple[Subscriber[Any], list[Any]]] = [
            (
                session.subscriber(ELECTRODES, delivery=Delivery.QUEUE, capacity=_WAITING_MOST),
                self.frames,
            ),
            (
                session.subscriber(FEATURES, delivery=Delivery.QUEUE, capacity=_WAITING_MOST),
                self.estimates,
            ),
        ]
        self._threads = [threading.Thread(target=self._take, args=pair) for pair in streams]
        for thread in self._threads:
            thread.start()

    def _take(self, stream: Subscriber[Any], kept: list[ReceivedMessage[Any]]) -> None:
        while not self._stop.is_set():
            try:
                kept.append(stream.next(timeout_s=0.1))
            except StreamTimeout:
                continue

    def stop(self) -> None:
        """Take no more."""
        self._stop.set()
        for thread in self._threads:
            thread.join()


def run_swap(
    *,
    changes: int,
    sensors: int,
    rate_hz: float,
    hold_s: float,
    as_json: bool,
    save: bool,
    out: Path | None = None,
) -> int:
    """``palpate bench swap``, whose help explains the options; 1 if the goal is missed."""
    with FiniteRun("bench-swap") as children:
        profile = _start(children, sensors, rate_hz)
        runtimes = _runtimes(profile)
        with join(profile, wait_s=10.0) as session:
            book = TareBook(session)
            witness = Witness(session)
            try:
                _wait_for_estimates(witness, sensors, children)
                admin = ModelAdmin(session, read_token(token_file(children.folder, _STATION)))
                began_ns, began = time.monotonic_ns(), _reasons(session)
                time.sleep(2 * changes * hold_s)
                between_ns, between = time.monotonic_ns(), _reasons(session)
                loads_s, rolls_s = _change(admin, changes, hold_s)
                ended_ns = time.monotonic_ns()
                time.sleep(SETTLE_S)
                ended = _reasons(session)
                children.check(["gateway", "features"])
            finally:
                witness.stop()
            judge = Judge(witness, runtimes, book)
        still = judge.account(began_ns, between_ns, between - began)
        busy = judge.account(between_ns, ended_ns, ended - between)
    values = {
        "swap.sensors": sensors,
        "swap.rate_hz": rate_hz,
        "swap.changes": len(loads_s) + len(rolls_s),
        "swap.undisturbed": asdict(still),
        "swap.changing": asdict(busy),
        "swap.load_s": _spread(loads_s),
        "swap.roll_back_s": _spread(rolls_s),
        "swap.goal_met": goal_met(
            busy, rolls_s, due=sensors * rate_hz * (ended_ns - between_ns) * 1e-9
        ),
    }
    finish("swap", values, lambda: _print(values, still, busy), as_json=as_json, save=save, out=out)
    return 0 if values["swap.goal_met"] else FAILED


def goal_met(busy: Account, rolls_s: Sequence[float], *, due: float) -> bool:
    """Whether nothing was lost, repeated or mixed of enough frames, and rolling back was quick.

    ``due`` frames were to come while bundles changed; ``rolls_s`` are durations [s].
    """
    sound = not (busy.lost or busy.repeated or busy.mixed)
    return sound and busy.frames >= LEAST_SHARE * due and max(rolls_s) <= ROLL_BACK_GOAL_S


def _start(children: FiniteRun, sensors: int, rate_hz: float) -> Profile:
    """Start a station whose repository has the copies; return when its services are ready."""
    models = children.folder / "models"
    other = read_bundle(resolve(OTHER))
    for version in range(1, COPIES + 1):
        # Of another threshold, so that each estimate tells which of the copies has made it.
        manifest = replace(
            other.manifest,
            name=_NAME,
            version=version,
            contact_threshold_n=other.manifest.contact_threshold_n * version,
        )
        write_bundle(
            models / _NAME / str(version),
            model=other.model,
            golden=other.golden,
            manifest=manifest,
            known_inputs=other.known_inputs,
        )
    fingers = [
        {
            "name": f"finger{index}",
            "driver": "bench",
            "options": {"rate_hz": rate_hz, "phase": index / sensors},
        }
        for index in range(sensors)
    ]
    profile = private_profile(
        _STATION,
        features={"bundle": FIRST},
        gateway={"sensors": fingers},
        models={"folder": str(models)},
        log={"level": "warning"},
    )
    children.start_profile(profile)
    wait_ready(profile, {"features"})
    children.start_module("gateway", "bench.parts", "gateway", children.folder / "profile.toml")
    return profile


def _reasons(session: Session) -> Counter[str]:
    """What the service counts beside frames and estimates: mostly why a frame has no estimate."""
    status = session.query(endpoints.STATUS, ServiceRequest(), service="features", timeout_s=5.0)
    return Counter(
        {name: n for name, n in status.counters.items() if not name.startswith(_NO_REASONS)}
    )


def _wait_for_estimates(witness: Witness, sensors: int, children: FiniteRun) -> None:
    deadline = time.monotonic() + _START_S
    while len({got.sensor for got in list(witness.estimates)}) < sensors:
        children.check(["gateway", "features"])
        if time.monotonic() > deadline:
            raise LinkError(
                "not every finger got an estimate",
                remedy=f"see the logs in {children.folder / 'logs'}",
            )
        time.sleep(0.1)
    time.sleep(SETTLE_S)


def _change(admin: ModelAdmin, changes: int, hold_s: float) -> tuple[list[float], list[float]]:
    """Load a copy and roll back, again and again; durations as the operator sees them [s]."""
    loads_s, rolls_s = [], []
    with progress_bar() as bar:
        task = bar.add_task("load and roll back", total=changes)
        for turn in range(changes):
            began_s = time.monotonic()
            admin.load("features", f"{_NAME}:{turn % COPIES + 1}")
            loads_s.append(time.monotonic() - began_s)
            time.sleep(hold_s)
            began_s = time.monotonic()
            admin.roll_back("features")
            rolls_s.append(time.monotonic() - began_s)
            time.sleep(hold_s)
            bar.advance(task)
    return loads_s, rolls_s


def _runtimes(profile: Profile) -> dict[bytes, Runtime]:
    """Every bundle that serves during the run, by its digest."""
    repository = Repository(profile.models.repository_folder)
    names = [FIRST, *(f"{_NAME}:{version}" for version in range(1, COPIES + 1))]
    bundles = [read_bundle(repository.resolve(name)) for name in names]
    return {bundle.sha256: load(bundle, "features") for bundle in bundles}


class Judge:
    """Compares every estimate with what its bundle makes of its frame."""

    def __init__(self, witness: Witness, runtimes: Mapping[bytes, Runtime], book: TareBook) -> None:
        self._runtimes = runtimes
        self._frames = {
            (got.sensor, got.message.stamp.sequence): got.message
            for got in witness.frames
            if got.message.tare_id != NO_TARE
        }
        # While the gateway answers: a tare may be older than this end of the stream.
        named = {(sensor, frame.tare_id) for (sensor, _), frame in self._frames.items()}
        self._tares = {name: book.baseline(*name, timeout_s=_START_S) for name in named}
        self._estimates: dict[tuple[str, int], list[ReceivedMessage[FeatureEstimate]]] = {}
        for got in witness.estimates:
            key = (got.sensor, got.message.source.sequence)
            self._estimates.setdefault(key, []).append(got)

    def account(self, began_ns: int, ended_ns: int, reasons: Counter[str]) -> Account:
        """Of the frames that were read in this time, by the monotonic clock [ns]."""
        bundles: Counter[str] = Counter()
        arrivals: dict[str, list[int]] = {}
        frames = lost = repeated = mixed = 0
        for key, frame in self._frames.items():
            if not began_ns <= frame.stamp.monotonic_ns < ended_ns:
                continue
            frames += 1
            found = self._estimates.get(key, [])
            lost += not found
            repeated += len(found) > 1
            for got in found:
                runtime = self._runtimes.get(got.message.bundle_sha256)
                bundles["unknown" if runtime is None else runtime.label] += 1
                mixed += not self._made_by(runtime, key[0], frame, got.payload)
                arrivals.setdefault(key[0], []).append(got.received_monotonic_ns)
        gaps_ns = [int(np.diff(np.sort(times)).max()) for times in arrivals.values() if times[1:]]
        gap_max_s = max(gaps_ns, default=0) * 1e-9
        return Account(frames, lost, repeated, mixed, gap_max_s, dict(bundles), dict(reasons))

    def _made_by(
        self, runtime: Runtime | None, sensor: str, frame: ElectrodeFrame, payload: bytes
    ) -> bool:
        if runtime is None:
            return False
        wanted = estimate(frame, self._tares[sensor, frame.tare_id], runtime)
        return not isinstance(wanted, EstimateRefusal) and payload == FEATURE_ESTIMATE.encode(
            wanted
        )


def _spread(durations_s: list[float]) -> dict[str, float]:
    p50, p99 = np.percentile(durations_s, (50, 99))
    return {"p50": float(p50), "p99": float(p99), "max": max(durations_s)}


def _print(values: dict[str, Any], still: Account, busy: Account) -> None:
    console = Console(highlight=False)
    table = Table(
        title=f"{values['swap.sensors']} fingers at {values['swap.rate_hz']:g} Hz, "
        f"{values['swap.changes']} changes of the bundle",
        title_justify="left",
    )
    for column in ("", "frames", "lost", "repeated", "mixed", "longest gap"):
        table.add_column(column, justify="right" if column else "left")
    for name, part in (("undisturbed", still), ("changing", busy)):
        table.add_row(
            name,
            f"{part.frames:,}",
            str(part.lost),
            str(part.repeated),
            str(part.mixed),
            f"{part.gap_max_s * 1e3:.1f} ms",
        )
    console.print(table)
    for name, part in (("undisturbed", still), ("changing", busy)):
        if part.reasons:
            reasons = ", ".join(f"{count} {reason}" for reason, count in part.reasons.items())
            console.print(f"{name}, counted by the service: {reasons}")
    for name, key in (("load", "swap.load_s"), ("roll back", "swap.roll_back_s")):
        took = values[key]
        console.print(
            f"{name}: p50 {took['p50'] * 1e3:.1f} ms, max {took['max'] * 1e3:.1f} ms, as the "
            "operator sees it"
        )
