"""The contract that every device meets; one class of tests for all drivers."""

from __future__ import annotations

import gc
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from tests.gateway.device_cases import CASES, Case
from tests.gateway.reading_devices import open_again
from tests.gateway.scenes import was_approached, was_felt, was_measured

from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate.messages import Origin, SensorType
from palpate_gateway.device import Device
from palpate_gateway.drivers import DRIVERS, make_device
from palpate_gateway.emulators.emulator import Emulator
from palpate_gateway.readings import (
    ElectrodeReading,
    PoseReading,
    Reading,
    RecordedMessage,
    WrenchReading,
)

PATIENCE_S = 20.0
ON_THE_BUS = ("pose_zenoh", "ros_biotac", "ros_wrench")
SOME = 12
"""Readings that are worth to be looked at."""


@dataclass
class Bench:
    """One case, its device in software if it has one, and the devices that were made.

    Attributes:
        case: What is tested.
        make: A new device, closed.
        emulator: The device in software; None of a file.
    """

    case: Case
    make: Callable[[], Device]
    emulator: Emulator | None = None
    made: list[Device] = field(default_factory=list)

    def device(self) -> Device:
        """A new device, which is closed after the test."""
        self.made.append(self.make())
        return self.made[-1]

    def take(self, device: Device, count: int = SOME) -> list[Reading]:
        """The next readings of the stream that the device is for."""
        readings: list[Reading] = []
        deadline = time.monotonic() + PATIENCE_S
        while len(readings) < count:
            assert time.monotonic() < deadline, device.counters
            try:
                readings += self.main_stream(device.read(0.5))
            except DeviceTimeout:
                continue
        return readings

    def main_stream(self, readings: list[Reading]) -> list[Reading]:
        """Without the truth that virtual fingers and records bring along."""
        if self.case.emulate is not None:
            return readings
        kind = PoseReading if self.case.driver == "pose_file" else ElectrodeReading
        return [
            one
            for one in readings
            if isinstance(one, kind)
            or (isinstance(one, RecordedMessage) and one.topic == "electrodes")
        ]

    def drain(self, device: Device) -> list[Reading]:
        """All that a finite source has."""
        readings: list[Reading] = []
        while got := device.read(1.0):
            readings += got
        return readings


@pytest.fixture(scope="module", autouse=True)
def _rest_of_the_process() -> None:
    """What earlier tests left is not looked through at each collection of these tests."""
    gc.collect()
    gc.freeze()  # as the whole run does once it has collected its tests, so it stays so


