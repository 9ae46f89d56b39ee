"""The zero of a force/torque sensor, asked for over the bus, and lost with its power."""

from __future__ import annotations

import importlib
import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from palpate.bus import endpoints
from palpate.errors import ErrorCode, LinkError, RemoteError
from palpate.messages import (
    SensorState,
    SensorStatus,
    ServiceState,
    WrenchZero,
    WrenchZeroRequest,
)
from palpate_deploy.station.tare import take_tare
from palpate_gateway.emulators.bota import BotaEmulator
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.robotous import RobotousSerialEmulator

fakes: Any = importlib.import_module("wrench_fakes")


def kms_options(emulator: Kms40Emulator) -> dict[str, Any]:
    host, _, port = emulator.address.partition(":")
    return {"host": host, "port": int(port), "flags_every_s": 0.1}


def gateway(driver: str, options: dict[str, Any]) -> dict[str, Any]:
    return {"sensors": [{"name": "ft", "driver": driver, "options": options}]}


def ask_zero(bus: Any, *, readings: int = 20) -> WrenchZero:
    found: WrenchZero = bus.session.query(
        endpoints.ZERO, WrenchZeroRequest(readings), sensor="ft", timeout_s=20.0
    )
    return found


def sensor(bus: Any, state: SensorState) -> SensorStatus:
    """The sensor's status when it is in a state."""

    def reached() -> SensorStatus | None:
        now = bus.status()
        found = [one for one in now.sensor_states if one.state is state] if now else []
        return found[0] if found else None

    one = bus.until(reached)
    assert isinstance(one, SensorStatus)
    assert one.name == "ft"
    return one


