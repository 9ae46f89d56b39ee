"""``palpate bench e2e``: latency from a frame's stamp to a client's estimate, and a load test.

For the latency two sets of processes run at once, palpate and a bare floor, each with router,
source, service and client over loopback TCP. A gate lets one source send at a time, in turns of a
few seconds, so that both meet the same disturbances by the host: their ratio does not depend on its
speed. The load test sends frames of many fingers and accounts for each that is lost.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from palpate.config import LinkConfig
from palpate.errors import LinkError
from palpate.files.bundle import read_manifest
from palpate_deploy.bench.harness import SourceGate, read_rows
from palpate_deploy.bench.load import LoadResult, ramp_rate, run_load, start_palpate
from palpate_deploy.bench.results import Latency, finish, latency, progress_bar, stage_medians
from palpate_deploy.bench.station import SETTLE_S, wait_ready
from palpate_deploy.station.host import free_endpoint
from palpate_deploy.station.processes import FiniteRun
from palpate_services.inference.repository import Repository

RATE_HZ = 100.0
P50_GOAL, P99_GOAL = 1.15, 1.3
"""Times the floor (serving reference, goal G1)."""

FIELD_BUNDLE = "field-twin"
"""A field of 6,870 nodes with its uncertainty: 110 kB."""

_PALPATE, _FLOOR = 0, 1
_WARM_UP = 20


@dataclass(frozen=True, slots=True)
class Run:
    """Latency of both sides, measured in turns."""

    palpate: Latency
    floor: Latency
    stages_s: dict[str, float]
    """Median of each stage of palpate's estimates [s]."""

    @property
    def p50_ratio(self) -> float:
        """Median, times the floor's."""
        return self.palpate.p50_s / self.floor.p50_s

    @property
    def p99_ratio(self) -> float:
        """99 %, times the floor's."""
        return self.palpate.p99_s / self.floor.p99_s

    def plain(self) -> dict[str, Any]:
        """As JSON."""
        return {
            **asdict(self),
            "p50_ratio": round(self.p50_ratio, 3),
            "p99_ratio": round(self.p99_ratio, 3),
        }


def run_e2e(
    *,
    seconds: float,
    rounds: int,
    runs: int,
    sensors: int,
    fields: int,
    load_seconds: float,
    ramp: bool,
    bundle: str,
    as_json: bool,
    save: bool,
    out: Path | None = None,
) -> None:
    """``palpate bench e2e``, whose help explains the options: measure, print, keep."""
    folder = Repository.of_user().resolve(bundle)
    manifest = read_manifest(folder)
    label = f"{manifest.name}:{manifest.version}"
    measured: list[Run] = []
    loads: list[LoadResult] = []
    first_loss: LoadResult | None = None
    with progress_bar() as bar:
        for _ in range(runs):
            model = folder / "model.onnx"
            measured.append(
                measure_latency(seconds=seconds, rounds=rounds, bundle=bundle, model=model, bar=bar)
            )
        for service, count, served in (
            ("features", sensors, bundle),
            ("field", fields, FIELD_BUNDLE),
        ):
            if count:
                loads.append(
                    run_load(
                        service,
                        sensors=count,
                        rate_hz=RATE_HZ,
                        seconds=load_seconds,
                        bundle=served,
                        bar=bar,
                    )
                )
        if ramp and sensors:
            first_loss = ramp_rate(loads[0], bundle=bundle, bar=bar)
    finish(
        "e2e",
        {"e2e.bundle": label} | _values(measured, loads, first_loss),
        lambda: _print(label, measured, loads, first_loss, ramped=ramp and bool(sensors)),
        as_json=as_json,
        save=save,
        out=out,
    )


