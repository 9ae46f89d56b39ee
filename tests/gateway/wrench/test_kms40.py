"""The KMS 40 driver against a KMS 40 in software, over TCP on loopback."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.gateway.reading_devices import open_again

from palpate.config import parse_config
from palpate.errors import ConfigError, DeviceError, DeviceLost
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.wrench.kms40 import Kms40Options, WrenchKms40

fakes: Any = importlib.import_module("wrench_fakes")


def device_at(emulator: Kms40Emulator, **options: Any) -> WrenchKms40:
    host, _, port = emulator.address.partition(":")
    values = {"host": host, "port": int(port), **options}
    return WrenchKms40(parse_config(Kms40Options, values, where="test"))


@pytest.fixture
def emulator() -> Iterator[Kms40Emulator]:
    with Kms40Emulator(fakes.wave) as running:
        yield running


@pytest.fixture
def device(emulator: Kms40Emulator) -> Iterator[WrenchKms40]:
    with device_at(emulator, flags_every_s=0.05) as opened:
        yield opened


def test_wrenches_are_those_that_were_felt(device: WrenchKms40) -> None:
    readings = fakes.take(device, 200)
    fakes.assert_felt(readings)
    assert max(r.force[0] for r in readings) - min(r.force[0] for r in readings) > 0.1
    assert [r.tick for r in readings] == list(range(1, len(readings) + 1))
    times = [r.time_s for r in readings]
    assert times == sorted(times)
    assert not any(r.overload for r in readings)
    assert device.identity.serial == "310042"
    counters = device.counters
    assert counters["samples"] == len(readings)
    assert counters["replies"] > 10
    for name in ("junk_bytes", "refusals", "invalid_samples"):
        assert not counters.get(name)


def test_without_the_devices_time_it_is_the_same() -> None:
    with Kms40Emulator(fakes.wave, stamped=False) as emulator, device_at(emulator) as device:
        fakes.assert_felt(fakes.take(device, 20))
        assert device.counters["untimed_lines"] >= 20


def test_the_mount_turns_and_shifts() -> None:
    half = math.sqrt(0.5)
    mount = {
        "carries": "indenter",
        "orientation_wxyz": (half, 0.0, 0.0, half),
        "origin_m": (0.0, 0.0, 0.01),
    }
    with (
        Kms40Emulator(fakes.constant) as emulator,
        device_at(emulator, mount=mount) as device,
    ):
        reading = fakes.take(device, 1)[0]
    # x of the sensor is y of the BioTac; the reaction has the other sign.
    force = np.array([-0.25, -1.5, -1.0])
    torque = np.array([-0.01, -0.02, -0.005]) + np.cross([0.0, 0.0, 0.01], force)
    np.testing.assert_allclose(reading.force, force, atol=1e-6)
    np.testing.assert_allclose(reading.torque, torque, atol=1e-6)


def test_rate_and_filter_are_set(emulator: Kms40Emulator) -> None:
    with device_at(emulator, rate_hz=125.0, filter_number=3, serial="mine") as device:
        assert emulator.divider == 4
        assert emulator.answer("FLT()") == "FLT=3"
        assert device.info.rate_hz == 125.0
        assert device.identity.serial == "mine"
        fakes.assert_felt(fakes.take(device, 5))


def test_a_rate_that_it_has_not_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match="nearest are 250 and 500"):
        parse_config(Kms40Options, {"host": "x", "rate_hz": 300.0}, where="test")
    with pytest.raises(ConfigError, match="key 'host' is missing"):
        parse_config(Kms40Options, {}, where="test")


@pytest.mark.parametrize("at_start", [False, True])
def test_zero_is_the_devices_own(at_start: bool) -> None:
    with Kms40Emulator(fakes.constant) as emulator:
        with device_at(emulator, zero_at_start=at_start) as device:
            if not at_start:
                np.testing.assert_allclose(
                    fakes.take(device, 1)[0].force, fakes.CONSTANT[:3], atol=1e-6
                )
                device.zero()
            for reading in fakes.take(device, 20):
                np.testing.assert_array_equal(reading.force, 0.0)
                np.testing.assert_array_equal(reading.torque, 0.0)
        # The device keeps it.
        with device_at(emulator) as device:
            np.testing.assert_array_equal(fakes.take(device, 1)[0].force, 0.0)


def test_it_stops_the_stream_when_it_leaves_and_finds_an_old_one(emulator: Kms40Emulator) -> None:
    with device_at(emulator) as device:
        fakes.take(device, 1)
    assert not emulator.streaming
    emulator.answer("L1()")
    with device_at(emulator) as device:
        fakes.assert_felt(fakes.take(device, 50))
        assert not device.counters["junk_bytes"]


def test_silence_is_a_timeout_and_ends(emulator: Kms40Emulator, device: WrenchKms40) -> None:
    fakes.take(device, 5)
    emulator.inject("silence", 100.0)
    assert "nothing came within 0." in fakes.wait_for_timeout(device)
    while not device.counters.get("flags_unanswered"):
        fakes.wait_for_timeout(device)
    emulator.end("silence")
    fakes.read_until(device, lambda readings: len(readings) >= 50)


@pytest.mark.parametrize("fault", ["restart", "unplug"])
def test_a_lost_connection_is_found_and_opened_again(emulator: Kms40Emulator, fault: str) -> None:
    with device_at(emulator, rate_hz=250.0) as device:
        fakes.take(device, 5)
        emulator.inject(fault, 100.0 if fault == "unplug" else 0.0)
        with pytest.raises(DeviceLost, match="is gone"):
            fakes.read_until(device, lambda _: False)
        emulator.end(fault)
        open_again(device)
        fakes.read_until(device, lambda readings: len(readings) >= 50)
        assert emulator.divider == 2


def test_with_a_fault_it_is_not_opened(emulator: Kms40Emulator) -> None:
    emulator.inject("error", 100.0)
    with pytest.raises(DeviceError, match=r"reports calibration fault -> its forces are not valid"):
        device_at(emulator).open()
    # Whoever does not ask does not know.
    with device_at(emulator, flags_every_s=0.0) as device:
        fakes.assert_felt(fakes.take(device, 20))
        assert "flags_unanswered" not in device.counters


class Contrary(Kms40Emulator):
    """Answers one request otherwise."""

    def __init__(self, request: str, reply: str) -> None:
        super().__init__(fakes.wave)
        self._other = (request, reply)

    def answer(self, line: str) -> str:
        usual = super().answer(line)
        return self._other[1] if line == self._other[0] else usual


@pytest.mark.parametrize(
    ("request_line", "reply", "message"),
    [
        ("SN()", "ERROR(14)", r"SN\(\) was refused: unknown command \(error 14\)"),
        ("SN()", 'SN=""', "gives no serial number"),
        ("LDIV(1)", "LDIV=2", r"LDIV\(1\) was answered with '2' instead of '1'"),
        ("L1()", "", r"L1\(\) was not answered within 2 s"),
        ("FLAGS()", "ERROR(14)", r"FLAGS\(\) was refused.*has no FLAGS, set flags_every_s = 0"),
        ("FLAGS()", "", r"FLAGS\(\) was not answered.*has no FLAGS, set flags_every_s = 0"),
    ],
)
def test_a_wrong_answer_says_which(request_line: str, reply: str, message: str) -> None:
    with Contrary(request_line, reply) as emulator:
        device = device_at(emulator)
        with pytest.raises(DeviceError, match=message):
            device.open()
        assert not device.is_open


def test_a_refused_zero_leaves_the_stream_on() -> None:
    with Contrary("TARE(1)", "ERROR(18)") as emulator, device_at(emulator) as device:
        with pytest.raises(DeviceError, match=r"TARE\(1\) was refused: command failed"):
            device.zero()
        assert len(fakes.take(device, 20)) >= 20


def test_flags_that_are_no_number_are_counted() -> None:
    with (
        Contrary("FLAGS()", "FLAGS=none") as emulator,
        device_at(emulator, flags_every_s=0.02) as device,
    ):
        fakes.read_until(device, lambda readings: device.counters["bad_flags"] >= 3)


def test_nobody_there_says_what_to_do(emulator: Kms40Emulator) -> None:
    emulator.stop()
    device = device_at(emulator)
    with pytest.raises(DeviceError, match=r"no connection.*-> check address, port, cable"):
        device.open()
    device.close()
