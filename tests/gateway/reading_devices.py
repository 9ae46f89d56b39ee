"""Reading a device in tests, as the gateway's worker does or plainly."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from palpate.errors import DeviceError, DeviceTimeout
from palpate_gateway.device import Device
from palpate_gateway.readings import ElectrodeReading, WrenchReading

PATIENCE_S = 20.0
"""A test that waits longer has failed [s]."""

R = TypeVar("R", ElectrodeReading, WrenchReading)


class Follower(Generic[R]):
    """Reads a device as the gateway's worker does: when it is lost, it is opened again.

    Args:
        device: A closed device.
        kind: What it brings.
    """

    def __init__(self, device: Device, kind: type[R]) -> None:
        self.device = device
        self.readings: list[R] = []
        self.errors: list[DeviceError] = []
        self._kind: type[R] = kind
        self._counts: Counter[str] = Counter()

    def until(self, true: Callable[[], Any]) -> None:
        """Read until a condition holds."""
        deadline = time.monotonic() + PATIENCE_S
        while not true():
            assert time.monotonic() < deadline, (self.errors, self.counts())
            try:
                self.device.open()
                for reading in self.device.read(0.05):
                    assert isinstance(reading, self._kind)
                    self.readings.append(reading)
            except DeviceTimeout:
                pass
            except DeviceError as error:
                self.errors.append(error)
                self._counts += Counter(self.device.counters)
                self.device.close()
                time.sleep(0.02)

    def more(self, count: int = 20) -> list[R]:
        """The next readings."""
        had = len(self.readings)
        self.until(lambda: len(self.readings) >= had + count)
        return self.readings[had:]

    def counts(self) -> Counter[str]:
        """What it counted, in all its lives."""
        return self._counts + Counter(self.device.counters)


def read_frames(
    device: Device, until: Callable[[list[ElectrodeReading]], Any]
) -> list[ElectrodeReading]:
    """Readings of an open finger until a condition holds; errors but silence are raised."""
    got: list[ElectrodeReading] = []
    deadline = time.monotonic() + PATIENCE_S
    while not until(got):
        assert time.monotonic() < deadline, device.counters
        try:
            for reading in device.read(0.5):
                assert isinstance(reading, ElectrodeReading)
                got.append(reading)
        except DeviceTimeout:
            continue
    return got


def open_again(device: Device) -> None:
    """Close it, and open it as soon as that can be done."""
    device.close()
    deadline = time.monotonic() + PATIENCE_S
    while not device.is_open:
        assert time.monotonic() < deadline
        try:
            device.open()
        except DeviceError:
            time.sleep(0.05)
