"""``palpate bench hand``: five BioTacs and two force/torque sensors through one gateway.

Emulators send at full rate: three fingers on one CAN bus and two on another (4400 slots a second
each), a KMS 40 over TCP (500 Hz) and a Bota over a serial line (1000 Hz). Nothing may be lost. The
floor is a program that reads the same devices with python-can, sockets and pyserial, and discards
what it reads.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from palpate.errors import LinkError
from palpate.messages import Status
from palpate.process import cpu_time_s
from palpate_deploy.bench.harness import read_rows
from palpate_deploy.bench.results import finish, owed, progress_bar
from palpate_deploy.bench.station import free_port, gateway_station, wait_ready
from palpate_deploy.station.host import join, write_profile
from palpate_deploy.station.processes import FiniteRun, command_line
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.status import ask_status

CORE_GOAL = 0.5
"""Share of a core that the gateway may use."""

_LOSSES = ("lost", "missing", "dropped", "parity", "overflow", "incomplete", "silences", "device_l")


class GatewayUse(NamedTuple):
    """What the system reports of the gateway's process; see the same names of ``HandResult``."""

    core: float
    worst_core: float
    kernel_drops: int
    stolen: float


@dataclass(frozen=True, slots=True)
class HandResult:
    """Load, losses and latency of the hand.

    Attributes:
        seconds: Length of the measurement [s].
        core: Share of one core that the gateway used.
        worst_core: The same in its worst tenth.
        kernel_drops: Datagrams that the kernel discarded because they were not read in time.
        stolen: Share of the cores' time that the hypervisor gave to other machines: everything is
            then late, and CPU times are longer too.
        frames: Electrode and wrench frames that the client received.
        lost: Frames missing by sequence numbers or by the devices' own counts, or with invalid
            channels, and those that a sensor which stopped would have sent until the end; of one
            whose rate is not known, since it sent one frame or none: 1.
        counters: The gateway's counters of losses that are not zero.
        publish_p50_s: Time from a reading in the gateway to its message on the bus, with
            ``publish_p99_s``: the largest over sensors and the tenths of the run [s].
        p50_s: Time from the last sample of an electrode frame to the client, with ``p99_s`` [s].
        wrench_p99_s: The same of the wrenches [s].
        floor_core: Share of one core that the bare reader used.
        floor_p50_s: Time from the kernel's stamp of a slot to the bare reader, with
            ``floor_p99_s`` [s].
    """

    seconds: float
    core: float
    worst_core: float
    kernel_drops: int
    stolen: float
    frames: int
    lost: int
    counters: dict[str, int]
    publish_p50_s: float
    publish_p99_s: float
    p50_s: float
    p99_s: float
    wrench_p99_s: float
    floor_core: float
    floor_p50_s: float
    floor_p99_s: float

    @property
    def nothing_lost(self) -> bool:
        """Whether no frame was lost, and the gateway counted no loss or silence either."""
        return self.lost == 0 and not self.counters


def account(
    rows_file: Path,
    floor_file: Path,
    begin_ns: int,
    end_ns: int,
    used: GatewayUse,
    before: Mapping[str, int],
    looks: Sequence[Status],
) -> HandResult:
    """Count what arrived between two instants of the monotonic clock [ns].

    ``before`` holds the gateway's counters at the beginning, ``looks`` its status during the run,
    the last one at the end; the files hold the client's rows and the bare reader's result.

    Raises:
        LinkError: No frame of one kind came to the client, or nothing of a device to the reader.
    """
    names, rows, lost = read_rows(rows_file)
    # Selected by arrival, so that frames still on their way at the end do not count as lost.
    rows = rows[(rows[:, 4] >= begin_ns) & (rows[:, 4] < end_ns)]
    of_finger = np.array([str(name).startswith("finger") for name in names])
    for number in range(len(names)):
        mine = rows[rows[:, 0] == number]
        lost += int((np.diff(mine[:, 1]) - 1).sum()) + owed(mine[:, 4], end_ns)
    lost += int(rows[:, 2].sum()) + int(rows[:, 5].sum())
    for what, there in (("electrode", of_finger[rows[:, 0]]), ("wrench", ~of_finger[rows[:, 0]])):
        if not there.any():
            raise LinkError(f"no {what} frame came to the client", remedy="see the gateway's log")
    silent = 7 - len(np.unique(rows[:, 0]))
    late_s = (rows[:, 4] - rows[:, 3]) * 1e-9
    electrodes = late_s[of_finger[rows[:, 0]]]
    p50, p99 = np.percentile(electrodes, (50, 99))
    with np.load(floor_file, allow_pickle=False) as archive:
        if not (heard := archive["heard"]).all():
            raise LinkError(
                f"the bare reader received from {heard.sum()} of {len(heard)} devices",
                remedy="see the emulators' logs: without its load there is nothing to compare with",
            )
        floor_p50, floor_p99 = np.percentile(archive["late_s"], (50, 99))
        floor_core = float(archive["core"])
    told = {
        name: value - before.get(name, 0)
        for name, value in looks[-1].counters.items()
        if any(word in name for word in _LOSSES) and value > before.get(name, 0)
    }
    return HandResult(
        seconds=(end_ns - begin_ns) * 1e-9,
        **used._asdict(),
        frames=len(rows),
        lost=lost + silent,
        counters=told,
        publish_p50_s=_longest(looks, "publish_p50_s"),
        publish_p99_s=_longest(looks, "publish_p99_s"),
        p50_s=float(p50),
        p99_s=float(p99),
        wrench_p99_s=float(np.percentile(late_s[~of_finger[rows[:, 0]]], 99)),
        floor_core=floor_core,
        floor_p50_s=float(floor_p50),
        floor_p99_s=float(floor_p99),
    )


