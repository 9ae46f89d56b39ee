"""BioTacs behind a bridge, against the emulator, over a pseudo terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from tests.gateway.reading_devices import PATIENCE_S, open_again, read_frames

from palpate.config import parse_config
from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate.messages import ServiceState
from palpate_gateway.biotac.bridge import BiotacBridge, BridgeOptions
from palpate_gateway.emulators.biotac_bridge import BiotacBridgeEmulator, stuffed
from palpate_gateway.emulators.biotac_slots import idle_counts
from palpate_gateway.emulators.lines import crc16_x25
from palpate_gateway.protocols.channels import ALL_VALID
from palpate_gateway.readings import ElectrodeReading

pytest.importorskip("serial")

Emulate = Callable[..., BiotacBridgeEmulator]
FingerQueue = Callable[..., BiotacBridge]


@pytest.fixture
def emulate() -> Iterator[Emulate]:
    running: list[BiotacBridgeEmulator] = []

    def start(**options: Any) -> BiotacBridgeEmulator:
        emulator = BiotacBridgeEmulator(**{"hello_s": 0.2, "status_s": 0.1, **options})
        emulator.start()
        running.append(emulator)
        return emulator

    yield start
    for emulator in running:
        emulator.stop()


@pytest.fixture
def finger() -> Iterator[FingerQueue]:
    made: list[BiotacBridge] = []

    def make(line: str, **options: Any) -> BiotacBridge:
        given = parse_config(BridgeOptions, {"line": line, **options}, where="test")
        made.append(BiotacBridge(given))
        return made[-1]

    yield make
    for device in made:
        device.close()


def assert_right(readings: list[ElectrodeReading], index: int) -> None:
    """Every valid electrode of every reading is what the finger measured."""
    assert readings
    for reading in readings:
        good = np.array([reading.validity >> k & 1 for k in range(19)], bool)
        right = np.array(idle_counts(0.0, index)[:19])
        np.testing.assert_array_equal(reading.electrodes[good], right[good])


def test_the_sums_of_the_emulator() -> None:
    assert crc16_x25(b"123456789") == 0x906E
    assert stuffed(b"") == b"\x01\x00"
    assert stuffed(b"\x11\x00\x22") == b"\x02\x11\x02\x22\x00"
    assert stuffed(bytes(range(1, 255)) + b"\0")[:1] == b"\xff"


@pytest.mark.parametrize(("pac_first", "slots"), [(False, 44), (True, 22)])
def test_three_fingers_of_one_line(
    emulate: Emulate, finger: FingerQueue, pac_first: bool, slots: int
) -> None:
    emulator = emulate(
        pac_first=pac_first, slots_per_packet=slots, sequence=65530, clock_us=2**32 - 300_000
    )
    for index in range(3):
        device = finger(emulator.address, port=index + 1)
        device.open()
        assert device.identity.serial == f"BT-EMU-{index + 1}"
        readings = read_frames(device, lambda got: len(got) > 20)
        assert_right(readings, index)
        whole = [one for one in readings if one.validity == ALL_VALID]
        assert len(whole) >= len(readings) - 3
        assert whole[-1].pdc == 2600 + index
        assert set(np.concatenate([one.pac for one in whole])) == set(range(2040, 2045))
        times = np.diff([one.time_s for one in readings])
        assert np.median(times) == pytest.approx(0.01, abs=1e-6)
        assert times.min() > 0.0


def test_what_others_of_the_line_counted_before_is_not_counted(
    emulate: Emulate, finger: FingerQueue
) -> None:
    emulator = emulate(fingers=2)
    first, second = finger(emulator.address), finger(emulator.address, port=2)
    first.open()
    for _ in range(2):
        read_frames(first, lambda got: len(got) > 20)
        before = first.counters["packets"]
        second.open()
        read_frames(second, lambda got: len(got) > 2)
        since = second.counters["packets"]
        assert 0 < since <= first.counters["packets"] - before
        second.close()


@pytest.mark.parametrize("fault", ["error_word", "parity"])
def test_words_of_errors_are_no_parity_errors(
    emulate: Emulate, finger: FingerQueue, fault: str
) -> None:
    emulator = emulate()
    device = finger(emulator.address)
    device.open()
    emulator.inject(fault, 60.0)
    read_frames(device, lambda got: len(got) > 10 and got[-1].validity != ALL_VALID)
    found = {name for name, count in device.counters.items() if count}
    told = {name for name in found if name == "parity_errors" or name.startswith("device_error")}
    assert ("parity_errors" in told) == (fault == "parity")
    assert len(told) == 1


def test_an_opening_that_fails_brings_no_old_counts(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate()
    device = finger(emulator.address)
    device.open()
    read_frames(device, lambda got: len(got) > 2)
    device.close()
    assert device.counters["samples"] > 0
    emulator.stop()
    with pytest.raises(DeviceError):
        device.open()
    assert device.counters["samples"] == 0


def test_a_slower_bridge_tells_its_rate(emulate: Emulate, finger: FingerQueue) -> None:
    device = finger(emulate(slot_rate_hz=2200.0, fingers=1).address)
    device.open()
    assert device.identity.slot_period_s == pytest.approx(1 / 2200)
    times = np.diff([one.time_s for one in read_frames(device, lambda got: len(got) > 10)])
    assert np.median(times) == pytest.approx(0.02, abs=1e-6)
    assert device.info.rate_hz == pytest.approx(50.0)


def test_a_slow_finger_is_not_silent_between_its_frames(bus: Any, emulate: Emulate) -> None:
    options = {"line": emulate(slot_rate_hz=1000.0, fingers=1).address}
    slow = {"name": "slow", "driver": "biotac_bridge", "options": options}
    with bus.gateway({"sensors": [slow]}):
        bus.state(ServiceState.READY)
        now = bus.until(lambda: (s := bus.status()) and s.counters["frames_published"] > 50 and s)
    assert now.counters.get("silences", 0) < 10


def wait_for_packets(emulator: BiotacBridgeEmulator, count: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while emulator.sent < count:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_late_hello_opens_the_bridge_again(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate(slot_rate_hz=4000.0, hello_s=3.0)
    wait_for_packets(emulator, 30)  # the HELLO at its start is gone
    hasty = finger(emulator.address, hello_s=0.1)
    hasty.open()
    assert hasty.identity.serial.endswith("port1")
    with pytest.raises(DeviceLost, match=r"HELLO came later than hello_s = 0\.1 s.*raise hello_s"):
        read_frames(hasty, lambda _: False)
    hasty.close()
    patient = finger(emulator.address, hello_s=PATIENCE_S)
    patient.open()
    assert patient.identity.serial == "BT-EMU-1"
    assert patient.identity.slot_period_s == pytest.approx(1 / 4000)


def test_without_a_wait_a_hello_may_come_at_any_time(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate(hello_s=0.3)
    wait_for_packets(emulator, 10)
    device = finger(emulator.address, hello_s=0.0)
    device.open()
    assert_right(read_frames(device, lambda got: len(got) > 100), 0)


def test_a_fast_clock_is_the_time_of_the_frames(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate()
    emulator.inject("clock_drift", 30.0)
    device = finger(emulator.address)
    device.open()
    readings = read_frames(device, lambda got: len(got) > 60)
    assert_right(readings, 0)
    assert device.counters["lost_slots"] == device.counters["restarts"] == 0


def test_silence_is_told_and_counted_as_lost_frames(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate()
    device = finger(emulator.address)
    device.open()
    read_frames(device, lambda got: len(got) > 5)
    emulator.inject("silence", 0.6)
    silent = False
    deadline = time.monotonic() + PATIENCE_S
    while not silent:
        assert time.monotonic() < deadline
        try:
            device.read(0.2)
        except DeviceTimeout:
            silent = True
    readings = read_frames(device, lambda got: sum(one.missed_before for one in got) > 0)
    assert 45 <= sum(one.missed_before for one in readings) <= 80
    assert_right(read_frames(device, lambda got: len(got) > 5), 0)


@pytest.mark.parametrize(("fault", "message"), [("restart", "restarted"), ("unplug", "is gone")])
def test_a_bridge_that_begins_anew_is_lost_and_found(
    emulate: Emulate, finger: FingerQueue, fault: str, message: str
) -> None:
    emulator = emulate()
    device = finger(emulator.address)
    device.open()
    read_frames(device, lambda got: len(got) > 5)
    emulator.inject(fault, 0.0 if fault == "restart" else 0.5)
    with pytest.raises(DeviceLost, match=message):
        read_frames(device, lambda _: False)
    open_again(device)
    assert_right(read_frames(device, lambda got: len(got) > 5), 0)


def test_an_empty_port_is_no_sensor(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate(fingers=2)
    emulator.inject("absent", 30.0)
    with pytest.raises(DeviceLost, match="no finger answers"):
        finger(emulator.address, port=2).open()
    with pytest.raises(DeviceError, match="samples 2 fingers only"):
        finger(emulator.address, port=3).open()
    there = finger(emulator.address, port=1)
    there.open()
    assert_right(read_frames(there, lambda got: len(got) > 5), 0)


def test_the_source_must_be_the_one_that_was_named(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate(source=9)
    with pytest.raises(DeviceError, match=r"no packet of source 8 .* correct source"):
        finger(emulator.address, source=8).open()
    device = finger(emulator.address, source=9)
    device.open()
    assert_right(read_frames(device, lambda got: len(got) > 3), 0)


def test_the_wrong_speed_is_told(emulate: Emulate, finger: FingerQueue) -> None:
    with pytest.raises(DeviceError, match="check baud"):
        finger(emulate().address, baud=115200).open()


def test_without_hello_the_line_names_the_finger(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate(hello_s=3600.0)
    time.sleep(0.1)  # the first one goes to nobody
    device = finger(emulator.address, hello_s=0.0)
    device.open()
    assert device.identity.serial.endswith("port1")
    assert_right(read_frames(device, lambda got: len(got) > 3), 0)


def test_hello_is_waited_for_from_the_first_packet_on(
    emulate: Emulate, finger: FingerQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bridge that stood still when it was opened says HELLO as late as its first packet."""
    monkeypatch.setattr("palpate_gateway.biotac.bridge._FIRST_S", 30.0)
    emulator = emulate(hello_s=0.5)
    emulator.inject("silence", 1.5)
    time.sleep(0.1)
    device = finger(emulator.address, hello_s=1.0)
    device.open()
    assert device.identity.serial == "BT-EMU-1"


def test_each_port_once(emulate: Emulate, finger: FingerQueue) -> None:
    emulator = emulate()
    finger(emulator.address).open()
    with pytest.raises(ConfigError, match="is configured twice"):
        finger(emulator.address).open()
