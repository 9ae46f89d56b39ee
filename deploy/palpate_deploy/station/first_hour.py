"""The way from a profile to estimates of one's own finger: run, zero and tare, look, calibrate.

Each step looks first whether it is done: a station that runs is used, and a finger that has a
bundle that was made for it keeps it. So the walk can be broken off anywhere and taken again.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table

from palpate.admin import read_token, token_file
from palpate.bus import Delivery, Session, Subscriber
from palpate.bus.topics import ELECTRODES, FEATURES, POSE, WRENCH, Topic
from palpate.client.estimates import ask_zero
from palpate.client.models import ModelAdmin
from palpate.config import Role
from palpate.errors import LinkError, RemoteError, StreamTimeout, printable
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    FloatArray,
    IndenterPoseFrame,
    QualityFlag,
    Tare,
    WrenchFrame,
)
from palpate.process import stop_on_signals
from palpate_deploy.station.calibrate import CalibrationOrder, calibrate_finger
from palpate_deploy.station.host import join, write_profile
from palpate_deploy.station.logs import cell
from palpate_deploy.station.new_station import FINGER, WRENCH_SENSOR
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import Profile, load_profile
from palpate_deploy.station.tare import LET_GO_S, tare_at_rest

_JOIN_S = 0.5
_READY_S = 60.0
_POLL_S = 0.1

_ASK_S = 10.0
_AGAIN_S = 0.2

_SEEN_S = 2.0
_MOST = 4000
_LOOKED_AT: tuple[Topic[Any], ...] = (ELECTRODES, WRENCH, POSE, FEATURES)

_ZERO_READINGS = 100
"""Averaged for a zero: a tenth of a second of the fast sensors, a second of the slow ones."""

UNTOUCHED_COUNTS = 25.0
"""An electrode that is further from its baseline shows a touch [counts]; as the gateway's limit
for a finger that is held (docs/tare-and-health.md)."""


@dataclass(frozen=True, slots=True)
class WalkOrder:
    """How to walk.

    Attributes:
        path: The profile.
        presses: How many presses to calibrate with.
        look_s: How long the signals are shown [s].
        records: Folder of the record of the presses.
    """

    path: Path
    presses: int
    look_s: float
    records: Path


def walk(order: WalkOrder) -> None:
    """Run the station, and take its finger to estimates; a station that it started runs on.

    Raises:
        ConfigError: The profile is wrong.
        LinkError: The station does not become ready, or its port is somebody else's.
        RemoteError: The finger is not let go.
        StreamTimeout: A sensor of the profile sends nothing.
        DatasetError: Too few presses.
    """
    profile = load_profile(order.path)
    console = Console()
    with _running(profile, console) as run:
        with join(profile, wait_s=_READY_S, role=Role.OPERATOR) as session:
            console.print("tare: let go of the finger", markup=False)
            tare = tare_at_rest(
                session, FINGER, threading.Event(), again_s=_AGAIN_S, console=console
            )
            assert tare is not None, "nothing interrupts it"
            if any(sensor.name == WRENCH_SENSOR for sensor in profile.gateway.sensors):
                zero_wrench(session, tare)
            console.print(
                f"tared over {tare.frames_averaged} frames: noise "
                f"{float(np.median(tare.electrodes_sd)):.1f} counts",
                markup=False,
            )
            look(session, tare, order.look_s, console)
            own, measured = _own_bundle(session, profile), _has_wrench(session)
            known = bool(own) and _knows_finger(session)
        if own and not known:
            serial = printable(tare.sensor_serial)
            console.print(f"{own} was not made for this finger, {serial}", markup=False)
        if known:
            console.print(f"calibrated already: {own}", markup=False)
        elif not measured:
            console.print(
                "not calibrated: no force/torque sensor sends for this finger; give one in the "
                f"profile, of = {FINGER!r}, and run this again",
                markup=False,
            )
        else:
            calibrate_finger(
                profile.link.as_role(Role.OPERATOR),
                profile.station,
                CalibrationOrder(FINGER, order.presses, order.records, None, "", serve=True),
                token=None,
                profile=profile,
                as_json=False,
            )
        _tell_estimate(profile, console)
        if run is not None:
            _wait(run, console)


@contextlib.contextmanager
def _running(profile: Profile, console: Console) -> Iterator[FiniteRun | None]:
    """The station, started for the block if it does not run; None = it runs elsewhere."""
    if _runs(profile):
        console.print(f"station {profile.station!r} runs already", markup=False)
        yield None
        return
    with FiniteRun(f"{profile.station}-first-hour") as run:
        resolved = write_profile(profile, run.folder)
        command = [sys.executable, "-m", "palpate_deploy", "up", "--profile", str(resolved)]
        console.print(f"up: palpate up; log {run.log('up')}", markup=False, soft_wrap=True)
        run.start("up", command)
        _wait_ready(profile, run)
        yield run


def _runs(profile: Profile) -> bool:
    """Whether the station's gateway and features are ready at the profile's router."""
    try:
        with join(profile, wait_s=_JOIN_S) as session:
            return not _missing(session)
    except LinkError:
        return False


def _missing(session: Session) -> set[str]:
    ready = {one.service for one in session.alive() if one.ready}
    return {"gateway", "features"} - ready


def _wait_ready(profile: Profile, run: FiniteRun) -> None:
    until = time.monotonic() + _READY_S
    missing = {"router"}
    while time.monotonic() < until:
        run.check(["up"])
        try:
            with join(profile, wait_s=_JOIN_S) as session:
                while time.monotonic() < until:
                    run.check(["up"])
                    if not (missing := _missing(session)):
                        return
                    time.sleep(_POLL_S)
        except LinkError:
            time.sleep(_POLL_S)
    raise LinkError(
        f"{', '.join(sorted(missing))} not ready within {_READY_S:g} s",
        remedy=f"see {run.log('up')}, and palpate status",
    )


def zero_wrench(session: Session, tare: Tare) -> None:
    """Zero the force/torque sensor while the tared finger shows that nothing touches it.

    The gateway zeroes under any constant load, because a tool's weight is one; a press is, too.

    Raises:
        RemoteError: The gateway refuses for a minute.
        StreamTimeout: The finger is touched for a minute, or sends nothing.
    """
    until = time.monotonic() + LET_GO_S
    refused: RemoteError | None = None
    with session.subscriber(ELECTRODES, sensor=FINGER, delivery=Delivery.QUEUE) as frames:
        while time.monotonic() < until:
            frames.next_batch(0.0, most=_MOST)
            if touched(frames.next(_ASK_S).message, tare):
                continue
            asked_ns = time.monotonic_ns()
            try:
                zero = ask_zero(session, WRENCH_SENSOR, readings=_ZERO_READINGS, timeout_s=_ASK_S)
            except RemoteError as error:
                refused = error
                continue
            seen = [
                one.message
                for one in frames.next_batch(_ASK_S, most=_MOST)
                if asked_ns <= one.message.stamp.monotonic_ns <= zero.monotonic_ns
            ]
            if seen and not any(touched(frame, tare) for frame in seen):
                return
    raise refused or StreamTimeout(
        f"the finger was touched for {LET_GO_S:g} s",
        remedy="leave it untouched, and tare it again if its baseline is wrong: palpate tare",
    )


def touched(frame: ElectrodeFrame, tare: Tare) -> bool:
    """Whether a frame shows a touch: an electrode is far from its baseline."""
    away = np.abs(frame.electrodes.astype(np.float64) - tare.electrodes)
    return bool(np.any(away > np.maximum(UNTOUCHED_COUNTS, 5.0 * tare.electrodes_sd)))


class _Seen:
    """What the streams of the finger have shown so far.

    Attributes:
        counts: Messages by stream.
        texts: The last one of each, in words.
    """

    def __init__(self, tare: Tare) -> None:
        self._tare = tare
        self.counts = {topic.name: 0 for topic in _LOOKED_AT}
        self.texts = dict.fromkeys(self.counts, "nothing comes")

    def take(self, name: str, stream: Subscriber[Any]) -> None:
        """Count what waits in a stream, and keep the last message."""
        batch = stream.next_batch(0.0, most=_MOST)
        self.counts[name] += len(batch)
        if batch:
            self.texts[name] = self._text(batch[-1].message)

    def _text(self, message: object) -> str:
        if isinstance(message, ElectrodeFrame):
            tared = message.electrodes.astype(np.float64) - self._tare.electrodes
            most = int(np.argmax(np.abs(tared)))
            return f"E{most + 1} {tared[most]:+.0f} counts, the most of all; PDC {message.pdc}"
        if isinstance(message, WrenchFrame):
            return f"{_newtons(message.force)}, {np.linalg.norm(message.force):.2f} N in all"
        if isinstance(message, FeatureEstimate):
            return _estimate(message)
        assert isinstance(message, IndenterPoseFrame)
        return f"{message.indenter} at {' '.join(f'{1e3 * x:+.1f}' for x in message.position)} mm"

    def table(self, seconds: float) -> Table:
        """All streams, with their rates over so many seconds."""
        table = Table()
        for column in ("stream", "Hz", "now"):
            # One that may not fold takes its room from the others, down to nothing.
            table.add_column(column, no_wrap=column != "now", overflow="fold")
        for name, count in self.counts.items():
            table.add_row(name, f"{count / max(seconds, _POLL_S):.0f}", cell(self.texts[name]))
        return table


def _newtons(force: FloatArray) -> str:
    return " ".join(f"{value:+.2f}" for value in force) + " N"


def _estimate(message: FeatureEstimate) -> str:
    flags = "".join(f", {flag.name}" for flag in message.quality)
    bundle = f"{message.bundle_name}:{message.bundle_version}"
    bounds = message.bounds
    doubt = ", how far off is not known,"
    if bounds is not None and bounds.force is not None:
        doubt = f" +- {bounds.force:.2f} N"
    return f"{_newtons(message.force)}{doubt} by {printable(bundle)}{flags}"


def look(session: Session, tare: Tare, seconds: float, console: Console) -> None:
    """Show what the finger's streams bring: live in a terminal, else once at the end.

    Raises:
        StreamTimeout: The finger brings nothing.
    """
    seen = _Seen(tare)
    with contextlib.ExitStack() as stack:
        streams = {
            topic.name: stack.enter_context(
                session.subscriber(topic, sensor=FINGER, delivery=Delivery.QUEUE)
            )
            for topic in _LOOKED_AT
        }
        live = None
        if console.is_terminal:
            live = stack.enter_context(Live(console=console, auto_refresh=False))
        began_s = time.monotonic()
        while (passed_s := time.monotonic() - began_s) < seconds:
            for name, stream in streams.items():
                seen.take(name, stream)
            if live is not None:
                live.update(seen.table(passed_s), refresh=True)
            time.sleep(_POLL_S)
        if live is None:
            console.print(seen.table(seconds))
    if not seen.counts["electrodes"]:
        raise StreamTimeout(
            f"no electrodes of {FINGER!r} came in {seconds:g} s", remedy="see palpate status"
        )


def _own_bundle(session: Session, profile: Profile) -> str:
    """The bundle that the station serves for this finger alone; empty = none."""
    token = read_token(token_file(profile.models.memory_folder, profile.station))
    for inventory in ModelAdmin(session, token).served("features"):
        for one in inventory.served:
            if one.sensor == FINGER and one.name:
                return f"{one.name}:{one.version}"
    return ""


def _knows_finger(session: Session) -> bool:
    """Whether the bundle that serves was made for this finger, by its serial number.

    It may be that of another one, which had this name at the station before.
    """
    with session.subscriber(FEATURES, sensor=FINGER) as estimates:
        return QualityFlag.UNCALIBRATED not in estimates.next(_ASK_S).message.quality


def _has_wrench(session: Session) -> bool:
    with session.subscriber(WRENCH, sensor=FINGER) as forces:
        return bool(forces.next_batch(_SEEN_S, most=1))


def _tell_estimate(profile: Profile, console: Console) -> None:
    """Show an estimate, as a robot gets it."""
    with (
        join(profile, wait_s=_JOIN_S) as session,
        session.subscriber(FEATURES, sensor=FINGER) as estimates,
    ):
        console.print(f"served: {_estimate(estimates.next(_ASK_S).message)}", markup=False)


def _wait(run: FiniteRun, console: Console) -> None:
    """Until Ctrl-C."""
    stop = stop_on_signals()
    console.print("the station runs; Ctrl-C stops it", markup=False)
    while not stop.wait(_POLL_S):
        run.check(["up"])
