"""The bridge to ROS: what a node with rmw_zenoh gets, decoded by an independent library."""

from __future__ import annotations

import dataclasses
import math
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh.ext
from tests.protos.ros_idl import Features, PointStamped, WrenchStamped

from palpate import Client
from palpate.bus import ForeignSubscriber, Session, run_router
from palpate.bus.topics import FEATURES, WRENCH
from palpate.config import LinkConfig, parse_config
from palpate.errors import ConfigError, StreamTimeout
from palpate.messages import (
    FeatureEstimate,
    Origin,
    QualityFlag,
    ServiceState,
    Stamp,
    Status,
    WrenchFrame,
)
from palpate.ros.layouts import DEFINITIONS
from palpate.ros.layouts import FEATURES as FEATURES_LAYOUT
from palpate_services import ros_bridge
from palpate_services.config import RosBridgeConfig
from palpate_services.ros_bridge import run_ros_bridge

WALL_NS = 1_700_000_000_123_456_789
WRENCH_KEY = (
    "geometry_msgs::msg::dds_::WrenchStamped_/"
    "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77"
)
POINT_KEY = (
    "geometry_msgs::msg::dds_::PointStamped_/"
    "RIHS01_4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897"
)
"""As in the message packages of ROS 2 Jazzy."""

Until = Callable[[Callable[[], bool]], None]


def stamp(sequence: int = 5) -> Stamp:
    return Stamp(sequence, sequence, 10**9, WALL_NS, 7, Origin.LIVE)


def estimate(**changes: Any) -> FeatureEstimate:
    touched = FeatureEstimate(
        source=stamp(),
        sensor_serial="BT1",
        bundle_sha256=bytes(32),
        tare_id=1,
        in_contact=True,
        force=np.array([0.5, -1.5, 2.5], np.float32),
        force_sd=np.array([0.1, 0.2, 0.3], np.float32),
        contact_location=np.array([1e-3, 2e-3, -3e-3], np.float32),
        contact_location_sd=np.array([1e-4, 2e-4, 3e-4], np.float32),
        quality=(QualityFlag.SATURATED, QualityFlag.UNCALIBRATED),
        bundle_name="mine",
        bundle_version=3,
    )
    return dataclasses.replace(touched, **changes)


@contextmanager
def bridge(link: LinkConfig, until: Until, **config: Any) -> Iterator[Session]:
    """A running bridge, and a session of the station."""
    stop = threading.Event()
    parsed = parse_config(RosBridgeConfig, config, where="test")
    thread = threading.Thread(target=run_ros_bridge, args=(parsed, link, "lab", stop))
    with Session.open(link) as session:
        thread.start()
        try:
            until(lambda: any(one.service == "ros_bridge" and one.ready for one in session.alive()))
            yield session
        finally:
            stop.set()
            thread.join(10.0)
    assert not thread.is_alive()


def received(
    session: Session, topics: dict[str, ForeignSubscriber], publish: Callable[[], None]
) -> dict[str, tuple[bytes, bytes]]:
    """The first sample on each of some topics, while something is published again and again."""
    got: dict[str, tuple[bytes, bytes]] = {}
    for _ in range(200):
        publish()
        for name, subscriber in topics.items():
            try:
                sample = subscriber.next(0.02)
            except StreamTimeout:
                continue
            got.setdefault(name, (sample.payload, sample.attachment))
        if len(got) == len(topics):
            break
    return got


