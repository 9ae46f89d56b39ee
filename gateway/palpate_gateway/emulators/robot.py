"""A robot in software: a program on the bus that tells where its flange is.

Without a router to join it is one, at a loopback port of its own.
"""

from __future__ import annotations

import secrets
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import ClassVar

from palpate.bus import Publisher, Session, run_router
from palpate.bus.topics import ROBOT_POSE
from palpate.config import LinkConfig
from palpate.errors import LinkError
from palpate.messages import Pose, RobotPoseFrame
from palpate.rigid import compose, inverse
from palpate_gateway.emulators.emulator import Emulator, Pace, tell_lead

TipSource = Callable[[float], Pose]
"""Pose of the tip in the sensor frame at a time of the emulator's own [s]."""

BASE_SENSOR = Pose((0.4, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0))
"""A finger that lies on its nail before the robot: its z points down."""

FLANGE_INDENTER = Pose((0.0, 0.0, 0.12), (1.0, 0.0, 0.0, 0.0))
"""A straight tool."""

_JOIN_S = 5.0
_BACK_NS = 5_000_000_000
_NAN, _TOO_LONG = struct.pack("<d", float("nan")), struct.pack("<d", 2.0)


def above_the_pad(t: float) -> Pose:
    """Nothing is touched."""
    return Pose((-0.004, 0.0, -0.016), (1.0, 0.0, 0.0, 0.0))


def slow_approach(t: float) -> Pose:
    """The tip of a press every five seconds, as ``slow_press`` has its wrench."""
    share = max(0.0, 1.0 - abs(t % 5.0 - 2.5) / 1.5)
    return Pose((-0.004, 0.0, -0.016 + 0.007 * share), (1.0, 0.0, 0.0, 0.0))


class RobotEmulator(Emulator):
    """Tells poses of a flange that carries an indenter.

    Faults:

    * ``lost``: poses do not come; ``repeated``: each comes twice;
    * ``late``: every other one comes after the next;
    * ``nan``, ``long``: a quaternion with a part that is no number, or is 2;
    * ``stuck``: it tells where it was when the fault began;
    * ``wrong_time``: its times are five seconds back;
    * ``silence``: its program stands still; ``unplug``: it has left the bus;
    * ``restart``: its program ends and, when the fault ends, begins anew, as its clock does;
    * ``clock_drift``: its clock, and with it its loop, runs at another speed.

    Args:
        tip: Where the tip of its indenter is.
        robot: Its name on the bus.
        rate_hz: Poses each second.
        connect: Endpoint of the router; empty = be one.
        port: To be a router at; 0 = any free one.
        station: On which it publishes.
        drift_ppm: How much too fast its clock is while it drifts [1e-6].
    """

    faults: ClassVar[frozenset[str]] = frozenset(
        "lost repeated late nan long stuck wrong_time silence unplug restart clock_drift".split()
    )

    def __init__(
        self,
        tip: TipSource = slow_approach,
        *,
        robot: str = "arm",
        rate_hz: float = 250.0,
        connect: str = "",
        port: int = 0,
        station: str = "lab",
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(rate_hz)
        self.robot, self.station = robot, station
        self._tip, self._drift = tip, drift_ppm * 1e-6
        self._connect, self._port = connect, port
        self._router: threading.Thread | None = None
        self._session: Session | None = None
        self._publisher: Publisher[RobotPoseFrame] | None = None
        self._late = b""
        self._away = False
        self._began_s = 0.0
        self._begin(0)

    @property
    def address(self) -> str:
        """Endpoint of the router."""
        return self._connect or f"tcp/127.0.0.1:{self._port}"

    def _begin(self, tick: int) -> None:
        """Its program starts."""
        self._run_id = secrets.randbits(64) or 1
        self._sequence, self._first_tick = 0, tick

    def _listen(self) -> None:
        if not self._connect:
            with socket.create_server(("127.0.0.1", self._port)) as free:
                self._port = free.getsockname()[1]
            listen = (self.address,)
            self._router = threading.Thread(target=run_router, args=(listen, self._stop))
            self._router.start()
        try:
            self._join()
        except LinkError:
            self._stop.set()
            self._hang_up()
            raise

    def _join(self) -> None:
        link = LinkConfig(connect=(self.address,), wait_for_router_s=_JOIN_S)
        self._session = Session.open(link, station=self.station)
        self._publisher = self._session.publisher(ROBOT_POSE, sensor=self.robot)

    def _leave(self) -> None:
        session, self._session, self._publisher = self._session, None, None
        if session is not None:
            session.close()

    def _hang_up(self) -> None:
        self._leave()
        if self._router is not None:
            self._router.join(_JOIN_S)
            self._router = None

    def _serve(self) -> None:
        pace = Pace(self.rate_hz, self._stop)
        self._began_s = time.monotonic()
        tell_lead(self._tip, self._began_s)
        tick = 0
        while not self._stop.is_set():
            pace.fast = self._drift if self.faulty("clock_drift") else 0.0
            due_s = pace.wait()
            tick += 1
            self._step(tick, due_s - self._began_s)

    def _step(self, tick: int, t: float) -> None:
        """One turn of its loop."""
        if self._gone():
            return
        if self._away:
            self._away = False
            self._begin(tick)
        if self.faulty("silence"):
            return
        self._sequence += 1
        if self.faulty("lost"):
            return
        payload = self._payload(tick, self._tip(self.held(t)))
        if not self._late and self.faulty("late"):
            self._late = payload
            return
        self._tell(payload)
        self._tell(self._late)
        self._late = b""
        if self.faulty("repeated"):
            self._tell(payload)

    def _gone(self) -> bool:
        """Whether it does not run, or is not on the bus."""
        if self.faulty("restart"):
            self._away = True
            return True
        if self.faulty("unplug"):
            self._leave()
            return True
        if self._publisher is None:
            with suppress(LinkError):  # the router is away, too; next time
                self._join()
        return self._publisher is None

    def _payload(self, tick: int, tip: Pose) -> bytes:
        time_ns = _BACK_NS + round(1e9 * (tick - self._first_tick) / self.rate_hz)
        if self.faulty("wrong_time"):
            time_ns -= _BACK_NS
        flange = compose(compose(BASE_SENSOR, tip), inverse(FLANGE_INDENTER))
        frame = RobotPoseFrame(self.robot, self._sequence, time_ns, flange, self._run_id)
        payload = ROBOT_POSE.codec.encode(frame)
        # A number that is 0 is not on the wire; of a quaternion one never is.
        largest = struct.pack("<d", max(flange.orientation, key=abs))
        for fault, wrong in (("nan", _NAN), ("long", _TOO_LONG)):
            if self.faulty(fault):
                return payload.replace(largest, wrong)
        self.sent += 1
        return payload

    def _tell(self, payload: bytes) -> None:
        if payload and self._publisher is not None:
            self._publisher.put_payload(payload)
