"""``palpate bench e2e``: frame stamp to estimate in a client, beside the bare floor.

Two sets of processes live at once, each router, source, service and client over loopback TCP; a
gate lets one source send at a time, in turns of a few seconds. So both meet the same noise of the
host, and the one number that a slower host does not change is their ratio.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from palpate.bus import Session
from palpate.config import LinkConfig
from palpate.errors import LinkError
from palpate_deploy.bench.harness import Gate, read_rows
from palpate_deploy.bench.load import LoadResult, ramp_rate, run_load
from palpate_deploy.bench.results import Latency, append_history, latency, machine, plain
from palpate_deploy.children import Children
from palpate_deploy.ports import free_endpoint
from palpate_deploy.profile import Profile, changed, load_profile
from palpate_deploy.run_folder import write_profile
from palpate_services.repository import resolve

RATE_HZ = 100.0
P50_GOAL, P99_GOAL = 1.5, 2.0
"""Times the floor (serving reference, goal G1)."""

_PALPATE, _FLOOR = 0, 1
_WARM_UP = 20
_SETTLE_S = 0.4
_READY_S = 20.0


def run_e2e(
    *,
    seconds: float,
    rounds: int,
    sensors: int,
    load_seconds: float,
    ramp: bool,
    bundle: str,
    as_json: bool,
    save: bool,
) -> None:
    """Measure, print, and on request keep.

    Args:
        seconds: Length of one round [s].
        rounds: Rounds of each side.
        sensors: Fingers of the load test.
        load_seconds: Length of the load test [s].
        ramp: Raise the rate until a frame is lost.
        bundle: Bundle that is served.
        as_json: Print JSON.
        save: Append to the history.
    """
    folder = resolve(bundle)
    quiet = Console(stderr=True)
    columns = (TextColumn("{task.description:32}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=quiet, disable=not sys.stderr.isatty()) as bar:
        palpate, floor = measure_latency(
            seconds=seconds, rounds=rounds, bundle=bundle, model=folder / "model.onnx", bar=bar
        )
        load = run_load(
            sensors=sensors, rate_hz=RATE_HZ, seconds=load_seconds, bundle=bundle, bar=bar
        )
        first_loss = ramp_rate(load, bundle=bundle, bar=bar) if ramp else None
    values = _values(palpate, floor, load, first_loss)
    if as_json:
        print(json.dumps({**values, "machine": machine()}, indent=2))
    else:
        _print(palpate, floor, load, first_loss, ramped=ramp)
    if save:
        append_history("e2e", values)


def measure_latency(
    *, seconds: float, rounds: int, bundle: str, model: Path, bar: Progress
) -> tuple[Latency, Latency]:
    """Latency of palpate and of the floor, in turns.

    Raises:
        ProcessEnded: A process of the benchmark ended early.
        LinkError: They did not find one another in time.
    """
    with Children("bench") as children:
        gates = children.folder / "gates"
        opened = [Gate(gates, _PALPATE), Gate(gates, _FLOOR)]
        outs = [children.folder / "palpate.npz", children.folder / "floor.npz"]
        start_palpate(children, bundle, outs[_PALPATE], _one_finger(gates), delivery="newest")
        _start_floor(children, model, outs[_FLOOR], gates)
        names = ["gateway", "features", "client", "floor-source", "floor-service", "floor-client"]
        # Both run their first frames through, unmeasured: tare, first inference, page faults.
        for gate in opened:
            gate.set(True)
            time.sleep(1.5)
            gate.set(False)
            time.sleep(_SETTLE_S)
        task = bar.add_task("latency, interleaved", total=2 * rounds)
        for turn in range(rounds):
            # Who goes first changes, so that no side is always the one after the other.
            for side in (turn % 2, 1 - turn % 2):
                opened[side].set(True)
                time.sleep(seconds)
                opened[side].set(False)
                time.sleep(_SETTLE_S)
                children.check(names)
                bar.advance(task)
        for gate in opened:
            gate.set(True)  # a source that waits at its gate would not hear the signal to stop
        for name in reversed(names):
            children.stop_one(name)
        results = []
        for out in outs:
            _, rows, _ = read_rows(out)
            # Sequences run on from the first frame; those before the first estimate had no tare.
            lost = int(rows[-1, 0] - rows[0, 0] + 1 - len(rows)) if len(rows) else -1
            if not len(rows):
                raise LinkError(
                    "no estimate came to the client of the benchmark",
                    remedy=f"see the logs in {children.folder / 'logs'}",
                )
            results.append(latency(rows, warm_up=_WARM_UP, lost=lost))
    return results[_PALPATE], results[_FLOOR]


def start_palpate(
    children: Children, bundle: str, out: Path, sensors: list[dict[str, Any]], *, delivery: str
) -> Profile:
    """Start router, features, client and the gateway; return when all but the gateway are ready.

    Raises:
        LinkError: They are not ready in time.
    """
    endpoint = free_endpoint()
    profile = changed(
        load_profile("bench"),
        router={"listen": (endpoint,)},
        link={"connect": (endpoint,)},
        features={"bundle": bundle},
        gateway={"sensors": sensors},
        log={"level": "warning"},
    )
    children.start_profile(profile)
    part = [sys.executable, "-m", "palpate_deploy.bench.parts"]
    children.start("client", [*part, "client", endpoint, profile.station, str(out), delivery])
    wait_ready(profile, {"features", "client"})
    start_gateway(children, profile)
    return profile


def start_gateway(children: Children, profile: Profile, name: str = "gateway") -> None:
    """Start the gateway of a benchmark with the benchmark's driver."""
    path = write_profile(profile, children.folder)
    part = [sys.executable, "-m", "palpate_deploy.bench.parts"]
    children.start(name, [*part, "gateway", str(path)])