def test_a_node_gets_estimates_and_wrenches(link: LinkConfig, until: Until) -> None:
    with bridge(link, until, frame_ids={"finger": "thumb_tip"}) as session:
        keys = {
            "force": f"0/palpate/finger/force/{WRENCH_KEY}",
            "contact_location": f"0/palpate/finger/contact_location/{POINT_KEY}",
            "wrench": f"0/palpate/finger/wrench/{WRENCH_KEY}",
            "features": "0/palpate/finger/features/palpate_msgs::msg::dds_::Features_/*",
        }
        topics = {name: session.foreign_subscriber(key) for name, key in keys.items()}
        estimates = session.publisher(FEATURES, sensor="finger")
        wrenches = session.publisher(WRENCH, sensor="finger")
        sensed = WrenchFrame(
            stamp(), "FT1",
            np.array([1, 2, 3], np.float32), np.array([0.25, 0.5, 0.75], np.float32),
        )  # fmt: skip

        def publish() -> None:
            estimates.put(estimate())
            wrenches.put(sensed)

        got = received(session, topics, publish)
        assert got.keys() == topics.keys()
        tokens = session.foreign_tokens("@ros2_lv/0/**")

    force = WrenchStamped.deserialize(got["force"][0])
    assert (force.header.stamp.sec, force.header.stamp.nanosec) == divmod(WALL_NS, 10**9)
    assert force.header.frame_id == "thumb_tip"
    assert (force.wrench.force.x, force.wrench.force.y, force.wrench.force.z) == (0.5, -1.5, 2.5)
    assert math.isnan(force.wrench.torque.x)

    point = PointStamped.deserialize(got["contact_location"][0]).point
    assert (point.x, point.y, point.z) == pytest.approx((1e-3, 2e-3, -3e-3))

    wrench = WrenchStamped.deserialize(got["wrench"][0]).wrench
    assert (wrench.force.z, wrench.torque.y) == (3.0, 0.5)

    features = Features.deserialize(got["features"][0])
    assert features.in_contact
    assert (features.sensor_serial, features.sequence, features.bundle) == ("BT1", 5, "mine:3")
    assert list(features.quality) == [2, 7]
    assert features.force_sd.z == pytest.approx(0.3)
    assert math.isnan(features.centre_of_pressure.x)
    assert math.isnan(features.contact_normal_sd)

    numbers = (zenoh.ext.Int64, zenoh.ext.Int64, bytes)
    attached = {
        name: zenoh.ext.z_deserialize(tuple[numbers], zenoh.ZBytes(one[1]))  # type: ignore[valid-type]
        for name, one in got.items()
    }
    assert all(int(sequence) >= 1 for sequence, _, _ in attached.values())
    assert len({gid for _, _, gid in attached.values()}) == len(keys)
    assert {len(gid) for _, _, gid in attached.values()} == {16}

    parts = [token.split("/") for token in tokens]
    assert [one[8] for one in parts if one[5] == "NN"] == ["palpate"]
    announced = {one[9]: "/".join(one[10:12]) for one in parts if one[5] == "MP"}
    assert announced["%palpate%finger%force"] == WRENCH_KEY
    assert announced["%palpate%finger%contact_location"] == POINT_KEY
    assert len(announced) == 4
    assert len({one[4] for one in parts}) == len(parts), "ids of entities differ"


def test_without_contact_there_is_no_point(link: LinkConfig, until: Until) -> None:
    with bridge(link, until, namespace="/robot/touch", domain=4) as session:
        topics = {
            name: session.foreign_subscriber(f"4/robot/touch/a_b/{name}/*/*")
            for name in ("force", "contact_location")
        }
        publisher = session.publisher(FEATURES, sensor="a-b")
        free = estimate(in_contact=False, contact_location=None, contact_location_sd=None)
        got = received(session, {"force": topics["force"]}, lambda: publisher.put(free))
        assert got
        with pytest.raises(StreamTimeout):
            topics["contact_location"].next(0.2)


def test_only_chosen_sensors_go_out_and_the_tokens_go_with_the_bridge(
    link: LinkConfig, until: Until
) -> None:
    with Session.open(link) as outside:
        with bridge(link, until, sensors=("left",)) as session:
            left = session.publisher(FEATURES, sensor="left")
            right = session.publisher(FEATURES, sensor="right")
            both = {
                name: session.foreign_subscriber(f"0/palpate/{name}/force/*/*")
                for name in ("left", "right")
            }

            def publish() -> None:
                right.put(estimate())
                left.put(estimate())

            assert received(session, {"left": both["left"]}, publish)
            with pytest.raises(StreamTimeout):
                both["right"].next(0.2)
            until(lambda: len(outside.foreign_tokens("@ros2_lv/0/**")) == 4)
        until(lambda: not outside.foreign_tokens("@ros2_lv/0/**"))


def test_two_sensors_with_one_name_in_ros_are_refused_at_the_start(link: LinkConfig) -> None:
    config = parse_config(RosBridgeConfig, {"sensors": ("f-1", "f_1")}, where="test")
    stop = threading.Event()
    stop.set()
    with pytest.raises(ConfigError, match="'f-1' and 'f_1'") as caught:
        run_ros_bridge(config, link, "lab", stop)
    assert "rename" in caught.value.remedy


