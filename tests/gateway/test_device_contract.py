"""The contract that every device meets; one class of tests for all drivers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpate.gateway.device import Device
from palpate.gateway.drivers import make_device
from palpate.gateway.readings import ElectrodeReading, Reading, RecordedMessage
from palpate.protos.errors import DeviceError, DeviceTimeout
from palpate.protos.messages import Origin, SensorType

FRAMES = 120


class DeviceContract:
    """What ``Device`` promises. Subclasses give the fixture ``make``: a new finite device."""

    @pytest.fixture
    def make(self) -> Callable[[], Device]:
        raise NotImplementedError

    def drain(self, device: Device) -> list[Reading]:
        readings: list[Reading] = []
        while got := device.read(1.0):
            readings += got
        return readings

    def frames(self, readings: list[Reading]) -> list[Reading]:
        return [
            r
            for r in readings
            if isinstance(r, ElectrodeReading)
            or (isinstance(r, RecordedMessage) and r.topic == "electrodes")
        ]

    def test_info_before_opening(self, make: Callable[[], Device]) -> None:
        device = make()
        info = device.info
        assert info.sensor_type is SensorType.BIOTAC
        assert info.rate_hz > 0
        assert info.finite
        assert isinstance(info.origin, Origin)
        assert not device.is_open

    def test_closed_device_says_so(self, make: Callable[[], Device]) -> None:
        device = make()
        with pytest.raises(DeviceError, match=r"not open -> call open\(\)"):
            device.read(0.1)
        with pytest.raises(DeviceError, match="not open"):
            _ = device.identity

    def test_open_and_close_are_idempotent(self, make: Callable[[], Device]) -> None:
        device = make()
        device.close()
        device.open()
        device.open()
        assert device.is_open
        assert device.identity.serial
        assert device.identity.slot_period_s > 0
        device.close()
        device.close()
        assert not device.is_open

    def test_ends_with_an_empty_list_for_ever(self, make: Callable[[], Device]) -> None:
        with make() as device:
            assert len(self.frames(self.drain(device))) == FRAMES
            assert device.read(0.1) == []
            assert device.read(0.1) == []

    def test_time_and_ticks_go_forward(self, make: Callable[[], Device]) -> None:
        with make() as device:
            readings = self.frames(self.drain(device))
        times = [r.time_s for r in readings]
        assert times == sorted(times)
        ticks = [r.tick for r in readings if isinstance(r, ElectrodeReading)]
        assert ticks == sorted(set(ticks))

    def test_counts_its_samples(self, make: Callable[[], Device]) -> None:
        with make() as device:
            self.drain(device)
            assert device.counters["samples"] == FRAMES * 44

    def test_opens_again_with_the_same_readings(self, make: Callable[[], Device]) -> None:
        device = make()
        runs = []
        for _ in range(2):
            device.open()
            runs.append([repr(reading) for reading in self.drain(device)])
            device.close()
        assert runs[0] == runs[1]


class TestVirtual(DeviceContract):
    @pytest.fixture
    def make(self) -> Callable[[], Device]:
        return lambda: make_device("virtual", {"realtime": False, "frames": FRAMES})


class TestTwin(DeviceContract):
    @pytest.fixture
    def make(self, tape_path: Callable[..., Path]) -> Callable[[], Device]:
        path = str(tape_path())
        return lambda: make_device(
            "virtual", {"tape": path, "realtime": False, "frames": FRAMES, "seed": 3}
        )


class TestVirtualLive(DeviceContract):
    @pytest.fixture
    def make(self) -> Callable[[], Device]:
        return lambda: make_device("virtual", {"rate_hz": 1000, "frames": FRAMES})

    def test_times_out(self) -> None:
        with make_device("virtual", {"rate_hz": 1}) as device:
            assert device.read(1.0)
            with pytest.raises(DeviceTimeout, match=r"no frame within 0\.01 s"):
                device.read(0.01)


class TestTextLog(DeviceContract):
    @pytest.fixture
    def make(self, log: Callable[..., Any], tmp_path: Path) -> Callable[[], Device]:
        path = log(FRAMES).write(tmp_path / "a.btd.gz", gz=True)
        return lambda: make_device("text_log", {"path": path})


class TestRecord(DeviceContract):
    @pytest.fixture
    def make(self, record: Callable[..., Path]) -> Callable[[], Device]:
        path = record(FRAMES)
        return lambda: make_device("record", {"path": path})
