"""``palpate bench alignment``: errors of stamps, and of streams aligned by them.

Emulators in processes of their own and a robot's program send one signal, whose time is known by
the host's monotonic clock: a BioTac on a CAN bus, a KMS 40 (TCP), an ATI Net F/T (UDP), a Bota
(serial line), and poses over the bus. Readings pass driver, pipeline and bus; the client compares
them with the truth.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from palpate.alignment import AlignmentClock, electrode_instants, linear, times_of
from palpate.bus import Delivery, ReceivedMessage
from palpate.bus.topics import ELECTRODES, POSE, WRENCH, Topic
from palpate.errors import LinkError
from palpate.messages import ElectrodeFrame, IndenterPoseFrame, WrenchFrame
from palpate.sampling import sample_offsets
from palpate_deploy.bench.alignment_parts import (
    LOW_COUNTS,
    LOW_N,
    SPAN_COUNTS,
    SPAN_M,
    SPAN_N,
    OnTime,
    time_of,
)
from palpate_deploy.bench.harness import received
from palpate_deploy.bench.results import finish, machine, progress_bar, write_result
from palpate_deploy.bench.station import free_port, gateway_station, wait_ready
from palpate_deploy.station.host import join, write_profile
from palpate_deploy.station.processes import FiniteRun, command_line
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.status import ask_status

Floats = npt.NDArray[np.float64]

Wrenches = dict[str, list[WrenchFrame]]


@dataclass(frozen=True, slots=True)
class ErrorSpread:
    """Distribution of errors [s]: median (late is positive), percentiles of the magnitudes."""

    count: int
    median_s: float
    p95_s: float
    p99_s: float
    max_s: float

    def cells(self) -> list[str]:
        """The numbers as a row of a table."""
        numbers = (self.median_s, self.p95_s, self.p99_s, self.max_s)
        return [f"{self.count:,}", *(f"{1e3 * value:.3f} ms" for value in numbers)]


def spread(errors_s: Floats) -> ErrorSpread:
    """Distribution of errors [s]; NaN is left out."""
    kept = errors_s[np.isfinite(errors_s)]
    if not len(kept):
        return ErrorSpread(0, np.nan, np.nan, np.nan, np.nan)
    sizes = np.abs(kept)
    p95, p99 = np.percentile(sizes, (95, 99))
    return ErrorSpread(
        len(kept), float(np.median(kept)), float(p95), float(p99), float(sizes.max())
    )


def _off(share: Floats, stamp_ns: npt.NDArray[np.int64], counts: OnTime) -> Floats:
    """Stamp minus the time of the value [s]; NaN at times that do not count."""
    stamp_s = _seconds(stamp_ns)
    return np.where(counts(stamp_s), stamp_s - time_of(share, stamp_s), np.nan)


def _seconds(time_ns: npt.NDArray[np.int64]) -> Floats:
    return np.asarray(1e-9 * time_ns.astype(np.float64))


def _shares(frames: Sequence[ElectrodeFrame], *, pac: bool) -> Floats:
    """The signal in the electrodes, or PAC samples, of frames; NaN where a sample is invalid."""
    layout = frames[0].sensor_type.layout
    first, number = (layout.first_pac_bit, layout.pac_samples) if pac else (0, layout.electrodes)
    counts = np.array([frame.pac if pac else frame.electrodes for frame in frames], np.float64)
    bits = np.array([frame.validity for frame in frames], np.uint64)[:, None]
    good = bits >> np.arange(first, first + number, dtype=np.uint64) & np.uint64(1)
    return np.where(good == 1, (counts - LOW_COUNTS) / SPAN_COUNTS, np.nan)


def _signals(
    wrenches: Wrenches, poses: Sequence[IndenterPoseFrame]
) -> dict[str, tuple[npt.NDArray[np.int64], Floats, float, float]]:
    """Of each stream: times [ns], values of shape ``(N, 1)``, and lowest value and span."""
    found = {
        name: (
            times_of(stream, AlignmentClock.MONOTONIC),
            np.array([[frame.force[2]] for frame in stream], np.float64),
            LOW_N,
            SPAN_N,
        )
        for name, stream in wrenches.items()
    }
    travels = np.array([[frame.position[0]] for frame in poses], np.float64)
    return {**found, "pose": (times_of(poses, AlignmentClock.MONOTONIC), travels, 0.0, SPAN_M)}


def stamp_errors(
    frames: Sequence[ElectrodeFrame],
    wrenches: Wrenches,
    poses: Sequence[IndenterPoseFrame],
    counts: OnTime,
) -> dict[str, ErrorSpread]:
    """Errors of the stamps of each stream."""
    at_ns = electrode_instants(frames, AlignmentClock.MONOTONIC)
    shares = _shares(frames, pac=False)
    stamps_ns = times_of(frames, AlignmentClock.MONOTONIC)
    pac_ns = stamps_ns[:, None] + np.array([sample_offsets(frame).pac for frame in frames])
    pac = _shares(frames, pac=True)
    errors = {
        "electrodes": _off(shares, at_ns, counts),
        "PAC": _off(pac, pac_ns, counts),
        "electrodes, all at the stamp": _off(shares, at_ns, counts)
        - _seconds(at_ns - stamps_ns[:, None]),
    }
    for name, (times_ns, values, low, span) in _signals(wrenches, poses).items():
        errors[name] = _off((values[:, 0] - low) / span, times_ns, counts)
    return {name: spread(found) for name, found in errors.items()}


def apart(
    frames: Sequence[ElectrodeFrame],
    wrenches: Wrenches,
    poses: Sequence[IndenterPoseFrame],
    counts: OnTime,
) -> dict[str, ErrorSpread]:
    """Errors in time between the electrodes and other streams aligned by their stamps.

    Every stream is interpolated at the instant of each electrode of each frame; the error is the
    difference of the times that both values give.
    """
    at_ns = electrode_instants(frames, AlignmentClock.MONOTONIC)
    about_s = _seconds(at_ns)
    shares = _shares(frames, pac=False)
    electrodes_s = np.where(counts(about_s), time_of(shares, about_s), np.nan)
    out = {}
    for name, (times_ns, values, low, span) in _signals(wrenches, poses).items():
        value, _ = linear(at_ns, times_ns, values)
        out[name] = spread(electrodes_s - time_of((value[..., 0] - low) / span, about_s))
    return out


_HEAD = """\
# Errors of stamps and of alignment on one host

