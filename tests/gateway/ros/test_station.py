"""A driver of ROS beside a gateway, on the gateway's own router: frames with the host's stamps."""

from __future__ import annotations

from typing import Any

from palpate.bus import Delivery
from palpate.bus.topics import ELECTRODES, WRENCH
from palpate.messages import Origin, ServiceState
from palpate_gateway.emulators.biotac_slots import idle_counts
from palpate_gateway.emulators.ros import RosHandEmulator, RosWrenchEmulator

PATIENCE_S = 15.0


def test_fingers_and_wrench_of_ros_are_sensors_of_the_station(bus: Any) -> None:
    router = bus.link.connect[0]
    heard = bus.session.subscriber(ELECTRODES, sensor="thumb", delivery=Delivery.QUEUE)
    felt = bus.session.subscriber(WRENCH, sensor="thumb", delivery=Delivery.QUEUE)
    finger = {"topic": "/hand/tactile", "message": "biotac_sensors/BioTacHand", "serial": "BTEMU2"}
    sensors = [
        {"name": "thumb", "driver": "ros_biotac", "options": finger},
        {"name": "ft", "driver": "ros_wrench", "of": "thumb", "options": {"topic": "/ft/wrench"}},
    ]
    hand = RosHandEmulator(whole_frames=True, fingers=2, connect=router)
    load = RosWrenchEmulator(lambda t: (0.0, 0.0, 3.0, 0.0, 0.0, 0.0), connect=router)
    with hand, load, bus.gateway({"sensors": sensors}):
        frames = [heard.next(PATIENCE_S) for _ in range(100)]
        wrench = felt.next(PATIENCE_S).message
        status = bus.state(ServiceState.READY)
    assert wrench.force.tolist() == [0.0, 0.0, 3.0]
    assert wrench.sensor_serial == "ft-wrench"
    assert status.counters["thumb.lost_messages"] == 0
    slow = list(idle_counts(0.0, 1))[:22]
    for k, received in enumerate(frames, 1):
        frame = received.message
        assert frame.sensor_serial == "BTEMU2"
        assert frame.stamp.origin is Origin.LIVE
        assert frame.stamp.sequence == k
        values = [*frame.electrodes, frame.pdc, frame.tac, frame.tdc]
        assert values == slow
    # The stamp is the begin of the frame, which lasts 10 ms and arrives when it is over.
    delays_ns = [one.received_monotonic_ns - one.message.stamp.monotonic_ns for one in frames[20:]]
    assert min(delays_ns) >= 9_900_000
