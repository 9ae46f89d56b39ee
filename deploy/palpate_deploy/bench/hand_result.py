"""What a hand's run came to: losses, share of a core, latencies; and showing it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from palpate.messages import Status

CORE_GOAL = 0.5
"""Share of a core that the gateway may use."""

_LOSSES = ("lost", "missing", "dropped", "parity", "overflow", "incomplete", "silences", "device_l")


class Used(NamedTuple):
    """What the system says of the gateway's process.

    Attributes:
        core: Share of one core.
        worst_core: The same in its worst tenth.
        kernel_drops: Datagrams that it did not fetch in time.
        stolen: Share of the cores' time that this virtual machine did not get, though it wanted it.
    """

    core: float
    worst_core: float
    kernel_drops: int
    stolen: float


@dataclass(frozen=True, slots=True)
class HandResult:
    """What became of the hand's frames.

    Attributes:
        seconds: Length of the measurement [s].
        core: Share of one core that the gateway used.
        worst_core: The same in its worst tenth.
        kernel_drops: Datagrams that the kernel threw away because it was not read in time.
        stolen: Share of the cores' time that this virtual machine did not get, though it wanted it:
            everything is then late, and takes longer by the clock of its processes, too.
        frames: Electrode and wrench frames in the client.
        lost: Frames that sequence numbers, the devices' own account or invalid channels miss.
        counters: The gateway's counters of losses that are not zero.
        publish_p50_s: Median of: reading in the gateway's hands to its message on the bus, of the
            sensor and at the time where it was longest (a look every tenth of the run) [s].
        publish_p99_s: 99th percentile, likewise [s].
        p50_s: Median of: last sample of an electrode frame to the client's hands [s].
        p99_s: 99th percentile [s].
        wrench_p99_s: The same of the wrenches [s].
        floor_core: Share of one core that the bare reader used.
        floor_p50_s: Median of: kernel's stamp of a slot to the bare reader's hands [s].
        floor_p99_s: 99th percentile [s].
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


def account(
    rows_file: Path,
    floor_file: Path,
    begin_ns: int,
    end_ns: int,
    used: Used,
    before: Mapping[str, int],
    looks: Sequence[Status],
) -> HandResult:
    """Count what arrived between two instants.

    Args:
        rows_file: What the client wrote.
        floor_file: What the bare reader wrote.
        begin_ns: Begin by the monotonic clock [ns].
        end_ns: End [ns].
        used: What the gateway's process used and missed.
        before: The gateway's counters at the begin.
        looks: What it told during the run; the last at the end.
    """
    with np.load(rows_file, allow_pickle=False) as archive:
        names, rows, lost = archive["sensors"], archive["rows"], int(archive["dropped"])
    rows = rows[(rows[:, 4] >= begin_ns) & (rows[:, 4] < end_ns)]
    of_finger = np.array([str(name).startswith("finger") for name in names])
    for number in range(len(names)):
        mine = rows[rows[:, 0] == number]
        lost += int((np.diff(mine[:, 1]) - 1).sum())
    lost += int(rows[:, 2].sum()) + int(rows[:, 5].sum())
    silent = 7 - len(np.unique(rows[:, 0]))
    late_s = (rows[:, 4] - rows[:, 3]) * 1e-9
    electrodes = late_s[of_finger[rows[:, 0]]]
    p50, p99 = np.percentile(electrodes, (50, 99))
    with np.load(floor_file, allow_pickle=False) as archive:
        floor_p50, floor_p99 = np.percentile(archive["late_s"], (50, 99))
        floor_core = float(archive["core"])
    told = {
        name: value - before.get(name, 0)
        for name, value in looks[-1].counters.items()
        if any(word in name for word in _LOSSES) and value > before.get(name, 0)
    }
    return HandResult(
        seconds=(end_ns - begin_ns) * 1e-9,
        core=used.core,
        worst_core=used.worst_core,
        kernel_drops=used.kernel_drops,
        stolen=used.stolen,
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
    console = Console()
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
        highlight=False,
    )
    if result.counters:
        told = ", ".join(f"{name} {count}" for name, count in result.counters.items())
        console.print(f"counted by the gateway: {told}", soft_wrap=True, highlight=False)
