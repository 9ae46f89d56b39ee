"""The process ``ros_bridge``: estimates and wrenches as topics of ROS 2, for nodes with rmw_zenoh.

For each sensor, under the bridge's namespace: ``force`` (``WrenchStamped``, estimated; its torque
is not a number, because features have none), ``contact_location`` and ``centre_of_pressure``
(``PointStamped``, only in contact), ``features`` (``palpate_msgs/Features``, everything), and
``wrench`` (``WrenchStamped``, measured by the finger's force/torque sensor). Headers hold the wall
clock of the frame's first slot and the sensor frame. No ROS is needed on this side.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from palpate.bus import Delivery, ForeignPublisher, Session, TapSample
from palpate.bus.topics import FEATURES, WRENCH
from palpate.config import LinkConfig
from palpate.errors import ConfigError, LinkError, StreamTimeout, WireError
from palpate.health import Health, HealthReporter
from palpate.heartbeat import beat
from palpate.messages import FeatureEstimate, ServiceState, WrenchFrame
from palpate.process import avoid_pauses
from palpate.ros import layouts
from palpate.ros.rmw_zenoh import (
    GID_BYTES,
    GID_BYTES_HUMBLE,
    NO_TYPE_HASH,
    RosNode,
    RosTopic,
    SampleInfo,
    gid_of,
)
from palpate_services.config import RosBridgeConfig

SERVICE = "ros_bridge"
NODE = "palpate"
"""Name under which ``ros2 node list`` shows the bridge."""

_WAIT_S = 0.2
_SENSORS_MAX = 256
"""Names come from other processes, and each takes publishers."""

_TELL_S = 0.2
_ABSENT_S = 5.0
"""A named sensor of which nothing comes for so long after the first message of another one is a
trouble [s]: until then a station starts."""

_CLASH_S = 2.0
"""So long after its last message a sensor of a taken name is a trouble [s]."""

_SHOWN = 8

_NAN = math.nan


class RosOutput(NamedTuple):
    """A message for ROS: the last part of its topic's name, its layout, its fields."""

    name: str
    layout: str
    fields: Mapping[str, Any]


def run_ros_bridge(
    config: RosBridgeConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = SERVICE,
) -> None:
    """Publish for ROS until ``stop`` is set.

    Raises:
        ConfigError: Two of the sensors have one name in ROS.
        LinkError: The station's bus cannot be joined, or the router of ROS.
        MissingExtraError: ``rosbags`` is not installed.
    """
    layouts.typestore("cdr")
    health = Health(SERVICE, instance)
    with (
        Session.open(link, station=station) as session,
        Session.open(config.changed(link, roles=False, direct=False)) as ros,
        RosBridge(ros, config) as bridge,
        session.tap([FEATURES, WRENCH], delivery=Delivery.QUEUE, capacity=config.capacity) as tap,
    ):
        presence = session.presence(SERVICE, instance=instance)

        def refresh() -> None:
            health.set_counts(tap.counters)

        with HealthReporter(session, health, refresh=refresh):
            avoid_pauses()
            health.set_state(ServiceState.READY)
            presence.ready()
            told_s, lost = 0.0, False
            while not stop.is_set():
                beat()
                with contextlib.suppress(StreamTimeout):
                    health.count(bridge.pass_on(tap.next(_WAIT_S)))
                    health.worked()
                if time.monotonic() - told_s < _TELL_S:
                    continue
                told_s = time.monotonic()
                if (trouble := bridge.trouble()) is not None:
                    health.fail(trouble)
                elif lost:
                    health.set_state(ServiceState.READY)
                lost = trouble is not None
            presence.not_ready()
            health.set_state(ServiceState.STOPPING)