def _longest(looks: Sequence[Status], gauge: str) -> float:
    return max(
        (value for look in looks for name, value in look.gauges.items() if name.endswith(gauge)),
        default=float("nan"),
    )


def show(result: HandResult) -> None:
    """Print it for people."""
    console = Console(highlight=False)
    table = Table(
        title=f"five BioTacs on CAN, a KMS 40 and a Bota, {result.seconds:.0f} s",
        title_justify="left",
    )
    for column in ("", "gateway", "bare reader", "ratio"):
        table.add_column(column, justify="right" if column else "left")
    pairs = (
        ("share of a core", result.core, result.floor_core, "{:.1%}"),
        ("last slot to client, p50", result.p50_s * 1e3, result.floor_p50_s * 1e3, "{:.2f} ms"),
        ("last slot to client, p99", result.p99_s * 1e3, result.floor_p99_s * 1e3, "{:.2f} ms"),
    )
    for name, ours, bare, form in pairs:
        table.add_row(name, form.format(ours), form.format(bare), f"{ours / bare:.2f}")
    console.print(table)
    console.print(
        f"{result.frames:,} frames in the client, {result.lost} lost, "
        f"{result.kernel_drops} datagrams dropped by the kernel; in its worst tenth the gateway "
        f"used {result.worst_core:.1%} of a core (goal {CORE_GOAL:.0%}); wrenches p99 "
        f"{result.wrench_p99_s * 1e3:.2f} ms; from a reading to its message on the bus p50 "
        f"{result.publish_p50_s * 1e3:.2f}, p99 {result.publish_p99_s * 1e3:.2f} ms; "
        f"{result.stolen:.1%} of this machine's cores went to others",
        soft_wrap=True,
    )
    if result.counters:
        told = ", ".join(f"{name} {count}" for name, count in result.counters.items())
        console.print(f"counted by the gateway: {told}", soft_wrap=True)


_BUSES = ({"channel": "239.74.163.2", "fingers": 3}, {"channel": "239.74.163.3", "fingers": 2})
_SETTLE_S = 4.0
_PARTS = "bench.hand_parts"


def run_hand(*, seconds: float, floor_seconds: float, as_json: bool, save: bool) -> None:
    """``palpate bench hand``, whose help explains the options: measure, print, keep."""
    with progress_bar() as bar:
        result = measure_hand(seconds, floor_seconds, bar)
    values = {
        "hand": asdict(result),
        "hand.core_goal_met": result.core <= CORE_GOAL,
        "hand.loss_goal_met": result.nothing_lost,
        "hand.p99_ratio": round(result.p99_s / result.floor_p99_s, 2),
    }
    finish("hand", values, lambda: show(result), as_json=as_json, save=save)


