"""A BioTac whose driver speaks only ROS: one finger of a tactile topic."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Literal

from pydantic import Field

from palpate.config import LinkConfig, StrictConfig
from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate.messages import Origin, SensorType
from palpate.ros.layouts import BIOTAC_ALL, BIOTAC_HAND
from palpate_gateway.device import DeviceIdentity, DeviceInfo, SerialOption
from palpate_gateway.protocols.ros_hands import RosHand, decode_hand
from palpate_gateway.readings import ElectrodeReading, Reading
from palpate_gateway.ros.finger_track import Channel, FingerTrack
from palpate_gateway.ros.subscription import (
    RosDevice,
    RosMessage,
    RosSubscription,
    RosTopicOptions,
)

LAYOUTS = {"sr_robot_msgs/BiotacAll": BIOTAC_ALL, "biotac_sensors/BioTacHand": BIOTAC_HAND}
"""Names of the tactile messages in options."""

TactileMessage = Literal["sr_robot_msgs/BiotacAll", "biotac_sensors/BioTacHand"]

_AWAY_S = 1.0
"""A finger that is in no message for so long is away [s]."""


class RosFingerOptions(StrictConfig):
    """Which finger of a tactile message, and what its driver fills.

    Attributes:
        finger: Place of the finger in it, from 1; in a ``BiotacAll`` 1 to 4 are the first, middle,
            ring and little finger, 5 is the thumb.
        serial: Serial number of the finger. In a ``BioTacHand`` it finds the finger; a
            ``BiotacAll`` has none, so that it is only published. Empty = by its place.
        rate_hz: New readings each second [Hz].
        missing: Channels that this driver does not fill; their validity bits stay clear, which is
            no fault.
        repeats: What to do with a ``BiotacAll`` that has no new count of electrodes, PDC, TAC and
            TDC: the rate of messages is the controller's, not the finger's.
    """

    finger: int = Field(default=1, ge=1, le=5)
    serial: SerialOption = ""
    rate_hz: float = Field(default=100.0, gt=0.0, le=10_000.0)
    missing: tuple[Channel, ...] = ()
    repeats: Literal["drop", "keep"] = "drop"

    @property
    def unfilled(self) -> frozenset[str]:
        """The same channels by their names in ``DeviceIdentity``."""
        return frozenset(channel.upper() for channel in self.missing)

    def track(self, layout: str) -> FingerTrack:
        """The track of the finger in messages of a layout."""
        return FingerTrack(
            self.finger,
            serial=self.serial if layout == BIOTAC_HAND else "",
            rate_hz=self.rate_hz,
            missing=self.missing,
            repeats=self.repeats,
        )


class RosBiotacOptions(RosFingerOptions, RosTopicOptions):
    """Options of the ``ros_biotac`` driver.

    Attributes:
        message: Type of the messages.
    """

    message: TactileMessage


class RosBiotac(RosDevice):
    """One BioTac or BioTac SP of a topic.

    Its readings have the message's time: of the frame's begin in a ``BioTacHand``, of the header
    in a ``BiotacAll``, of publishing where the header has none.
    """

    options_class = RosBiotacOptions
    needs = ("rosbags",)

    def __init__(self, options: RosBiotacOptions) -> None:
        super().__init__(
            DeviceInfo(
                driver="ros_biotac",
                sensor_type=SensorType.BIOTAC,
                model=f"finger {options.finger} of {options.topic}",
                rate_hz=options.rate_hz,
                live=True,
                finite=False,
                origin=Origin.LIVE,
            )
        )
        self._options = options
        layout = LAYOUTS[options.message]
        self._topic: RosSubscription[RosHand] = RosSubscription(
            options, layout, partial(decode_hand, layout=layout)
        )
        self._track = options.track(layout)
        self._early: RosMessage[RosHand] | None = None
        self._there_s = 0.0
        self.join(LinkConfig(), "lab")

    @property
    def counters(self) -> Mapping[str, int]:
        """Of the readings and of the topic, since it was opened last."""
        return {**self._topic.counters, **self._track.counters}

    def _open(self) -> DeviceIdentity:
        self._track.begin()
        self._early = early = self._topic.open()
        finger = self._track.find(early.message)
        if finger is None:
            self._topic.close()
            places = [k for k, one in enumerate(early.message.fingers, 1) if one is not None]
            there = ", ".join(map(str, places)) or "none"
            raise DeviceError(
                f"{self.info.model}: no finger answers there",
                remedy=f"there are: {there}; correct finger or serial",
            )
        self._there_s = time.monotonic()
        kind = finger.sensor_type
        period_s = early.message.slot_period_s
        if not early.message.whole_frames:
            # The times of sampling inside a message are not known: a slot's share of its period.
            period_s = 1.0 / (self._options.rate_hz * kind.layout.slots)
        name = self._options.topic.strip("/").replace("/", "-")
        serial = self._options.serial or finger.serial or f"{name}-{self._options.finger}"
        self._serial = finger.serial
        self._kind = kind
        # Its driver may publish fewer frames than slots would make.
        rate_hz = self._options.rate_hz
        return DeviceIdentity(
            serial,
            period_s,
            sensor_type=kind,
            rate_hz=rate_hz,
            unfilled=self._options.unfilled,
        )

    def _close(self) -> None:
        self._topic.close()

    def _read(self, timeout_s: float) -> list[Reading]:
        until = time.monotonic() + timeout_s
        while True:
            early, self._early = self._early, None
            left_s = max(until - time.monotonic(), 0.0)
            messages = self._topic.take(left_s) if early is None else [early]
            readings = self._before_error(self._reading(message) for message in messages)
            if readings:
                return list(readings)
            if time.monotonic() >= until:
                raise DeviceTimeout(
                    f"{self.info.model}: no new reading within {timeout_s:g} s",
                    remedy="messages come, but repeat the last one: check the driver of the hand",
                )

    def _reading(self, message: RosMessage[RosHand]) -> ElectrodeReading | None:
        hand = message.message
        if not hand.time_ns:
            time_ns = message.sent_ns or message.arrival_ns
            hand = replace(hand, time_ns=time_ns, end_ns=time_ns)
        reading = self._track.take(hand, lost=message.lost, arrival_ns=message.arrival_ns)
        if self._track.restarted:
            raise DeviceLost(
                f"{self.info.model}: the time of its messages was set back",
                remedy="nothing, if that is right; it is opened again by itself",
            )
        finger = self._track.find(hand)
        now_s = time.monotonic()
        if finger is None:
            if now_s - self._there_s > _AWAY_S:
                raise DeviceLost(
                    f"{self.info.model}: the finger is in no message any more",
                    remedy="check its plug and cable; it is looked for again by itself",
                )
            return None
        self._there_s = now_s
        if finger.sensor_type is not self._kind or finger.serial != self._serial:
            raise DeviceLost(
                f"{self.info.model}: another finger is in its place",
                remedy="nothing, if it was exchanged; it is opened again by itself",
            )
        return reading