class RosBridge:
    """The bridge as a node of ROS 2; a topic is announced when it has its first message.

    Args:
        session: At the router that ROS uses.
        config: What to publish.

    Raises:
        ConfigError: Two of the sensors have one name in ROS.
    """

    def __init__(self, session: Session, config: RosBridgeConfig) -> None:
        self._session, self._config = session, config
        self._sensors: dict[str, str] = {}
        self._named = {*config.sensors, *config.frame_ids}
        self._came: set[str] = set()
        self._first_s = 0.0
        self._clash: tuple[float, ConfigError] | None = None
        for sensor in config.sensors:
            self._name_of(sensor)
        self._node = RosNode(session.zid, NODE, config.domain)
        self._node_token = session.foreign_token(self._node.token)
        self._publishers: dict[tuple[str, str], _RosPublisher] = {}

    def pass_on(self, sample: TapSample) -> str:
        """Publish what a message of the station holds; the counter that counts it.

        ``passed_on``, ``not_followed`` (of another sensor), ``same_name`` (its sensor has the name
        of another one in ROS, so that nothing is published), ``rejected_...``.
        """
        if not self._came:
            self._first_s = time.monotonic()
        if len(self._came) < _SENSORS_MAX or sample.sensor in self._named:
            self._came.add(sample.sensor)
        wanted = self._config.sensors
        if wanted and sample.sensor not in wanted:
            return "not_followed"
        if sample.sensor not in self._sensors.values() and len(self._sensors) >= _SENSORS_MAX:
            return "not_followed"
        try:
            self._name_of(sample.sensor)
        except ConfigError as error:  # the others go on
            self._clash = time.monotonic(), error
            return "same_name"
        topic = FEATURES if sample.topic == FEATURES.name else WRENCH
        try:
            message = topic.codec.decode(sample.payload)
        except WireError as error:
            return f"rejected_{error.reason}"
        frame_id = self._config.frame_ids.get(sample.sensor, sample.sensor)
        for output in outputs_of(message, frame_id):
            payload = layouts.encode(output.fields, output.layout)
            self._publisher(sample.sensor, output).put(payload)
        return "passed_on"

    def trouble(self) -> ConfigError | LinkError | None:
        """What ROS should get and does not; None = nothing is lost."""
        if not self._session.has_router():
            place = f", {self._config.connect}," if self._config.connect else ""
            return LinkError(
                f"the router of ROS{place} is gone: its nodes get nothing",
                remedy="start it again; the bridge goes on by itself",
            )
        now_s = time.monotonic()
        if self._clash is not None and now_s - self._clash[0] < _CLASH_S:
            return self._clash[1]
        absent = sorted(self._named - self._came)
        if not (absent and self._came) or now_s - self._first_s < _ABSENT_S:
            return None
        return ConfigError(
            f"nothing of {_listed(absent)} comes; there are: {_listed(sorted(self._came))}",
            remedy="correct the names in ros_bridge.sensors and ros_bridge.frame_ids, or see why "
            "the sensor is silent: palpate status",
        )

    def _name_of(self, sensor: str) -> str:
        """Name of a sensor in ROS, where names have no '-' and do not begin with a digit."""
        name = sensor.replace("-", "_")
        name = f"_{name}" if name[0].isdigit() else name
        other = self._sensors.setdefault(name, sensor)
        if other != sensor:
            raise ConfigError(
                f"sensors {other!r} and {sensor!r} would both be {name!r} in ROS",
                remedy="rename one of them, or name the one to publish: ros_bridge.sensors",
            )
        return name

    def _publisher(self, sensor: str, output: RosOutput) -> _RosPublisher:
        known = self._publishers.get((sensor, output.name))
        if known is None:
            config = self._config
            hashed = NO_TYPE_HASH if config.humble else layouts.type_hash(output.layout)
            name = f"{config.namespace}/{self._name_of(sensor)}/{output.name}"
            topic = RosTopic(name, output.layout, hashed, config.domain)
            token = self._node.publisher_token(topic)
            gid = gid_of(token, GID_BYTES_HUMBLE if config.humble else GID_BYTES)
            known = _RosPublisher(self._session, topic, token, gid)
            self._publishers[sensor, output.name] = known
        return known

    def __enter__(self) -> RosBridge:
        return self

    def __exit__(self, *exc_info: object) -> None:
        for publisher in self._publishers.values():
            publisher.close()
        self._node_token.close()


def _listed(sensors: Sequence[str]) -> str:
    """The first of some names, and how many there are beside them."""
    more = f" and {len(sensors) - _SHOWN} more" if len(sensors) > _SHOWN else ""
    return ", ".join(map(repr, sensors[:_SHOWN])) + more


class _RosPublisher:
    """One topic: its publisher, its token, and the numbers of its messages."""

    def __init__(self, session: Session, topic: RosTopic, token: str, gid: bytes) -> None:
        self._publisher: ForeignPublisher = session.foreign_publisher(topic.key)
        self._token = session.foreign_token(token)
        self._gid, self._sequence = gid, 0

    def put(self, payload: bytes) -> None:
        self._sequence += 1
        info = SampleInfo(self._sequence, time.time_ns(), self._gid)
        self._publisher.put(payload, info.encode())

    def close(self) -> None:
        self._token.close()
        self._publisher.close()


def outputs_of(message: FeatureEstimate | WrenchFrame, frame_id: str) -> Iterator[RosOutput]:
    """Messages for ROS that say what a message of palpate says.

    Args:
        message: Of one sensor.
        frame_id: Name of its sensor frame in ROS.
    """
    if isinstance(message, WrenchFrame):
        header = _header(message.stamp.wall_ns, frame_id)
        wrench = {"force": _xyz(message.force), "torque": _xyz(message.torque)}
        yield RosOutput("wrench", layouts.WRENCH_STAMPED, {"header": header, "wrench": wrench})
        return
    header = _header(message.source.wall_ns, frame_id)
    wrench = {"force": _xyz(message.force), "torque": _xyz(None)}
    yield RosOutput("force", layouts.WRENCH_STAMPED, {"header": header, "wrench": wrench})
    points = (
        ("contact_location", message.contact_location),
        ("centre_of_pressure", message.centre_of_pressure),
    )
    for name, point in points:
        if point is not None:
            stamped = {"header": header, "point": _xyz(point)}
            yield RosOutput(name, layouts.POINT_STAMPED, stamped)
    normal_sd = message.contact_normal_sd
    fields = {
        "header": header,
        "sensor_serial": message.sensor_serial,
        "sequence": message.source.sequence,
        "in_contact": message.in_contact,
        "force": _xyz(message.force),
        "force_sd": _xyz(message.force_sd),
        "contact_location": _xyz(message.contact_location),
        "contact_location_sd": _xyz(message.contact_location_sd),
        "centre_of_pressure": _xyz(message.centre_of_pressure),
        "centre_of_pressure_sd": _xyz(message.centre_of_pressure_sd),
        "contact_normal": _xyz(message.contact_normal),
        "contact_normal_sd": _NAN if normal_sd is None else normal_sd,
        "quality": layouts.bytes_list(message.quality),
        "bundle": f"{message.bundle_name}:{message.bundle_version}",
    }
    yield RosOutput("features", layouts.FEATURES, fields)


def _header(wall_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": layouts.stamp_of(wall_ns), "frame_id": frame_id}


def _xyz(vector: Sequence[float] | Any | None) -> dict[str, float]:
    """A vector or point as fields; of None every part is not a number."""
    x, y, z = (_NAN,) * 3 if vector is None else map(float, vector)
    return {"x": x, "y": y, "z": z}
