"""The benchmark of a hand: its account on a run whose losses are known, and that it runs."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import LinkError
from palpate.messages import ServiceState, Status
from palpate_deploy.bench.hand import GatewayUse, HandResult, account

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

SENSORS = [*(f"finger{k}" for k in range(5)), "kms40", "bota"]


def accounted(
    folder: Path,
    rows: list[list[int]],
    *,
    dropped: int = 0,
    end_ns: int = 12 * 10**6,
    heard: Sequence[bool] = (True,) * 4,
) -> HandResult:
    client, floor = folder / "client.npz", folder / "floor.npz"
    np.savez(
        client,
        sensors=np.array(SENSORS),
        rows=np.array(rows, np.int64),
        dropped=np.int64(dropped),
    )
    np.savez(floor, late_s=np.array([1e-4, 2e-4]), core=np.float64(0.4), heard=np.array(heard))
    looks = [
        Status(
            "gateway",
            "a",
            ServiceState.READY,
            1,
            1,
            1.0,
            "1",
            counters={"finger0.lost_slots": count, "finger0.samples": 9},
            gauges={"finger0.publish_p99_s": 1e-3 * count, "bota.publish_p99_s": 2e-3},
        )
        for count in (5, 3)
    ]
    used = GatewayUse(0.4, 0.5, 0, 0.0)
    return account(client, floor, 0, end_ns, used, {"finger0.lost_slots": 1}, looks)


def whole_run() -> list[list[int]]:
    """Sensor, sequence, missed before, last sample, arrival [ns], invalid; 10 of each sensor."""
    return [row for k in range(10) for row in whole_row(k)]


def whole_row(k: int) -> list[list[int]]:
    """The frames of all sensors after ``k`` ms."""
    return [[n, k + 1, 0, 10**6 * k, 10**6 * k + 2_000_000, 0] for n in range(7)]


def test_a_whole_run_has_lost_nothing(tmp_path: Path) -> None:
    result = accounted(tmp_path, whole_run())
    assert (result.frames, result.lost) == (70, 0)
    assert result.p50_s == result.p99_s == pytest.approx(2e-3)
    assert result.floor_p50_s == pytest.approx(1.5e-4)
    assert result.counters == {"finger0.lost_slots": 2}
    assert result.publish_p99_s == pytest.approx(5e-3)


@pytest.mark.parametrize(
    ("change", "lost"),
    [
        (lambda rows: [row for row in rows if row[:2] != [2, 5]], 1),  # a hole
        (lambda rows: [[*r[:2], 4 * (r[:2] == [3, 4]), *r[3:]] for r in rows], 4),  # told as missed
        (lambda rows: [[*r[:5], int(r[:2] == [0, 9])] for r in rows], 1),  # an invalid channel
        (lambda rows: [row for row in rows if row[0] != 6], 1),  # a sensor that never came
    ],
)
def test_what_is_lost_is_counted(
    tmp_path: Path, change: Callable[[list[list[int]]], list[list[int]]], lost: int
) -> None:
    assert accounted(tmp_path, change(whole_run())).lost == lost
    assert accounted(tmp_path, whole_run(), dropped=2).lost == 2


def test_a_sensor_that_stops_owes_its_frames_until_the_end(tmp_path: Path) -> None:
    """At its rate, 1 kHz, where it has one."""
    end_ns = 3 * 10**9
    on = [row for n in range(3000) for row in whole_row(n)]
    assert accounted(tmp_path, on, end_ns=end_ns).lost == 0
    stopped = [row for row in on if row[0] != 2 or row[1] <= 1000]
    assert accounted(tmp_path, stopped, end_ns=end_ns).lost == pytest.approx(2000, abs=5)
    just_one = [row for row in on if row[0] != 5 or row[1] <= 1]
    assert accounted(tmp_path, just_one, end_ns=end_ns).lost == 1


def test_a_floor_that_read_nothing_of_a_device_is_none(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="received from 3 of 4 devices"):
        accounted(tmp_path, whole_run(), heard=(True, True, False, True))


def test_no_loss_is_one_that_the_gateway_does_not_count_either(tmp_path: Path) -> None:
    """A sensor that falls silent and comes back leaves no hole in its numbers."""
    result = accounted(tmp_path, whole_run())
    assert not result.nothing_lost
    assert replace(result, counters={}).nothing_lost
    assert not replace(result, counters={"finger0.silences": 1}).nothing_lost
    assert not replace(result, counters={}, lost=1).nothing_lost


def test_it_runs(palpate: Palpate) -> None:
    words = ("bench", "hand", "--seconds", "2", "--floor-seconds", "2", "--json")
    done = palpate(*words, timeout=120)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    # How many frames a busy machine loses and how late they are, a test cannot ask.
    assert told["hand"]["frames"] > 0
    assert told["hand"]["floor_core"] > 0
    assert 0.0 <= told["hand"]["stolen"] < 1.0
    assert 0 < told["hand"]["publish_p50_s"] <= told["hand"]["publish_p99_s"]
    assert {"hand.core_goal_met", "hand.loss_goal_met", "hand.p99_ratio"} <= told.keys()
