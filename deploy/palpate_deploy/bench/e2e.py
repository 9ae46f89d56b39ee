"""``palpate bench e2e``: latency from a frame's stamp to a client's estimate, and a load test.

For the latency two sets of processes run at once, palpate and a bare floor, each with router,
source, service and client over loopback TCP. A gate lets one source send at a time, in turns of a
few seconds, so that both meet the same disturbances by the host: their ratio does not depend on its
speed. The load test sends frames of many fingers and accounts for each that is lost.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from palpate.config import LinkConfig
from palpate.errors import LinkError
from palpate.messages import ServiceState
from palpate_deploy.bench.harness import SourceGate, read_rows
from palpate_deploy.bench.results import Latency, finish, latency, progress_bar
from palpate_deploy.bench.station import SETTLE_S, wait_ready
from palpate_deploy.diagnose.replay import total
from palpate_deploy.station.host import free_endpoint, join, private_profile, write_profile
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.status import ask_status
from palpate_services.inference.repository import Repository

_STEP = 1.25
_STEP_S = 3.0
_RATE_MAX_HZ = 2000.0
_UNANSWERED = ("untared", "restarts", "frames_received", "estimates_published")
_TARE_FRAMES = 50
_GRACE_S = 30.0


@dataclass(frozen=True, slots=True)
class LoadResult:
    """The account of a load test with ``sensors`` fingers, each at ``rate_hz``.

    ``published`` counts the tared frames, which need an estimate, by the gateway's counters;
    ``reached_hz`` is the rate of a finger that the gateway reached, ``received`` the estimates in
    the client, ``lost_at`` lost frames by place and reason; the percentiles are ages there [s].
    """

    sensors: int
    rate_hz: float
    published: int
    reached_hz: float
    received: int
    lost_at: dict[str, int] = field(default_factory=dict)
    p50_s: float = 0.0
    p99_s: float = 0.0

    @property
    def lost(self) -> int:
        """Frames without an estimate in the client."""
        return self.published - self.received

    def plain(self) -> dict[str, Any]:
        """As JSON."""
        return {**asdict(self), "lost": self.lost}

    def sentence(self) -> str:
        """For people."""
        where = ", ".join(f"{count} {place}" for place, count in self.lost_at.items())
        return (
            f"{self.sensors} fingers at {self.rate_hz:g} Hz ({self.reached_hz * self.sensors:,.0f} "
            f"frames/s sent): {self.lost} of {self.published:,} frames lost"
            + (f" ({where})" if where else "")
            + f", p50 {self.p50_s * 1e3:.2f} ms, p99 {self.p99_s * 1e3:.2f} ms"
        )


def ramp_rate(base: LoadResult, *, bundle: str, bar: Progress) -> LoadResult | None:
    """Raise the rate from the base's until a frame is lost; None if none ever is."""
    if base.lost:
        return base
    rate_hz = base.rate_hz * _STEP
    while rate_hz <= _RATE_MAX_HZ:
        result = run_load(
            sensors=base.sensors,
            rate_hz=round(rate_hz),
            seconds=_STEP_S,
            bundle=bundle,
            bar=bar,
        )
        if result.lost:
            return result
        rate_hz *= _STEP
    return None


def run_load(
    *, sensors: int, rate_hz: float, seconds: float, bundle: str, bar: Progress
) -> LoadResult:
    """Send frames of many fingers through gateway, features and client; account for each."""
    task = bar.add_task(f"{sensors} fingers at {rate_hz:g} Hz", total=None)
    frames = round(rate_hz * seconds) + _TARE_FRAMES
    fingers = [
        {
            "name": f"finger{index}",
            "driver": "bench",
            "options": {"rate_hz": rate_hz, "frames": frames, "phase": index / sensors},
        }
        for index in range(sensors)
    ]
    with FiniteRun("bench-load") as children:
        out = children.folder / "client.npz"
        began = time.monotonic()
        # The client queues all messages: a frame counts as lost if its estimate did not arrive.
        profile = start_palpate(children, bundle, out, fingers, delivery="queue")
        deadline = time.monotonic() + seconds * 3 + _GRACE_S
        with join(profile, wait_s=10.0) as session:
            # Rarely: every request for the status is load as well.
            time.sleep(seconds)
            while True:
                statuses = {status.service: status for status in ask_status(session)}
                gateway = statuses.get("gateway")
                if gateway is not None and gateway.state is ServiceState.FINISHED:
                    break
                children.check(["gateway", "features", "client"])
                if time.monotonic() > deadline:
                    break
                time.sleep(0.5)
            time.sleep(1.2)  # the last messages arrive, and the services update their counters
            statuses = {status.service: status for status in ask_status(session)}
        for name in ("client", "gateway", "features"):
            children.stop_one(name)
        bar.update(task, total=1, completed=1)
        return _account(out, sensors, rate_hz, statuses, time.monotonic() - began)


def _account(
    out: Path, sensors: int, rate_hz: float, statuses: dict[str, Any], elapsed_s: float
) -> LoadResult:
    names, rows, dropped = read_rows(out)
    gateway = dict(statuses["gateway"].counters) if "gateway" in statuses else {}
    features = dict(statuses["features"].counters) if "features" in statuses else {}
    due = total(gateway, "frames_published") - total(gateway, "frames_untared")
    lost_at: Counter[str] = Counter()
    for name, count in features.items():
        if count and name not in _UNANSWERED:
            lost_at[f"in features ({name})"] += count
    estimates = features.get("estimates_published", 0)
    if dropped:
        lost_at["in the client (overflow)"] = dropped
    if (on_the_way := estimates - len(rows) - dropped) > 0:
        lost_at["between features and client"] = on_the_way
    ages_s = (rows[:, 2] - rows[:, 1]) * 1e-9
    sent_s = (rows[:, 1].max() - rows[:, 1].min()) * 1e-9 if len(rows) else elapsed_s
    p50, p99 = np.percentile(ages_s, (50, 99)) if len(rows) else (0.0, 0.0)
    return LoadResult(
        sensors,
        rate_hz,
        due,
        due / sensors / max(sent_s, 1e-9),
        len(names),
        dict(lost_at),
        float(p50),
        float(p99),
    )