def measure_hand(seconds: float, floor_seconds: float, bar: Progress) -> HandResult:
    """Start everything, measure the gateway, then the floor."""
    with FiniteRun("bench-hand") as children:
        buses, wrenches = _start_emulators(children)
        rows_file, floor_file = children.folder / "client.npz", children.folder / "floor.npz"
        profile = _start_gateway(children, buses, wrenches, rows_file)
        task = bar.add_task("gateway", total=10)
        time.sleep(_SETTLE_S)
        pid = children.pid("gateway")
        before = _status(profile).counters
        begin_ns, used_s, shares = time.monotonic_ns(), cpu_time_s(pid), []
        looks: list[Status] = []
        host = _host_ticks()
        for _ in range(10):
            part_s, part_used_s = time.monotonic(), cpu_time_s(pid)
            time.sleep(seconds / 10)
            shares.append((cpu_time_s(pid) - part_used_s) / (time.monotonic() - part_s))
            children.check(["gateway", "client", *(f"emulator-{n}" for n in range(4))])
            looks.append(_status(profile))
            bar.advance(task)
        end_ns = time.monotonic_ns()
        core = (cpu_time_s(pid) - used_s) / ((end_ns - begin_ns) * 1e-9)
        total, stolen = (now - then for now, then in zip(_host_ticks(), host, strict=True))
        drops = _kernel_drops(pid)
        children.stop_one("client")
        children.stop_one("gateway")
        task = bar.add_task("floor", total=1)
        plan = {
            "seconds": floor_seconds,
            "buses": buses,
            "sockets": [[wrenches["kms40"]["host"], wrenches["kms40"]["port"]]],
            "lines": [[wrenches["bota"]["port"], wrenches["bota"]["baud"]]],
        }
        children.start_module("floor", _PARTS, "floor", floor_file, json.dumps(plan))
        if children.wait("floor", floor_seconds + 20.0) != 0:
            raise children.ended("floor", -1)
        bar.advance(task)
        return account(
            rows_file,
            floor_file,
            begin_ns,
            end_ns,
            GatewayUse(core, max(shares), drops, stolen / max(total, 1)),
            before,
            looks,
        )


def _start_emulators(
    children: FiniteRun,
) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """Start the emulators; returns python-can's options and the addresses of the wrench sensors."""
    emulate = [sys.executable, "-m", "palpate_deploy", "emulate"]
    buses: list[dict[str, Any]] = []
    for number, bus in enumerate(_BUSES):
        port = free_port()
        words = ["--channel", str(bus["channel"]), "--bus", f"port={port}"]
        words += ["--fingers", str(bus["fingers"]), "--seed", str(10 * number)]
        children.start(f"emulator-{number}", [*emulate, "biotac-can", *words])
        buses.append({"interface": "udp_multicast", "channel": bus["channel"], "port": port})
    tcp, line = free_port(), children.folder / "bota"
    children.start("emulator-2", [*emulate, "kms40", "--port", str(tcp)])
    children.start("emulator-3", [*emulate, "bota", "--link", str(line), "--baud", "460800"])
    deadline = time.monotonic() + 30.0
    names = [f"emulator-{number}" for number in range(4)]
    while not all("palpate gateway probe" in children.log(n).read_text("utf-8") for n in names):
        children.check(names)
        if time.monotonic() > deadline:
            raise LinkError("an emulator does not start", remedy=f"see {children.folder / 'logs'}")
        time.sleep(0.1)
    return buses, {
        "kms40": {"host": "127.0.0.1", "port": tcp},
        "bota": {"port": str(line), "baud": 460800, "rate_hz": 1000.0},
    }


def _start_gateway(
    children: FiniteRun,
    buses: list[dict[str, Any]],
    wrenches: dict[str, dict[str, Any]],
    rows_file: Path,
) -> Profile:
    sensors = [
        {
            "name": f"finger{number}{port}",
            "driver": "biotac_can",
            "options": {
                "interface": options["interface"],
                "channel": options["channel"],
                "bus_options": {"port": options["port"]},
                "fingers": bus["fingers"],
                "port": port,
            },
        }
        for number, (bus, options) in enumerate(zip(_BUSES, buses, strict=True))
        for port in range(1, int(str(bus["fingers"])) + 1)
    ]
    sensors += [
        {"name": name, "driver": f"wrench_{name}", "options": options}
        for name, options in wrenches.items()
    ]
    profile = gateway_station(sensors)
    endpoint = profile.link.connect[0]
    children.start_profile(profile)
    children.start_module("client", _PARTS, "client", endpoint, profile.station, rows_file)
    wait_ready(profile, {"client"})
    children.start("gateway", command_line("gateway", write_profile(profile, children.folder)))
    wait_ready(profile, {"gateway"})
    return profile


def _host_ticks() -> tuple[int, int]:
    """Ticks of all cores since boot: all, and those that the hypervisor gave to other machines."""
    ticks = [int(word) for word in Path("/proc/stat").read_text("utf-8").split()[1:9]]
    return sum(ticks), ticks[7]


def _kernel_drops(pid: int) -> int:
    """Datagrams that the kernel discarded because the process did not read them in time."""
    sockets = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):  # closed in the meantime
            sockets.add(os.readlink(link))
    lines = Path(f"/proc/{pid}/net/udp").read_text("utf-8").splitlines()[1:]
    rows = [line.split() for line in lines]
    return sum(int(row[12]) for row in rows if f"socket:[{row[9]}]" in sockets)


def _status(profile: Profile) -> Status:
    with join(profile, wait_s=10.0) as session:
        for _ in range(5):
            for status in ask_status(session):
                if status.service == "gateway":
                    return status
            time.sleep(0.5)
    raise LinkError("the gateway does not answer", remedy="see the logs in the run's folder")
