"""``palpate bench alignment``: how far off stamps are, and electrodes, wrenches and poses apart.

Emulators in processes of their own and a robot's program show one signal whose time is known by the
host's monotonic clock: a BioTac on a CAN bus, a KMS 40 (TCP), an ATI Net F/T (UDP), a Bota (serial
line) and poses over the bus. They go the whole way: driver, pipeline, bus, client. What a client
then holds is compared with the truth by ``alignment_account``.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from palpate.bus import Delivery, Session
from palpate.bus.topics import ELECTRODES, POSE, WRENCH
from palpate.config import LinkConfig
from palpate.errors import LinkError, StreamTimeout
from palpate.messages import ElectrodeFrame, IndenterPoseFrame, WrenchFrame
from palpate_deploy.bench.alignment_account import Spread, apart, stamp_errors
from palpate_deploy.bench.alignment_page import page_of
from palpate_deploy.bench.e2e import wait_ready
from palpate_deploy.bench.lateness import OnTime
from palpate_deploy.bench.results import append_history, machine
from palpate_deploy.bench.station import free_port, gateway_station
from palpate_deploy.children import Children
from palpate_deploy.processes import command_line
from palpate_deploy.profile import Profile
from palpate_deploy.run_folder import write_profile
from palpate_deploy.status import ask_status

GOAL_S = 1e-3
CHANNEL = "239.74.163.7"
_WRENCHES = ("kms40", "rdt", "bota")
_DEVICES = ("finger", *_WRENCHES)
_READY_S = 30.0
_IDENTITY = {"position_m": (0.0, 0.0, 0.0), "orientation_wxyz": (1.0, 0.0, 0.0, 0.0)}


@dataclass(frozen=True, slots=True)
class AlignmentResult:
    """What was found.

    Attributes:
        seconds: Length of the measurement [s].
        kept: Share of it that counts: when the host left the emulators in time (``lateness``).
        stamps: By stream, stamp less truth.
        apart: By stream, how far it is from the electrodes once aligned by stamps.
        gauges: What the gateway told of the clocks.
    """

    seconds: float
    kept: float
    stamps: dict[str, Spread]
    apart: dict[str, Spread]
    gauges: dict[str, float]


@dataclass(slots=True)
class _Caught:
    """Frames that came to the client."""

    frames: list[ElectrodeFrame] = field(default_factory=list)
    wrenches: dict[str, list[WrenchFrame]] = field(default_factory=dict)
    poses: list[IndenterPoseFrame] = field(default_factory=list)

    def take(self, sensor: str, message: object) -> None:
        """Keep a message."""
        if isinstance(message, ElectrodeFrame):
            self.frames.append(message)
        elif isinstance(message, WrenchFrame):
            self.wrenches.setdefault(sensor, []).append(message)
        elif isinstance(message, IndenterPoseFrame):
            self.poses.append(message)


def run_alignment(
    *, seconds: float, settle_seconds: float, page: Path | None, as_json: bool, save: bool
) -> None:
    """Measure, print, and on request keep.

    Args:
        seconds: Length of the measurement [s].
        settle_seconds: How long before it the clocks are followed [s].
        page: Write a page of it.
        as_json: Print JSON.
        save: Append to the history.
    """
    columns = (TextColumn("{task.description:32}"), BarColumn(), TimeElapsedColumn())
    quiet = Console(stderr=True)
    with Progress(*columns, console=quiet, disable=not sys.stderr.isatty()) as bar:
        result = measure_alignment(seconds, settle_seconds, bar)
    values = {
        "alignment": asdict(result),
        "alignment.goal_met": all(one.p95_s <= GOAL_S for one in result.apart.values()),
    }
    if as_json:
        print(json.dumps({**values, "machine": machine()}, indent=2))
    else:
        _print(result)
    if page is not None:
        text = page_of(
            result.seconds, result.kept, result.stamps, result.apart, result.gauges, machine()
        )
        page.write_text(text, encoding="utf-8")
    if save:
        append_history("alignment", values)


def measure_alignment(seconds: float, settle_seconds: float, bar: Progress) -> AlignmentResult:
    """Start everything, let the clocks settle, measure.

    Raises:
        ProcessEnded: A process of the benchmark ended early.
        LinkError: They did not find one another in time, or a stream did not come.
    """
    with Children("bench-alignment") as children:
        sensors = _start_devices(children)
        profile = gateway_station(sensors)
        endpoint = profile.link.connect[0]
        children.start_profile(profile)
        part = [sys.executable, "-m", "palpate_deploy.bench.alignment_parts"]
        robot = [*part, "robot", endpoint, profile.station, _late_file(children, "robot")]
        children.start("robot", robot)
        children.start("gateway", command_line("gateway", write_profile(profile, children.folder)))
        wait_ready(profile, {"gateway"})
        task = bar.add_task("clocks settle", total=1)
        time.sleep(settle_seconds)
        bar.advance(task)
        names = [*_DEVICES, "robot", "gateway"]
        caught, gauges = _catch(profile, seconds, children, names, bar)
        for name in ("robot", *_DEVICES):
            children.stop_one(name)
        late = [Path(_late_file(children, name)) for name in ("robot", *_DEVICES)]
    on_time = OnTime.of(late)
    begin_s, end_s = (1e-9 * caught.frames[at].stamp.monotonic_ns for at in (0, -1))
    streams = caught.frames, caught.wrenches, caught.poses
    return AlignmentResult(
        seconds,
        float(on_time(np.linspace(begin_s, end_s, 10_000)).mean()),
        stamp_errors(*streams, on_time),
        apart(*streams, on_time),
        {name: value for name, value in sorted(gauges.items()) if "clock" in name},
    )


def _late_file(children: Children, name: str) -> str:
    return str(children.folder / f"late-{name}.npy")


def _start_devices(children: Children) -> list[dict[str, Any]]:
    """Start the emulators; the gateway's sensors."""
    can, tcp, udp, web = (free_port() for _ in range(4))
    line = children.folder / "bota"
    told = {
        "finger": [CHANNEL, str(can)],
        "kms40": [str(tcp)],
        "rdt": [str(udp), str(web)],
        "bota": [str(line)],
    }
    part = [sys.executable, "-m", "palpate_deploy.bench.alignment_parts"]
    for name, words in told.items():
        children.start(name, [*part, name, *words, _late_file(children, name)])
    bus = {"interface": "udp_multicast", "channel": CHANNEL, "bus_options": {"port": can}}
    rdt = {"product": "ati_net_ft", "host": "127.0.0.1", "port": udp, "http_port": web}
    pose = {"robot": "arm", "rate_hz": 250.0, "indenter": "sphere_7mm"}
    placed = {"base_sensor": _IDENTITY, "flange_indenter": _IDENTITY}
    options: dict[str, tuple[str, dict[str, Any]]] = {
        "finger": ("biotac_can", {**bus, "fingers": 1}),
        "kms40": ("wrench_kms40", {"host": "127.0.0.1", "port": tcp}),
        "rdt": ("wrench_rdt", rdt),
        "bota": ("wrench_bota", {"port": str(line), "serial": "bota"}),
        "pose": ("pose_zenoh", {**pose, **placed}),
    }
    return [{"name": n, "driver": d, "options": chosen} for n, (d, chosen) in options.items()]


