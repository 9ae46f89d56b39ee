"""A robot's program on the bus, and the device that hears it."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.bus import Publisher, Session, Subscriber
from palpate.bus.topics import ROBOT_POSE
from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import ConfigError, DeviceLost, DeviceTimeout, LinkError
from palpate.messages import Origin, Pose
from palpate.v1 import robot_pb2
from palpate_gateway.device import BusDevice
from palpate_gateway.drivers import make_device

fakes: Any = importlib.import_module("pose_fakes")
PATIENCE_S: float = fakes.PATIENCE_S


def device_of(link: LinkConfig, **options: Any) -> BusDevice:
    device = make_device("pose_zenoh", {"robot": "arm", **fakes.BENCH, **options})
    assert isinstance(device, BusDevice)
    device.join(link, "lab")
    return device


@pytest.fixture
def device(link: LinkConfig) -> Iterator[BusDevice]:
    """An open device."""
    with device_of(link) as device:
        yield device


@pytest.fixture
def session(link: LinkConfig) -> Iterator[Session]:
    with Session.open(link) as session:
        yield session


@pytest.fixture
def told(device: BusDevice, session: Session) -> Publisher[Any]:
    """A publisher of the robot's poses to which the device listens."""
    publisher = session.publisher(ROBOT_POSE, sensor="arm", lossless=True)
    fakes.until(publisher.matched)
    return publisher


def test_facts_before_opening(link: LinkConfig) -> None:
    device = device_of(link, rate_hz=500)
    info = device.info
    assert (info.sensor_type, info.rate_hz, info.live, info.finite) == (None, 500, True, False)
    assert info.origin is Origin.LIVE
    assert info.model == "robot arm, sphere_7mm"


def test_what_a_program_puts_becomes_the_tip(link: LinkConfig, device: BusDevice) -> None:
    with Client(link.connect[0], timeout_s=PATIENCE_S) as client:
        poses = client.robot_pose_publisher("arm")
        other = client.robot_pose_publisher("other_arm")
        fakes.until(poses.matched)
        for number in range(1, 201):
            flange = fakes.flange(number)
            poses.put(flange.position, flange.orientation, 5_000_000_000 + 1_000_000 * number)
            other.put((9.0, 9.0, 9.0), (1.0, 0.0, 0.0, 0.0))
        readings = fakes.take(device, 200)
    assert fakes.numbers(readings) == list(range(1, 201))
    assert [reading.tick for reading in readings] == list(range(1, 201))
    np.testing.assert_allclose([r.time_s for r in readings], 0.001 * np.arange(200), atol=1e-12)
    np.testing.assert_allclose(readings[7].position, fakes.tip(8).position, atol=fakes.NEAR)
    assert {reading.in_contact for reading in readings} == {None}
    assert {reading.indenter for reading in readings} == {"sphere_7mm"}
    assert sum(reading.missed_before for reading in readings) == 0
    assert device.identity.serial == "arm"
    counted = {name: n for name, n in device.counters.items() if n}
    assert counted == {"samples": 200}


def test_a_large_clock_keeps_its_microseconds(device: BusDevice, told: Publisher[Any]) -> None:
    wall_ns = 1_763_719_200_123_456_789
    for number in range(3):
        told.put(fakes.frame(number + 1, time_ns=wall_ns + 1_000 * number))
    times = [reading.time_s for reading in fakes.take(device, 3)]
    assert times == pytest.approx([0.0, 1e-6, 2e-6], abs=1e-15)


def test_silence_is_a_timeout_and_ends(device: BusDevice, told: Publisher[Any]) -> None:
    with pytest.raises(
        DeviceTimeout, match=r"'arm' published no new pose within 0\.05 s"
    ) as caught:
        device.read(0.05)
    assert "palpate topic list" in caught.value.remedy
    told.put(fakes.frame(1))
    assert fakes.numbers(fakes.take(device, 1)) == [1]
    told.put(fakes.frame(1))  # nothing new
    with pytest.raises(DeviceTimeout):
        device.read(0.05)


def test_losses_are_counted_and_told(device: BusDevice, told: Publisher[Any]) -> None:
    for number in (5, 6, 9, 8, 10):
        told.put(fakes.frame(number))
    readings = fakes.take(device, 4)
    assert [reading.missed_before for reading in readings] == [0, 0, 2, 0]
    assert device.counters["lost_poses"] == 2
    assert device.counters["late_poses"] == 1


def test_millimetres_are_no_metres(device: BusDevice, told: Publisher[Any]) -> None:
    there = Pose((400.0, 0.5, 300.0), (1.0, 0.0, 0.0, 0.0))
    told.put(replace(fakes.frame(1), pose_base_flange=there))
    with pytest.raises(DeviceLost, match=r"\(400, 0\.5, 300\) m, out of any .* is this in mm\?"):
        fakes.take(device, 1)


