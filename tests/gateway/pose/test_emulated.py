"""A robot in software and the driver that hears it: the twin's presses, and every fault."""

from __future__ import annotations

import importlib
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import ConfigError, DeviceLost, DeviceTimeout
from palpate.messages import Pose
from palpate_deploy.cli.app import app
from palpate_gateway.device import Device
from palpate_gateway.drivers import make_device
from palpate_gateway.emulators.robot import (
    BASE_SENSOR,
    FLANGE_INDENTER,
    RobotEmulator,
    slow_approach,
)
from palpate_gateway.emulators.twin import RATE_HZ, TwinTip, loop_options, make_loop
from palpate_gateway.readings import PoseReading

fakes: Any = importlib.import_module("pose_fakes")
PATIENCE_S: float = fakes.PATIENCE_S


def options_of(emulator: RobotEmulator) -> dict[str, Any]:
    poses = {"base_sensor": BASE_SENSOR, "flange_indenter": FLANGE_INDENTER}
    tables = {
        name: {"position_m": pose.position, "orientation_wxyz": pose.orientation}
        for name, pose in poses.items()
    }
    return {"robot": "arm", "connect": emulator.address, "indenter": "sphere_7mm", **tables}


@contextmanager
def bench(**options: Any) -> Iterator[tuple[RobotEmulator, Device]]:
    """A robot at a router of its own, and an open device."""
    with (
        RobotEmulator(**options) as emulator,
        make_device("pose_zenoh", options_of(emulator)) as device,
    ):
        fakes.take(device, 5)
        yield emulator, device


def follow(device: Device, reached: Callable[[], bool]) -> list[PoseReading]:
    """Read as a worker does, open again where it is lost, until something is true."""
    readings: list[PoseReading] = []
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline, device.counters
        try:
            device.open()
            readings += [r for r in device.read(0.1) if isinstance(r, PoseReading)]
        except DeviceTimeout:
            continue
        except DeviceLost:
            device.close()
    return readings


def on_the_path(reading: PoseReading) -> bool:
    """Whether the tip is somewhere on the approach, and turned as it is there."""
    x, y, z = reading.position
    straight = abs(abs(float(reading.orientation[0])) - 1.0) < 1e-9
    return math.hypot(x + 0.004, y) < 1e-9 and -0.016 - 1e-9 <= z <= -0.009 + 1e-9 and straight


def test_it_tells_where_the_tip_is() -> None:
    with bench(rate_hz=500.0) as (emulator, device):
        readings = fakes.take(device, 100)
        assert device.counters["samples"] >= 100
        assert device.counters["lost_poses"] == 0
    assert all(on_the_path(reading) for reading in readings)
    steps = np.diff([reading.time_s for reading in readings])
    np.testing.assert_allclose(steps, 0.002, atol=1e-9)
    assert emulator.sent >= 100


def test_a_restart_is_another_run() -> None:
    with bench() as (emulator, device):
        emulator.inject("restart", 0.1)
        fakes.until(lambda: _lost(device))
        device.close()
        device.open()
        readings = fakes.take(device, 20)
        assert readings[0].time_s == 0.0
        assert device.counters["lost_poses"] == 0


def _lost(device: Device) -> bool:
    try:
        device.read(0.05)
    except DeviceTimeout:
        return False
    except DeviceLost:
        return True
    return False


@pytest.mark.parametrize("fault", ["silence", "unplug"])
def test_a_silent_robot_is_heard_again(fault: str) -> None:
    with bench() as (emulator, device):
        emulator.inject(fault, 60.0)
        fakes.until(lambda: _silent(device))
        emulator.end(fault)
        readings = fakes.take(device, 20)
    assert all(on_the_path(reading) for reading in readings)
    ticks = [reading.tick for reading in readings]
    assert ticks == sorted(set(ticks))  # some may be lost while a link comes up again


def _silent(device: Device) -> bool:
    try:
        device.read(0.1)
    except DeviceTimeout:
        return True
    return False


def test_stuck_is_where_it_was() -> None:
    with bench() as (emulator, device):
        emulator.inject("stuck", 60.0)
        fakes.take(device, 10)
        places = {tuple(reading.position) for reading in fakes.take(device, 20)}
    assert len(places) <= 2  # one pose may have been on its way