def wait_ready(profile: Profile, services: set[str]) -> None:
    """Wait until services are ready.

    Raises:
        LinkError: They are not in time.
    """
    link = LinkConfig(connect=profile.link.connect, wait_for_router_s=_READY_S)
    deadline = time.monotonic() + _READY_S
    with Session.open(link, station=profile.station) as session:
        while True:
            missing = services - {one.service for one in session.alive() if one.ready}
            if not missing:
                break
            if time.monotonic() > deadline:
                raise LinkError(
                    f"{', '.join(sorted(missing))} not ready within {_READY_S:g} s",
                    remedy="see the logs of the benchmark in the run's folder",
                )
            time.sleep(0.05)
    time.sleep(_SETTLE_S)  # subscriptions travel after presence


def _one_finger(gates: Path) -> list[dict[str, Any]]:
    options = {"rate_hz": RATE_HZ, "gate": str(gates), "gate_index": _PALPATE}
    return [{"name": "finger", "driver": "bench", "options": options}]


def _start_floor(children: Children, model: Path, out: Path, gates: Path) -> None:
    endpoint = free_endpoint()
    settings = {
        "router": _settings(children, "router", LinkConfig(connect=(), listen=(endpoint,))),
        "peer": _settings(children, "peer", LinkConfig(connect=(endpoint,))),
    }
    floor = [sys.executable, "-m", "palpate_deploy.bench.floor"]
    children.start("floor-router", [*floor, "router", settings["router"]])
    time.sleep(0.5)
    children.start("floor-service", [*floor, "service", settings["peer"], str(model)])
    children.start("floor-client", [*floor, "client", settings["peer"], str(out)])
    time.sleep(1.5)
    children.start("floor-source", [*floor, "source", settings["peer"], str(gates), str(RATE_HZ)])
    time.sleep(1.0)


def _settings(children: Children, mode: str, link: LinkConfig) -> str:
    """Palpate's own Zenoh settings as a file: the same for both sides by construction."""
    from palpate.bus.settings import zenoh_config

    path = children.folder / f"floor-{mode}.json5"
    path.write_text(str(zenoh_config(link, mode)), encoding="utf-8")
    return str(path)


def _values(
    palpate: Latency, floor: Latency, load: LoadResult, first_loss: LoadResult | None
) -> dict[str, Any]:
    p50, p99 = palpate.p50_s / floor.p50_s, palpate.p99_s / floor.p99_s
    return {
        "e2e.palpate": plain(palpate),
        "e2e.floor": plain(floor),
        "e2e.p50_ratio": round(p50, 3),
        "e2e.p99_ratio": round(p99, 3),
        "e2e.p50_goal_met": p50 <= P50_GOAL,
        "e2e.p99_goal_met": p99 <= P99_GOAL,
        "load": load.plain(),
        "load.goal_met": load.lost == 0,
        "first_loss": None if first_loss is None else first_loss.plain(),
    }


def _print(
    palpate: Latency,
    floor: Latency,
    load: LoadResult,
    first_loss: LoadResult | None,
    *,
    ramped: bool,
) -> None:
    console = Console()
    table = Table(
        title=f"frame stamp to estimate in the client, one finger at {RATE_HZ:g} Hz, loopback TCP",
        title_justify="left",
    )
    for column in ("", "p50", "p99", "max", "estimates", "lost"):
        table.add_column(column, justify="right" if column else "left")
    for name, side in (("palpate", palpate), ("floor", floor)):
        table.add_row(
            name,
            *(f"{value * 1e3:.3f} ms" for value in (side.p50_s, side.p99_s, side.max_s)),
            f"{side.count:,}",
            str(side.lost),
        )
    p50, p99 = palpate.p50_s / floor.p50_s, palpate.p99_s / floor.p99_s
    table.add_row(
        "ratio (goal)",
        _against(p50, P50_GOAL),
        _against(p99, P99_GOAL),
        f"{palpate.max_s / floor.max_s:.2f}",
        "",
        "",
    )
    console.print(table)
    console.print(load.sentence(), soft_wrap=True, highlight=False)
    if first_loss is not None:
        console.print(f"first loss: {first_loss.sentence()}", soft_wrap=True, highlight=False)
    elif ramped:
        console.print("no frame was lost up to the end of the ramp")


def _against(ratio: float, goal: float) -> str:
    colour = "green" if ratio <= goal else "red"
    return f"[{colour}]{ratio:.2f}[/] (<= {goal:g})"
