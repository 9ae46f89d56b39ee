"""A gateway that was killed knows that a zero was taken, and takes no load for one."""

from __future__ import annotations

import importlib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.gateway.wrench.test_zeroing import ask_zero, gateway, kms_options, sensor

from palpate.heartbeat import FILE_VARIABLE
from palpate.messages import SensorState, ServiceState
from palpate_gateway.emulators.bota import BotaEmulator
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.ros import RosWrenchEmulator

fakes: Any = importlib.import_module("wrench_fakes")

PRESSED = (0.0, 0.0, -8.0, 0.0, 0.0, 0.0)


@pytest.fixture(autouse=True)
def heartbeat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """All gateways of a test are that of one supervisor."""
    file = tmp_path / "gateway"
    monkeypatch.setenv(FILE_VARIABLE, str(file))
    return file


def test_a_press_is_not_taken_for_the_zero_at_the_start(bus: Any) -> None:
    load = [fakes.CONSTANT]
    with BotaEmulator(lambda t: load[0]) as emulator:
        options = {"port": emulator.address, "rate_hz": 200, "zero_at_start": True}
        values = gateway("wrench_bota", options)
        with bus.gateway(values):
            sensor(bus, SensorState.LIVE)
        load[0] = PRESSED
        for _ in range(2):
            with bus.gateway(values):
                sensor(bus, SensorState.ZERO_LOST)
                counters = bus.state(ServiceState.DEGRADED).counters
                assert (counters["zero_lost"], "zeros" in counters) == (1, False)
        with bus.gateway(values):
            sensor(bus, SensorState.ZERO_LOST)
            zero = ask_zero(bus)
            np.testing.assert_allclose(
                zero.force_before, np.subtract(PRESSED, fakes.CONSTANT)[:3], atol=0.05
            )
            np.testing.assert_allclose(zero.force_after, 0.0, atol=0.05)
            sensor(bus, SensorState.LIVE)


def test_a_device_that_says_that_it_has_its_zero_is_believed(bus: Any) -> None:
    with Kms40Emulator(fakes.constant) as emulator:
        values = gateway("wrench_kms40", kms_options(emulator))
        with bus.gateway(values):
            sensor(bus, SensorState.LIVE)
            ask_zero(bus)
        with bus.gateway(values):
            sensor(bus, SensorState.LIVE)
            np.testing.assert_allclose(ask_zero(bus).force_before, 0.0, atol=1e-3)
        emulator.inject("restart")
        with bus.gateway(values):
            sensor(bus, SensorState.ZERO_LOST)


def test_what_the_driver_subtracts_goes_on_with_the_same_publisher(bus: Any) -> None:
    with RosWrenchEmulator(fakes.constant) as emulator:
        values = gateway(
            "ros_wrench", {"topic": emulator.topic, "connect": emulator.address, "rate_hz": 100}
        )
        with bus.gateway(values):
            sensor(bus, SensorState.LIVE)
            ask_zero(bus)
        with bus.gateway(values):
            sensor(bus, SensorState.LIVE)
            np.testing.assert_allclose(ask_zero(bus).force_before, 0.0, atol=1e-6)
            emulator.inject("restart")
            sensor(bus, SensorState.ZERO_LOST)
        with bus.gateway(values):
            sensor(bus, SensorState.ZERO_LOST)
            np.testing.assert_allclose(ask_zero(bus).force_before, fakes.CONSTANT[:3], atol=1e-6)


@pytest.mark.parametrize(
    "content", [b"", b"cut off", b"\xff" * 48], ids=["empty", "cut", "cut at the publisher"]
)
def test_a_broken_file_still_says_that_a_zero_was_taken(
    bus: Any, heartbeat: Path, content: bytes
) -> None:
    heartbeat.with_name("gateway.ft.zero").write_bytes(content)
    with RosWrenchEmulator(fakes.constant) as emulator:
        options = {"topic": emulator.topic, "connect": emulator.address, "zero_at_start": True}
        with bus.gateway(gateway("ros_wrench", options)):
            sensor(bus, SensorState.ZERO_LOST)


def test_a_spare_that_takes_over_takes_no_load_for_its_zero(
    bus: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(FILE_VARIABLE)  # gateways of two hosts
    load = [fakes.CONSTANT]
    with BotaEmulator(lambda t: load[0]) as emulator:
        options = {"port": emulator.address, "rate_hz": 200, "zero_at_start": True}
        values = gateway("wrench_bota", options)
        with ExitStack() as stack:
            first = stack.enter_context(bus.gateway(values))
            sensor(bus, SensorState.LIVE)
            stack.enter_context(bus.gateway(values, instance="spare"))
            bus.until(lambda: [one for one in bus.statuses() if one.last_error is not None])
            load[0] = PRESSED
            first.stop.set()
            sensor(bus, SensorState.ZERO_LOST)
            np.testing.assert_allclose(
                ask_zero(bus).force_before, np.subtract(PRESSED, fakes.CONSTANT)[:3], atol=0.05
            )
