"""A robot in software: a program on the bus that publishes the pose of its flange.

Without the address of a router it runs its own, at a loopback port.
"""

from __future__ import annotations

import secrets
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from palpate.bus import Publisher, Session
from palpate.bus.topics import ROBOT_POSE
from palpate.messages import Pose, RobotPoseFrame
from palpate.rigid import compose, inverse
from palpate_gateway.emulators import FAULTS
from palpate_gateway.emulators.emulator import SampleTicker, set_lead
from palpate_gateway.emulators.routed import RoutedEmulator

TipSource = Callable[[float], Pose]
"""Gives the pose of the tip in the sensor frame at a time of the emulator's own [s]."""

BASE_SENSOR = Pose((0.4, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0))
"""Pose of a finger that lies on its nail in front of the robot: its z axis points down."""

FLANGE_INDENTER = Pose((0.0, 0.0, 0.12), (1.0, 0.0, 0.0, 0.0))
"""Pose of the indenter: a straight tool."""

_BACK_NS = 5_000_000_000
_NAN, _TOO_LONG = struct.pack("<d", float("nan")), struct.pack("<d", 2.0)


def above_the_pad(t: float) -> Pose:
    """The tip rests above the pad, without contact."""
    return Pose((-0.004, 0.0, -0.016), (1.0, 0.0, 0.0, 0.0))


def slow_approach(t: float) -> Pose:
    """The tip of an indentation every five seconds, at the times of ``slow_press``."""
    share = max(0.0, 1.0 - abs(t % 5.0 - 2.5) / 1.5)
    return Pose((-0.004, 0.0, -0.016 + 0.007 * share), (1.0, 0.0, 0.0, 0.0))


class RobotEmulator(RoutedEmulator):
    """Publishes poses of a flange that carries an indenter.

    Faults:

    * ``lost``: poses are missing; ``repeated``: each comes twice;
    * ``late``: every other pose comes after the next one;
    * ``nan``, ``long``: a part of the quaternion is not a number, or is 2;
    * ``stuck``: it repeats the pose from its begin;
    * ``wrong_time``: its times are five seconds in the past;
    * ``silence``: its program hangs; ``unplug``: it has left the bus;
    * ``restart``: its program ends; when the fault ends, program and clock start again;
    * ``clock_drift``: its clock, and with it its loop, runs at another speed.
    """

    faults: ClassVar = FAULTS["robot"]
    _publisher: Publisher[RobotPoseFrame] | None

    def __init__(
        self,
        tip: TipSource = slow_approach,
        *,
        robot: str = "arm",
        rate_hz: float = 250.0,
        connect: str = "",
        tls: Path | None = None,
        port: int = 0,
        station: str = "lab",
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(rate_hz, connect, port, tls)
        self.robot, self.station = robot, station
        self._tip, self._drift = tip, drift_ppm * 1e-6
        self._late = b""
        self._began_s = 0.0
        self._begin(0.0)

    def _begin(self, clock_s: float) -> None:
        """Start its program."""
        self._run_id = secrets.randbits(64) or 1
        self._sequence, self._started_s = 0, clock_s

    def _join(self) -> None:
        self._session = Session.open(self._link(), station=self.station)
        self._publisher = self._session.publisher(ROBOT_POSE, sensor=self.robot)

    def _serve(self) -> None:
        ticker = SampleTicker(self.rate_hz, self._stop)
        self._began_s = time.monotonic()
        set_lead(self._tip, self._began_s)
        while not self._stop.is_set():
            ticker.fast = self._drift if self.faulty("clock_drift") else 0.0
            due_s = ticker.wait()
            self._step(ticker.clock_s, due_s - self._began_s)

    def _step(self, clock_s: float, t: float) -> None:
        """One cycle of its loop."""
        if self._gone():
            return
        if self._away:
            self._away = False
            self._begin(clock_s)
        if self.faulty("silence"):
            return
        self._sequence += 1
        if self.faulty("lost"):
            return
        payload = self._payload(clock_s, self._tip(self.held(t)))
        if not self._late and self.faulty("late"):
            self._late = payload
            return
        self._tell(payload)
        self._tell(self._late)
        self._late = b""
        if self.faulty("repeated"):
            self._tell(payload)

    def _payload(self, clock_s: float, tip: Pose) -> bytes:
        time_ns = _BACK_NS + round(1e9 * (clock_s - self._started_s))
        if self.faulty("wrong_time"):
            time_ns -= _BACK_NS
        flange = compose(compose(BASE_SENSOR, tip), inverse(FLANGE_INDENTER))
        frame = RobotPoseFrame(self.robot, self._sequence, time_ns, flange, self._run_id)
        payload = ROBOT_POSE.codec.encode(frame)
        # Protobuf omits a field that is 0, so the fault is put into the largest part of the
        # quaternion.
        largest = struct.pack("<d", max(flange.orientation, key=abs))
        for fault, wrong in (("nan", _NAN), ("long", _TOO_LONG)):
            if self.faulty(fault):
                return payload.replace(largest, wrong)
        self.sent += 1
        return payload

    def _tell(self, payload: bytes) -> None:
        if payload and self._publisher is not None:
            self._publisher.put_payload(payload)