def test_what_became_zero_is_told(bus: Any) -> None:
    with (
        Kms40Emulator(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        zero = ask_zero(bus, readings=0)
        assert (zero.sensor_serial, zero.readings_averaged) == ("310042", 250)
        assert zero.device.startswith("Weiss KMS 40 at 127.0.0.1")
        before = np.concatenate([zero.force_before, zero.torque_before])
        np.testing.assert_allclose(before, fakes.CONSTANT, atol=1e-3)
        after = np.concatenate([zero.force_after, zero.torque_after])
        np.testing.assert_allclose(after, 0.0, atol=1e-3)
        assert bus.state(ServiceState.READY).counters["zeros"] == 1
        again = ask_zero(bus)
        np.testing.assert_allclose(again.force_before, 0.0, atol=1e-3)
        assert again.monotonic_ns > zero.monotonic_ns


def test_a_load_that_moves_is_not_taken(bus: Any) -> None:
    def shaking(t: float) -> Any:
        return (3.0 * math.sin(40.0 * t), 0.0, 1.0, 0.0, 0.0, 0.0)

    with (
        Kms40Emulator(shaking) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        with pytest.raises(
            RemoteError, match=r"cannot zero 'ft': Fx varies by 2\.\d+ N .*leave the sensor"
        ) as caught:
            ask_zero(bus, readings=250)
        assert caught.value.code is ErrorCode.DEVICE
        assert "zeros" not in bus.state(ServiceState.READY).counters


def test_an_overloaded_sensor_is_not_taken(bus: Any) -> None:
    with (
        Kms40Emulator(lambda t: (0.0, 0.0, 200.0, 0.0, 0.0, 0.0)) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        with pytest.raises(RemoteError, match="cannot zero 'ft': it is overloaded"):
            ask_zero(bus)


class DeafToZero(Kms40Emulator):
    """It confirms a zero, and takes none."""

    def _data_line(self) -> str:
        tare, self._tare = self._tare, None
        line = super()._data_line()
        self._tare = tare
        return line


def test_a_zero_that_changes_nothing_is_no_success(bus: Any) -> None:
    with (
        DeafToZero(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        with pytest.raises(RemoteError, match=r"'ft' took no zero: it reads .* as before"):
            ask_zero(bus)


def test_a_restart_loses_the_zero_and_a_new_one_brings_it_back(bus: Any) -> None:
    with (
        Kms40Emulator(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        ask_zero(bus)
        emulator.inject("restart")
        lost = sensor(bus, SensorState.ZERO_LOST)
        assert lost.message.startswith("the zero that it had may be gone: it was opened again")
        now = bus.state(ServiceState.DEGRADED)
        assert now.counters["zero_lost"] == 1
        assert now.last_error.remedy.endswith("take its zero again: palpate tare ft")
        ask_zero(bus)
        sensor(bus, SensorState.LIVE)
        assert bus.state(ServiceState.READY).counters["zeros"] == 2


def test_a_device_that_still_has_its_zero_is_believed(bus: Any) -> None:
    with (
        Kms40Emulator(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        ask_zero(bus)
        emulator.inject("unplug", 0.5)
        sensor(bus, SensorState.LOST)
        sensor(bus, SensorState.LIVE)
        now = bus.state(ServiceState.READY)
        assert now.counters["device_lost"] >= 1
        assert "zero_lost" not in now.counters


def test_a_sensor_without_a_zero_loses_none(bus: Any) -> None:
    with (
        Kms40Emulator(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        emulator.inject("restart")
        bus.until(lambda: (now := bus.status()) and now.counters.get("device_lost"))
        sensor(bus, SensorState.LIVE)
        assert "zero_lost" not in bus.state(ServiceState.READY).counters


@pytest.mark.parametrize(
    ("make", "driver", "options"),
    [
        (lambda: BotaEmulator(fakes.constant), "wrench_bota", {"rate_hz": 400.0}),
        (lambda: RobotousSerialEmulator(fakes.constant), "wrench_robotous", {"rate_hz": 200}),
    ],
    ids=["bota", "robotous"],
)
def test_those_that_cannot_tell_may_have_lost_it(
    bus: Any, make: Callable[[], Any], driver: str, options: dict[str, Any]
) -> None:
    with make() as emulator:
        port = {"port": emulator.address, "zero_at_start": True, **options}
        with bus.gateway(gateway(driver, port)):
            sensor(bus, SensorState.LIVE)
            zero = ask_zero(bus)
            np.testing.assert_allclose(zero.force_before, 0.0, atol=0.05)
            emulator.inject("restart", 0.5)
            sensor(bus, SensorState.ZERO_LOST)
            zero = ask_zero(bus)
            np.testing.assert_allclose(zero.force_before, fakes.CONSTANT[:3], atol=0.05)
            np.testing.assert_allclose(zero.force_after, 0.0, atol=0.05)
            sensor(bus, SensorState.LIVE)


def test_who_waits_hears_when_the_sensor_goes(bus: Any) -> None:
    with (
        Kms40Emulator(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        emulator.inject("silence", 30.0)
        with pytest.raises(RemoteError, match=r"took no zero|does not deliver at present"):
            ask_zero(bus, readings=5_000)


def test_a_wrench_is_not_asked_for_a_baseline_nor_a_finger_for_a_zero(bus: Any) -> None:
    with (
        Kms40Emulator(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        with pytest.raises(LinkError, match="no gateway has a BioTac of this name"):
            bus.ask_tare("ft")
    with bus.gateway({"sensors": [{"name": "ft", "driver": "virtual"}]}):
        bus.state(ServiceState.READY)
        with pytest.raises(LinkError, match="no gateway has a force/torque sensor of this name"):
            ask_zero(bus)


def test_one_command_tares_whichever_sensor_it_is(
    bus: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    with Kms40Emulator(fakes.constant) as emulator:
        values = gateway("wrench_kms40", kms_options(emulator))
        values["sensors"].append({"name": "finger", "driver": "virtual"})
        with bus.gateway(values):
            bus.state(ServiceState.READY)
            take_tare(bus.link, "lab", "ft", frames=20, timeout_s=20.0)
            lines = capsys.readouterr().out.splitlines()
            assert lines[0].startswith("zeroed ft (310042, Weiss KMS 40 at 127.0.0.1")
            assert lines[1] == "before  +1.500 -0.250 +1.000 N  +0.0200 -0.0100 +0.0050 N m"
            assert lines[2].replace("-", "+").startswith("after   +0.000 +0.000 +0.000 N  ")
            assert lines[3] == "means of 20 readings each"
            take_tare(bus.link, "lab", "finger", frames=2, timeout_s=20.0)
            assert capsys.readouterr().out.startswith("tared finger (VIRTUAL")
            with pytest.raises(LinkError, match="answers on palpate/@v1/lab/nobody/tare"):
                take_tare(bus.link, "lab", "nobody", frames=2, timeout_s=20.0)


@pytest.mark.parametrize("readings", [4, 5_001, 2**32 - 1])
def test_a_zero_over_more_than_ten_seconds_is_refused(bus: Any, readings: int) -> None:
    with (
        Kms40Emulator(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        with pytest.raises(RemoteError, match=r"'ft' averages 5 to 5000 readings") as caught:
            ask_zero(bus, readings=readings)
        assert caught.value.code is ErrorCode.INVALID_REQUEST
        assert ask_zero(bus, readings=5).readings_averaged == 5


def test_a_zero_of_a_caller_that_left_is_not_taken(bus: Any) -> None:
    with (
        Kms40Emulator(fakes.constant) as emulator,
        bus.gateway(gateway("wrench_kms40", kms_options(emulator))),
    ):
        sensor(bus, SensorState.LIVE)
        token = bus.session.caller_token("gone")
        left = threading.Thread(
            target=lambda: bus.session.query_all(
                endpoints.ZERO,
                WrenchZeroRequest(5_000, "gone"),
                sensor="ft",
                timeout_s=20.0,
            )
        )
        left.start()
        bus.until(lambda: any(t.name == "zero of ft" for t in threading.enumerate()))
        token.close()
        # The next one need not wait ten seconds for the readings of the first.
        assert ask_zero(bus, readings=5).readings_averaged == 5
        left.join(20.0)
        assert not left.is_alive()
        assert bus.state(ServiceState.READY).counters["zeros"] == 1
