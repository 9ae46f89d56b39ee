"""When was it sampled: device time to host time, and the stamp of each frame.

Three kinds of source need three maps: a live device (its delay is unknown but never negative), a
recording replayed at its pace (its first frame is now), and one replayed as fast as possible (its
times stay as recorded, so that the result does not depend on when it is replayed).
"""

from __future__ import annotations

import contextlib
import math
import secrets
import threading
import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from palpate import clock
from palpate.bus.topics import ELECTRODES, FIELD_TRUTH, POSE, WRENCH
from palpate.messages import (
    ElectrodeFrame,
    FieldFrame,
    IndenterPoseFrame,
    Origin,
    SensorType,
    Stamp,
    Tare,
    WrenchFrame,
)
from palpate_gateway.clock.envelope import SETTLED_S, ClockEnvelope
from palpate_gateway.clock.wall_clock import WallClock
from palpate_gateway.readings import (
    ClockObservation,
    ElectrodeReading,
    FieldReading,
    PoseReading,
    Reading,
    RecordedMessage,
    WrenchReading,
)

ODD_PPM = 1000.0
"""A clock that is wrong by more [ppm] is no quartz: its rate is not as configured."""

_DELAYS = 512
"""Number of readings over which the median delay is taken."""


def new_session_id() -> int:
    """A random name for one run of a gateway, 64 bits, never 0."""
    return secrets.randbelow(2**64 - 1) + 1


class HostTime(NamedTuple):
    """One instant on the host's monotonic and on its wall clock [ns]."""

    monotonic_ns: int
    wall_ns: int


class ClockQuality(IntEnum):
    """How good a sensor's stamps are, as its gauge ``clock_quality`` shows."""

    ARRIVAL = 0
    """The device sends no time: its stamps are times of arrival, late by every delay on the way."""
    SETTLING = 1
    """Its clock has been followed for less than four seconds, and the drift is not known yet; or it
    seems to have stopped and gone on."""
    FOLLOWED = 2
    """Its clock is followed, offset and drift."""
    ODD = 3
    """Followed, but wrong by more than any quartz: a rate may be configured wrong."""


class ClockMap(ABC):
    """Maps the device's time to the host's."""

    clock_id = clock.CLOCK_ID
    """Identifies the monotonic clock of the mapped times."""
    paced = False
    """Whether a frame must wait until its mapped time before it is published."""
    of_this_run = True
    """Whether the mapped times belong to this run of the gateway, and the stamps carry its id."""

    @abstractmethod
    def map(
        self, time_s: float, arrival_ns: int, observed: ClockObservation | None = None
    ) -> HostTime:
        """Host time of a reading.

        Args:
            time_s: The device's time [s].
            arrival_ns: Host monotonic clock when the reading arrived [ns].
            observed: Newest observation of the device's clock; None = this reading is the newest.
        """

    def gauges(self) -> Mapping[str, float]:
        """Gauges of the status, none for a recording; may be called from any thread."""
        return {}

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the status: ``clock_steps``, where a clock is followed."""
        return {}


class LiveClock(ClockMap):
    """Follows the clock of a live device by offset and drift; see ``ClockEnvelope``.

    Mapped times keep the order of the device's times and are never later than the arrival.
    """

    def __init__(self, wall: WallClock | None = None) -> None:
        self._wall = wall or WallClock()
        self._envelope = ClockEnvelope()
        self._first: ClockObservation | None = None
        self._last_s = -math.inf
        self._last_ns = 0
        self._delays_ns = [0] * _DELAYS
        self._number = 0

    def map(
        self, time_s: float, arrival_ns: int, observed: ClockObservation | None = None
    ) -> HostTime:
        """See ``ClockMap``."""
        device_s, observed_ns = (time_s, arrival_ns) if observed is None else observed
        first = self._first
        if first is None:
            self._first = first = ClockObservation(device_s, observed_ns)
        # Counted from the first reading, so that a float holds nanoseconds for months.
        since_s = device_s - first.device_s
        since_ns = observed_ns - first.arrival_ns
        self._envelope.add(since_s, since_ns - since_s * 1e9)
        x_s = time_s - first.device_s
        mapped_ns = first.arrival_ns + math.floor(x_s * 1e9 + self._envelope.at(x_s))
        mapped_ns = min(mapped_ns, observed_ns)
        if time_s >= self._last_s:
            # The envelope may have moved down since the last reading; stamps must not go back.
            self._last_s = time_s
            self._last_ns = mapped_ns = max(mapped_ns, self._last_ns)
        self._delays_ns[self._number % _DELAYS] = observed_ns - mapped_ns
        self._number += 1
        return HostTime(mapped_ns, self._wall.at(mapped_ns, now_ns=observed_ns))

    @property
    def quality(self) -> ClockQuality:
        """How good its stamps are."""
        if self._envelope.span_s < SETTLED_S or self._envelope.in_doubt:
            return ClockQuality.SETTLING
        if abs(self._envelope.drift_ppm) > ODD_PPM:
            return ClockQuality.ODD
        return ClockQuality.FOLLOWED

    def gauges(self) -> Mapping[str, float]:
        """Quality; and from the first reading on, drift and median delay of the last readings."""
        gauges = {"clock_quality": float(self.quality)}
        delays_ns = sorted(self._delays_ns[: self._number])
        if delays_ns:
            gauges["clock_drift_ppm"] = self._envelope.drift_ppm
            gauges["clock_delay_p50_s"] = 1e-9 * delays_ns[len(delays_ns) // 2]
        return gauges

    @property
    def counters(self) -> Mapping[str, int]:
        """``clock_steps``: how often the device's clock has stopped and gone on."""
        return {"clock_steps": self._envelope.steps}