def test_a_later_sensor_of_a_taken_name_in_ros_is_not_mixed_in_and_told(
    link: LinkConfig, until: Until
) -> None:
    with bridge(link, until) as session, Client(link.connect[0]) as robot:
        force = session.foreign_subscriber("0/palpate/f_1/force/*/*")
        first = session.publisher(FEATURES, sensor="f-1")
        second = session.publisher(FEATURES, sensor="f_1")
        assert received(session, {"force": force}, lambda: first.put(estimate()))

        def told() -> bool:
            second.put(estimate())
            return status(robot).state is ServiceState.DEGRADED

        until(told)
        assert status(robot).counters["same_name"] > 0
        error = status(robot).last_error
        assert error is not None
        assert "'f-1' and 'f_1'" in error.message
        while force.waiting:
            got = WrenchStamped.deserialize(force.next(0.0).payload)
            assert got.header.frame_id == "f-1"


def status(robot: Client) -> Status:
    """That of the bridge."""
    (found,) = [one for one in robot.status() if one.service == "ros_bridge"]
    return found


@pytest.mark.parametrize("config", [{"sensors": ("thumb",)}, {"frame_ids": {"thumb": "tip"}}])
def test_a_named_sensor_of_which_nothing_comes_is_told_until_it_comes(
    link: LinkConfig, until: Until, monkeypatch: pytest.MonkeyPatch, config: dict[str, Any]
) -> None:
    """Before, everything was ready, and not one message came in ROS."""
    monkeypatch.setattr(ros_bridge, "_ABSENT_S", 0.3)
    with bridge(link, until, **config) as session, Client(link.connect[0]) as robot:
        finger = session.publisher(FEATURES, sensor="finger")
        thumb = session.publisher(FEATURES, sensor="thumb")

        def told() -> bool:
            finger.put(estimate())
            return status(robot).state is ServiceState.DEGRADED

        until(told)
        assert status(robot).message == "nothing of 'thumb' comes; there are: 'finger'"

        def over() -> bool:
            thumb.put(estimate())
            return status(robot).state is ServiceState.READY

        until(over)


def test_a_router_of_ros_that_is_gone_is_told_until_it_is_back(
    link: LinkConfig, until: Until, new_port: Callable[[], int]
) -> None:
    """Before, everything was ready, and all messages counted as passed on."""
    endpoint = f"tcp/127.0.0.1:{new_port()}"

    @contextmanager
    def router_of_ros() -> Iterator[None]:
        stop = threading.Event()
        thread = threading.Thread(target=run_router, args=((endpoint,), stop), daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(20.0)

    with ExitStack() as first:
        first.enter_context(router_of_ros())
        with bridge(link, until, connect=endpoint), Client(link.connect[0]) as robot:
            until(lambda: status(robot).state is ServiceState.READY)
            first.close()
            until(lambda: status(robot).state is ServiceState.DEGRADED)
            assert f"router of ROS, {endpoint}, is gone" in status(robot).message
            with router_of_ros():
                until(lambda: status(robot).state is ServiceState.READY)


def test_a_station_that_sends_nothing_yet_is_no_trouble(
    link: LinkConfig, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_bridge, "_ABSENT_S", 0.0)
    with bridge(link, until, sensors=("thumb",)), Client(link.connect[0]) as robot:
        time.sleep(0.6)
        assert status(robot).state is ServiceState.READY


def test_humble_has_no_type_hash(link: LinkConfig, until: Until) -> None:
    with bridge(link, until, humble=True) as session:
        key = "0/palpate/f/force/geometry_msgs::msg::dds_::WrenchStamped_/TypeHashNotSupported"
        publisher = session.publisher(FEATURES, sensor="f")
        topics = {"force": session.foreign_subscriber(key)}
        got = received(session, topics, lambda: publisher.put(estimate()))
        assert len(got["force"][1]) == 16 + 1 + 24


@pytest.mark.parametrize("values", [{"namespace": "touch"}, {"domain": 999}, {"connect": "x"}])
def test_wrong_settings_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(values))):
        parse_config(RosBridgeConfig, values, where="ros_bridge")


def test_the_page_for_users_of_ros_has_our_message_and_a_valid_table() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "ros.md").read_text(encoding="utf-8")
    assert f"```{DEFINITIONS[FEATURES_LAYOUT]}```" in page
    table = page.partition("```toml\n")[2].partition("```")[0]
    values = tomllib.loads(table)
    assert "ros_bridge" in values["processes"]
    parse_config(RosBridgeConfig, values["ros_bridge"], where="docs/ros.md")
