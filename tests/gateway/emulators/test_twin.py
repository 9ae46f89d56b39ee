"""The twin as a source of emulators: the virtual finger's counts, and one scene for all."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest

from palpate.errors import ConfigError
from palpate_gateway.drivers import make_device
from palpate_gateway.emulators.biotac_slots import CHANNELS, SlotBlocks, idle_counts, round_of
from palpate_gateway.emulators.twin import (
    RATE_HZ,
    TwinCounts,
    TwinLoop,
    TwinWrench,
    loop_options,
    make_loop,
)
from palpate_gateway.readings import ElectrodeReading, WrenchReading

PAC = CHANNELS - 1


@pytest.fixture(scope="module")
def loop() -> TwinLoop:
    return make_loop(loop_options(seed=4))


def begins_now() -> float:
    """An epoch that lets a loop begin when the monotonic clock began."""
    return time.time() - time.monotonic()


def test_the_same_seed_has_the_same_counts(loop: TwinLoop) -> None:
    again, other = make_loop(loop_options(seed=4)), make_loop(loop_options(1, seed=4))
    for name in ("frames", "pac", "wrench"):
        np.testing.assert_array_equal(getattr(again, name), getattr(loop, name))
    assert other.frames.shape != loop.frames.shape or (other.frames != loop.frames).any()
    # The second finger of a seed is the first of the next.
    np.testing.assert_array_equal(make_loop(loop_options(seed=5)).frames, other.frames)


def test_the_counts_are_those_of_the_virtual_finger(loop: TwinLoop) -> None:
    options = loop_options(seed=4).model_dump()
    source, felt = TwinCounts([loop], begins_now()), TwinWrench(loop.wrench, begins_now())
    frames, readings = 0, []
    with make_device("virtual", options) as finger:
        while got := finger.read(1.0):
            readings += got
    every = np.arange(CHANNELS)
    for reading in readings:
        if not isinstance(reading, WrenchReading | ElectrodeReading):
            continue
        t = reading.tick / RATE_HZ
        if isinstance(reading, WrenchReading):
            told = [*reading.force, *reading.torque]
            np.testing.assert_allclose(felt(t), told, atol=2e-3)
            continue
        frames += 1
        counts = source.slots(np.full(CHANNELS, t), every, 0)
        right = [*reading.electrodes, reading.pdc, reading.tac, reading.tdc, reading.pac[0]]
        np.testing.assert_array_equal(counts, right)
        instants = t + np.arange(22) / 22 / RATE_HZ
        np.testing.assert_array_equal(source.slots(instants, np.full(22, PAC), 0), reading.pac)
    assert frames == round(loop.duration_s * RATE_HZ)


def test_between_two_frames_it_runs_straight_and_after_the_last_anew(loop: TwinLoop) -> None:
    source = TwinCounts([loop], begins_now())
    times = np.arange(0.0, loop.duration_s, 1.7e-3)
    for place in (0, 18, 19, 21):
        told = source.slots(times, np.full(len(times), place), 0)
        right = np.interp(times, np.arange(len(loop.frames)) / RATE_HZ, loop.frames[:, place])
        assert np.abs(told - right).max() <= 0.5 + 0.05
        later = source.slots(times + 3.0 * loop.duration_s, np.full(len(times), place), 0)
        assert np.abs(told - later).max() <= 1
    assert source(5.0, 0) == source.slots(np.full(CHANNELS, 5.0), np.arange(CHANNELS), 0).tolist()


def test_electrodes_and_wrench_are_of_one_instant_whatever_the_emulators_clocks(
    loop: TwinLoop,
) -> None:
    source, felt = TwinCounts([loop]), TwinWrench(loop.wrench)
    source.lead_s, felt.lead_s = 1000.0, -50.0
    now_s = time.monotonic()
    host_s = now_s + np.arange(0.0, loop.duration_s, 0.01)
    pdc = source.slots(host_s - 1000.0, np.full(len(host_s), 19), 0)
    force = np.linalg.norm([felt(t + 50.0)[:3] for t in host_s.tolist()], axis=1)
    rest = np.median(pdc[force == 0.0])
    assert (force > 0.5).sum() > 100
    # Untouched the pressure is at rest, and under load the two go together to the frame: the
    # harder the press, the less the pressure rises with the force, about as its root.
    assert np.abs(pdc[force == 0.0] - rest).max() <= 4
    shifts = range(-5, 6)
    alike = [np.corrcoef(np.roll(np.sqrt(force), shift), pdc)[0, 1] for shift in shifts]
    assert shifts[int(np.argmax(alike))] == 0


def test_another_process_plays_the_same_scene(loop: TwinLoop) -> None:
    walls = [time.time() + 0.37 * k for k in range(60)]
    program = (
        "import json, sys, time\n"
        "from palpate_gateway.emulators.twin import TwinWrench, loop_options, make_loop\n"
        "felt = TwinWrench(make_loop(loop_options(1, seed=3)).wrench)\n"
        "ahead_s = time.time() - time.monotonic()\n"
        "print(json.dumps([felt(wall - ahead_s) for wall in json.loads(sys.argv[1])]))\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program, json.dumps(walls)],
        capture_output=True,
        text=True,
        timeout=60.0,
        check=True,
    )
    ahead_s = time.time() - time.monotonic()
    felt = TwinWrench(loop.wrench)
    here = [felt(wall - ahead_s) for wall in walls]
    assert any(any(one) for one in here)
    np.testing.assert_allclose(json.loads(ran.stdout), here, atol=0.02)


def test_an_epoch_moves_the_scene(loop: TwinLoop) -> None:
    here, later = TwinWrench(loop.wrench), TwinWrench(loop.wrench, 7.5)
    for t in np.arange(0.0, 20.0, 0.5).tolist():
        np.testing.assert_allclose(later(t + 7.5), here(t), atol=5e-3)


@pytest.mark.parametrize("options", [{"unit": "none"}, {"unit": 99}, {"trajectories": ["none"]}])
def test_what_the_tape_lacks_is_told(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"the tape .* has no"):
        make_loop(loop_options(**options))


def test_one_trajectory_can_be_played_alone() -> None:
    one = make_loop(loop_options(trajectories=["cube/00/normal"]))
    assert 15.0 < one.duration_s < 60.0


@pytest.mark.parametrize("electrodes", [19, 24])
@pytest.mark.parametrize("pac_first", [False, True])
def test_prepared_slots_are_those_of_single_instants(
    loop: TwinLoop, electrodes: int, pac_first: bool
) -> None:
    order = round_of(electrodes, pac_first=pac_first)
    for source in (TwinCounts([loop, loop], begins_now()), idle_counts):
        blocks = SlotBlocks(source, 2, order)
        prepared = blocks.block(37, 500, 3.0, 1 / 4400)
        single = [blocks.with_faults(37 + k, 3.0 + k / 4400, ()) for k in range(500)]
        assert prepared == single
