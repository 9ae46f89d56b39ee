"""The virtual finger by closed formulas, and what every virtual finger does."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_gateway.device import Device
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import ElectrodeReading, PoseReading, Reading, WrenchReading
from palpate_gateway.virtual.formula_physics import (
    FormulaSpecimen,
    contact,
    electrode_counts,
    films,
    random_touch,
)


def collect(**options: Any) -> dict[str, Any]:
    with make_device("virtual", {"model": "formula", "realtime": False, **options}) as device:
        return arrays(drain(device))


def drain(device: Device) -> list[Reading]:
    readings: list[Reading] = []
    while got := device.read(1.0):
        readings += got
    return readings


def arrays(readings: list[Reading]) -> dict[str, Any]:
    frames = [r for r in readings if isinstance(r, ElectrodeReading)]
    wrenches = [r for r in readings if isinstance(r, WrenchReading)]
    poses = [r for r in readings if isinstance(r, PoseReading)]
    assert [r.tick for r in frames] == [r.tick for r in wrenches] == [r.tick for r in poses]
    return {
        "electrodes": np.array([r.electrodes for r in frames], int),
        "pac": np.array([r.pac for r in frames], int),
        "slow": np.array([(r.pdc, r.tac, r.tdc) for r in frames]),
        "force": np.array([r.force for r in wrenches]),
        "torque": np.array([r.torque for r in wrenches]),
        "tip": np.array([r.position for r in poses]),
        "quaternion": np.array([r.orientation for r in poses]),
        "contact": np.array([r.in_contact for r in poses]),
    }


@pytest.fixture(scope="module")
def run() -> dict[str, Any]:
    return collect(seed=5, episodes=40)


def test_same_options_same_counts() -> None:
    first, again = collect(seed=1, episodes=3), collect(seed=1, episodes=3)
    assert all(np.array_equal(first[key], again[key]) for key in first)
    other = collect(seed=2, episodes=3)
    assert not np.array_equal(first["tip"][:300], other["tip"][:300])


def test_pace_and_limit_do_not_change_the_counts() -> None:
    options = {"seed": 1, "frames": 200, "rate_hz": 1000}
    fast = collect(**options)
    with make_device("virtual", {**options, "model": "formula"}) as device:
        live = arrays(drain(device))
    assert all(np.array_equal(fast[key], live[key]) for key in fast)
    longer = collect(seed=1, frames=333, rate_hz=1000)
    assert all(np.array_equal(fast[key], longer[key][:200]) for key in fast)


def test_limits() -> None:
    assert len(collect(frames=7)["force"]) == 7
    assert len(collect(duration_s=0.25)["force"]) == 25
    assert len(collect(frames=7, duration_s=0.05)["force"]) == 5
    assert not make_device("virtual", {}).info.finite


def test_starts_untouched(run: dict[str, Any]) -> None:
    assert not run["contact"][:100].any()
    assert not collect(rate_hz=10, frames=50)["contact"].any()
    rest = run["electrodes"][:100]
    assert (rest.mean(axis=0) > 2000).all()
    assert (rest.mean(axis=0) < 3500).all()
    assert (rest.std(axis=0) < 1.0).all()


def test_force_pushes_the_finger_away_from_the_indenter(run: dict[str, Any]) -> None:
    force, contact = run["force"], run["contact"]
    assert not force[~contact].any()
    magnitude = np.linalg.norm(force, axis=1)
    assert 8.0 < magnitude.max() < 25.0
    # Pressed from the ventral side (-z), the finger is pushed dorsally (+z).
    assert (force[magnitude > 2.0, 2] > 0).mean() > 0.95
    # The indenter's own z axis points into the finger, where the normal force points.
    w, x, y, z = run["quaternion"].T
    into = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert (np.sum(into * force, axis=1)[contact] > 0).all()
    assert np.allclose(np.linalg.norm(run["quaternion"], axis=1), 1.0)


def test_friction_keeps_coulombs_limit(run: dict[str, Any]) -> None:
    w, x, y, z = run["quaternion"].T
    into = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    normal = np.sum(into * run["force"], axis=1)
    shear = np.linalg.norm(run["force"] - normal[:, None] * into, axis=1)
    assert (shear <= 0.6 * normal + 1e-4).all()
    assert shear.max() > 2.0


def test_torque_is_that_of_the_force_at_the_tip(run: dict[str, Any]) -> None:
    assert np.allclose(run["torque"], np.cross(run["tip"], run["force"]), atol=1e-6)


def test_counts_fall_under_the_contact_and_rise_beside_it(run: dict[str, Any]) -> None:
    tared = run["electrodes"] - run["electrodes"][:100].mean(axis=0)
    pressed = np.flatnonzero(np.linalg.norm(run["force"], axis=1) > 3.0)
    strongest = np.argmin(tared[pressed], axis=1)
    distance = np.linalg.norm(ELECTRODE_POSITIONS[strongest] - run["tip"][pressed], axis=1)
    every = np.linalg.norm(ELECTRODE_POSITIONS[None] - run["tip"][pressed, None], axis=2)
    assert np.median(distance - every.min(axis=1)) < 2e-3
    assert tared[pressed].min() < -0.4 * 4095
    assert 0.01 * 4095 < tared[pressed].max() < 0.15 * 4095
    assert (tared[pressed].max(axis=1) > 10).mean() > 0.8


def test_pressure_channels(run: dict[str, Any]) -> None:
    pdc = run["slow"][:, 0]
    rise = pdc - pdc[:100].mean()
    assert 500 < rise.max() < 750
    assert abs(run["pac"][:100].mean() - 2040) < 1.0
    assert run["pac"].std() > 20


def test_shear_shows_in_the_electrodes() -> None:
    """Traction alone, at the same place and depth, moves the counts by far more than the noise."""
    sheared = next(e for e in (random_touch(0, k) for k in range(50)) if e.shear_m > 0.5e-3)
    state = contact(sheared, np.array([sheared.times_s[2]]), 7e-3)
    without = state._replace(traction=np.zeros(1))
    counts, plain = (
        electrode_counts(films(sheared, s, 7e-3), FormulaSpecimen.number(1), np.ones(1))
        for s in (state, without)
    )
    assert np.abs(counts - plain).max() > 50


def test_units_differ_in_electrics_only() -> None:
    one, two = collect(unit=1, episodes=2), collect(unit=2, episodes=2)
    assert np.array_equal(one["force"], two["force"])
    assert np.abs(one["electrodes"][:50].mean(0) - two["electrodes"][:50].mean(0)).max() > 20


def test_a_host_that_slept_loses_frames_and_says_so() -> None:
    with make_device("virtual", {"rate_hz": 100}) as device:
        assert device.read(1.0)
        # As if the process had been stopped for three seconds.
        device._begun_s -= 3.0  # type: ignore[attr-defined]
        frame = device.read(1.0)[0]
        assert isinstance(frame, ElectrodeReading)
        assert frame.missed_before >= 290
        assert frame.tick == frame.missed_before + 1
        assert device.counters["missing_frames"] == frame.missed_before
        following = device.read(1.0)[0]
        assert isinstance(following, ElectrodeReading)
        assert (following.missed_before, following.tick) == (0, frame.tick + 1)
        assert following.time_s == pytest.approx(frame.time_s + 0.01)


def test_live_device_keeps_its_deadlines() -> None:
    with make_device("virtual", {"rate_hz": 500, "frames": 100}) as device:
        begun_s = time.monotonic()
        drain(device)
        # A lower bound only: frame 99 is due 0.198 s after opening.
        assert time.monotonic() - begun_s > 0.19