def test_a_router_that_is_there_is_joined(link: Any) -> None:
    with RobotEmulator(connect=link.connect[0]) as emulator:
        assert emulator.address == link.connect[0]
        with make_device("pose_zenoh", options_of(emulator)) as device:
            assert len(fakes.take(device, 10)) >= 10


def test_a_port_that_is_taken_is_told() -> None:
    with RobotEmulator() as emulator, pytest.raises(OSError, match="in use"):
        RobotEmulator(port=int(emulator.address.rpartition(":")[2])).start()
    assert not [t for t in threading.enumerate() if t.name == "RobotEmulator"]


def test_a_robot_that_cannot_join_leaves_no_router_behind() -> None:
    before = set(threading.enumerate())
    with pytest.raises(ConfigError, match="Zenoh key"):
        RobotEmulator(station="My Lab").start()
    left = {t for t in threading.enumerate() if not t.daemon} - before
    for thread in left:
        thread.join(PATIENCE_S)
    assert not [thread for thread in left if thread.is_alive()]


def test_certificates_of_another_router_are_not_its_own(tmp_path: Path) -> None:
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (tmp_path / name).write_text("of the station")
    words = ["emulate", "robot", "--play", "press", "--seconds", "0.5"]
    ran = subprocess.run(
        [sys.executable, "-m", "palpate_deploy", *words],
        env=os.environ | {"PALPATE_TLS": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert "tls" not in ran.stdout


def test_the_twins_tip_runs_straight_between_frames() -> None:
    half = math.sqrt(0.5)
    quarter = (half, 0.0, 0.0, half)
    tips = [
        Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        Pose((0.002, 0.0, 0.004), (-half, 0.0, 0.0, -half)),  # the same turn, the other sign
        Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
    ]
    tip = TwinTip(tips)
    tip._since_epoch_s = 0.0
    middle = tip(0.5 / RATE_HZ)
    assert middle.position == pytest.approx((0.001, 0.0, 0.002))
    eighth = math.pi / 8.0
    assert middle.orientation == pytest.approx((math.cos(eighth), 0.0, 0.0, math.sin(eighth)))
    there = tip(1.0 / RATE_HZ).orientation
    assert abs(float(np.dot(there, quarter))) == pytest.approx(1.0)
    assert tip(2.0 / RATE_HZ).position == pytest.approx((0.0, 0.0, 0.0))


def test_the_twins_tip_is_that_of_the_virtual_finger() -> None:
    options = loop_options().model_copy(update={"episodes": 1})
    loop = make_loop(options)
    with make_device("virtual", {**options.model_dump(), "realtime": False}) as device:
        truth: list[PoseReading] = []
        while got := device.read(1.0):
            truth += [reading for reading in got if isinstance(reading, PoseReading)]
    assert len(loop.tips) == len(truth) + 1
    assert loop.tips[0] == loop.tips[-1]
    for tip, reading in zip(loop.tips[:200], truth, strict=False):
        np.testing.assert_array_equal(tip.position, reading.position)
    assert loop.indenters == tuple(dict.fromkeys(reading.indenter for reading in truth))


def test_slow_approach_is_slow() -> None:
    places = np.array([slow_approach(0.004 * k).position for k in range(2500)])
    assert np.abs(np.diff(places, axis=0)).max() < 5e-3 * 0.004


def test_emulate_prints_what_reads_it(link: Any) -> None:
    words = ["emulate", "robot", "--play", "press", "--connect", link.connect[0]]
    result = CliRunner().invoke(app, [*words, "--seconds", "0.5"])
    assert result.exit_code == 0, result.output
    assert 'driver = "pose_zenoh"' in result.output
    assert f'connect = "{link.connect[0]}"' in result.output
    assert "base_sensor.position_m=[0.4, 0.0, 0.1]" in result.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--robot", "Arm 1"], "cannot stand in a Zenoh key"),
        (["--connect", "127.0.0.1:7447"], "is not tcp/HOST:PORT"),
        (["--play", "press", "--fault", "parity@1"], "wrong_time"),
    ],
)
def test_emulate_names_what_is_wrong(words: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["emulate", "robot", *words])
    assert result.exit_code != 0
    assert message in result.output + str(result.exception)