def _catch(
    profile: Profile, seconds: float, children: Children, names: list[str], bar: Progress
) -> tuple[_Caught, dict[str, float]]:
    caught, stop = _Caught(), threading.Event()
    link = LinkConfig(connect=profile.link.connect, wait_for_router_s=_READY_S)
    with Session.open(link, station=profile.station) as session:
        streams = [
            session.subscriber(topic, delivery=Delivery.QUEUE)
            for topic in (ELECTRODES, WRENCH, POSE)
        ]

        def take(stream: Any) -> None:
            while not stop.is_set():
                try:
                    got = stream.next(timeout_s=0.1)
                except StreamTimeout:
                    continue
                caught.take(got.sensor, got.message)

        threads = [threading.Thread(target=take, args=(stream,)) for stream in streams]
        for thread in threads:
            thread.start()
        try:
            task = bar.add_task("alignment", total=10)
            for _ in range(10):
                time.sleep(seconds / 10)
                children.check(names)
                bar.advance(task)
        finally:
            stop.set()
            for thread in threads:
                thread.join()
        told = [one for one in ask_status(session, timeout_s=5.0) if one.service == "gateway"]
    missing = [name for name in _WRENCHES if not caught.wrenches.get(name)]
    missing += [] if caught.frames else ["finger"]
    missing += [] if caught.poses else ["pose"]
    if missing or not told:
        raise LinkError(
            f"nothing came of {', '.join(missing) or 'the gateway'}",
            remedy=f"see the logs in {children.folder / 'logs'}",
        )
    return caught, dict(told[0].gauges)


def _print(result: AlignmentResult) -> None:
    console = Console()
    for title, rows in (
        ("stamp less truth", result.stamps),
        ("apart from the electrodes when aligned by stamps", result.apart),
    ):
        table = Table(title=title, title_justify="left")
        for column in ("", "readings", "median", "p95", "p99", "max"):
            table.add_column(column, justify="right" if column else "left")
        for name, one in rows.items():
            numbers = (one.median_s, one.p95_s, one.p99_s, one.max_s)
            table.add_row(name, f"{one.count:,}", *(f"{1e3 * value:.3f} ms" for value in numbers))
        console.print(table)
    console.print(
        f"{result.kept:.0%} of {result.seconds:g} s count: else this host starved the emulators",
        highlight=False,
        soft_wrap=True,
    )