def measure_latency(*, seconds: float, rounds: int, bundle: str, model: Path, bar: Progress) -> Run:
    """Latency of palpate and of the floor, in turns and on equal terms."""
    core = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else "any"
    with FiniteRun("bench") as children:
        gates = children.folder / "gates"
        opened = [SourceGate(gates, _PALPATE), SourceGate(gates, _FLOOR)]
        outs = [children.folder / "palpate.npz", children.folder / "floor.npz"]
        options = {"rate_hz": RATE_HZ, "gate": str(gates), "gate_index": _PALPATE}
        finger = {"name": "finger", "driver": "bench", "options": options}
        profile = start_palpate(
            children, bundle, outs[_PALPATE], [finger], delivery="newest", core=core
        )
        _start_floor(children, model, outs[_FLOOR], gates, "" if core == "any" else str(core))
        names = ["gateway", "features", "client", "floor-source", "floor-service", "floor-client"]
        # The first frames are not measured: tare, first inference, page faults.
        for side, gate in enumerate(opened):
            gate.set(True)
            if side == _PALPATE:
                wait_ready(profile, {"gateway"})  # with its first frames
            time.sleep(1.5)
            gate.set(False)
            time.sleep(SETTLE_S)
        begun_ns = time.monotonic_ns()
        turns: list[list[tuple[int, int]]] = [[], []]
        task = bar.add_task("latency, interleaved", total=2 * rounds)
        for turn in range(rounds):
            # The order alternates, so that no side always follows the other.
            for side in (turn % 2, 1 - turn % 2):
                opened_ns = time.monotonic_ns()
                opened[side].set(True)
                time.sleep(seconds)
                opened[side].set(False)
                turns[side].append((opened_ns, time.monotonic_ns()))
                time.sleep(SETTLE_S)
                children.check(names)
                bar.advance(task)
        ended_ns = time.monotonic_ns()
        for gate in opened:
            gate.set(True)  # a source that waits at its gate does not see the stop event
        for name in reversed(names):
            children.stop_one(name)
        results: list[Latency] = []
        stages_s: dict[str, float] = {}
        for out, own in zip(outs, turns, strict=True):
            _, rows, _ = read_rows(out)
            measured = rows[(rows[:, 1] >= begun_ns) & (rows[:, 1] < ended_ns)]
            if not len(measured):
                raise LinkError(
                    "no estimate came to the client of the benchmark",
                    remedy=f"see the logs in {children.folder / 'logs'}",
                )
            stages_s |= stage_medians(measured)  # the floor notes none
            results.append(latency(measured, warm_up=_WARM_UP, lost=_lost(rows, own)))
    return Run(results[_PALPATE], results[_FLOOR], stages_s)


def _lost(rows: npt.NDArray[np.int64], turns: list[tuple[int, int]]) -> int:
    """Frames of a side without an estimate: holes, and what it owes after its last one.

    ``turns`` are begins and ends of the time in which frames were sent [ns], host monotonic clock.
    Frames before the first estimate had no tare and do not count.
    """
    holes = int(rows[-1, 0] - rows[0, 0] + 1 - len(rows))
    silent_ns = sum(max(end - max(begin, int(rows[-1, 2])), 0) for begin, end in turns)
    # Less may be frames on their way.
    return holes + (round(silent_ns * 1e-9 * RATE_HZ) if silent_ns >= SETTLE_S * 1e9 else 0)


def _start_floor(children: FiniteRun, model: Path, out: Path, gates: Path, core: str) -> None:
    from palpate.bus.zenoh_session import zenoh_config

    # Palpate's Zenoh settings as files, so that both sides have the same.
    endpoint = free_endpoint()
    router, peer = (children.folder / f"floor-{mode}.json5" for mode in ("router", "peer"))
    listening = LinkConfig(connect=(), listen=(endpoint,))
    router.write_text(str(zenoh_config(listening, "router")), encoding="utf-8")
    joining = LinkConfig(connect=(endpoint,))
    peer.write_text(str(zenoh_config(joining, "peer")), encoding="utf-8")
    children.start_module("floor-router", "bench.floor", "router", router)
    time.sleep(0.5)
    children.start_module("floor-service", "bench.floor", "service", peer, model)
    children.start_module("floor-client", "bench.floor", "client", peer, out)
    time.sleep(1.5)
    children.start_module("floor-source", "bench.floor", "source", peer, gates, RATE_HZ, core)
    time.sleep(1.0)


