"""The Robotous driver against its emulator, over a pseudo terminal and a virtual CAN bus."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from tests.gateway.reading_devices import PATIENCE_S, Follower

from palpate.config import parse_config
from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.emulators.lines import SerialLine
from palpate_gateway.emulators.robotous import (
    RobotousCanEmulator,
    RobotousEmulator,
    RobotousSerialEmulator,
)
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.robotous import RobotousCanLine, RobotousOptions, WrenchRobotous

pytest.importorskip("serial")
can = pytest.importorskip("can")

SHARES = (1.0, -2.0, 3.0, 0.1, -0.05, 0.02)
FORCE_STEP, TORQUE_STEP = 1.0 / 50.0, 1.0 / 2000.0
LOAD = (10.0, -5.0, 20.0, 0.1, -0.05, 0.025)


def sweep(t: float) -> tuple[float, ...]:
    """All six in fixed shares of one ramp: parts of two samples do not fit together."""
    return tuple(share * (1.0 + 7.0 * (t % 1.3)) for share in SHARES)


def is_of_sweep(reading: WrenchReading) -> bool:
    told = [*reading.force, *reading.torque]
    ramp = told[2] / SHARES[2]
    # Half a step of its own, and that of the ramp, which is told in half steps of Fz.
    steps = 3 * (FORCE_STEP,) + 3 * (2.0 * TORQUE_STEP,)
    near = [
        abs(value - share * ramp) < step
        for value, share, step in zip(told, SHARES, steps, strict=True)
    ]
    return all(near) and 0.98 < ramp < 10.2


def passed(moment_s: float) -> bool:
    return time.monotonic() > moment_s


def make(options: dict[str, Any]) -> WrenchRobotous:
    return WrenchRobotous(parse_config(RobotousOptions, options, where="test"))


@pytest.fixture(params=["serial", "can"])
def sensor(request: pytest.FixtureRequest) -> Iterator[RobotousEmulator]:
    made: RobotousEmulator
    if request.param == "serial":
        made = RobotousSerialEmulator(sweep, baud=921600)
    else:
        made = RobotousCanEmulator(sweep, channel=request.node.name)
    with made:
        yield made


def line_of(sensor: RobotousEmulator) -> dict[str, Any]:
    if isinstance(sensor, RobotousSerialEmulator):
        return {"port": sensor.address, "baud": 921600}
    interface, _, channel = sensor.address.partition(":")
    return {"interface": interface, "channel": channel}


@pytest.fixture
def follower(sensor: RobotousEmulator) -> Iterator[Follower[WrenchReading]]:
    with make(line_of(sensor) | {"rate_hz": 500}) as device:
        yield Follower(device, WrenchReading)


def test_it_sets_up_the_sensor_and_reads_it(sensor: RobotousEmulator) -> None:
    options = line_of(sensor) | {"rate_hz": 1000, "cutoff_hz": 100}
    with make(options) as device:
        assert (device.identity.serial, device.info.rate_hz) == ("RFT-1", 1000.0)
        assert (sensor.rate_hz, sensor.filter_code, sensor.running) == (1000.0, (1, 5), True)
        readings = Follower(device, WrenchReading).more(300)
        assert device.counters["samples"] >= 300
    assert all(map(is_of_sweep, readings))
    assert not any(reading.overload for reading in readings)
    times = [reading.time_s for reading in readings]
    assert times == sorted(set(times))
    assert [r.tick for r in readings] == list(range(1, len(readings) + 1))
    deadline = time.monotonic() + PATIENCE_S
    while sensor.running:
        assert time.monotonic() < deadline, "closing did not stop the stream"
        time.sleep(0.01)


@pytest.mark.parametrize(("model", "divisor"), [("RFT40-SA01", 2000.0), ("RFT80-6A01", 1000.0)])
def test_values_follow_model_and_mount(model: str, divisor: float) -> None:
    mount = {
        "carries": "indenter",
        "orientation_wxyz": (0.5**0.5, 0.0, 0.0, 0.5**0.5),
        "origin_m": (0.0, 0.0, 0.02),
    }
    with RobotousSerialEmulator(lambda _: LOAD, model=model) as sensor:
        with make({"port": sensor.address, "mount": mount, "serial": "ours"}) as device:
            reading = Follower(device, WrenchReading).more(1)[0]
    fx, fy, fz, tx, ty, tz = LOAD
    # A quarter turn about z, and the reaction's sign; then the lever of 20 mm.
    force = (fy, -fx, -fz)
    torque = (ty - 0.02 * force[1], -tx + 0.02 * force[0], -tz)
    assert reading.force == pytest.approx(force, abs=1e-6)
    assert reading.torque == pytest.approx(torque, abs=0.5 / divisor + 1e-6)
    assert reading.serial == "ours"


def test_a_torque_divisor_outdoes_the_model() -> None:
    with RobotousSerialEmulator(lambda _: LOAD) as sensor:
        with make({"port": sensor.address, "torque_divisor": 1000.0}) as device:
            reading = Follower(device, WrenchReading).more(1)[0]
    assert reading.torque == pytest.approx([2.0 * value for value in LOAD[3:]], abs=1e-6)


def test_an_old_stream_is_stopped_first(sensor: RobotousEmulator) -> None:
    sensor.running = True
    with make(line_of(sensor) | {"rate_hz": 500}) as device:
        assert all(map(is_of_sweep, Follower(device, WrenchReading).more(50)))
        assert sensor.rate_hz == 500.0


def test_zero_is_taken_in_the_sensor(sensor: RobotousEmulator) -> None:
    sensor._source = lambda _: LOAD
    with make(line_of(sensor) | {"zero_at_start": True}) as device:
        follower = Follower(device, WrenchReading)
        assert all(not reading.force.any() for reading in follower.more(10))
        sensor._source = lambda _: (11.0, *LOAD[1:])
        follower.until(lambda: follower.readings[-1].force[0] == pytest.approx(1.0))
        device.zero()
        assert all(not reading.force.any() for reading in follower.more(10))


@pytest.mark.parametrize("load", [LOAD, (0.36, -0.3, 0.38, 0.009, 0.0, -0.0095)])
def test_a_zero_that_is_not_taken_is_told(
    sensor: RobotousEmulator, load: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor._source = lambda _: load
    answer = sensor._answer
    monkeypatch.setattr(sensor, "_answer", lambda r: answer(r) if r[0] != 17 else None)
    with make(line_of(sensor)) as device, pytest.raises(DeviceError, match="it took no zero"):
        device.zero()


SILENT = "no sample came for 0.3 s"


@pytest.mark.parametrize(
    ("fault", "duration_s", "error"),
    [("silence", 0.6, SILENT), ("restart", 0.1, SILENT), ("unplug", 0.2, "is gone")],
)
def test_a_sensor_that_is_away_is_found_again(
    sensor: RobotousEmulator,
    follower: Follower[WrenchReading],
    fault: str,
    duration_s: float,
    error: str,
) -> None:
    if fault == "unplug" and isinstance(sensor, RobotousCanEmulator):
        error = SILENT  # the bus stays; the plug has taken the sensor's supply
    follower.more()
    sensor.inject(fault, duration_s)
    follower.until(lambda: any(error in str(one) for one in follower.errors))
    follower.until(lambda: not sensor.faulty(fault))
    follower.more(40)
    assert all(map(is_of_sweep, follower.readings))


def test_a_restart_is_followed_by_the_same_settings(sensor: RobotousEmulator) -> None:
    with make(line_of(sensor) | {"rate_hz": 500, "cutoff_hz": 50}) as device:
        follower = Follower(device, WrenchReading)
        follower.more()
        sensor.inject("restart")
        follower.until(lambda: follower.errors)
        follower.more()
    assert (sensor.rate_hz, sensor.filter_code) == (500.0, (1, 6))


@pytest.mark.parametrize("sensor", ["can"], indirect=True)
def test_bus_off_is_found_and_survived(
    sensor: RobotousEmulator, follower: Follower[WrenchReading], monkeypatch: pytest.MonkeyPatch
) -> None:
    follower.more()
    assert isinstance(sensor, RobotousCanEmulator)
    kind = type(sensor._bus)
    with monkeypatch.context() as patch:
        patch.setattr(kind, "state", property(lambda _: can.BusState.ERROR))
        sensor.inject("busoff", 0.1)
        follower.until(lambda: any("bus off" in str(error) for error in follower.errors))
    follower.more(40)
    assert all(map(is_of_sweep, follower.readings))


@pytest.mark.parametrize("sensor", ["can"], indirect=True)
def test_halves_far_apart_are_not_joined(
    sensor: RobotousEmulator, follower: Follower[WrenchReading]
) -> None:
    with can.Bus(interface="virtual", channel=sensor.address.partition(":")[2]) as bus:
        follower.more()
        sensor.running = False
        time.sleep(0.02)
        for can_id, data in ((1, b"\x0b" + bytes(7)), (2, bytes(8))):
            bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
            read_until = time.monotonic() + 0.1
            follower.until(partial(passed, read_until))
    follower.until(lambda: follower.counts()["lonely_second"])
    follower.more()
    assert all(map(is_of_sweep, follower.readings))


@pytest.mark.parametrize(("apart_us", "joined"), [(2_000, True), (2_500, False)])
def test_stamps_of_halves_may_scatter_at_1000_hz(apart_us: int, joined: bool) -> None:
    halves = [(1, b"\x0b" + bytes(7), 10**9), (2, bytes(8), 10**9 + 1000 * apart_us)]
    bus = SimpleNamespace(
        name="a",
        counters={},
        read=lambda _: SimpleNamespace(messages=lambda: halves),
    )
    line = RobotousCanLine(
        bus,  # type: ignore[arg-type]
        request_id=0x64,
        first_id=1,
        second_id=2,
        period_s=1e-3,
    )
    assert len(line.read(0.1)) == joined
    assert line.counters["lonely_first"] == (not joined)


def test_others_on_the_bus_do_not_hide_silence(request: pytest.FixtureRequest) -> None:
    channel = request.node.name
    with (
        RobotousCanEmulator(sweep, channel=channel) as sensor,
        can.Bus(interface="virtual", channel=channel) as bus,
        make({"interface": "virtual", "channel": channel}) as device,
    ):
        follower = Follower(device, WrenchReading)
        follower.more()
        other = can.Message(arbitration_id=0x300, data=bytes(8), is_extended_id=False)
        noise = bus.send_periodic(other, 0.005)
        sensor.inject("restart")
        follower.until(lambda: follower.errors)
        follower.more()
        noise.stop()
        assert follower.counts()["other_ids"] > 0


def test_two_sensors_with_the_same_identifiers_are_told(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("palpate_gateway.clock.sample_times._CHECK_NS", 200_000_000)
    channel = request.node.name
    options = {"interface": "virtual", "channel": channel, "rate_hz": 200}
    with RobotousCanEmulator(sweep, channel=channel):
        with RobotousCanEmulator(lambda _: LOAD, channel=channel), make(options) as device:
            follower = Follower(device, WrenchReading)
            follower.until(lambda: "more than one sensor" in str(follower.errors))
            # It is not published again as long as there are two.
            assert follower.readings
            with pytest.raises(DeviceLost, match="more than one sensor"):
                device.open()
        with make(options) as device:
            assert all(map(is_of_sweep, Follower(device, WrenchReading).more(300)))


def test_nobody_there_is_told_with_the_request() -> None:
    line = SerialLine(115200)
    line.plug()
    with pytest.raises(
        DeviceTimeout, match=r"request 1 \(model\) was not answered; it sent: nothing"
    ):
        make({"port": line.path}).open()
    line.close()
    with pytest.raises(DeviceError, match=r"cannot be opened.*-> plug it in"):
        make({"port": "/dev/no-such-line"}).open()


def test_another_speed_is_told_by_what_came() -> None:
    with RobotousSerialEmulator(sweep, baud=921600) as sensor:
        sensor.running = True
        with pytest.raises(DeviceTimeout, match=r"it sent: \d+ junk_bytes.*-> check .* baud"):
            make({"port": sensor.address}).open()


@pytest.mark.parametrize("serial_line", [True, False])
def test_an_unknown_model_needs_a_divisor(serial_line: bool) -> None:
    with RobotousSerialEmulator(lambda _: LOAD) as sensor:
        sensor._model = "RFT99-XX"
        with pytest.raises(DeviceError, match=r"'RFT99-XX' is not in .*-> set model or torque_div"):
            make({"port": sensor.address}).open()
        with make({"port": sensor.address, "model": "RFT44-SB01"}) as device:
            assert Follower(device, WrenchReading).more(1)[0].torque[0] == pytest.approx(0.1)


def test_a_model_that_is_another_one_is_refused() -> None:
    with RobotousSerialEmulator(lambda _: LOAD) as sensor:
        with pytest.raises(DeviceError, match="it says that it is a RFT64-SB01, not a RFT80-6A01"):
            make({"port": sensor.address, "model": "RFT80-6A01"}).open()


def test_a_refused_setting_is_told() -> None:
    with RobotousSerialEmulator(lambda _: LOAD) as sensor:
        sensor._most_hz = 100
        with pytest.raises(DeviceError, match=r"request 15 \(set_rate\) was refused: out of range"):
            make({"port": sensor.address}).open()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({}, "either port"),
        ({"port": "a", "interface": "virtual", "channel": "b"}, "either port"),
        ({"port": "a", "rate_hz": 60}, "60 is not one of 10, 20"),
        ({"port": "a", "rate_hz": 500}, "500 is above 333 for 115200"),
        ({"port": "a", "baud": 9600}, "9600"),
        ({"port": "a", "cutoff_hz": 7}, "cutoff"),
        ({"port": "a", "model": "RFT1"}, "RFT1"),
        ({"interface": "virtual", "channel": "b", "first_id": 2}, "different"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        make(options)