class ArrivalClock(ClockMap):
    """For a live device that sends no time: its readings carry host times of arrival already."""

    def __init__(self, wall: WallClock | None = None) -> None:
        self._wall = wall or WallClock()
        self._last_ns = 0

    def map(
        self, time_s: float, arrival_ns: int, observed: ClockObservation | None = None
    ) -> HostTime:
        """See ``ClockMap``."""
        self._last_ns = max(self._last_ns, min(round(time_s * 1e9), arrival_ns))
        return HostTime(self._last_ns, self._wall.at(self._last_ns, now_ns=arrival_ns))

    def gauges(self) -> Mapping[str, float]:
        """Its quality; there is no clock that could drift."""
        return {"clock_quality": float(ClockQuality.ARRIVAL)}


class _RecordedClock(ClockMap):
    """Shared by both maps of recordings: device time that never steps back.

    Recorded times can, where a log was joined from several; time then stands still.
    """

    def __init__(self) -> None:
        self._shift_s = 0.0
        self._last_s = -math.inf

    def _steady_s(self, time_s: float) -> float:
        if time_s + self._shift_s < self._last_s:
            self._shift_s = self._last_s - time_s
        self._last_s = time_s + self._shift_s
        return self._last_s


_MEET_S = 10.0
"""How long the sensors of a file wait for one another; opening a long one takes seconds [s]."""


class PacedStart:
    """The begin of a file that is replayed at its own pace: its earliest reading is now.

    The sensors of one file share it, so that they stay as far apart as they were recorded.

    Args:
        sensors: How many read the file, each in a thread of its own.
    """

    def __init__(self, sensors: int = 1) -> None:
        self._lock = threading.Lock()
        self._first_s: list[float] = []
        self._began: tuple[float, HostTime] | None = None
        self._all_here = threading.Barrier(sensors, timeout=_MEET_S)

    def meet(self, time_s: float) -> tuple[float, HostTime]:
        """Wait for the first readings of the others: device time of the earliest [s], and now.

        Args:
            time_s: Device time of this sensor's first reading [s].
        """
        with self._lock:
            self._first_s.append(time_s)
        # One that cannot be opened must not keep the others.
        with contextlib.suppress(threading.BrokenBarrierError):
            self._all_here.wait()
        with self._lock:
            if self._began is None:
                self._began = min(self._first_s), HostTime(*clock.now())
            return self._began

    def leave(self) -> None:
        """A sensor has ended: nobody waits for it."""
        self._all_here.abort()


class PacedClock(_RecordedClock):
    """A recording at its own pace: its first reading is now.

    Args:
        start: Shared by the sensors of one file; None = this one is alone.
    """

    paced = True

    def __init__(self, start: PacedStart | None = None) -> None:
        super().__init__()
        self._start = start or PacedStart()
        self._began: tuple[float, HostTime] | None = None

    def map(
        self, time_s: float, arrival_ns: int, observed: ClockObservation | None = None
    ) -> HostTime:
        """See ``ClockMap``."""
        if self._began is None:
            self._began = self._start.meet(time_s)
        first_s, now = self._began
        elapsed_ns = round((self._steady_s(time_s) - first_s) * 1e9)
        return HostTime(now.monotonic_ns + elapsed_ns, now.wall_ns + elapsed_ns)


class FileClock(_RecordedClock):
    """A recording as fast as possible: times as recorded.

    Monotonic times are device times, so that the sensors of one file can be compared.

    Args:
        serial: Serial number of the sensor, which makes the clock's id.
        start_wall_ns: Wall clock at device time zero [ns]; None = not recorded, then the Unix
            epoch.
    """

    of_this_run = False

    def __init__(self, serial: str, start_wall_ns: int | None) -> None:
        super().__init__()
        self._start_wall_ns = start_wall_ns or 0
        self._lift_ns: int | None = None
        # Never this host's id: an age computed from these times would mean nothing.
        named = zlib.crc32(f"file:{serial}:{self._start_wall_ns}".encode()) or 1
        self.clock_id = named if named != clock.CLOCK_ID else named ^ 1

    def map(
        self, time_s: float, arrival_ns: int, observed: ClockObservation | None = None
    ) -> HostTime:
        """See ``ClockMap``."""
        device_ns = round(self._steady_s(time_s) * 1e9)
        if self._lift_ns is None:
            # A stamp cannot be negative; the times of a device may be.
            self._lift_ns = max(-device_ns, 0)
        monotonic_ns = device_ns + self._lift_ns
        if not self._start_wall_ns:
            return HostTime(monotonic_ns, monotonic_ns)
        return HostTime(monotonic_ns, self._start_wall_ns + device_ns)


