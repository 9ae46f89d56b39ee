"""The load test of ``palpate bench e2e``: frames of many fingers, and where each of them is lost.

Beside losses and ages it says where the time goes: the share of a core that each process takes, and
the stages of an estimate as its service notes them.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from palpate.messages import ServiceState
from palpate.process import cpu_time_s
from palpate_deploy.bench.harness import read_rows
from palpate_deploy.bench.results import stage_medians
from palpate_deploy.bench.station import wait_ready
from palpate_deploy.diagnose.replay import total
from palpate_deploy.station.host import join, private_profile, write_profile
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.status import ask_status

_STEP = 1.25
_STEP_S = 3.0
_RATE_MAX_HZ = 2000.0
_UNANSWERED = frozenset({"untared", "restarts", "frames_received", "estimates_published"})
_TARE_FRAMES = 50
_GRACE_S = 30.0
_UNKNOWN_S = 1.0
"""So long frames are sent before it is known, at most [s]."""

_PROCESSES = ("gateway", "service", "client", "router")

_FIELD_QUEUE = {"rate_hz": 1000.0, "keep_newest": 10, "max_age_s": 0.5}
"""A field of every frame, as features by default, and patience for a host that is busy."""


@dataclass(frozen=True, slots=True)
class LoadResult:
    """The account of a load test of a ``service`` with ``sensors`` fingers, each at ``rate_hz``.

    ``published`` counts the tared frames, which need an estimate, by the gateway's counters;
    ``reached_hz`` is the rate of a finger that the gateway reached, ``received`` the estimates in
    the client, ``lost_at`` lost frames by place and reason; the percentiles are ages there [s].
    ``silent`` counts the fingers without any estimate there, e.g. for want of a tare.
    ``cores`` are the shares of a core that the processes took while frames were sent, and
    ``stages_s`` the medians of the estimates' stages [s].
    """

    service: str
    sensors: int
    rate_hz: float
    published: int
    reached_hz: float
    received: int
    lost_at: dict[str, int] = field(default_factory=dict)
    p50_s: float = 0.0
    p99_s: float = 0.0
    cores: dict[str, float] = field(default_factory=dict)
    stages_s: dict[str, float] = field(default_factory=dict)
    silent: int = 0

    @property
    def met(self) -> bool:
        """Whether every finger got estimates, and none was lost."""
        return self.lost == 0 and self.silent == 0

    @property
    def lost(self) -> int:
        """Frames without an estimate in the client."""
        return self.published - self.received

    def plain(self) -> dict[str, Any]:
        """As JSON."""
        return {**asdict(self), "lost": self.lost}

    def sentences(self) -> list[str]:
        """For people."""
        where = ", ".join(f"{count} {place}" for place, count in self.lost_at.items())
        stages = ", ".join(f"{name} {value * 1e3:.2f}" for name, value in self.stages_s.items())
        return [
            f"{self.service}: {self.sensors} fingers at {self.rate_hz:g} Hz "
            f"({self.reached_hz * self.sensors:,.0f} frames/s sent): "
            f"{self.lost} of {self.published:,} frames lost"
            + (f" ({where})" if where else "")
            + (f", {self.silent} fingers without any estimate" if self.silent else "")
            + f", p50 {self.p50_s * 1e3:.2f} ms, p99 {self.p99_s * 1e3:.2f} ms",
            "  cores: " + ", ".join(f"{name} {share:.2f}" for name, share in self.cores.items()),
            *([f"  median stages [ms]: {stages}"] if stages else []),
        ]


def ramp_rate(base: LoadResult, *, bundle: str, bar: Progress) -> LoadResult | None:
    """Raise the rate from the base's until a frame is lost; None if none ever is."""
    if not base.met:
        return base
    rate_hz = base.rate_hz * _STEP
    while rate_hz <= _RATE_MAX_HZ:
        result = run_load(
            base.service,
            sensors=base.sensors,
            rate_hz=round(rate_hz),
            seconds=_STEP_S,
            bundle=bundle,
            bar=bar,
        )
        if not result.met:
            return result
        rate_hz *= _STEP
    return None


