"""The Bota driver against its emulator, over a pseudo terminal."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from typing import Any

import pytest
from tests.gateway.reading_devices import PATIENCE_S, Follower

from palpate.config import parse_config
from palpate.errors import ConfigError, DeviceError, DeviceTimeout
from palpate_gateway.emulators.bota import BotaEmulator
from palpate_gateway.emulators.lines import SerialLine
from palpate_gateway.protocols.bota import BotaFrame
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.bota import BotaOptions, WrenchBota

pytest.importorskip("serial")

SHARES = (1.0, -2.0, 3.0, 0.1, -0.05, 0.02)
LOAD = (10.0, -5.0, 20.0, 0.1, -0.05, 0.025)


def sweep(t: float) -> tuple[float, ...]:
    """All six in fixed shares of one ramp: parts of two samples do not fit together."""
    return tuple(share * (1.0 + 7.0 * (t % 1.3)) for share in SHARES)


def is_of_sweep(reading: WrenchReading) -> bool:
    told = [*reading.force, *reading.torque]
    near = [abs(value - share * told[0]) < 1e-5 for value, share in zip(told, SHARES, strict=True)]
    return all(near) and 0.99 < told[0] < 10.2


def make(sensor: BotaEmulator, **options: Any) -> WrenchBota:
    values = {"port": sensor.address} | options
    return WrenchBota(parse_config(BotaOptions, values, where="test"))


def test_a_temperature_that_is_no_number_spoils_no_wrench() -> None:
    device = WrenchBota(BotaOptions(port="a", rate_hz=400.0))
    assert device._take(BotaFrame(0, LOAD, 1_000_000, math.nan)) is not None
    assert device.counters.get("not_finite", 0) == 0
    assert device._take(BotaFrame(0, (math.nan, *LOAD[1:]), 1_002_500, 20.0)) is None
    assert device.counters["not_finite"] == 1


@pytest.fixture
def sensor() -> Iterator[BotaEmulator]:
    with BotaEmulator(sweep) as made:
        booted(made)
        yield made


def booted(sensor: BotaEmulator) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while sensor.mode == "boot":
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def follower(sensor: BotaEmulator) -> Iterator[Follower[WrenchReading]]:
    with make(sensor, rate_hz=800) as device:
        yield Follower(device, WrenchReading)


@pytest.mark.parametrize(
    ("rate_hz", "sinc"), [(1000, 51), (800, 64), (400, 128), (250, 205), (200, 256), (100, 512)]
)
def test_it_sets_up_the_sensor_and_reads_it(sensor: BotaEmulator, rate_hz: int, sinc: int) -> None:
    with make(sensor, rate_hz=rate_hz, temperature_compensation=True) as device:
        assert device.info.rate_hz == pytest.approx(rate_hz, rel=0.005)
        assert (sensor.settings.sinc, sensor.settings.compensated) == (sinc, True)
        assert device.identity.serial == sensor.address
        readings = Follower(device, WrenchReading).more(30)
    assert all(map(is_of_sweep, readings))
    for before, after in itertools.pairwise(readings):
        steps = after.tick - before.tick
        assert after.time_s - before.time_s == pytest.approx(19.53125e-6 * sinc * steps, abs=2e-6)


def test_values_are_those_of_the_sensor_on_the_mount() -> None:
    mount = {
        "carries": "indenter",
        "orientation_wxyz": (0.5**0.5, 0.0, 0.0, 0.5**0.5),
        "origin_m": (0.0, 0.0, 0.02),
    }
    with BotaEmulator(lambda _: LOAD) as sensor:
        booted(sensor)
        with make(sensor, mount=mount, serial="ours") as device:
            reading = Follower(device, WrenchReading).more(1)[0]
    fx, fy, fz, tx, ty, tz = LOAD
    # A quarter turn about z, and the reaction's sign; then the lever of 20 mm.
    force = (fy, -fx, -fz)
    torque = (ty - 0.02 * force[1], -tx + 0.02 * force[0], -tz)
    assert reading.force == pytest.approx(force, abs=1e-5)
    assert reading.torque == pytest.approx(torque, abs=1e-6)
    assert reading.serial == "ours"


def test_each_value_has_the_time_that_the_sensor_gave_it(sensor: BotaEmulator) -> None:
    # The emulator's clock begins with the source's.
    with make(sensor) as device:
        readings = Follower(device, WrenchReading).more(100)
    for reading in readings:
        # 1 us of rounding, and float32.
        assert reading.force[0] == pytest.approx(sweep(reading.time_s)[0], abs=1e-4)


@pytest.mark.parametrize(("baud", "given"), [(460800, 0), (230400, 0), (115200, 115200)])
def test_the_speed_is_found_or_given(baud: int, given: int) -> None:
    with BotaEmulator(sweep, baud=baud) as sensor:
        booted(sensor)
        with make(sensor, baud=given, rate_hz=200) as device:
            assert all(map(is_of_sweep, Follower(device, WrenchReading).more()))
            assert sensor.settings.baud == baud


@pytest.mark.parametrize("runs_after_boot", [True, False])
def test_a_sensor_that_is_booting_is_waited_for(runs_after_boot: bool) -> None:
    with (
        BotaEmulator(sweep, boot_s=0.4, runs_after_boot=runs_after_boot) as sensor,
        make(sensor, baud=460800) as device,
    ):
        assert all(map(is_of_sweep, Follower(device, WrenchReading).more()))


def test_zero_is_taken_in_the_sensor() -> None:
    # What the sensor was left with must not spoil its zero.
    with BotaEmulator(lambda _: LOAD) as sensor:
        booted(sensor)
        with make(sensor) as device:
            follower = Follower(device, WrenchReading)
            follower.more()
            before = follower.readings[-1]
            device.zero()
            after = follower.more()
            assert all(abs(value) < 1e-3 for r in after for value in (*r.force, *r.torque))
            assert after[0].time_s > before.time_s
            assert after[0].tick > before.tick
            assert device.counters["lost_samples"] == 0
            assert sensor.settings.offsets == pytest.approx([-value for value in LOAD], abs=1e-3)
            device.zero()
            assert sensor.settings.offsets == pytest.approx([-value for value in LOAD], abs=1e-3)
        with make(sensor, zero_at_start=True) as device:
            assert abs(Follower(device, WrenchReading).more(1)[0].force[2]) < 1e-3


def test_offsets_that_work_otherwise_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    with BotaEmulator(lambda _: LOAD) as sensor, make(sensor) as device:
        take = sensor._take

        def turned(command: str, values: str) -> None:
            take(command, "".join(f",{-float(value)}" for value in values.split(",")[1:]))

        monkeypatch.setattr(sensor, "_take", turned)
        with pytest.raises(DeviceError, match="after taking zero it still reads"):
            device.zero()
        assert Follower(device, WrenchReading).more(1)[0].force == pytest.approx(LOAD[:3])


def test_a_zero_that_fails_has_cost_the_one_before() -> None:
    with BotaEmulator(lambda _: LOAD) as sensor, make(sensor) as device:
        sensor.inject("overload", 60.0)
        with pytest.raises(DeviceError, match="not valid now"):
            device.take_zero()
        assert not device.zero_lost, "it had none"
        sensor.end("overload")
        device.take_zero()
        sensor.inject("overload", 60.0)
        with pytest.raises(DeviceError, match="not valid now"):
            device.take_zero()
        assert (device.zero_lost, device.counters["zero_lost"]) == (True, 1)
        sensor.end("overload")
        device.take_zero()
        assert not device.zero_lost
        assert Follower(device, WrenchReading).more(1)[0].force == pytest.approx(0.0, abs=1e-3)


def test_late_samples_are_good_for_a_zero() -> None:
    with BotaEmulator(lambda _: LOAD) as sensor, make(sensor) as device:
        sensor.inject("late", 60.0)
        device.take_zero()
        assert Follower(device, WrenchReading).more(1)[0].force == pytest.approx(0.0, abs=1e-3)


AWAY = [
    ("silence", 0.1, "lost_samples"),
    ("silence", 0.45, "error: no sample came for 0.3 s"),
    ("restart", 0.0, "error: it has restarted: it wrote its boot text"),
    ("restart", 0.4, "error: no sample came for 0.3 s"),
    ("unplug", 0.2, "error: is gone"),
]


@pytest.mark.parametrize(("fault", "duration_s", "shown"), AWAY)
def test_a_sensor_that_is_away_is_found_again(
    sensor: BotaEmulator,
    follower: Follower[WrenchReading],
    fault: str,
    duration_s: float,
    shown: str,
) -> None:
    follower.more()
    sensor.inject(fault, duration_s)
    if shown.startswith("error: "):
        follower.until(lambda: any(shown[7:] in str(error) for error in follower.errors))
    else:
        follower.until(lambda: all(follower.counts()[name] for name in shown.split()))
    follower.until(lambda: not sensor.faulty(fault))
    follower.more(40)
    assert all(map(is_of_sweep, follower.readings))
    assert sensor.settings.sinc == 64


def test_a_clock_that_drifts_loses_nothing(
    sensor: BotaEmulator, follower: Follower[WrenchReading]
) -> None:
    sensor.inject("clock_drift", 60.0)
    follower.more(200)
    # A host that is busy may keep the emulator from sending.
    assert [e for e in follower.errors if "no sample came" not in str(e)] == []
    assert follower.counts()["wrong_times"] == 0
    assert follower.counts()["lost_samples"] * 37 <= sensor._line.overrun


def test_the_clock_may_wrap() -> None:
    # Its clock stands still until it runs.
    with BotaEmulator(sweep, runs_after_boot=False) as sensor:
        booted(sensor)
        sensor._clock_us = 2.0**32 - 100_000.0
        with make(sensor) as device:
            follower = Follower(device, WrenchReading)
            start = follower.more(1)[0].time_s
            follower.until(lambda: follower.readings[-1].time_s > 2.0**32 * 1e-6 + 0.1)
    assert start < 2.0**32 * 1e-6
    times = [reading.time_s for reading in follower.readings]
    assert times == sorted(set(times))


def test_a_clock_that_begins_anew_without_a_word_is_a_restart(
    sensor: BotaEmulator, follower: Follower[WrenchReading]
) -> None:
    follower.more()
    sensor._clock_us = 10_000.0
    follower.until(lambda: any("its clock started again" in str(e) for e in follower.errors))
    follower.more()
    assert all(map(is_of_sweep, follower.readings))
    assert follower.counts()["restarts"] == 1


def test_nobody_there_is_told_with_the_command() -> None:
    line = SerialLine(115200)
    line.plug()
    options = BotaOptions(port=line.path, baud=460800, boot_s=0.0)
    with pytest.raises(DeviceTimeout, match="'C' was not answered at 460800 bit/s"):
        WrenchBota(options).open()
    line.close()
    with pytest.raises(DeviceError, match=r"cannot be opened.*-> plug it in"):
        WrenchBota(options).open()


def test_a_refused_setting_is_told(sensor: BotaEmulator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensor, "_set", lambda command, _: command != "f")
    with pytest.raises(DeviceError, match=r"command 'f,128,0,0,1' was refused \(code 1\)"):
        make(sensor).open()


def test_a_speed_too_slow_for_the_rate_is_told() -> None:
    with BotaEmulator(sweep, baud=230400) as sensor:
        booted(sensor)
        with pytest.raises(DeviceError, match=r"230400 bit/s carry 623 samples/s, not 800"):
            make(sensor, rate_hz=800).open()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"port": ""}, "port"),
        ({"rate_hz": 300}, "none of 1004, 800, 400, 250, 200, 100"),
        ({"baud": 12345}, "12345"),
        ({"baud": 115200, "rate_hz": 400}, "400 is above 311 for 115200"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        parse_config(BotaOptions, {"port": "a"} | options, where="test")