RATE_HZ = 100.0
P50_GOAL, P99_GOAL = 1.5, 2.0
"""Times the floor (serving reference, goal G1)."""

_PALPATE, _FLOOR = 0, 1
_WARM_UP = 20


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
    """``palpate bench e2e``, whose help explains the options: measure, print, keep."""
    folder = Repository.of_user().resolve(bundle)
    with progress_bar() as bar:
        palpate, floor = measure_latency(
            seconds=seconds, rounds=rounds, bundle=bundle, model=folder / "model.onnx", bar=bar
        )
        load = run_load(
            sensors=sensors, rate_hz=RATE_HZ, seconds=load_seconds, bundle=bundle, bar=bar
        )
        first_loss = ramp_rate(load, bundle=bundle, bar=bar) if ramp else None
    values = _values(palpate, floor, load, first_loss)
    finish(
        "e2e",
        values,
        lambda: _print(palpate, floor, load, first_loss, ramped=ramp),
        as_json=as_json,
        save=save,
    )


def measure_latency(
    *, seconds: float, rounds: int, bundle: str, model: Path, bar: Progress
) -> tuple[Latency, Latency]:
    """Latency of palpate and of the floor, in turns."""
    with FiniteRun("bench") as children:
        gates = children.folder / "gates"
        opened = [SourceGate(gates, _PALPATE), SourceGate(gates, _FLOOR)]
        outs = [children.folder / "palpate.npz", children.folder / "floor.npz"]
        options = {"rate_hz": RATE_HZ, "gate": str(gates), "gate_index": _PALPATE}
        finger = {"name": "finger", "driver": "bench", "options": options}
        start_palpate(children, bundle, outs[_PALPATE], [finger], delivery="newest")
        _start_floor(children, model, outs[_FLOOR], gates)
        names = ["gateway", "features", "client", "floor-source", "floor-service", "floor-client"]
        # The first frames are not measured: tare, first inference, page faults.
        for gate in opened:
            gate.set(True)
            time.sleep(1.5)
            gate.set(False)
            time.sleep(SETTLE_S)
        task = bar.add_task("latency, interleaved", total=2 * rounds)
        for turn in range(rounds):
            # The order alternates, so that no side always follows the other.
            for side in (turn % 2, 1 - turn % 2):
                opened[side].set(True)
                time.sleep(seconds)
                opened[side].set(False)
                time.sleep(SETTLE_S)
                children.check(names)
                bar.advance(task)
        for gate in opened:
            gate.set(True)  # a source that waits at its gate does not see the stop event
        for name in reversed(names):
            children.stop_one(name)
        results = []
        for out in outs:
            _, rows, _ = read_rows(out)
            # Frames before the first estimate had no tare and do not count as lost.
            lost = int(rows[-1, 0] - rows[0, 0] + 1 - len(rows)) if len(rows) else -1
            if not len(rows):
                raise LinkError(
                    "no estimate came to the client of the benchmark",
                    remedy=f"see the logs in {children.folder / 'logs'}",
                )
            results.append(latency(rows, warm_up=_WARM_UP, lost=lost))
    return results[_PALPATE], results[_FLOOR]


def start_palpate(
    children: FiniteRun, bundle: str, out: Path, sensors: list[dict[str, Any]], *, delivery: str
) -> Profile:
    """Start router, features, client and the gateway; return when all but the gateway are ready."""
    profile = private_profile(
        "bench",
        features={"bundle": bundle},
        gateway={"sensors": sensors},
        log={"level": "warning"},
    )
    children.start_profile(profile)
    where = profile.link.connect[0], profile.station
    children.start_module("client", "bench.parts", "client", *where, out, delivery)
    wait_ready(profile, {"features", "client"})
    path = write_profile(profile, children.folder)
    children.start_module("gateway", "bench.parts", "gateway", path)
    return profile


def _start_floor(children: FiniteRun, model: Path, out: Path, gates: Path) -> None:
    from palpate.bus.link import zenoh_config

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
    children.start_module("floor-source", "bench.floor", "source", peer, gates, RATE_HZ)
    time.sleep(1.0)


def _values(
    palpate: Latency, floor: Latency, load: LoadResult, first_loss: LoadResult | None
) -> dict[str, Any]:
    p50, p99 = palpate.p50_s / floor.p50_s, palpate.p99_s / floor.p99_s
    return {
        "e2e.palpate": asdict(palpate),
        "e2e.floor": asdict(floor),
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
    console = Console(highlight=False)
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
    console.print(load.sentence(), soft_wrap=True)
    if first_loss is not None:
        console.print(f"first loss: {first_loss.sentence()}", soft_wrap=True)
    elif ramped:
        console.print("no frame was lost up to the end of the ramp")


def _against(ratio: float, goal: float) -> str:
    colour = "green" if ratio <= goal else "red"
    return f"[{colour}]{ratio:.2f}[/] (<= {goal:g})"
