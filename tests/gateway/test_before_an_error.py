"""What came before an error is delivered first, also where both came at once."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from tests.gateway.pose_fakes import BENCH, frame
from tests.gateway.ros_fakes import BEGAN_NS, all_fields, wrench_fields

from palpate.bus import Session
from palpate.bus.foreign import ForeignSample
from palpate.config import LinkConfig, parse_config
from palpate.errors import DeviceLost, DeviceTimeout, StreamTimeout
from palpate.messages import Pose
from palpate.ros.layouts import BIOTAC_ALL, WRENCH_STAMPED, encode
from palpate.ros.rmw_zenoh import SampleInfo
from palpate_gateway.device import Device, DeviceIdentity
from palpate_gateway.drivers import make_device
from palpate_gateway.emulators.lines import crc16_x25
from palpate_gateway.ports.sockets import ReceivedBytes
from palpate_gateway.pose.robot import PoseZenoh
from palpate_gateway.protocols.bota import BotaFrame
from palpate_gateway.protocols.netft_xml import NetftSettings
from palpate_gateway.protocols.rdt import RdtScale
from palpate_gateway.protocols.ros_hands import decode_hand
from palpate_gateway.readings import Reading
from palpate_gateway.ros import subscription
from palpate_gateway.ros.subscription import RosDevice, RosMessage, RosSubscription, RosTopicOptions
from palpate_gateway.ros.wrench import decode_wrench
from palpate_gateway.wrench.bota import BotaOptions, WrenchBota
from palpate_gateway.wrench.rdt import CounterClock, RdtOptions, WrenchRdt

GOOD = 3
"""Good readings of each batch; behind them the clock goes back for good."""

SET_BACK = [*range(GOOD), *range(-100, -80)]

TOPIC = {"topic": "/a", "connect": "tcp/127.0.0.1:1"}


class Waiting:
    """A topic with everything waiting already."""

    counters: dict[str, int] = {}  # noqa: RUF012
    publisher = None

    def __init__(self, messages: Sequence[Any]) -> None:
        self._messages = [RosMessage(one, None, 0, 1 + k) for k, one in enumerate(messages)]

    def open(self) -> Any:
        return self._messages.pop(0)

    def take(self, timeout_s: float) -> Any:
        return self._messages

    def close(self) -> None:
        pass


def of_a_topic(driver: str, messages: Sequence[Any], **options: Any) -> Device:
    device = make_device(driver, {**TOPIC, **options})
    assert isinstance(device, RosDevice)
    device._topic = Waiting(messages)  # type: ignore[assignment]
    return device


def ros_biotac() -> Device:
    layout = BIOTAC_ALL
    hands = [
        decode_hand(encode(all_fields(k % 40, BEGAN_NS + 10**7 * k), layout), layout)
        for k in SET_BACK
    ]
    return of_a_topic("ros_biotac", hands, message="sr_robot_msgs/BiotacAll")


def ros_wrench() -> Device:
    wrenches = [
        decode_wrench(encode(wrench_fields(k, BEGAN_NS + 10**7 * k), WRENCH_STAMPED))
        for k in SET_BACK
    ]
    return of_a_topic("ros_wrench", wrenches)


def bota() -> Device:
    class OfOneBatch(WrenchBota):
        def _connect(self) -> str:
            return "a"

        def _frames(self, timeout_s: float) -> list[BotaFrame]:
            return [
                BotaFrame(0, (1.0,) * 6, stamp_us, 20.0)
                for stamp_us in (90_000_000, 90_002_500, 90_005_000, 1_000, 3_500)
            ]

    return OfOneBatch(BotaOptions(port="a", rate_hz=400.0))


def bota_boots() -> Device:
    class OfOneRead(WrenchBota):
        def _connect(self) -> str:
            self._early = b"".join(bota_bytes(k) for k in range(GOOD)) + b"App Init\r\n"
            return "a"

    return OfOneRead(BotaOptions(port="a", rate_hz=400.0))


def bota_bytes(k: int) -> bytes:
    body = struct.pack("<H6fIf", 0, *(1.0,) * 6, 90_000_000 + 2_500 * k, 20.0)
    return b"\xaa" + body + crc16_x25(body).to_bytes(2, "little")


class OfDatagrams(WrenchRdt):
    """Has these datagrams waiting, and a page whose scale was changed meanwhile."""

    datagrams: list[bytes]

    def _connect(self) -> str:
        waiting = self.datagrams

        def receive(timeout_s: float) -> ReceivedBytes:
            if not waiting:
                raise DeviceTimeout("nothing", remedy="wait")
            return ReceivedBytes(waiting.pop(0), 1)

        self._port = SimpleNamespace(  # type: ignore[assignment]
            receive=receive, write=lambda _: None, close=lambda: None
        )
        self._clock = CounterClock(7000.0, "it")
        self._scale = RdtScale(1e6, 1e6)
        self._take(self._port.receive(0.0), self._early)
        self._interrupted_at = None
        return "a"

    def _page(self, timeout_s: float) -> NetftSettings:
        return SimpleNamespace(scale=RdtScale(2e6, 2e6))  # type: ignore[return-value]


def of_datagrams(datagrams: Sequence[bytes], **options: Any) -> Device:
    device = OfDatagrams(RdtOptions(**{"product": "ati_net_ft", **options}))
    device.datagrams = list(datagrams)
    return device


def rdt_record(number: int, sampled: int, status: int = 0) -> bytes:
    return struct.pack(">3I6i", number, sampled, status, *(1000,) * 6)


RDT = [rdt_record(1 + k, 70_000 + k) for k in range(GOOD)]


def rdt_restarts() -> Device:
    return of_datagrams([*RDT, rdt_record(1, 5)], counts_per_n=1e6, counts_per_n_m=1e6)


def rdt_restarts_within_a_datagram() -> Device:
    more = b"".join([*RDT[1:], rdt_record(1, 5)])
    return of_datagrams([RDT[0], more], counts_per_n=1e6, counts_per_n_m=1e6)


def rdt_has_two_sensors() -> Device:
    return of_datagrams([*RDT, rdt_record(4, 70_003, 0b1001)], product="onrobot_hex")


def rdt_has_another_scale() -> Device:
    return of_datagrams([*RDT, rdt_record(1, 70_003), rdt_record(2, 70_004)])


def pose_zenoh() -> Device:
    away = frame(GOOD, pose=Pose((600.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    frames = [*(frame(k) for k in range(GOOD)), away]

    class OneBatch:
        counters: dict[str, int] = {}  # noqa: RUF012

        def next(self, timeout_s: float) -> Any:
            if not frames:
                raise StreamTimeout("none", remedy="wait")
            return SimpleNamespace(message=frames.pop(0), received_monotonic_ns=1)

    device = make_device("pose_zenoh", {"robot": "arm", **BENCH})
    assert isinstance(device, PoseZenoh)

    def opened() -> DeviceIdentity:
        device._subscriber = OneBatch()  # type: ignore[assignment]
        return DeviceIdentity("arm", 1 / 250)

    device._open = opened  # type: ignore[method-assign]
    return device


MADE = [
    ros_biotac,
    ros_wrench,
    bota,
    bota_boots,
    rdt_restarts,
    rdt_restarts_within_a_datagram,
    rdt_has_two_sensors,
    rdt_has_another_scale,
    pose_zenoh,
]


@pytest.mark.parametrize("make", MADE)
def test_readings_before_an_error_are_delivered_and_counted(make: Any) -> None:
    device = make()
    with device:
        readings: list[Reading] = []
        with pytest.raises(DeviceLost):  # noqa: PT012
            while len(readings) < 100:
                readings += device.read(0.1)
        assert len(readings) == GOOD == device.counters["samples"]


def test_messages_before_another_publisher_are_delivered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscription, "_OTHER_S", -1.0)
    topic: RosSubscription[bytes] = RosSubscription(
        parse_config(RosTopicOptions, TOPIC, where="test"), "", bytes
    )
    samples = [
        SimpleNamespace(
            payload=b"%d" % k,
            attachment=SampleInfo(k, 1 + k, bytes([k // GOOD]) * 16).encode(),
            received_monotonic_ns=1,
        )
        for k in range(GOOD + 1)
    ]
    topic._subscriber = SimpleNamespace(  # type: ignore[assignment]
        next=lambda _: samples.pop(0), waiting=GOOD, counters={}
    )
    assert [one.message for one in topic.take(0.1)] == [b"0", b"1", b"2"]
    with pytest.raises(DeviceLost, match="another publisher"):
        topic.take(0.1)


def test_messages_before_the_session_is_closed_are_delivered() -> None:
    """Once it is, the topic is lost and not only silent: nothing will come."""
    topic: RosSubscription[bytes] = RosSubscription(
        parse_config(RosTopicOptions, TOPIC, where="test"), "", bytes
    )
    with Session.open(LinkConfig(connect=())) as session:
        topic._subscriber = subscriber = session.foreign_subscriber("rt/x")
        attachment = SampleInfo(1, 1, bytes(16)).encode()
        subscriber._waiting.put("rt/x", ForeignSample("rt/x", b"0", attachment, 1))
    assert [one.message for one in topic.take(0.1)] == [b"0"]
    with pytest.raises(DeviceLost, match="closed"):
        topic.take(0.1)
