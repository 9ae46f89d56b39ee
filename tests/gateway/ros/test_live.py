"""Drivers of ROS topics, against emulated nodes that publish as rmw_zenoh does."""

from __future__ import annotations

import itertools
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from tests.gateway.scenes import ramp, was_felt
from tests.protos.ros_idl import WrenchStamped

from palpate.bus import Session
from palpate.config import joining_link
from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate.messages import SensorType
from palpate_gateway.device import Device
from palpate_gateway.drivers import make_device
from palpate_gateway.emulators.biotac_slots import idle_counts
from palpate_gateway.emulators.ros import (
    WRENCH_KEY,
    RosEmulator,
    RosHandEmulator,
    RosWrenchEmulator,
)
from palpate_gateway.readings import ElectrodeReading, Reading, WrenchReading
from palpate_gateway.wrench.device import WrenchDevice

HAND = "biotac_sensors/BioTacHand"
ALL = "sr_robot_msgs/BiotacAll"
PATIENCE_S = 15.0


def changing(t: float, finger: int) -> list[int]:
    """New counts every 11 ms, as of a Shadow hand."""
    counts = list(idle_counts(t, finger))
    counts[4] += round(t / 0.011) % 50
    return counts


def finger_at(emulator: RosEmulator, message: str = ALL, **options: Any) -> Device:
    values = {"topic": emulator.topic, "message": message, "connect": emulator.address}
    return make_device("ros_biotac", values | options)


def take(device: Device, count: int) -> list[Any]:
    readings: list[Reading] = []
    until = time.monotonic() + PATIENCE_S
    while len(readings) < count:
        assert time.monotonic() < until, device.counters
        try:
            readings += device.read(0.5)
        except DeviceTimeout:
            continue
    return readings