Made by `palpate bench alignment --seconds {seconds:g} --page docs/results/alignment.md`
on {machine}.

Emulated devices, each in a process of its own, and a robot's program send one signal whose time is
known by the host's monotonic clock: a ramp up and down, 0.25 s each. Their readings pass driver,
pipeline and bus to a client. No hardware takes part: the delay inside a real device (filters,
conversion, adapters) is added to these errors, and is the same for each of its readings
([time.md](../time.md#what-no-stamp-can-know)). The clocks of finger, RDT and Bota run 200 ppm fast;
the robot has a clock of its own, 40 ppm fast.

The host is shared, and delays emulators as it never delays a sensor: readings sent more than 5 ms
late, and those around them, are left out. {kept:.0%} of the time counts.

## Stamps

Stamp minus the true time of a reading; late is positive. The median has its sign, the other columns
are magnitudes.

{stamps}

Every channel of the finger has its own instant (`palpate.sampling`); one count equals 0.07 ms here,
which is part of the numbers. The row "all at the stamp" shows the error of a program that ignores
that a frame takes 10 ms.

## Electrodes, wrench and pose

Every stream is interpolated at the instant of each electrode (`palpate.alignment`); the error is
the difference between the times of both values. The goal is 1 ms.

{apart}

## Gauges of the gateway

{gauges}
"""


def page_of(result: AlignmentResult, machine: dict[str, Any]) -> str:
    """The page as Markdown."""
    told = ["| gauge | |", "| --- | ---: |"]
    told += [f"| `{name}` | {value:.6g} |" for name, value in result.gauges.items()]
    return _HEAD.format(
        seconds=result.seconds,
        kept=result.kept,
        machine=f"{machine['cpus']} CPUs ({machine['cpu']}), load {machine['load_1min']}",
        stamps=_table(result.stamps),
        apart=_table(result.apart),
        gauges="\n".join(told),
    )


def _table(rows: dict[str, ErrorSpread]) -> str:
    out = [
        "| | readings | median | 95 % | 99 % | largest |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    out += [f"| {name} | {' | '.join(one.cells())} |" for name, one in rows.items()]
    return "\n".join(out)


GOAL_S = 1e-3
CHANNEL = "239.74.163.7"
_WRENCHES = ("kms40", "rdt", "bota")
_DEVICES = ("finger", *_WRENCHES)
_READY_S = 30.0
_PARTS = "bench.alignment_parts"
_IDENTITY = {"position_m": (0.0, 0.0, 0.0), "orientation_wxyz": (1.0, 0.0, 0.0, 0.0)}


@dataclass(frozen=True, slots=True)
class AlignmentResult:
    """Errors of stamps and of the alignment, by stream.

    ``kept`` is the share of ``seconds`` that counts, in which no emulator was late; ``stamps`` are
    stamp minus truth, ``apart`` the error relative to the electrodes once aligned by stamps.
    """

    seconds: float
    kept: float
    stamps: dict[str, ErrorSpread]
    apart: dict[str, ErrorSpread]
    gauges: dict[str, float]


def run_alignment(
    *, seconds: float, settle_seconds: float, page: Path | None, as_json: bool, save: bool
) -> None:
    """``palpate bench alignment``, whose help explains the options: measure, print, keep."""
    with progress_bar() as bar:
        result = measure_alignment(seconds, settle_seconds, bar)
    values = {
        "alignment": asdict(result),
        "alignment.goal_met": all(one.p95_s <= GOAL_S for one in result.apart.values()),
    }
    if page is not None:
        write_result(page, page_of(result, machine()))
    finish("alignment", values, lambda: _print(result), as_json=as_json, save=save)


def measure_alignment(seconds: float, settle_seconds: float, bar: Progress) -> AlignmentResult:
    """Start everything, let the clocks settle, measure."""
    with FiniteRun("bench-alignment") as children:
        sensors = _start_devices(children)
        profile = gateway_station(sensors)
        endpoint = profile.link.connect[0]
        children.start_profile(profile)
        late_file = _late_file(children, "robot")
        children.start_module("robot", _PARTS, "robot", endpoint, profile.station, late_file)
        children.start("gateway", command_line("gateway", write_profile(profile, children.folder)))
        wait_ready(profile, {"gateway"})
        task = bar.add_task("clocks settle", total=1)
        time.sleep(settle_seconds)
        bar.advance(task)
        names = [*_DEVICES, "robot", "gateway"]
        frames, wrenches, poses, gauges = _catch(profile, seconds, children, names, bar)
        for name in ("robot", *_DEVICES):
            children.stop_one(name)
        late = [_late_file(children, name) for name in ("robot", *_DEVICES)]
    on_time = OnTime.of(late)
    begin_s, end_s = (1e-9 * frames[at].stamp.monotonic_ns for at in (0, -1))
    return AlignmentResult(
        seconds,
        float(on_time(np.linspace(begin_s, end_s, 10_000)).mean()),
        stamp_errors(frames, wrenches, poses, on_time),
        apart(frames, wrenches, poses, on_time),
        {name: value for name, value in sorted(gauges.items()) if "clock" in name},
    )


def _late_file(children: FiniteRun, name: str) -> Path:
    return children.folder / f"late-{name}.npy"


def _start_devices(children: FiniteRun) -> list[dict[str, Any]]:
    """Start the emulators; returns the gateway's sensors."""
    can, tcp, udp, web = (free_port() for _ in range(4))
    line = children.folder / "bota"
    told = {"finger": (CHANNEL, can), "kms40": (tcp,), "rdt": (udp, web), "bota": (line,)}
    for name, words in told.items():
        children.start_module(name, _PARTS, name, *words, _late_file(children, name))
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
    profile: Profile, seconds: float, children: FiniteRun, names: list[str], bar: Progress
) -> tuple[list[ElectrodeFrame], Wrenches, list[IndenterPoseFrame], dict[str, float]]:
    """Frames, wrenches by sensor and poses of the measurement; the gateway's gauges at its end."""
    stop = threading.Event()
    with join(profile, wait_s=_READY_S) as session:
        taken: list[list[ReceivedMessage[Any]]] = [[], [], []]
        topics: tuple[Topic[Any], ...] = (ELECTRODES, WRENCH, POSE)
        threads = []
        for topic, into in zip(topics, taken, strict=True):
            stream = session.subscriber(topic, delivery=Delivery.QUEUE)
            threads.append(threading.Thread(target=into.extend, args=(received(stream, stop),)))
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
    frames, forces, poses = taken
    came = {got.sensor for got in forces} | ({"pose"} if poses else set())
    came |= {"finger"} if frames else set()
    missing = [name for name in (*_DEVICES, "pose") if name not in came]
    if missing or not told:
        raise LinkError(
            f"no message of {', '.join(missing) or 'the gateway'} came",
            remedy=f"see the logs in {children.folder / 'logs'}",
        )
    wrenches = {name: [got.message for got in forces if got.sensor == name] for name in _WRENCHES}
    return (
        [got.message for got in frames],
        wrenches,
        [got.message for got in poses],
        dict(told[0].gauges),
    )


def _print(result: AlignmentResult) -> None:
    console = Console(highlight=False)
    for title, rows in (
        ("stamp minus truth", result.stamps),
        ("apart from the electrodes when aligned by stamps", result.apart),
    ):
        table = Table(title=title, title_justify="left")
        for column in ("", "readings", "median", "p95", "p99", "max"):
            table.add_column(column, justify="right" if column else "left")
        for name, one in rows.items():
            table.add_row(name, *one.cells())
        console.print(table)
    console.print(
        f"{result.kept:.0%} of {result.seconds:g} s count; at other times an emulator was late",
        soft_wrap=True,
    )
