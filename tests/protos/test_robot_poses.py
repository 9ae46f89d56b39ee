"""A robot tells its pose: checked at once, sent without waiting, dropped and counted if need be."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from palpate.bus import Delivery, Session
from palpate.bus.topics import ROBOT_POSE
from palpate.client import Client
from palpate.client.robot_poses import RobotPosePublisher
from palpate.codec import INDENTER_POSE_FRAME, ROBOT_POSE_FRAME
from palpate.config import LinkConfig
from palpate.errors import ConfigError, LinkError, WireError
from palpate.messages import Pose, RobotPoseFrame
from palpate.v1 import frames_pb2, robot_pb2

PATIENCE_S = 20.0
HERE, UP = (0.4, 0.0, 0.2), (1.0, 0.0, 0.0, 0.0)


def test_what_is_put_arrives(link: LinkConfig, wait_until: Callable[..., None]) -> None:
    with Session.open(link) as session, Client(link.connect[0], timeout_s=PATIENCE_S) as client:
        heard = session.subscriber(ROBOT_POSE, sensor="arm", delivery=Delivery.QUEUE)
        publisher = client.robot_pose_publisher("arm")
        wait_until(publisher.matched, PATIENCE_S)
        before_ns = time.monotonic_ns()
        publisher.put(np.array(HERE), list(UP))
        publisher.put(HERE, UP, 77)
        publisher.put(HERE, UP, time_ns=78, wall_ns=9)
        first, second, third = (heard.next(PATIENCE_S).message for _ in range(3))
        assert first.robot == "arm"
        assert first.pose_base_flange == Pose(HERE, UP)
        assert before_ns <= first.time_ns <= time.monotonic_ns()
        assert abs(first.wall_ns - time.time_ns()) < 60e9
        assert (second.time_ns, second.wall_ns) == (77, 0)
        assert (third.time_ns, third.wall_ns) == (78, 9)
        assert [first.sequence, second.sequence, third.sequence] == [1, 2, 3]
        assert first.run_id == second.run_id == third.run_id != 0
        again = client.robot_pose_publisher("arm")
        again.put(HERE, UP)
        fourth = heard.next(PATIENCE_S).message
        assert fourth.sequence == 1
        assert fourth.run_id not in (0, first.run_id)
        client.close()
        assert publisher.counters == {"put": 3, "published": 3, "dropped": 0}
        with pytest.raises(LinkError, match="'arm' is closed"):
            publisher.put(HERE, UP)


class Stalled:
    """A bus that takes nothing until it is let go."""

    def __init__(self) -> None:
        self.let_go = threading.Event()
        self.payloads: list[bytes] = []

    def publisher(self, topic: Any, sensor: str) -> Stalled:
        return self

    def put_payload(self, payload: bytes) -> None:
        self.let_go.wait(PATIENCE_S)
        self.payloads.append(payload)

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("position", "orientation", "time_ns", "reason"),
    [
        ((0.0, math.nan, 0.0), UP, None, "non_finite"),
        (HERE, (1.0, 0.0, 0.0, math.inf), None, "non_finite"),
        (HERE, (1.0, 1.0, 0.0, 0.0), None, "quaternion"),
        (HERE, (0.0, 0.0, 0.0, 0.0), None, "quaternion"),
        (HERE, (0.9989, 0.0, 0.0, 0.0), None, "quaternion"),
        (UP, HERE, None, "shape"),
        (HERE, (1.0, 0.0, 0.0), None, "shape"),
        (HERE, "wxyz", None, "shape"),
        (None, UP, None, "shape"),
        (HERE, UP, -1, "time"),
        (HERE, UP, 1 << 63, "time"),
        (HERE, UP, 1.5, "parse"),
    ],
)
def test_what_is_no_pose_is_refused_at_once(
    position: Any, orientation: Any, time_ns: Any, reason: str
) -> None:
    bus: Any = Stalled()
    with RobotPosePublisher(bus, "arm") as publisher:
        with pytest.raises(WireError) as caught:
            publisher.put(position, orientation, time_ns)
        assert caught.value.reason == reason
        assert publisher.counters["put"] == 0


def test_a_name_must_stand_in_a_key(link: LinkConfig) -> None:
    with (
        Client(link.connect[0], timeout_s=PATIENCE_S) as client,
        pytest.raises(ConfigError, match="'Left Arm' cannot stand"),
    ):
        client.robot_pose_publisher("Left Arm")


def test_a_stalled_bus_holds_nobody_up_and_leaves_a_hole(wait_until: Callable[..., None]) -> None:
    bus: Any = Stalled()
    publisher = RobotPosePublisher(bus, "arm", waiting=10)
    publisher.put(HERE, UP, 0)
    wait_until(lambda: not publisher._waiting._waiting["arm"], PATIENCE_S)  # it is being sent
    for number in range(1, 100):
        publisher.put(HERE, UP, number)
    assert publisher.counters == {"put": 100, "published": 0, "dropped": 89}
    bus.let_go.set()
    publisher.close()
    assert publisher.counters == {"put": 100, "published": 11, "dropped": 89}
    sequences = [ROBOT_POSE_FRAME.decode(payload).sequence for payload in bus.payloads]
    assert sequences == [1, *range(91, 101)], "the newest are kept"


def test_a_lost_bus_is_told_by_the_next_put(
    link: LinkConfig, wait_until: Callable[..., None]
) -> None:
    session = Session.open(link)
    publisher = RobotPosePublisher(session, "arm")
    session.close()
    publisher.put(HERE, UP)
    wait_until(lambda: not publisher._thread.is_alive(), PATIENCE_S)
    with pytest.raises(LinkError, match="cannot publish"):
        publisher.put(HERE, UP)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"robot": "an arm"}, "robot"),
        ({"robot": ""}, "robot"),
        ({"sequence": 0}, "sequence"),
        ({"time_ns": 1 << 63}, "time"),
        ({"wall_ns": 1 << 63}, "time"),
    ],
)
def test_a_bad_frame_is_refused_on_both_sides(change: dict[str, Any], reason: str) -> None:
    facts = {"robot": "arm", "sequence": 1, "time_ns": 5, **change}
    with pytest.raises(WireError) as caught:
        ROBOT_POSE_FRAME.encode(RobotPoseFrame(pose_base_flange=Pose(HERE, UP), **facts))
    assert caught.value.reason == reason
    message = robot_pb2.RobotPoseFrame.FromString(
        ROBOT_POSE_FRAME.encode(RobotPoseFrame("arm", 1, 5, Pose(HERE, UP)))
    )
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(WireError) as caught:
        ROBOT_POSE_FRAME.decode(message.SerializeToString())
    assert caught.value.reason == reason


def test_a_frame_without_a_pose_is_refused() -> None:
    message = robot_pb2.RobotPoseFrame(robot="arm", sequence=1, time_ns=5)
    with pytest.raises(WireError, match="pose_base_flange") as caught:
        ROBOT_POSE_FRAME.decode(message.SerializeToString())
    assert caught.value.reason == "quaternion"


def test_contact_is_known_or_not(examples: dict[str, Any]) -> None:
    known = examples["IndenterPoseFrame"]
    assert INDENTER_POSE_FRAME.decode(INDENTER_POSE_FRAME.encode(known)).in_contact is True
    message = frames_pb2.IndenterPoseFrame.FromString(INDENTER_POSE_FRAME.encode(known))
    message.contact_unknown = True
    with pytest.raises(WireError, match="contact_unknown") as caught:
        INDENTER_POSE_FRAME.decode(message.SerializeToString())
    assert caught.value.reason == "contact"
    message.in_contact = False
    unknown = INDENTER_POSE_FRAME.decode(message.SerializeToString())
    assert unknown.in_contact is None
    assert INDENTER_POSE_FRAME.encode(unknown) == message.SerializeToString()
