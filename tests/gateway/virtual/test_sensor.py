"""What a simulated unit's converter makes of ideal counts: pressure, warmth and creep."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from palpate.files.tape import read_tape
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import ElectrodeReading, PoseReading, Reading

fakes: Any = importlib.import_module("tape_fakes")

Write = Callable[..., Path]


def play(path: Path, **options: Any) -> list[Reading]:
    readings: list[Reading] = []
    with make_device("virtual", {"tape": str(path), "realtime": False, **options}) as device:
        while got := device.read(1.0):
            readings += got
    return readings


def frames(readings: list[Reading]) -> list[ElectrodeReading]:
    return [reading for reading in readings if isinstance(reading, ElectrodeReading)]


def test_pressure_channels(tape_path: Write) -> None:
    """PAC is what a 10 Hz high-pass leaves of the pressure, by an independent recursion."""
    path = tape_path(**fakes.QUIET)
    readings = play(path, episodes=1, trajectories=[fakes.IDS[2]])
    one = read_tape(path).trajectories[2]
    tips = np.array([r.position for r in readings if isinstance(r, PoseReading)])
    pressure = np.interp(tips[:, 2], one.poses[:, 2], one.fluid_pressure_pa)
    fine = np.interp(np.arange(len(pressure) * 22 * 10) / 220, np.arange(len(pressure)), pressure)
    slow, passed = fine[0], []
    for k, value in enumerate(fine):  # explicit Euler at 22 kHz
        slow += (value - slow) * 2 * np.pi * 10.0 / 22000.0
        if k % 10 == 0:
            passed.append(value - slow)
    pac = np.concatenate([r.pac.astype(float) for r in frames(readings)]) - 2028.0
    expected = np.array(passed) / 0.37
    assert expected.max() > 500.0
    error = pac - expected
    assert abs(error.mean()) < 1.0
    assert error.std() < 5.0  # noise of sd 2, Euler's error


def test_warm_up_moves_electrodes_and_temperatures(tape_path: Write) -> None:
    path = tape_path(noise_counts=0.0)
    options = {"untouched_s": 2.0, "frames": 100}
    cold, late, warm = (frames(play(path, on_for_s=s, **options)) for s in (0.0, 300.0, 1e6))
    rest = read_tape(path).specimens[0].rest_counts
    assert np.abs(warm[50].electrodes - rest).max() <= 0.5
    # The film's impedance goes with 1 / conductivity, which cold is exp(-0.25) of the warm one.
    shift = np.exp(-0.025 * 10.0)
    wanted = 4095.0 / (1.0 + (4095.0 / rest - 1.0) / shift)
    assert np.abs(cold[0].electrodes - wanted).max() < 20  # spatial modes of 0.5 %
    assert (late[0].electrodes > cold[0].electrodes).all()
    # 30, 37.2 and 40 degrees C on the maker's thermistor curve.
    t_k = np.array([30.0, 40.0 - 10.0 * np.exp(-1 / 3), 40.0]) + 273.15
    tdc = 4095 * 155183.0 / (np.exp(4025.0 / t_k) + 46555.0)
    assert np.allclose([run[0].tdc for run in (cold, late, warm)], tdc, atol=3)
    assert cold[50].tac > late[50].tac > 2048 + 3
    assert abs(warm[50].tac - 2048) <= 3


def test_creep_comes_late_and_goes_late(tape_path: Write) -> None:
    plain = electrodes(tape_path(**fakes.QUIET))
    share = {**fakes.QUIET, "creep_share": 0.2}
    slow = electrodes(tape_path(**share, creep_tau_s=15.0))
    fast = electrodes(tape_path(**share, creep_tau_s=0.01))
    down = int(np.argmin(plain))
    depth = plain[0] - plain[down]
    assert 0.15 * depth < slow[down] - plain[down] < 0.2 * depth  # 15 s have not passed
    assert 5 < plain[-1] - slow[-1] < 0.05 * depth  # nor did it come back quite
    assert np.abs(fast - plain)[[down, -1]].max() <= 1.0
    lag = np.argmax(plain - fast)
    assert lag > down  # on the way back it is behind


def electrodes(path: Path) -> Any:
    """Counts of E19 through one press, shape (N,)."""
    readings = play(path, episodes=1, trajectories=[fakes.IDS[2]])
    return np.array([r.electrodes[-1] for r in frames(readings)], float)
