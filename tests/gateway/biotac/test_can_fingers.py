"""BioTacs on CAN against the emulator, on python-can's virtual bus."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from tests.gateway.reading_devices import PATIENCE_S, read_frames

from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.emulators.biotac_can import BiotacCanEmulator
from palpate_gateway.emulators.biotac_slots import idle_counts
from palpate_gateway.protocols.channels import ALL_VALID
from palpate_gateway.readings import ElectrodeReading

can = pytest.importorskip("can")

Emulate = Callable[..., BiotacCanEmulator]


def of_finger(index: int) -> np.ndarray:
    return np.array(idle_counts(0.0, index)[:19])


def assert_right(readings: list[ElectrodeReading], index: int) -> None:
    """Every valid electrode of every reading is what the finger measured."""
    for reading in readings:
        good = np.array([reading.validity >> k & 1 for k in range(19)], bool)
        np.testing.assert_array_equal(reading.electrodes[good], of_finger(index)[good])


@pytest.mark.parametrize("pac_first", [False, True])
def test_three_fingers_of_one_bus(emulate: Emulate, finger: Any, pac_first: bool) -> None:
    emulate(pac_first=pac_first)
    devices = [finger(port=port) for port in (1, 2, 3)]
    for index, device in enumerate(devices):
        device.open()
        readings = read_frames(device, lambda got: len(got) > 20)
        whole = [one for one in readings if one.validity == ALL_VALID]
        assert len(whole) >= len(readings) - 2
        assert_right(readings, index)
        assert whole[0].pdc == 2600 + index
        assert (whole[0].tac, whole[0].tdc) == (2045, 1914)
        assert set(np.concatenate([one.pac for one in whole])) == set(range(2040, 2045))
        # A starved emulator stalls now and then, which looks like frames that are gone.
        times = np.diff([one.time_s for one in readings])
        assert np.median(times) == pytest.approx(0.01)
        assert times.min() > 0.0
    assert devices[1].identity.serial.endswith("port2")


def test_an_empty_port_is_no_sensor_and_a_pulled_one_is_lost(emulate: Emulate, finger: Any) -> None:
    emulator = emulate(fingers=2)
    emulator.inject("absent", 8.0)  # the rate is measured first, for 5 s at most
    with pytest.raises(DeviceLost, match="no finger answers"):
        finger(fingers=2, port=2).open()
    there = finger(fingers=2, port=1)
    there.open()
    assert_right(read_frames(there, lambda got: len(got) > 5), 0)
    back = finger(fingers=2, port=2)
    deadline = time.monotonic() + PATIENCE_S
    while not back.is_open:
        assert time.monotonic() < deadline
        try:
            back.open()
        except DeviceError:
            time.sleep(0.1)
    emulator.inject("absent", 1.0)
    with pytest.raises(DeviceLost, match="no finger answers"):
        read_frames(back, lambda _: False)
    assert_right(read_frames(there, lambda got: len(got) > 5), 0)


def test_silence_is_told_and_counted_as_lost_frames(emulate: Emulate, finger: Any) -> None:
    emulator, device = emulate(), finger()
    device.open()
    read_frames(device, lambda got: len(got) > 20)
    emulator.inject("silence", 0.8)
    silent = False
    deadline = time.monotonic() + PATIENCE_S
    while not silent:
        assert time.monotonic() < deadline
        try:
            device.read(0.2)
        except DeviceTimeout:
            silent = True
    readings = read_frames(device, lambda got: sum(one.missed_before for one in got) > 0)
    assert_right(readings, 0)
    missed = sum(one.missed_before for one in readings)
    assert 60 <= missed <= 90
    assert_right(read_frames(device, lambda got: len(got) > 10), 0)


@pytest.mark.parametrize("sequence", ["learn", "biotac_e1_first"])
def test_two_senders_of_one_bus_are_no_finger_until_one_is_named(
    emulate: Emulate, finger: Any, sequence: str
) -> None:
    emulate(can_id=0x101)
    device = finger(sequence=sequence)
    device.open()
    assert_right(read_frames(device, lambda got: len(got) > 10), 0)
    emulate(can_id=0x102, counts=lambda t, index: idle_counts(t, index + 1))
    readings: list[ElectrodeReading] = []

    def keep(got: list[ElectrodeReading]) -> bool:
        readings[:] = got
        return False

    both = "identifiers 0x101 and 0x102 both send slots.*can_id"
    with pytest.raises(DeviceError, match=both):
        read_frames(device, keep)
    assert_right(readings, 0)
    device.close()

    def again() -> None:
        device.open()
        read_frames(device, lambda _: False)

    with pytest.raises(DeviceError, match=both):
        again()
    named = finger(sequence=sequence, can_id=0x102)
    named.open()
    assert_right(read_frames(named, lambda got: len(got) > 10), 1)
    assert named.counters["other_ids"] > 0


def test_another_device_of_the_bus_is_not_taken_for_the_finger(
    emulate: Emulate, finger: Any, request: pytest.FixtureRequest
) -> None:
    device = finger()
    with can.Bus(interface="virtual", channel=request.node.name) as other:

        def disturb(count: int) -> None:
            for k in range(count):  # valid words of E1 and E2, behind commands for E9
                data = bytes.fromhex("B3 0108 0108 0108" if k % 3 else "82 0108 0108 0108")
                other.send(can.Message(arbitration_id=2, data=data, is_extended_id=False))

        disturb(300)
        emulate()
        device.open()
        readings = []
        for _ in range(10):
            disturb(20)
            readings += read_frames(device, lambda got: len(got) > 2)
    assert_right(readings, 0)
    assert device.counters["other_ids"] > 0


def test_nobody_on_the_bus_is_told(finger: Any) -> None:
    with pytest.raises(DeviceError, match="no reading came within 2 s"):
        finger().open()


def test_one_line_is_configured_alike_and_each_port_once(emulate: Emulate, finger: Any) -> None:
    emulate()
    finger(port=1).open()
    with pytest.raises(ConfigError, match=r"port 1 of .* is configured twice"):
        finger(port=1).open()
    with pytest.raises(ConfigError, match="configured differently"):
        finger(port=2, slot_rate_hz=3000.0).open()
    with pytest.raises(ConfigError, match="the line has 2 ports"):
        finger(port=3, fingers=2).open()


def test_two_buses_that_differ_in_their_port_only_are_two(finger: Any) -> None:
    group = {"interface": "udp_multicast", "channel": "239.74.163.5"}
    with ExitStack() as stack:
        free = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(2)]
        for one in free:
            one.bind(("", 0))
        ports = [one.getsockname()[1] for one in free]
    devices = []
    with ExitStack() as stack:
        for index, port in enumerate(ports):

            def counts(t: float, place: int, index: int = index) -> Sequence[int]:
                return idle_counts(t, place + index)

            emulator = BiotacCanEmulator(
                *group.values(), fingers=1, counts=counts, options={"port": port}
            )
            stack.enter_context(emulator)
            devices.append(finger(**group, fingers=1, bus_options={"port": port}))
            devices[-1].open()
        for index, device in enumerate(devices):
            assert_right(read_frames(device, lambda got: len(got) > 5), index)
        serials = [device.identity.serial for device in devices]
        assert all(str(port) in serial for port, serial in zip(ports, serials, strict=True))


def test_opens_again_after_closing(emulate: Emulate, finger: Any) -> None:
    emulate()
    device = finger()
    for _ in range(2):
        device.open()
        assert_right(read_frames(device, lambda got: len(got) > 3), 0)
        device.close()
        device.close()
