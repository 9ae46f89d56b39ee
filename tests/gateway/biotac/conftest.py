"""A CAN bus of emulated fingers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from palpate_gateway.device import Device
from palpate_gateway.drivers import make_device
from palpate_gateway.emulators.biotac_can import BiotacCanEmulator


@pytest.fixture
def emulate(request: pytest.FixtureRequest) -> Iterator[Callable[..., BiotacCanEmulator]]:
    """Starts emulators on the test's own virtual bus."""
    pytest.importorskip("can")
    running: list[BiotacCanEmulator] = []

    def start(**options: Any) -> BiotacCanEmulator:
        emulator = BiotacCanEmulator("virtual", request.node.name, **options)
        emulator.start()
        running.append(emulator)
        return emulator

    yield start
    for emulator in running:
        emulator.stop()


@pytest.fixture
def finger(request: pytest.FixtureRequest) -> Iterator[Callable[..., Device]]:
    """Makes devices of that bus."""
    made: list[Device] = []

    def make(**options: Any) -> Device:
        given = {"interface": "virtual", "channel": request.node.name, **options}
        made.append(make_device("biotac_can", given))
        return made[-1]

    yield make
    for device in made:
        device.close()