def eventually(device: Device, true: Callable[[], bool]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < until, device.counters
        try:
            device.read(0.2)
        except DeviceTimeout:
            continue


def test_repeats_at_the_controllers_rate_are_told_from_readings() -> None:
    emulator = RosHandEmulator(changing, rate_hz=500.0)
    with emulator, finger_at(emulator, rate_hz=90.9) as device:
        readings = take(device, 40)
        values = [reading.electrodes[4] for reading in readings]
        assert all(a != b for a, b in itertools.pairwise(values))
        counters = device.counters
        assert counters["repeated_readings"] > 2 * counters["samples"]
        span_s = readings[-1].time_s - readings[0].time_s
        assert span_s == pytest.approx(39 * 0.011, rel=0.2)


def test_two_fingers_of_a_hand_are_two_devices() -> None:
    with RosHandEmulator(whole_frames=True, fingers=2) as emulator:
        first = finger_at(emulator, HAND, finger=1)
        second = finger_at(emulator, HAND, serial="BTEMU2")
        with first, second:
            assert (first.identity.serial, second.identity.serial) == ("BTEMU1", "BTEMU2")
            assert first.info.sensor_type is SensorType.BIOTAC
            assert take(second, 1)[0].pdc == take(first, 1)[0].pdc + 1
        absent = finger_at(emulator, HAND, finger=3)
        with pytest.raises(DeviceError, match=r"no finger answers there -> there are: 1, 2"):
            absent.open()
        assert not absent.is_open


def test_the_rate_is_that_of_the_readings_not_of_the_slots() -> None:
    with (
        RosHandEmulator(whole_frames=True, rate_hz=20.0) as emulator,
        finger_at(emulator, HAND, rate_hz=20.0) as device,
    ):
        assert device.identity.slot_period_s == pytest.approx(1 / 4400, rel=1e-3)
        assert device.info.rate_hz == 20.0


def test_lost_messages_are_missing_readings() -> None:
    with RosHandEmulator() as emulator, finger_at(emulator, repeats="keep") as device:
        take(device, 5)
        emulator.inject("lost", 0.2)
        eventually(device, lambda: device.counters["lost_messages"] > 10)
        lost = device.counters["lost_messages"]
        assert abs(device.counters["missing_readings"] - lost) <= 2


def test_messages_that_do_not_decode_are_missing_readings() -> None:
    with RosHandEmulator() as emulator, finger_at(emulator, repeats="keep") as device:
        take(device, 5)
        emulator.inject("cut", 0.2)
        eventually(device, lambda: device.counters.get("rejected_parse", 0) > 10)
        take(device, 5)  # after the fault
        eventually(device, lambda: not emulator.faulty("cut"))
        take(device, 5)
        rejected = device.counters["rejected_parse"] + device.counters["lost_messages"]
        assert abs(device.counters["missing_readings"] - rejected) <= 2


@pytest.mark.parametrize(
    ("fault", "counter"),
    [
        ("repeated", "old_numbers"),
        ("late", "old_numbers"),
        ("cut", "rejected_parse"),
        ("absent", "absent"),
    ],
)
def test_a_fault_shows_by_its_counter_and_no_wrong_reading_comes(fault: str, counter: str) -> None:
    with (
        RosHandEmulator(whole_frames=True) as emulator,
        finger_at(emulator, HAND) as device,
    ):
        take(device, 3)
        emulator.inject(fault, 0.3)
        eventually(device, lambda: device.counters.get(counter, 0) > 3)
        later: list[ElectrodeReading] = take(device, 20)
        assert all(one.electrodes.tolist() == idle_counts(0.0, 0)[:19] for one in later)
        ticks = [one.tick for one in later]
        assert ticks == sorted(set(ticks))


def test_a_restarted_driver_is_told_and_read_again() -> None:
    with RosHandEmulator(whole_frames=True) as emulator, finger_at(emulator, HAND) as device:
        take(device, 3)
        emulator.inject("restart", 0.8)
        with pytest.raises(DeviceLost, match="another publisher than before"):
            take(device, 1000)
        device.close()
        device.open()
        assert take(device, 3)


def test_a_second_publisher_is_dropped_and_counted() -> None:
    with RosHandEmulator(whole_frames=True) as emulator:
        other = RosHandEmulator(whole_frames=True, connect=emulator.address)
        with finger_at(emulator, HAND) as device, other:
            eventually(device, lambda: device.counters["other_publishers"] > 5)
            times = [one.time_s for one in take(device, 10)]
            assert times == sorted(times)


def test_a_clock_that_is_set_back_is_told() -> None:
    with RosHandEmulator(whole_frames=True) as emulator, finger_at(emulator, HAND) as device:
        take(device, 3)
        emulator.inject("wrong_time", 5.0)
        with pytest.raises(DeviceLost, match="set back"):
            take(device, 1000)


def test_the_error_says_what_is_published_instead() -> None:
    with RosHandEmulator(whole_frames=True) as emulator:
        with pytest.raises(DeviceError, match=r"published as biotac_sensors::msg::BioTacHand"):
            finger_at(emulator, ALL, wait_s=0.3).open()
        values = {"topic": "/other", "message": ALL, "connect": emulator.address, "wait_s": 0.3}
        with pytest.raises(DeviceError, match=r"no sr_robot_msgs/msg/BiotacAll .*nobody publishes"):
            make_device("ros_biotac", values).open()
        domain = {**values, "topic": emulator.topic, "message": HAND, "domain": 3}
        with pytest.raises(DeviceError, match="nobody publishes"):
            make_device("ros_biotac", domain).open()


def test_the_subscription_shows_in_the_graph_of_ros() -> None:
    with RosHandEmulator() as emulator, finger_at(emulator):
        link = joining_link(emulator.address, wait_s=2.0)
        with Session.open(link.model_copy(update={"direct": False})) as session:
            tokens = session.foreign_tokens("@ros2_lv/0/*/*/*/MS/**")
        assert len(tokens) == 1
        # Its type hash is the publisher's, or ROS would say that the types differ.
        assert "/".join(tokens[0].split("/")[10:12]) == emulator.type_key


@pytest.mark.parametrize("topic", ["hand", "/a b", ""])
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(ConfigError, match="topic"):
        make_device("ros_wrench", {"topic": topic})


def test_a_publisher_that_is_a_peer_as_nodes_of_ros_are_is_heard() -> None:
    """Nodes with rmw_zenoh are peers that link to one another; drivers here go by the router."""
    with RosHandEmulator() as router:
        link = joining_link(router.address, wait_s=5.0)
        assert link.direct
        payload = [RosWrenchEmulator(ramp)._message(0.0, 10**9 + k) for k in range(400)]
        with Session.open(link) as node:
            publisher = node.foreign_publisher(f"0/peer/wrench/{WRENCH_KEY}")
            stop = threading.Event()

            def publish() -> None:
                for k, one in enumerate(payload, 1):
                    publisher.put(one, struct.pack("<qqB", k, k, 16) + bytes(16))
                    if stop.wait(0.02):
                        return

            thread = threading.Thread(target=publish)
            thread.start()
            try:
                values = {"topic": "/peer/wrench", "connect": router.address}
                with make_device("ros_wrench", values) as device:
                    last: WrenchReading = take(device, 20)[-1]
                    assert was_felt(last.force, last.torque)
                    assert device.counters["lost_messages"] == 0
            finally:
                stop.set()
                thread.join()


class TestWrench:
    def test_bytes_of_the_emulator_are_what_an_independent_library_reads(self) -> None:
        payload = RosWrenchEmulator(ramp)._message(0.0, 1_500_000_000)
        read = WrenchStamped.deserialize(payload)
        assert read.serialize() == payload
        assert (read.wrench.force.z, read.header.stamp.sec) == (3.0, 1)

    def test_the_mount_turns_the_wrench(self) -> None:
        with RosWrenchEmulator(ramp) as emulator:
            values = {"topic": emulator.topic, "connect": emulator.address}
            mount = {"carries": "indenter"}
            with make_device("ros_wrench", {**values, "mount": mount}) as device:
                for reading in take(device, 5):
                    assert was_felt(-reading.force, -reading.torque)

    def test_a_zero_is_subtracted_and_survives_reopening(self) -> None:
        with RosWrenchEmulator(lambda t: (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)) as emulator:
            values = {"topic": emulator.topic, "connect": emulator.address, "zero_at_start": True}
            device = make_device("ros_wrench", values)
            for _ in range(2):
                with device:
                    readings: list[WrenchReading] = take(device, 5)
                    assert np.abs([one.force for one in readings]).max() < 1e-9
                    assert device.counters.get("zero_lost", 0) == 0

    def test_a_driver_of_ros_that_was_started_again_may_have_another_zero(self) -> None:
        with RosWrenchEmulator(lambda t: (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)) as emulator:
            values = {"topic": emulator.topic, "connect": emulator.address}
            device = make_device("ros_wrench", values)
            assert isinstance(device, WrenchDevice)
            with device:
                device.take_zero()
                assert not take(device, 1)[-1].force.any()
                emulator.inject("restart")
                with pytest.raises(DeviceLost, match="another publisher"):
                    eventually(device, lambda: False)
            with device:
                assert device.zero_lost
                np.testing.assert_allclose(take(device, 1)[-1].force, (1.0, 2.0, 3.0))

    def test_none_is_lost_at_a_thousand_messages_a_second(self) -> None:
        with RosWrenchEmulator(ramp, rate_hz=1000.0) as emulator:
            values = {"topic": emulator.topic, "connect": emulator.address, "rate_hz": 1000}
            with make_device("ros_wrench", values) as device:
                take(device, 1500)
                assert device.counters["lost_messages"] == device.counters["queue_overflow"] == 0

    def test_numbers_that_no_sensor_measures_are_not_in_the_zero(self) -> None:
        garbage, load = (1e39, 0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
        told = itertools.cycle([garbage, load])
        with RosWrenchEmulator(lambda t: next(told)) as emulator:
            values = {"topic": emulator.topic, "connect": emulator.address, "zero_at_start": True}
            with make_device("ros_wrench", values) as device:
                assert np.abs(take(device, 1)[-1].force).max() < 1e-9

    def test_a_zero_of_nothing_but_garbage_is_refused(self) -> None:
        with RosWrenchEmulator(lambda t: (1e39, 0.0, 0.0, 0.0, 0.0, 0.0)) as emulator:
            values = {"topic": emulator.topic, "connect": emulator.address}
            device = make_device("ros_wrench", values)
            assert isinstance(device, WrenchDevice)
            with device, pytest.raises(DeviceError, match="numbers that no sensor measures"):
                device.take_zero()

    def test_a_number_that_is_none_is_dropped(self) -> None:
        with RosWrenchEmulator(ramp) as emulator:
            values = {"topic": emulator.topic, "connect": emulator.address}
            with make_device("ros_wrench", values) as device:
                take(device, 2)
                emulator.inject("nan", 0.2)
                eventually(device, lambda: device.counters.get("not_finite", 0) > 3)
                assert all(np.isfinite(one.force).all() for one in take(device, 20))