def _values(
    runs: list[Run], loads: list[LoadResult], first_loss: LoadResult | None
) -> dict[str, Any]:
    p50, p99 = (_spread(runs, name) for name in ("p50_ratio", "p99_ratio"))
    return {
        "e2e.palpate": asdict(runs[0].palpate) if len(runs) == 1 else _median(runs, "palpate"),
        "e2e.floor": asdict(runs[0].floor) if len(runs) == 1 else _median(runs, "floor"),
        "e2e.p50_ratio": round(p50[1], 3),
        "e2e.p99_ratio": round(p99[1], 3),
        "e2e.p50_ratio_range": [round(p50[0], 3), round(p50[2], 3)],
        "e2e.p99_ratio_range": [round(p99[0], 3), round(p99[2], 3)],
        "e2e.p50_goal_met": p50[1] <= P50_GOAL,
        "e2e.p99_goal_met": p99[1] <= P99_GOAL,
        "e2e.stages_s": {
            name: float(np.median([run.stages_s.get(name, 0.0) for run in runs]))
            for name in runs[0].stages_s
        },
        "e2e.runs": [run.plain() for run in runs],
        **{f"load.{load.service}": load.plain() for load in loads},
        "load.goal_met": all(load.met for load in loads),
        "first_loss": None if first_loss is None else first_loss.plain(),
    }


def _spread(runs: list[Run], name: str) -> tuple[float, float, float]:
    """Least, median and largest of a ratio."""
    ratios = [getattr(run, name) for run in runs]
    return min(ratios), float(np.median(ratios)), max(ratios)


def _median(runs: list[Run], side: str) -> dict[str, float]:
    """Each number of a side: its median over the runs; the largest and the losses of all runs."""
    sides = [asdict(getattr(run, side)) for run in runs]
    of_all: dict[str, Callable[[list[float]], float]] = {"max_s": max, "lost": sum}
    return {
        name: float(of_all.get(name, np.median)([one[name] for one in sides])) for name in sides[0]
    }


def _print(
    label: str,
    runs: list[Run],
    loads: list[LoadResult],
    first_loss: LoadResult | None,
    *,
    ramped: bool,
) -> None:
    console = Console(highlight=False)
    table = Table(
        title=f"frame stamp to estimate of {label} in the client, one finger at {RATE_HZ:g} Hz, "
        "loopback TCP",
        title_justify="left",
    )
    for column in ("", "p50", "p99", "max", "estimates", "lost"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for number, run in enumerate(runs, 1):
        for name, side in (("palpate", run.palpate), ("floor", run.floor)):
            table.add_row(
                name if len(runs) == 1 else f"{name}, run {number}",
                *(f"{value * 1e3:.3f} ms" for value in (side.p50_s, side.p99_s, side.max_s)),
                f"{side.count:,}",
                str(side.lost),
            )
    for name, place in (("ratio (goal)", 1), ("least", 0), ("largest", 2)):
        if place == 1 or len(runs) > 1:
            table.add_row(
                name,
                _against(_spread(runs, "p50_ratio")[place], P50_GOAL),
                _against(_spread(runs, "p99_ratio")[place], P99_GOAL),
            )
    console.print(table)
    stages = ", ".join(f"{name} {value * 1e3:.2f}" for name, value in runs[0].stages_s.items())
    console.print(f"median stages of palpate [ms]: {stages}", soft_wrap=True, markup=False)
    for load in loads:
        for line in load.sentences():
            console.print(line, soft_wrap=True, markup=False)
    if first_loss is not None:
        console.print("first loss: " + first_loss.sentences()[0], soft_wrap=True, markup=False)
    elif ramped:
        console.print("no frame was lost up to the end of the ramp")


def _against(ratio: float, goal: float) -> str:
    colour = "green" if ratio <= goal else "red"
    return f"[{colour}]{ratio:.2f}[/] (<= {goal:g})"
