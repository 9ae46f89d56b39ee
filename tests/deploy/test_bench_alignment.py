"""The alignment benchmark: its account on frames whose errors are known, and that it runs."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.messages import (
    BIOTAC_LAYOUT,
    ElectrodeFrame,
    IndenterPoseFrame,
    Origin,
    SensorType,
    Stamp,
    WrenchFrame,
)
from palpate.sampling import slots_of
from palpate_deploy.bench.alignment import (
    AlignmentResult,
    apart,
    page_of,
    spread,
    stamp_errors,
)
from palpate_deploy.bench.alignment_parts import (
    LATE_S,
    LOW_COUNTS,
    LOW_N,
    MARGIN_S,
    RAMP_S,
    SPAN_COUNTS,
    SPAN_M,
    SPAN_N,
    Lateness,
    OnTime,
    share_at,
    time_of,
)

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

SLOT_NS = 227_273
START_NS = 40_000_000_000
COUNT_S = RAMP_S / SPAN_COUNTS
"""What a count is worth: half of it is the error of a count that was rounded."""


ALWAYS = OnTime(np.zeros((0, 2)))


def stamp(time_ns: int) -> Stamp:
    return Stamp(1, 1, time_ns, 10**18 + time_ns, 7, Origin.LIVE)


def frame(true_ns: int, late_ns: int) -> ElectrodeFrame:
    times_s = 1e-9 * (true_ns + slots_of(BIOTAC_LAYOUT) * SLOT_NS).astype(np.float64)
    counts = np.rint(LOW_COUNTS + SPAN_COUNTS * share_at(times_s)).astype(np.uint16)
    return ElectrodeFrame(
        stamp=stamp(true_ns + late_ns),
        sensor_serial="s1",
        sensor_type=SensorType.BIOTAC,
        electrodes=counts[:19],
        pdc=int(counts[19]),
        pac=counts[22:],
        tac=int(counts[20]),
        tdc=int(counts[21]),
        validity=BIOTAC_LAYOUT.all_valid,
        slot_period_ns=SLOT_NS,
    )


def wrench(true_ns: int, late_ns: int) -> WrenchFrame:
    force_n = LOW_N + SPAN_N * float(share_at(np.array(1e-9 * true_ns)))
    force = np.array([0.0, 0.0, force_n], np.float32)
    return WrenchFrame(stamp(true_ns + late_ns), "ft", force, np.zeros(3, np.float32))


def pose(true_ns: int, late_ns: int) -> IndenterPoseFrame:
    travel_m = SPAN_M * float(share_at(np.array(1e-9 * true_ns)))
    at = np.array([travel_m, 0.0, 0.0])
    return IndenterPoseFrame(stamp(true_ns + late_ns), "sphere_7mm", at, np.array([1.0, 0, 0, 0]))


def grid(rate_hz: float, seconds: float = 2.0) -> list[int]:
    return [START_NS + round(1e9 * k / rate_hz) for k in range(round(seconds * rate_hz))]


def test_time_is_read_off_the_ramp_but_not_at_its_turning_points() -> None:
    time_s = np.linspace(3.0, 5.0, 2001)
    found_s = time_of(share_at(time_s), time_s + 0.4e-3)
    near_turn = np.abs((time_s + 0.5 * RAMP_S) % RAMP_S - 0.5 * RAMP_S) < MARGIN_S - 1e-3
    assert np.isnan(found_s[near_turn]).all()
    kept = np.isfinite(found_s)
    assert kept.mean() > 0.75
    np.testing.assert_allclose(found_s[kept], time_s[kept], atol=1e-9)


def test_errors_of_stamps_are_found_exactly() -> None:
    frames = [frame(at, 300_000) for at in grid(100.0)]
    wrenches = {"early": [wrench(at, -700_000) for at in grid(1000.0)]}
    poses = [pose(at, 50_000) for at in grid(250.0)]
    found = stamp_errors(frames, wrenches, poses, ALWAYS)
    assert found["electrodes"].median_s == pytest.approx(0.3e-3, abs=0.6 * COUNT_S)
    assert found["electrodes"].max_s < 0.3e-3 + 0.6 * COUNT_S
    assert found["PAC"].median_s == pytest.approx(0.3e-3, abs=0.6 * COUNT_S)
    assert found["early"].median_s == pytest.approx(-0.7e-3, abs=1e-6)
    assert found["early"].p99_s == pytest.approx(0.7e-3, abs=1e-6)
    assert found["pose"].median_s == pytest.approx(0.05e-3, abs=1e-6)
    # Who takes E1 to E19 for simultaneous is off by up to 36 slots.
    skew = found["electrodes, all at the stamp"]
    assert skew.max_s == pytest.approx(36e-9 * SLOT_NS - 0.3e-3, abs=COUNT_S)


def test_streams_that_were_aligned_are_apart_by_the_difference_of_their_errors() -> None:
    frames = [frame(at, 300_000) for at in grid(100.0)]
    wrenches = {
        "same": [wrench(at, 300_000) for at in grid(500.0)],
        "late": [wrench(at, 900_000) for at in grid(500.0)],
    }
    found = apart(frames, wrenches, [pose(at, -100_000) for at in grid(250.0)], ALWAYS)
    assert found["same"].p99_s < 0.6 * COUNT_S
    assert found["late"].median_s == pytest.approx(0.6e-3, abs=0.6 * COUNT_S)
    assert found["pose"].median_s == pytest.approx(-0.4e-3, abs=0.6 * COUNT_S)


def test_lost_samples_are_no_errors() -> None:
    whole = frame(START_NS + 100_000_000, 0)
    lost = np.array([*whole.electrodes[:5], 0, *whole.electrodes[6:]], np.uint16)
    cut = replace(whole, electrodes=lost, validity=BIOTAC_LAYOUT.all_valid & ~(1 << 5))
    wrenches = {"w": [wrench(at, 0) for at in grid(500.0)]}
    found = stamp_errors([cut], wrenches, [pose(at, 0) for at in grid(250.0)], ALWAYS)
    assert found["electrodes"].count == 18
    assert found["electrodes"].max_s < 0.6 * COUNT_S


def test_what_a_starved_emulator_sent_does_not_count(tmp_path: Path) -> None:
    lateness = Lateness()
    now_s = time.monotonic()
    lateness.note(now_s)
    lateness.note(now_s - 10 * LATE_S)
    lateness.note(now_s - 9 * LATE_S)  # the same burst
    lateness.note(now_s - 100.0)
    lateness.write(tmp_path / "late.npy")
    Lateness().write(tmp_path / "never.npy")
    on_time = OnTime.of([tmp_path / "late.npy", tmp_path / "never.npy"])
    times_s = now_s + np.array([-101.0, -50.0, -0.01, 0.1, 5.0])
    assert on_time(times_s).tolist() == [True, False, False, False, True]
    assert OnTime(np.zeros((0, 2)))(times_s).all()
    frames = [frame(at, 0) for at in grid(100.0)]
    wrenches = {"w": [wrench(at, 5_000_000 * (k > 500)) for k, at in enumerate(grid(500.0))]}
    starved = OnTime(np.array([[1e-9 * START_NS + 1.0, 1e-9 * START_NS + 2.0]]))
    poses = [pose(at, 0) for at in grid(250.0)]
    assert stamp_errors(frames, wrenches, poses, starved)["w"].max_s < 1e-6
    assert apart(frames, wrenches, poses, starved)["w"].max_s < 0.6 * COUNT_S


def test_of_nothing_there_is_no_spread() -> None:
    nothing = spread(np.array([np.nan]))
    assert nothing.count == 0
    assert np.isnan(nothing.p95_s)
    stamps = {"x": spread(np.array([1e-3, 2e-3]))}
    host = {"cpus": 2, "cpu": "a", "load_1min": 0.1}
    text = page_of(AlignmentResult(1.0, 0.5, stamps, {}, {"a.clock_drift_ppm": 3.0}), host)
    assert "| x | 2 | 1.500 ms |" in text
    assert "`a.clock_drift_ppm` | 3 |" in text


@pytest.mark.slow
def test_it_runs_the_whole_way(palpate: Palpate, tmp_path: Path) -> None:
    page = tmp_path / "alignment.md"
    words = ("bench", "alignment", "--seconds", "2", "--settle-seconds", "1", "--json")
    result = palpate(*words, "--page", str(page), timeout=120)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)["alignment"]
    assert set(found["apart"]) == {"kms40", "rdt", "bota", "pose"}
    assert set(found["stamps"]) >= {"electrodes", "PAC", "kms40", "rdt", "bota", "pose"}
    assert 0.0 <= found["kept"] <= 1.0
    assert found["kept"] < 0.1 or all(one["count"] for one in found["stamps"].values())
    assert found["gauges"]["kms40.clock_quality"] == 0.0
    assert {"finger.clock_drift_ppm", "rdt.clock_delay_p50_s"} <= set(found["gauges"])
    assert "# Errors of stamps and of alignment on one host" in page.read_text(encoding="utf-8")
