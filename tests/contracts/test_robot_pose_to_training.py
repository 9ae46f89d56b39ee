"""Journey B with a robot: electrodes, wrench, a robot's pose -> recorder -> training's ingest."""

from __future__ import annotations

import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus import Delivery, Session
from palpate.bus.topics import WRENCH
from palpate.client import Client
from palpate.config import LinkConfig, parse_config
from palpate.files.record import read_record
from palpate.messages import Pose
from palpate.rigid import Transform
from palpate_gateway.config import GatewayConfig
from palpate_gateway.drivers import DRIVERS
from palpate_gateway.pose.placement import Placement, PlacementOptions
from palpate_gateway.readings import PoseReading, Reading
from palpate_gateway.service import node
from palpate_gateway.virtual.finger import VirtualFinger
from palpate_services.config import RecorderConfig
from palpate_services.recorder.service import run_recorder

PATIENCE_S = 20.0
PERIOD_S = 0.004

# The finger lies on its back, so its z points down, as the flange's and the tool's does.
DOWN = (0.0, 1.0, 0.0, 0.0)
POSE = {
    "robot": "arm",
    "indenter": "sphere_7mm",
    "base_sensor": {"position_m": [0.4, 0.0, 0.1], "orientation_wxyz": DOWN},
    "flange_indenter": {"position_m": [0.0, 0.0, 0.12], "orientation_wxyz": [1, 0, 0, 0]},
}
SENSORS = [
    {"name": "finger", "driver": "without_pose", "options": {"model": "formula", "rate_hz": 200}},
    {"name": "robot", "of": "finger", "driver": "pose_zenoh", "options": POSE},
]
TIP = (0.004, 0.0, -0.011)


class WithoutPose(VirtualFinger):
    """A finger and a force/torque sensor, as on a bench: neither knows where the indenter is."""

    def _read(self, timeout_s: float) -> list[Reading]:
        while True:
            got = super()._read(timeout_s)
            left: list[Reading] = [
                reading for reading in got if not isinstance(reading, PoseReading)
            ]
            if left or not got:
                return left


@contextmanager
def station(link: LinkConfig, out: Path) -> Iterator[None]:
    """Gateway and recorder, until the block ends."""
    gateway = parse_config(GatewayConfig, {"sensors": SENSORS, "tare_frames": 20}, where="test")
    keep = RecorderConfig(out=out, rrd=False)
    stop = threading.Event()
    nodes = [
        threading.Thread(target=run_recorder, args=(keep, link, "lab", stop)),
        threading.Thread(target=node.run, args=(gateway, link, "lab", stop)),
    ]
    for one in nodes:
        one.start()
    try:
        yield
    finally:
        stop.set()
        for one in nodes:
            one.join(PATIENCE_S)


@contextmanager
def control_loop(link: LinkConfig) -> Iterator[None]:
    """A robot that stands over the finger and says so, 250 times a second."""
    stop = threading.Event()

    def run() -> None:
        with Client(link.connect[0], timeout_s=PATIENCE_S) as client:
            poses = client.robot_pose_publisher("arm")
            while not stop.wait(PERIOD_S):
                poses.put((0.404, 0.0, 0.231), DOWN)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < deadline, "it did not become true in time"


def test_a_robots_pose_is_the_contact_location_of_a_dataset(
    link: LinkConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ingest = pytest.importorskip("palpate_training.datasets.ingest")
    module: Any = types.ModuleType("driver_without_pose")
    module.WithoutPose = WithoutPose
    monkeypatch.setitem(sys.modules, "driver_without_pose", module)
    monkeypatch.setitem(DRIVERS, "without_pose", "driver_without_pose:WithoutPose")

    pressed = 0
    with Session.open(link) as session, station(link, tmp_path), control_loop(link):
        wrench = session.subscriber(WRENCH, sensor="finger", delivery=Delivery.QUEUE)

        def touched() -> bool:
            nonlocal pressed
            force = wrench.next(PATIENCE_S).message.force
            pressed += bool(np.linalg.norm(force) > 2 * ingest.TOUCH_N)
            return pressed > 40

        until(touched)
    (path,) = tmp_path.glob("*.mcap")

    seen = {(item.address.sensor, item.address.topic) for item in read_record(path)}
    assert {("finger", "electrodes"), ("finger", "wrench"), ("finger", "pose")} <= seen
    assert ("arm", "robot_pose") in seen, "what the robot told is kept, to be made anew"
    assert not {topic for sensor, topic in seen if sensor == "robot"}

    data = ingest.ingest_record(path)
    touching = np.linalg.norm(data.force, axis=1) > ingest.TOUCH_N
    np.testing.assert_array_equal(data.in_contact, touching)
    assert touching.any()
    assert not touching.all()
    location = data.contact_location[touching]
    np.testing.assert_allclose(location, np.tile(TIP, (len(location), 1)), atol=1e-6)
    assert np.isnan(data.contact_location[~touching]).all()


def test_a_registration_of_the_testbed_gives_base_sensor(tmp_path: Path) -> None:
    """As docs/devices/robot-pose.md says: the pose that is written there, turned round."""
    registrations = pytest.importorskip("palpate_training.experiment.registration")
    testbed = pytest.importorskip("palpate_training.experiment.registration")
    turn = np.array([0.1, 0.9, -0.2, 0.3])
    truth = Transform.from_pose([0.41, -0.2, 0.13, *(turn / np.linalg.norm(turn))])
    places = [(0.0, 0.0, -0.05), (0.04, 0.0, -0.05), (0.0, 0.05, -0.05), (0.03, 0.06, -0.05)]
    holes = np.array(places)
    found = testbed.register(truth.apply(holes), holes)  # truth: of the sensor in the base
    file = registrations.write_registrations(tmp_path / "registration.json", {"left": found})

    read = registrations.read_registrations(file)["left"].sensor_robot
    x, y, z, *orientation_wxyz = read.inverse().pose
    flange = Pose((0.4, -0.19, 0.3), (0.6, 0.0, 0.8, 0.0))
    tool = {"position_m": [0.0, 0.0, 0.12], "orientation_wxyz": [1, 0, 0, 0]}
    options = {
        "indenter": "cube",
        "base_sensor": {"position_m": [x, y, z], "orientation_wxyz": orientation_wxyz},
        "flange_indenter": tool,
    }
    placed = Placement(parse_config(PlacementOptions, options, where="test"))
    in_base = Transform.from_pose([*flange.position, *flange.orientation])
    tip = read.apply(in_base.apply(np.array([0.0, 0.0, 0.12])))
    np.testing.assert_allclose(placed.tip(flange).position, tip, atol=1e-9)