@pytest.fixture
def bench(case: Case, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    for package in case.packages:
        pytest.importorskip(package)
    if case.file is not None:
        options = case.file(request.getfixturevalue, tmp_path)
        made = Bench(case, lambda: make_device(case.driver, options))
        yield made
    else:
        assert case.emulate is not None
        with case.emulate() as emulator:
            made = Bench(case, lambda: case.device(emulator), emulator)
            yield made
    for device in made.made:
        device.close()


def for_cases(chosen: Callable[[Case], bool] = lambda _: True) -> pytest.MarkDecorator:
    cases = [case for case in CASES if chosen(case)]
    return pytest.mark.parametrize("case", cases, ids=lambda case: case.name)


every = for_cases()
finite = for_cases(lambda case: case.frames > 0)
hardware = for_cases(lambda case: case.emulate is not None)


def until(true: Callable[[], bool]) -> bool:
    """Whether it becomes true in time."""
    deadline = time.monotonic() + PATIENCE_S
    while not true():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


class TestDeviceContract:
    """What ``Device`` promises."""

    def test_every_driver_is_here(self) -> None:
        assert {case.driver for case in CASES} == set(DRIVERS)

    @every
    def test_info_before_opening(self, bench: Bench) -> None:
        device = bench.device()
        info = device.info
        assert info.driver == bench.case.driver
        assert info.sensor_type in (*SensorType, None)
        assert info.rate_hz > 0
        assert info.finite == (bench.case.frames > 0)
        assert info.live or bench.emulator is None
        assert isinstance(info.origin, Origin)
        assert info.model
        assert not device.is_open

    @every
    def test_closed_device_says_so(self, bench: Bench) -> None:
        device = bench.device()
        for _ in range(2):
            with pytest.raises(DeviceError, match=r"not open -> call open\(\)"):
                device.read(0.1)
            with pytest.raises(DeviceError, match="not open"):
                _ = device.identity
            device.open()
            device.close()

    @every
    def test_open_and_close_are_idempotent(self, bench: Bench) -> None:
        device = bench.device()
        device.close()
        device.open()
        device.open()
        assert device.is_open
        assert device.identity.serial
        assert device.identity.slot_period_s > 0
        assert bench.take(device, 1)
        device.close()
        device.close()
        assert not device.is_open

    @every
    def test_readings_are_in_order_and_what_was_measured(self, bench: Bench) -> None:
        with bench.device() as device:
            readings = bench.take(device)
            is_tactile = device.info.sensor_type is not None
        times = [reading.time_s for reading in readings]
        assert times == sorted(times)
        ticks = [one.tick for one in readings if not isinstance(one, RecordedMessage)]
        assert ticks == sorted(set(ticks))
        if bench.emulator is None:
            return
        for one in readings:
            assert isinstance(one, ElectrodeReading) == is_tactile
            if isinstance(one, WrenchReading):
                assert was_felt(one.force, one.torque, bench.case.tolerance)
                assert not one.overload
            elif isinstance(one, PoseReading):
                assert was_approached(one.position, one.orientation)
            elif isinstance(one, ElectrodeReading):
                slow = (one.pdc, one.tac, one.tdc)
                assert was_measured(one.electrodes, slow, one.pac, one.validity)
                assert one.validity

    @every
    def test_an_unknown_option_is_named(self, bench: Bench) -> None:
        with pytest.raises(ConfigError, match=f"{bench.case.driver}.*no_such_option"):
            make_device(bench.case.driver, {**bench.case.nowhere, "no_such_option": 1})

    @every
    def test_nothing_is_left_open(self, bench: Bench) -> None:
        device = bench.device()
        with device:  # the first opening imports, which opens what stays open
            bench.take(device, 1)
        gc.collect()
        before = Held.settled(bench)
        device.open()
        bench.take(device, 1)
        device.close()
        assert until(lambda: Held.now() <= before), (before, Held.now())

    @every
    def test_a_wrong_address_is_named_with_a_remedy_and_nothing_left_open(
        self, bench: Bench
    ) -> None:
        with bench.device():  # the first opening imports, which opens what stays open
            pass
        gc.collect()
        before = Held.settled(bench)
        # A virtual finger has no address but its tape, whose name is configuration.
        with pytest.raises((DeviceError, ConfigError), match=bench.case.names) as caught:
            make_device(bench.case.driver, bench.case.nowhere).open()
        assert caught.value.remedy
        del caught
        gc.collect()
        assert until(lambda: Held.now() <= before), (before, Held.now())

    @every
    def test_it_is_closed_when_its_reader_fails(self, bench: Bench) -> None:
        device = bench.device()
        with pytest.raises(ZeroDivisionError), device:
            _ = 1 // 0
        assert not device.is_open

    @every
    def test_opens_again_and_counts_anew(self, bench: Bench) -> None:
        device = bench.device()
        for _ in range(2):
            device.open()
            before = dict(device.counters)
            bench.take(device, 2)
            after = dict(device.counters)
            device.close()
            assert before.get("samples", 0) < 1000
            assert before.keys() <= after.keys()
            assert all(0 <= before.get(name, 0) <= count for name, count in after.items())
            assert all(isinstance(count, int) for count in device.counters.values())

    @finite
    def test_ends_with_an_empty_list_for_ever(self, bench: Bench) -> None:
        with bench.device() as device:
            readings = bench.main_stream(bench.drain(device))
            assert len(readings) == bench.case.frames
            assert device.counters["samples"] == bench.case.frames * bench.case.samples
            assert device.read(0.1) == []
            assert device.read(0.1) == []

    @finite
    def test_opens_again_with_the_same_readings(self, bench: Bench) -> None:
        device = bench.device()
        runs = []
        for _ in range(2):
            device.open()
            runs.append([repr(reading) for reading in bench.drain(device)])
            device.close()
        assert runs[0] == runs[1]

    @hardware
    def test_silence_does_not_hang(self, bench: Bench) -> None:
        assert bench.emulator is not None
        with bench.device() as device:
            bench.take(device, 1)
            bench.emulator.inject("silence", 60.0)
            assert until(lambda: _fails(device, DeviceTimeout, DeviceLost))
        bench.emulator.end("silence")

    @hardware
    def test_a_lost_device_says_so_and_comes_back(self, bench: Bench) -> None:
        emulator = bench.emulator
        assert emulator is not None
        if not bench.case.gone:
            pytest.skip("nothing tells that it is gone but that nothing comes")
        device = bench.device()
        device.open()
        bench.take(device, 1)
        emulator.inject(bench.case.gone, 60.0)
        assert until(lambda: _fails(device, DeviceLost))
        device.close()
        with pytest.raises(DeviceError):
            device.open()
        emulator.end(bench.case.gone)
        open_again(device)
        assert len(bench.take(device)) >= SOME

    @hardware
    def test_closing_while_the_device_is_gone_is_quiet(self, bench: Bench) -> None:
        assert bench.emulator is not None
        device = bench.device()
        device.open()
        bench.emulator.stop()
        device.close()
        assert not device.is_open


def _fails(device: Device, *kinds: type[DeviceError]) -> bool:
    """Whether reading raises one of these; a timeout that is not meant does not count."""
    try:
        device.read(0.05)
    except kinds:
        return True
    except DeviceTimeout:
        return False
    return False


@dataclass(frozen=True, slots=True)
class Held:
    """What a process holds: open files and threads."""

    files: int
    threads: int

    @classmethod
    def now(cls) -> Held:
        """Of this process."""
        return cls(len(os.listdir("/proc/self/fd")), threading.active_count())

    @classmethod
    def settled(cls, bench: Bench) -> Held:
        """Of this process when an emulator beside it opens nothing more.

        A router of the emulator's own opens a link to itself up to a second after it serves.
        """
        quiet_s = 2.0 if bench.case.driver in ON_THE_BUS else 0.0
        since_s, held = time.monotonic(), cls.now()
        deadline_s = since_s + PATIENCE_S
        while time.monotonic() - since_s < quiet_s and time.monotonic() < deadline_s:
            time.sleep(0.01)
            if (now := cls.now()) != held:
                since_s, held = time.monotonic(), now
        return held

    def __le__(self, other: Held) -> bool:
        return self.files <= other.files and self.threads <= other.threads