def _damaged(**changes: float) -> bytes:
    message = robot_pb2.RobotPoseFrame.FromString(ROBOT_POSE.codec.encode(fakes.frame(1)))
    for name, value in changes.items():
        setattr(message.pose_base_flange, name, value)
    return message.SerializeToString()


def test_what_is_no_pose_is_refused_and_counted(device: BusDevice, told: Publisher[Any]) -> None:
    told.put_payload(_damaged(px=float("nan")))
    told.put_payload(_damaged(qx=float("inf")))
    told.put_payload(_damaged(qw=2.0))
    told.put_payload(b"\xff\xff\xff")
    told.put(fakes.frame(1, robot="other_arm"))
    told.put(fakes.frame(1))
    assert fakes.numbers(fakes.take(device, 1)) == [1]
    counted = {name: n for name, n in device.counters.items() if n}
    assert counted == {
        "samples": 1,
        "rejected_non_finite": 2,
        "rejected_quaternion": 1,
        "rejected_parse": 1,
        "wrong_robot": 1,
    }
    device.close()
    assert {name: n for name, n in device.counters.items() if n} == counted


def test_a_program_that_began_anew_is_another_device(
    device: BusDevice, told: Publisher[Any]
) -> None:
    told.put(fakes.frame(1))
    told.put(fakes.frame(2))
    told.put(fakes.frame(1, run_id=8, time_ns=5))
    assert fakes.numbers(fakes.take(device, 2)) == [1, 2]
    for _ in range(2):
        with pytest.raises(DeviceLost, match="the program of robot 'arm' has restarted"):
            device.read(PATIENCE_S)
    device.close()
    fakes.until(lambda: not told.matched())
    device.open()
    fakes.until(told.matched)
    told.put(fakes.frame(3))  # the old one still runs
    told.put(fakes.frame(2, run_id=8, time_ns=9))
    (reading,) = fakes.take(device, 1)
    assert (reading.tick, reading.time_s) == (2, 0.0)
    assert device.counters["poses_of_old_runs"] == 1
    assert device.counters["samples"] == 1


def test_a_second_program_that_has_ended_does_not_lock_the_first_one_out(
    device: BusDevice, told: Publisher[Any]
) -> None:
    told.put(fakes.frame(1))
    told.put(fakes.frame(1, run_id=8, time_ns=5))
    fakes.take(device, 1)
    with pytest.raises(DeviceLost, match="restarted"):
        device.read(PATIENCE_S)
    for number in (2, 3):  # after the restart, and after the silence of the second program
        device.close()
        fakes.until(lambda: not told.matched())
        device.open()
        fakes.until(told.matched)
        told.put(fakes.frame(number))
        if number == 2:
            with pytest.raises(DeviceTimeout):
                device.read(0.2)
    assert fakes.numbers(fakes.take(device, 1)) == [3]


def test_a_bus_that_is_gone_is_a_lost_device(
    device: BusDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: Any) -> Any:
        raise LinkError("the session is closed", remedy="open the session again")

    monkeypatch.setattr(Subscriber, "next", gone)
    with pytest.raises(DeviceLost, match="the session is closed"):
        device.read(0.1)


def test_without_a_router_it_is_lost(free_port: int) -> None:
    link = LinkConfig(connect=(f"tcp/127.0.0.1:{free_port}",))
    device = device_of(link, timeout_s=0.2)
    with pytest.raises(DeviceLost, match="no router at tcp") as caught:
        device.open()
    assert "palpate up" in caught.value.remedy
    assert not device.is_open


def test_options_say_where_the_robot_is(link: LinkConfig, free_port: int) -> None:
    nowhere = LinkConfig(connect=(f"tcp/127.0.0.1:{free_port}",))
    options = {"connect": link.connect[0], "station": "next_door", "timeout_s": PATIENCE_S}
    with (
        device_of(nowhere, **options) as device,
        Session.open(link, station="next_door") as session,
    ):
        told = session.publisher(ROBOT_POSE, sensor="arm", lossless=True)
        fakes.until(told.matched)
        told.put(fakes.frame(1))
        assert fakes.numbers(fakes.take(device, 1)) == [1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": None}, "key 'robot' is missing"),
        ({"robot": "Arm 1"}, "cannot stand in a Zenoh key"),
        ({"rate_hz": 0}, "rate_hz"),
        ({"connect": "10.0.0.1:7447"}, "is not tcp/HOST:PORT"),
        (
            {"tls": dict.fromkeys(("root_ca_certificate", "certificate", "private_key"), "x")},
            "connect is empty",
        ),
        ({"rate": 250}, "did you mean 'rate_hz'"),
    ],
)
def test_wrong_options_are_named(changes: dict[str, Any], message: str) -> None:
    values = {"robot": "arm", **fakes.BENCH, **changes}
    with pytest.raises(ConfigError, match=message):
        make_device("pose_zenoh", {k: v for k, v in values.items() if v is not None})