@dataclass(frozen=True, slots=True)
class DueMessage:
    """A message on its way to the bus.

    Attributes:
        topic: Stream name.
        message: A message, or the bytes of a recorded one.
        due_ns: Host monotonic time at which it is to be published [ns]; 0 = at once.
    """

    topic: str
    message: ElectrodeFrame | WrenchFrame | IndenterPoseFrame | FieldFrame | Tare | bytes
    due_ns: int


class Stamper:
    """Turns readings into frames: each stream has its sequence, each frame its stamp.

    Belongs to one thread.

    Args:
        origin: Where the readings come from.
        session_id: Names this run of the gateway; 0 = unknown.
    """

    def __init__(self, origin: Origin, session_id: int = 0) -> None:
        self._origin = origin
        self._session_id = session_id
        self._clock: ClockMap | None = None
        self._serial = ""
        self._sensor_type: SensorType | None = None
        self._slot_period_ns = 0
        self._sequences: dict[str, int] = {}

    def begin(
        self,
        clock_map: ClockMap,
        *,
        serial: str,
        sensor_type: SensorType | None,
        slot_period_s: float,
    ) -> None:
        """The device was opened, or opened again: its clock is a new one, the sequences go on.

        Without a ``sensor_type`` it has no electrodes.
        """
        self._clock = clock_map
        self._serial, self._sensor_type = serial, sensor_type
        self._slot_period_ns = max(1, round(slot_period_s * 1e9))

    def message(self, reading: Reading, arrival_ns: int, tare_id: int) -> DueMessage:
        """The frame of a reading; a recorded message stays as it is.

        Args:
            reading: In order of time.
            arrival_ns: Host monotonic clock when it arrived [ns].
            tare_id: The tare in force, for a frame of electrodes.
        """
        if self._clock is None:
            raise RuntimeError("begin() comes before push()")
        observed = None if isinstance(reading, RecordedMessage) else reading.observed
        times = self._clock.map(reading.time_s, arrival_ns, observed)
        due_ns = times.monotonic_ns if self._clock.paced else 0
        if isinstance(reading, ElectrodeReading):
            if self._sensor_type is None:
                raise RuntimeError(f"{self._serial} sends electrodes and has no sensor type")
            stamp = self._stamp(ELECTRODES.name, reading.tick, times, reading.missed_before)
            electrodes = ElectrodeFrame(
                stamp,
                self._serial,
                self._sensor_type,
                reading.electrodes,
                reading.pdc,
                reading.pac,
                reading.tac,
                reading.tdc,
                reading.validity,
                self._slot_period_ns,
                tare_id,
            )
            return DueMessage(ELECTRODES.name, electrodes, due_ns)
        if isinstance(reading, WrenchReading):
            stamp = self._stamp(WRENCH.name, reading.tick, times)
            wrench = WrenchFrame(
                stamp, reading.serial, reading.force, reading.torque, reading.overload
            )
            return DueMessage(WRENCH.name, wrench, due_ns)
        if isinstance(reading, FieldReading):
            stamp = self._stamp(FIELD_TRUTH.name, reading.tick, times)
            field = FieldFrame(stamp, self._serial, reading.mesh_sha256, reading.displacement)
            return DueMessage(FIELD_TRUTH.name, field, due_ns)
        if isinstance(reading, PoseReading):
            stamp = self._stamp(POSE.name, reading.tick, times, reading.missed_before)
            pose = IndenterPoseFrame(
                stamp, reading.indenter, reading.position, reading.orientation, reading.in_contact
            )
            return DueMessage(POSE.name, pose, due_ns)
        return DueMessage(reading.topic, reading.payload, due_ns)

    def _stamp(self, topic: str, tick: int, times: HostTime, missed_before: int = 0) -> Stamp:
        """The next stamp of a stream; ``missed_before`` frames were lost directly before it."""
        assert self._clock is not None
        sequence = self._sequences.get(topic, 0) + 1
        self._sequences[topic] = sequence
        return Stamp(
            sequence,
            tick,
            times.monotonic_ns,
            times.wall_ns,
            self._clock.clock_id,
            self._origin,
            missed_before,
            self._session_id if self._clock.of_this_run else 0,
        )
