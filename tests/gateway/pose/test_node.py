"""A robot, a gateway and whoever listens, each with a session of its own on one bus."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate import clock
from palpate.bus import Delivery
from palpate.bus.topics import POSE, ROBOT_POSE, TARE
from palpate.client import Client
from palpate.client.robot_poses import RobotPosePublisher
from palpate.config import parse_config
from palpate.errors import ConfigError
from palpate.messages import Origin, ServiceState
from palpate_gateway.config import GatewayConfig
from palpate_gateway.service import node

fakes: Any = importlib.import_module("pose_fakes")
PATIENCE_S: float = fakes.PATIENCE_S
SLACK_NS = 5_000_000  # of a clock that is followed for a second, on a host that is busy
FINGER = {
    "name": "finger",
    "driver": "virtual",
    "options": {"model": "formula", "rate_hz": 200, "untouched_s": 60},
}


def robot_of(**options: Any) -> dict[str, Any]:
    return {
        "name": "robot",
        "driver": "pose_zenoh",
        "options": {"robot": "arm", "rate_hz": 200, **fakes.BENCH, **options},
    }


class Loop:
    """A control loop of 200 Hz in a thread; it notes when it was where."""

    def __init__(self, poses: RobotPosePublisher, first: int = 1) -> None:
        self.time_ns: dict[int, int] = {}
        self._poses = poses
        self._number = first
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.005):
            number, self._number = self._number, self._number + 1
            flange = fakes.flange(number)
            self.time_ns[number] = time.monotonic_ns()
            self._poses.put(flange.position, flange.orientation, self.time_ns[number])

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(PATIENCE_S)


@contextmanager
def control_loop(bus: Any, first: int = 1) -> Iterator[Loop]:
    """A robot's program, from its start to its end."""
    with Client(bus.link.connect[0], timeout_s=PATIENCE_S) as client:
        loop = Loop(client.robot_pose_publisher("arm"), first)
        try:
            yield loop
        finally:
            loop.stop()


def test_the_indenter_is_published_with_stamps_of_the_host(bus: Any) -> None:
    heard = bus.session.subscriber(POSE, sensor="robot", delivery=Delivery.QUEUE)
    with bus.gateway({"sensors": [robot_of()]}), control_loop(bus) as loop:
        received = [heard.next(PATIENCE_S) for _ in range(200)]
        status = bus.state(ServiceState.READY)
    assert status.counters["lost_poses"] == 0
    assert status.counters["samples"] >= 200
    frames = [one.message for one in received]
    numbers = fakes.numbers(frames)
    sequences = [frame.stamp.sequence for frame in frames]
    assert sequences == list(range(1, 201))
    # Every pose from the first that was heard on, each with the number that the program gave it.
    assert numbers == list(range(numbers[0], numbers[0] + 200))
    assert [frame.stamp.device_tick for frame in frames] == numbers
    assert {frame.in_contact for frame in frames} == {None}
    assert {frame.stamp.clock_id for frame in frames} == {clock.CLOCK_ID}
    assert {frame.stamp.origin for frame in frames} == {Origin.LIVE}
    np.testing.assert_allclose(frames[9].position, fakes.tip(numbers[9]).position, atol=fakes.NEAR)
    # One host, so its clock is known here: a stamp is not before the pose, nor after its arrival.
    for number, one in zip(numbers, received, strict=True):
        stamp_ns = one.message.stamp.monotonic_ns
        assert loop.time_ns[number] - SLACK_NS <= stamp_ns <= one.received_monotonic_ns
    assert heard.counters.get("lost_on_bus", 0) == 0


def test_a_lost_pose_is_told_in_the_stamp(bus: Any) -> None:
    heard = bus.session.subscriber(POSE, sensor="robot", delivery=Delivery.QUEUE)
    told = bus.session.publisher(ROBOT_POSE, sensor="arm", lossless=True)
    with bus.gateway({"sensors": [robot_of()]}):
        fakes.until(told.matched)
        for number in (1, 2, 6, 7):
            told.put(fakes.frame(number))
        stamps = [heard.next(PATIENCE_S).message.stamp for _ in range(4)]
        fakes.until(lambda: bus.status().counters["lost_poses"] == 3)
    assert [stamp.sequence for stamp in stamps] == [1, 2, 3, 4]
    assert [stamp.device_tick for stamp in stamps] == [1, 2, 6, 7]
    assert [stamp.missed_before for stamp in stamps] == [0, 0, 3, 0]


