"""A force/torque sensor whose driver speaks only ROS: WrenchStamped."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from pydantic import Field

from palpate.config import LinkConfig
from palpate.errors import DeviceError, DeviceLost
from palpate.ros.layouts import WRENCH_STAMPED, Dialect, decode, time_of
from palpate_gateway.readings import WrenchReading
from palpate_gateway.ros.subscription import (
    RosDevice,
    RosMessage,
    RosSubscription,
    RosTopicOptions,
)
from palpate_gateway.wrench.device import WrenchDevice, WrenchOptions, is_measured

_ZERO_S = 0.2
_BEGAN_ANEW = 10
"""So many messages in a row with an earlier time show that the clock of ROS was set back."""


class RosWrenchMessage(NamedTuple):
    """A ``WrenchStamped``.

    Attributes:
        time_ns: Time of its header [ns since the epoch]; 0 = not set.
        values: Fx Fy Fz [N] Tx Ty Tz [N m], in the frame that the header names.
    """

    time_ns: int
    values: tuple[float, float, float, float, float, float]


def decode_wrench(payload: bytes, dialect: Dialect = "cdr") -> RosWrenchMessage:
    """The wrench in these bytes; its numbers may be no finite ones.

    Raises:
        WireError: The bytes are no ``WrenchStamped``.
    """
    message = decode(payload, WRENCH_STAMPED, dialect)
    force, torque = message.wrench.force, message.wrench.torque
    return RosWrenchMessage(
        time_of(message.header.stamp),
        (force.x, force.y, force.z, torque.x, torque.y, torque.z),
    )


class RosWrenchOptions(WrenchOptions, RosTopicOptions):
    """Options of the ``ros_wrench`` driver.

    Attributes:
        rate_hz: Nominal rate of the messages [Hz].
    """

    rate_hz: float = Field(default=100.0, gt=0.0, le=10_000.0)


class RosWrench(WrenchDevice, RosDevice):
    """A force/torque sensor behind a topic.

    ROS has no common way to take its zero in the device, so this driver subtracts it: the zero is
    lost with the publisher, and the sensor's range is not used better.
    """

    options_class = RosWrenchOptions
    needs = ("rosbags",)

    def __init__(self, options: RosWrenchOptions) -> None:
        super().__init__("ros_wrench", f"wrench of {options.topic}", options.rate_hz, options)
        self._options = options
        self._topic: RosSubscription[RosWrenchMessage] = RosSubscription(
            options, WRENCH_STAMPED, decode_wrench
        )
        self._offset = np.zeros(6)
        self._zeroed: bytes | None = None
        self._same_publisher = False
        self._begin()
        self.join(LinkConfig(), "lab")

    def _begin(self) -> None:
        self._early: RosMessage[RosWrenchMessage] | None = None
        self._first_ns: int | None = None
        self._last_ns = 0
        self._late = 0
        self._order = dict.fromkeys(("late_messages", "repeated_messages"), 0)

    def zero(self) -> None:
        """See ``WrenchDevice``; takes 0.2 s."""
        values: list[tuple[float, ...]] = []
        until = time.monotonic() + _ZERO_S
        while (left_s := until - time.monotonic()) > 0.0 or not values:
            message = self._topic.next(max(left_s, self._options.wait_s))
            values.append(message.message.values)
        measured = [one for one in values if is_measured(one)]
        if not measured:
            raise DeviceError(
                f"{self.info.model}: it sends nothing but numbers that no sensor measures",
                remedy="check its driver: ros2 topic echo",
            )
        self._offset, self._zeroed = np.mean(measured, axis=0), self._topic.publisher

    def _zero_note(self) -> bytes:
        return self._offset.tobytes() + (self._zeroed or b"")

    def _resume_zero(self, note: bytes) -> None:
        offset, publisher = note[: self._offset.nbytes], note[self._offset.nbytes :]
        if publisher:
            self._offset, self._zeroed = np.frombuffer(offset), publisher

    def _keeps_zero(self) -> bool:
        return self._same_publisher

    def _connect(self) -> str:
        self._begin()
        self._early = self._topic.open()
        # A driver of ROS that was started again may have taken a zero of its own.
        publisher = self._topic.publisher
        self._same_publisher = publisher is not None and publisher == self._zeroed
        if not self._same_publisher:
            self._offset = np.zeros(6)
        return self._options.topic.strip("/").replace("/", "-")

    def _close(self) -> None:
        self._topic.close()

    def _protocol_counters(self) -> Mapping[str, int]:
        return {**self._topic.counters, **self._order}

    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        early, self._early = self._early, None
        messages = self._topic.take(timeout_s) if early is None else [early]
        return self._before_error(self._take(one) for one in messages)

    def _take(self, message: RosMessage[RosWrenchMessage]) -> WrenchReading | None:
        time_ns = message.message.time_ns or message.sent_ns or message.arrival_ns
        if self._first_ns is None:
            self._first_ns = time_ns
        elif time_ns == self._last_ns:
            self._order["repeated_messages"] += 1
            return None
        elif time_ns < self._last_ns:
            self._order["late_messages"] += 1
            self._late += 1
            if self._late >= _BEGAN_ANEW:
                raise DeviceLost(
                    f"{self.info.model}: the time of its messages was set back",
                    remedy="nothing, if that is right; it is opened again by itself",
                )
            return None
        self._late, self._last_ns = 0, time_ns
        return self._reading(
            (np.array(message.message.values) - self._offset).tolist(),
            time_s=(time_ns - self._first_ns) * 1e-9,
            arrival_ns=message.arrival_ns,
        )
