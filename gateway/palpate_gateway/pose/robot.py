"""Poses of the indenter from a robot whose program publishes its flange over Zenoh."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

from pydantic import Field

from palpate.bus import Delivery, ReceivedMessage, Session, Subscriber
from palpate.bus.topics import ROBOT_POSE
from palpate.config import LinkConfig, Name, RouterOptions
from palpate.errors import DeviceLost, DeviceTimeout, LinkError, StreamTimeout
from palpate.messages import Origin, RobotPoseFrame
from palpate_gateway.device import BusDevice, DeviceIdentity, DeviceInfo
from palpate_gateway.pose.placement import Placement, PlacementOptions, within_reach
from palpate_gateway.pose.track import PoseTrack, PoseVerdict
from palpate_gateway.readings import ClockObservation, PoseReading, Reading

_BATCH = 64
"""Largest number of readings in one answer of ``read``."""


class PoseZenohOptions(PlacementOptions, RouterOptions):
    """Options of the ``pose_zenoh`` driver.

    Attributes:
        robot: Name under which the robot's program publishes.
        rate_hz: Rate of its poses [Hz]; a gap longer than 40 ms and three periods is a silence.
        station: Station on which it publishes; empty = the gateway's own.
        timeout_s: Longest time to join the bus [s].
    """

    robot: Name
    rate_hz: float = Field(default=ROBOT_POSE.rate_hz, gt=0.0, le=10_000.0)
    station: Name | None = None
    timeout_s: float = Field(default=2.0, gt=0.0, le=60.0)


class PoseZenoh(BusDevice):
    """The poses of one robot as a live device, with a bus session of its own."""

    options_class = PoseZenohOptions

    def __init__(self, options: PoseZenohOptions) -> None:
        model, rate_hz = f"robot {options.robot}, {options.indenter}", options.rate_hz
        super().__init__(
            DeviceInfo(
                "pose_zenoh", None, model, rate_hz, live=True, finite=False, origin=Origin.LIVE
            )
        )
        self._options = options
        self._placement = Placement(options)
        self._track = PoseTrack()
        self._session: Session | None = None
        self._subscriber: Subscriber[RobotPoseFrame] | None = None
        self._counts = {"samples": 0, "wrong_robot": 0}
        self._last_counts: Mapping[str, int] = {}
        self._began_ns: int | None = None
        self._restarted = False
        self.join(LinkConfig(), "lab")

    @property
    def counters(self) -> Mapping[str, int]:
        """Poses that became readings, rejected poses by reason, and lost poses."""
        subscriber = self._subscriber  # another thread may close it meanwhile
        counted = self._last_counts if subscriber is None else subscriber.counters
        refused = {name: n for name, n in counted.items() if name.startswith("rejected_")}
        overflow = {"queue_overflow": counted.get("overflow", 0)}
        return {**self._counts, **self._track.counters, **overflow, **refused}

    def join(self, link: LinkConfig, station: str) -> None:
        """See ``BusDevice``; the options take precedence."""
        options = self._options
        link = options.changed(link, wait_for_router_s=options.timeout_s)
        own = LinkConfig(tls=link.tls)
        self._link = link.model_copy(update={"listen": own.listen})
        self._station = options.station or station

    def _open(self) -> DeviceIdentity:
        if not self._restarted:  # but after a silence, e.g. of a second program that has ended
            self._track.forget()
        self._track.begin()
        self._counts = dict.fromkeys(self._counts, 0)
        self._last_counts = {}
        self._began_ns = None
        try:
            self._session = Session.open(self._link, station=self._station)
        except LinkError as error:
            raise DeviceLost(error.problem, remedy=error.remedy) from error
        self._restarted = False
        self._subscriber = self._session.subscriber(
            ROBOT_POSE, sensor=self._options.robot, delivery=Delivery.QUEUE
        )
        return DeviceIdentity(self._options.robot, slot_period_s=1.0 / self._options.rate_hz)

    def _close(self) -> None:
        if self._subscriber is not None:
            self._last_counts = self._subscriber.counters
        session, self._session, self._subscriber = self._session, None, None
        if session is not None:
            session.close()

    def _read(self, timeout_s: float) -> list[Reading]:
        readings = self._before_error(self._arrived(timeout_s))
        if not readings:
            raise DeviceLost(
                f"the program of robot {self._options.robot!r} has restarted",
                remedy="nothing, if that is right; if not, two programs use this name",
            )
        self._counts["samples"] += len(readings)
        return list(readings)

    def _arrived(self, timeout_s: float) -> Iterator[PoseReading]:
        """The next readings, up to a restart; waits for the first one only."""
        assert self._subscriber is not None
        until = time.monotonic() + timeout_s
        count = 0
        while count < _BATCH and not self._restarted:
            try:
                left_s = 0.0 if count else max(until - time.monotonic(), 0.0)
                received = self._subscriber.next(left_s)
            except StreamTimeout as error:
                if count:
                    return
                raise DeviceTimeout(
                    f"robot {self._options.robot!r} published no new pose within {timeout_s:g} s",
                    remedy="check that its program runs, and its name, station and router: "
                    "palpate topic list",
                ) from error
            except LinkError as error:
                raise DeviceLost(error.problem, remedy=error.remedy) from error
            reading = self._reading(received)
            if reading is not None:
                count += 1
                yield reading

    def _reading(self, received: ReceivedMessage[RobotPoseFrame]) -> PoseReading | None:
        """The tip; None, and counted, if the pose is rejected."""
        frame = received.message
        if frame.robot != self._options.robot:
            self._counts["wrong_robot"] += 1
            return None
        verdict = self._track.take(frame)
        if verdict is not PoseVerdict.NEW:
            # Its clock may have restarted, too, so the map of the clock must start again.
            self._restarted = verdict is PoseVerdict.RESTARTED
            return None
        position = frame.pose_base_flange.position
        if not within_reach(position):
            told = ", ".join(f"{part:g}" for part in position)
            raise DeviceLost(
                f"robot {self._options.robot!r} is at ({told}) m, out of any robot's reach",
                remedy="let its program publish metres: is this in mm?",
            )
        if self._began_ns is None:
            self._began_ns = frame.time_ns
        # Relative to the first pose: a clock that counts from 1970 would lose digits.
        time_s = (frame.time_ns - self._began_ns) * 1e-9
        return self._placement.reading(
            frame.pose_base_flange,
            tick=frame.sequence,
            time_s=time_s,
            missed_before=self._track.missed_before,
            observed=ClockObservation(time_s, received.received_monotonic_ns),
        )