def test_a_robot_that_falls_silent_and_starts_again(bus: Any) -> None:
    heard = bus.session.subscriber(POSE, sensor="robot", delivery=Delivery.QUEUE)
    with bus.gateway({"sensors": [robot_of()]}):
        with control_loop(bus):
            before = [heard.next(PATIENCE_S).message for _ in range(20)]
            bus.state(ServiceState.READY)
        now = bus.state(ServiceState.DEGRADED)
        assert "robot" in now.last_error.message
        with control_loop(bus, first=5000):  # the program was started again
            while fakes.numbers([after := heard.next(PATIENCE_S).message])[0] < 5000:
                before.append(after)
            frames = [heard.next(PATIENCE_S).message for _ in range(20)]
            now = bus.state(ServiceState.READY)
    sequences = [frame.stamp.sequence for frame in [*before, after, *frames]]
    assert sequences == list(range(1, len(sequences) + 1)), "the gateway's sequence goes on"
    stamps = [frame.stamp.monotonic_ns for frame in [*before, after, *frames]]
    assert stamps == sorted(stamps)
    assert now.counters["device_lost"] >= 1 or now.counters["silences"] >= 1


def test_recorded_poses_go_out_in_the_keys_of_their_finger(
    bus: Any, log: Callable[..., Any], tmp_path: Path
) -> None:
    """Where training looks for them; and the finger answers for tares."""
    table = fakes.write_csv(tmp_path / "robot.csv", fakes.csv_lines(250))
    finger = log(100).write(tmp_path / "a.btd")
    pose = {"path": table, "start_wall_ns": 10**18, **fakes.BENCH}
    values = {
        "sensors": [
            {"name": "finger", "driver": "text_log", "options": {"path": finger}},
            {"name": "robot", "of": "finger", "driver": "pose_file", "options": pose},
        ],
        "pace": "fast",
        "wait_for": ["features"],
    }
    with bus.gateway(values), bus.consumer() as tap:
        samples = [tap.next(timeout_s=PATIENCE_S) for _ in range(351)]
        now = bus.state(ServiceState.FINISHED)
        assert bus.ask_tare("finger", _tare_id(samples)).sensor_serial
    assert {sample.sensor for sample in samples} == {"finger"}
    frames = [POSE.codec.decode(s.payload) for s in samples if s.topic == "pose"]
    assert fakes.numbers(frames) == list(range(1, 251))
    assert [frame.stamp.sequence for frame in frames] == list(range(1, 251))
    assert {frame.stamp.origin for frame in frames} == {Origin.REPLAYED}
    walls = [frame.stamp.wall_ns for frame in frames]
    np.testing.assert_allclose(np.array(walls) - 10**18, 4e6 * np.arange(250), atol=1e3)
    assert now.counters["robot.samples"] == 250


def _tare_id(samples: list[Any]) -> int:
    (tare,) = [TARE.codec.decode(s.payload) for s in samples if s.topic == "tare"]
    return int(tare.tare_id)


def test_damage_of_a_file_is_told_after_all_before_it(bus: Any, tmp_path: Path) -> None:
    table = fakes.write_csv(tmp_path / "robot.csv", fakes.csv_lines(100), cut=3)
    sensor = {"name": "robot", "driver": "pose_file", "options": {"path": table, **fakes.BENCH}}
    with bus.gateway({"sensors": [sensor], "pace": "fast", "wait_for": ["features"]}):
        with bus.consumer() as tap:
            frames = [message for _, message in bus.take(tap, 99)]
            now = bus.state(ServiceState.DEGRADED)
    assert fakes.numbers(frames) == list(range(1, 100))
    assert "line 101: the last line is cut" in now.last_error.message


def test_a_finger_that_has_poses_keeps_its_own(bus: Any) -> None:
    values = {"sensors": [{**robot_of(), "of": "finger"}, FINGER]}
    with bus.gateway(values), control_loop(bus):
        heard = bus.session.subscriber(POSE, sensor="finger", delivery=Delivery.QUEUE)
        now = bus.state(ServiceState.DEGRADED)
        fakes.until(lambda: "both" in bus.status().last_error.message)
        now = bus.status()
        frames = [heard.next(PATIENCE_S).message for _ in range(100)]
    assert "'finger' and 'robot' both publish the pose of 'finger'" in now.last_error.message
    assert frames[-1].indenter == "sphere_14mm"


def test_a_finger_is_of_nobody(bus: Any) -> None:
    config = {"sensors": [FINGER, {**FINGER, "name": "other", "of": "finger"}]}
    with pytest.raises(ConfigError, match="a tactile sensor itself -> `of` is for force/torque"):
        node.run(parse_config(GatewayConfig, config, where="test"), bus.link, "lab", stopped())


def stopped() -> threading.Event:
    stop = threading.Event()
    stop.set()
    return stop


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ([{"name": "robot", "of": "fingr"}, {"name": "finger"}], "is of 'fingr', which is no"),
        ([{"name": "robot", "of": "robot"}], "is of 'robot', which is no sensor of its own"),
        ([{"name": "a"}, {"name": "b", "of": "a"}, {"name": "c", "of": "b"}], "'c' is of 'b'"),
    ],
)
def test_owners_must_exist(sensors: list[dict[str, Any]], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_config(GatewayConfig, {"sensors": sensors}, where="test")
