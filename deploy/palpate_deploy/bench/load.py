"""Many fingers at once: how many frames are lost, where, and at which rate the first one is."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from palpate.bus import Session
from palpate.config import LinkConfig
from palpate.messages import ServiceState
from palpate_deploy.bench.harness import read_rows
from palpate_deploy.children import Children
from palpate_deploy.replay_account import total
from palpate_deploy.status import ask_status

_STEP = 1.25
_STEP_S = 3.0
_RATE_MAX_HZ = 2000.0
_UNANSWERED = ("untared", "restarts", "frames_received", "estimates_published")
_TARE_FRAMES = 50
_GRACE_S = 30.0


@dataclass(frozen=True, slots=True)
class LoadResult:
    """What became of the frames of many fingers.

    Attributes:
        sensors: How many fingers.
        rate_hz: Of each [Hz].
        published: Frames that were due an estimate (tared), by the gateways' account.
        reached_hz: Frames per second and finger that the gateway really sent [Hz].
        received: Estimates in the client's hands.
        lost_at: Lost frames by place and reason.
        p50_s: Median age in the client [s].
        p99_s: 99th percentile [s].
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
    """Send frames of many fingers through gateway, features and client, and account for each.

    Args:
        sensors: How many fingers, in one gateway.
        rate_hz: Of each [Hz].
        seconds: How long [s].
        bundle: Bundle that is served.
        bar: Progress.

    Raises:
        ProcessEnded: A process of the benchmark ended early.
        LinkError: They did not find one another in time.
    """
    from palpate_deploy.bench.e2e import start_palpate

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
    with Children("bench-load") as children:
        out = children.folder / "client.npz"
        began = time.monotonic()
        # The client keeps all that comes: a frame is lost when palpate did not bring its estimate.
        profile = start_palpate(children, bundle, out, fingers, delivery="queue")
        link = LinkConfig(connect=profile.link.connect, wait_for_router_s=10)
        deadline = time.monotonic() + seconds * 3 + _GRACE_S
        with Session.open(link, station=profile.station) as session:
            # Asked seldom: the questions are load too.
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
            time.sleep(1.2)  # what is on its way arrives, and the services hand in their counts
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
