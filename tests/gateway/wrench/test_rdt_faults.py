"""The RDT driver when sensors misbehave, against sensors in software on loopback."""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np
import pytest
from tests.gateway.rdt_sensors import device_at, running
from tests.gateway.reading_devices import open_again

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate.messages import ServiceState
from palpate_gateway.emulators.rdt import RdtEmulator, page

fakes: Any = importlib.import_module("wrench_fakes")


def test_a_start_that_is_not_heard_is_repeated() -> None:
    with RdtEmulator("hex", fakes.wave) as emulator:
        emulator.inject("deaf", 0.25)
        with device_at(emulator, "onrobot_hex", rate_hz=100.0) as device:
            fakes.read_until(device, lambda readings: len(readings) >= 10)
        emulator.inject("deaf", 100.0)
        with pytest.raises(DeviceTimeout, match="no record came after 10 start requests"):
            device_at(emulator, "onrobot_hex").open()


def test_silence_is_a_timeout_and_ends() -> None:
    with running() as (emulator, device):
        fakes.take(device, 5)
        emulator.inject("silence", 100.0)
        assert "nothing came within 0." in fakes.wait_for_timeout(device)
        while not device.counters.get("starts_repeated"):
            fakes.wait_for_timeout(device)
        emulator.end("silence")
        fakes.read_until(device, lambda readings: len(readings) >= 50)


def test_a_restart_is_found_and_opened_again() -> None:
    with running("onrobot_hex", rate_hz=200.0) as (emulator, device):
        fakes.read_until(device, lambda readings: bool(readings) and readings[-1].time_s > 1.0)
        emulator.inject("restart")
        with pytest.raises(DeviceLost, match=r"it was restarted -> .* its zero is gone"):
            fakes.read_until(device, lambda _: False)
        open_again(device)
        fakes.read_until(device, lambda readings: len(readings) >= 50)
        assert emulator.rate_hz == 200.0


def test_unplugged_it_is_found_and_opened_again() -> None:
    with running() as (emulator, device):
        fakes.take(device, 5)
        emulator.inject("unplug", 100.0)
        with pytest.raises(DeviceLost, match="is gone"):
            fakes.read_until(device, lambda _: False)
        emulator.end("unplug")
        open_again(device)
        fakes.read_until(device, lambda readings: len(readings) >= 50)


def test_a_sensor_that_reports_itself_faulty_is_not_called_silent(bus: Any) -> None:
    with RdtEmulator("netft", fakes.wave) as emulator:
        host, _, port = emulator.address.partition(":")
        options = {"product": "ati_net_ft", "host": host, "port": int(port)}
        options["http_port"] = emulator.page.port
        sensors = [{"name": "ft", "driver": "wrench_rdt", "options": options}]
        with bus.gateway({"sensors": sensors}):
            bus.state(ServiceState.READY)
            emulator.inject("error", 100.0)

            def told() -> str:
                now = bus.status()
                message = now.sensor_states[0].message if now else ""
                return message if "no reading came" in message else ""

            assert "but it counted" in (message := bus.until(told))
            assert "invalid_samples" in message


def test_what_comes_and_is_no_reading_is_not_nothing() -> None:
    with running() as (emulator, device):
        fakes.take(device, 5)
        emulator.inject("error", 100.0)
        assert "something came, but no valid reading within 0.1 s" in fakes.wait_for_timeout(device)


def test_a_drifting_clock_is_followed() -> None:
    with running() as (emulator, device):
        emulator.inject("clock_drift", 100.0)
        readings = fakes.read_until(device, lambda readings: len(readings) >= 500)
    times = np.array([r.time_s for r in readings])
    assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(1e-3, rel=1e-3)


def test_a_scale_that_changed_while_the_stream_was_interrupted_is_noticed() -> None:
    with running(source=fakes.constant) as (emulator, device):
        fakes.take(device, 5)
        emulator.inject("silence", 100.0)
        while not device.counters.get("starts_repeated"):
            fakes.wait_for_timeout(device)
        emulator.end("silence")
        fakes.take(device, 50)  # the same as before
        emulator.inject("silence", 100.0)
        emulator.page.content = page("Net F/T", (1e4, 1e5), ("N", "Nm"))
        emulator._counts_per_si = np.repeat((1e4, 1e5), 3)
        fakes.wait_for_timeout(device)
        emulator.end("silence")
        with pytest.raises(DeviceLost, match=r"were 1e\+06 and 1e\+06, and are 10000 and 100000"):
            fakes.take(device, 10_000)
        open_again(device)
        for reading in fakes.take(device, 50):
            assert reading.force == pytest.approx(fakes.CONSTANT[:3], abs=1e-3)


class SeveralSensors(RdtEmulator):
    """A HEX converter whose records come from sensors 1 and 2 in turn."""

    plugged = True

    def _record(self) -> bytes:
        whole = bytearray(super()._record())
        if not self.plugged:
            return bytes(whole)
        number = 1 + self._sequence % 2
        whole[11] |= 0b1000 | number
        return bytes(whole) if number == 1 else bytes(whole[:12]) + bytes(24)


def test_of_several_sensors_one_must_be_named() -> None:
    with SeveralSensors("hex", fakes.wave) as emulator:
        with pytest.raises(DeviceError, match=r"several sensors -> .*option 'sensor'"):
            device_at(emulator, "onrobot_hex").open()
        with device_at(emulator, "onrobot_hex", sensor=1) as device:
            fakes.read_until(device, lambda readings: len(readings) >= 20)
            assert device.counters["other_sensors"] >= 19


def test_a_second_sensor_that_is_plugged_in_later_is_not_mixed_in() -> None:
    with SeveralSensors("hex", fakes.wave) as emulator:
        emulator.plugged = False
        with device_at(emulator, "onrobot_hex") as device:
            fakes.read_until(device, lambda readings: len(readings) >= 20)
            emulator.plugged = True
            with pytest.raises(DeviceLost, match="several sensors"):
                fakes.read_until(device, lambda _: False)  # and none is of the other one


def test_with_a_wrong_rate_it_is_opened_with_the_hosts_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("palpate_gateway.wrench.rdt.CHECK_S", 0.2)
    with (
        RdtEmulator("netft", fakes.wave, counter_hz=3500.0) as emulator,
        device_at(emulator) as device,
    ):
        with pytest.raises(DeviceLost, match="not 7000 Hz"):
            fakes.read_until(device, lambda _: False)
        open_again(device)
        readings = fakes.read_until(device, lambda readings: len(readings) >= 50)
        assert device.counters["counter_rate_wrong"] == 1
        assert abs(readings[-1].time_s - time.monotonic()) < fakes.PATIENCE_S