def run_load(
    service: str, *, sensors: int, rate_hz: float, seconds: float, bundle: str, bar: Progress
) -> LoadResult:
    """Send frames of many fingers through gateway, service and client; account for each.

    ``service`` is ``"features"`` or ``"field"``, which then answers every frame.
    """
    task = bar.add_task(f"{service}: {sensors} fingers at {rate_hz:g} Hz", total=None)
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
        # The client queues all messages: a frame counts as lost if its estimate did not arrive.
        profile = start_palpate(children, bundle, out, fingers, delivery="queue", service=service)
        pids = {name: children.pid(service if name == "service" else name) for name in _PROCESSES}
        deadline = time.monotonic() + seconds * 3 + _GRACE_S
        with join(profile, wait_s=10.0) as session:
            wait_ready(profile, {"gateway"})  # what its start takes is no part of the load
            began_s, cpu_s = time.monotonic(), _cpu_s(pids)
            sending_s = max(seconds - _UNKNOWN_S, seconds / 2)
            time.sleep(sending_s)
            taken_s = time.monotonic() - began_s
            cores = {
                name: round((now_s - cpu_s[name]) / taken_s, 3)
                for name, now_s in _cpu_s(pids).items()
            }
            # Rarely: every request for the status is load as well.
            time.sleep(seconds - sending_s)
            while True:
                statuses = {status.service: status for status in ask_status(session)}
                gateway = statuses.get("gateway")
                if gateway is not None and gateway.state is ServiceState.FINISHED:
                    break
                children.check(["gateway", service, "client"])
                if time.monotonic() > deadline:
                    break
                time.sleep(0.5)
            elapsed_s = time.monotonic() - began_s
            time.sleep(1.2)  # the last messages arrive, and the services update their counters
            statuses = {status.service: status for status in ask_status(session)}
        for name in ("client", "gateway", service):
            children.stop_one(name)
        bar.update(task, total=1, completed=1)
        counters = {name: dict(status.counters) for name, status in statuses.items()}
        return _account(out, service, sensors, rate_hz, counters, elapsed_s, cores)


def _cpu_s(pids: dict[str, int]) -> dict[str, float]:
    """Processor time that processes have taken so far [s]; those of Linux."""
    taken: dict[str, float] = {}
    for name, pid in pids.items():
        with contextlib.suppress(OSError):  # not Linux, or it has ended
            taken[name] = cpu_time_s(pid)
    return taken


def _account(
    out: Path,
    service: str,
    sensors: int,
    rate_hz: float,
    counters: dict[str, dict[str, int]],
    elapsed_s: float,
    cores: dict[str, float],
) -> LoadResult:
    names, rows, dropped = read_rows(out)
    gateway, answered = counters.get("gateway", {}), counters.get(service, {})
    due = total(gateway, "frames_published") - total(gateway, "frames_untared")
    lost_at: Counter[str] = Counter()
    for name, count in answered.items():
        if count and name not in _UNANSWERED and not name.startswith("asked"):
            lost_at[f"in {service} ({name})"] += count
    estimates = answered.get("estimates_published", 0)
    if dropped:
        lost_at["in the client (overflow)"] = dropped
    if (on_the_way := estimates - len(rows) - dropped) > 0:
        lost_at[f"between {service} and client"] = on_the_way
    ages_s = (rows[:, 2] - rows[:, 1]) * 1e-9
    sent_s = (rows[:, 1].max() - rows[:, 1].min()) * 1e-9 if len(rows) else elapsed_s
    p50, p99 = np.percentile(ages_s, (50, 99)) if len(rows) else (0.0, 0.0)
    return LoadResult(
        service,
        sensors,
        rate_hz,
        due,
        due / sensors / max(sent_s, 1e-9),
        len(names),
        dict(lost_at),
        float(p50),
        float(p99),
        cores,
        stage_medians(rows),
        silent=sensors - len(np.unique(names)),
    )


def start_palpate(
    children: FiniteRun,
    bundle: str,
    out: Path,
    sensors: list[dict[str, Any]],
    *,
    delivery: str,
    service: str = "features",
    core: int | str = "idlest",
) -> Profile:
    """Start router, service, client and the gateway; return when all but the gateway are ready.

    The gateway stays on ``core``.
    """
    options = {"bundle": bundle, **(_FIELD_QUEUE if service == "field" else {})}
    profile = private_profile(
        "bench",
        **{service: options},
        gateway={"sensors": sensors, "core": core},
        log={"level": "warning"},
    ).model_copy(update={"processes": ("router", service)})
    children.start_profile(profile)
    where = profile.link.connect[0], profile.station
    children.start_module("client", "bench.parts", "client", *where, out, delivery, service)
    wait_ready(profile, {service, "client"})
    path = write_profile(profile, children.folder)
    children.start_module("gateway", "bench.parts", "gateway", path)
    return profile
