"""A CAN bus on python-can's virtual one: batches, silence, error frames, bus off."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest

from palpate.gateway.ports.can_bus import BATCH, CanBus
from palpate.protos.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout

can = pytest.importorskip("can")


@pytest.fixture
def sender(request: pytest.FixtureRequest) -> Iterator[Any]:
    bus = can.Bus(interface="virtual", channel=request.node.name)
    yield bus
    bus.shutdown()


@pytest.fixture
def bus(request: pytest.FixtureRequest, sender: Any) -> Iterator[CanBus]:
    with_name = CanBus("virtual", request.node.name)
    with_name.open()
    yield with_name
    with_name.close()


def test_frames_come_in_order_in_batches(sender: Any, bus: CanBus) -> None:
    for k in range(BATCH + 10):
        sender.send(can.Message(arbitration_id=k % 7, data=[k % 256], is_extended_id=False))
    began = time.monotonic_ns()
    first, rest = bus.read(1.0), bus.read(1.0)
    assert (len(first), len(rest)) == (BATCH, 10)
    assert [m.data[0] for m in first + rest] == [k % 256 for k in range(BATCH + 10)]
    assert [m.can_id for m in first[:8]] == [0, 1, 2, 3, 4, 5, 6, 0]
    assert all(began <= m.arrival_ns <= time.monotonic_ns() for m in first + rest)


def test_silence_is_a_timeout(bus: CanBus) -> None:
    with pytest.raises(DeviceTimeout, match=r"nothing came within 0\.01 s"):
        bus.read(0.01)


def test_what_is_no_data_frame_is_counted(sender: Any, bus: CanBus) -> None:
    sender.send(can.Message(arbitration_id=1, is_remote_frame=True, is_extended_id=False))
    sender.send(can.Message(is_error_frame=True))
    sender.send(can.Message(arbitration_id=5, data=b"\x01", is_extended_id=False))
    assert [m.can_id for m in bus.read(1.0)] == [5]
    assert bus.counters == {"error_frames": 1, "other_frames": 1}


def test_only_noise_is_silence(sender: Any, bus: CanBus) -> None:
    sender.send(can.Message(is_error_frame=True))
    with pytest.raises(DeviceTimeout):
        bus.read(0.05)


def test_bus_off_is_told(sender: Any, bus: CanBus, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = type(bus._bus)
    monkeypatch.setattr(kind, "state", property(lambda _: can.BusState.ERROR))
    sender.send(can.Message(is_error_frame=True))
    with pytest.raises(DeviceLost, match="bus off"):
        bus.read(1.0)


def test_a_bus_that_breaks_is_told(bus: CanBus, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise can.CanOperationError("No such device")

    monkeypatch.setattr(type(bus._bus), "recv", broken)
    with pytest.raises(DeviceLost, match="No such device"):
        bus.read(1.0)


def test_sends(sender: Any, bus: CanBus) -> None:
    bus.write(0x64, bytes(8))
    message = sender.recv(1.0)
    assert (message.arbitration_id, bytes(message.data)) == (0x64, bytes(8))
    assert not message.is_extended_id


def test_closed_and_closed_again(bus: CanBus) -> None:
    bus.close()
    bus.close()
    with pytest.raises(DeviceError, match="not open"):
        bus.read(0.1)


def test_an_unknown_interface_is_named() -> None:
    with pytest.raises(ConfigError, match="teletype:can0"):
        CanBus("teletype", "can0").open()


def test_a_bus_that_is_not_there_says_what_to_do() -> None:
    with pytest.raises(DeviceError, match=r"socketcan:nocan0: cannot join.*-> bring it up"):
        CanBus("socketcan", "nocan0").open()
