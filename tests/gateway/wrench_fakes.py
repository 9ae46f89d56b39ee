"""What tests of force/torque drivers share: a load that shows errors, and patience.

Tests wait for facts, not for times.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np

from palpate.errors import DeviceTimeout
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.device import WrenchDevice

PATIENCE_S = 20.0
CONSTANT = (1.5, -0.25, 1.0, 0.02, -0.01, 0.005)
WIDTH_N = 3.0


def along(fx: float) -> tuple[float, float, float, float, float, float]:
    """All axes follow the first, so that a wrench that was never felt gives itself away."""
    return (fx, -0.5 * fx, 5.0 + 0.25 * fx, 0.1 * fx, 0.05 * fx - 0.02, 0.3)


def wave(t: float) -> tuple[float, float, float, float, float, float]:
    return along(WIDTH_N * math.sin(6.0 * t))


def constant(t: float) -> tuple[float, float, float, float, float, float]:
    return CONSTANT


def assert_felt(readings: Sequence[WrenchReading]) -> None:
    """Each is a wrench of the wave, to the tenth of a millinewton that a HEX counts."""
    for reading in readings:
        told = np.concatenate([reading.force, reading.torque])
        assert abs(told[0]) <= WIDTH_N + 1e-3
        np.testing.assert_allclose(told, along(float(told[0])), atol=1.1e-4)


def take(device: WrenchDevice, count: int) -> list[WrenchReading]:
    """The next readings."""
    readings: list[WrenchReading] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(readings) < count:
        assert time.monotonic() < deadline
        readings += [r for r in device.read(5.0) if isinstance(r, WrenchReading)]
    return readings


def read_until(
    device: WrenchDevice, reached: Callable[[list[WrenchReading]], bool]
) -> list[WrenchReading]:
    """All that is published until something is true; every bit of it was felt, and in order."""
    readings: list[WrenchReading] = []
    deadline = time.monotonic() + PATIENCE_S
    while not reached(readings):
        assert time.monotonic() < deadline, device.counters
        try:
            readings += [r for r in device.read(0.2) if isinstance(r, WrenchReading)]
        except DeviceTimeout:
            continue
    assert_felt(readings)
    ticks = [r.tick for r in readings]
    assert ticks == sorted(set(ticks))
    times = [r.time_s for r in readings]
    assert times == sorted(times)
    return readings


def wait_for_timeout(device: WrenchDevice) -> str:
    """What the device says when nothing comes."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        try:
            device.read(0.1)
        except DeviceTimeout as error:
            return str(error)
    raise AssertionError("there was no timeout")
