"""Device time to host time.

Three kinds of source need three maps: a live device (its delay is unknown but never negative), a
recording replayed at its pace (its first frame is now), and one replayed as fast as possible (its
times stay as recorded, so that the result does not depend on when it is replayed).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple, Protocol

from palpate import clock
from palpate_gateway.timing.envelope import SETTLED_S, Envelope
from palpate_gateway.timing.wall_clock import WallClock

ODD_PPM = 1000.0
"""Clocks of devices are wrong by less [ppm]; more is a rate that is not as configured."""

_DELAYS = 512
"""Of so many readings the median delay is told."""


class HostTime(NamedTuple):
    """Monotonic and wall time [ns]."""

    monotonic_ns: int
    wall_ns: int


class Heard(NamedTuple):
    """What was heard of a device's clock: of the newest thing that arrived.

    A reading may be older than what came with it: a frame lasts 10 ms, and its end is what arrives.

    Attributes:
        device_s: The device's time of it [s].
        arrival_ns: Host monotonic clock when it arrived [ns].
    """

    device_s: float
    arrival_ns: int


class ClockQuality(IntEnum):
    """How good a sensor's stamps are, as its gauge tells."""

    ARRIVAL = 0
    """The device tells no time: the time of arrival, late by all that delays."""
    SETTLING = 1
    """Its clock is followed for less than four seconds: the drift is not known yet."""
    FOLLOWED = 2
    """Its clock is followed, offset and drift."""
    ODD = 3
    """Followed, but it runs wrong by more than any quartz: a rate is configured wrong?"""


class ClockMap(Protocol):
    """Maps the device's time to the host's."""

    @property
    def clock_id(self) -> int:
        """Names the monotonic clock of the mapped times."""
        ...

    @property
    def paced(self) -> bool:
        """Whether a frame must wait until its mapped time before it is published."""
        ...

    def map(self, time_s: float, arrival_ns: int, heard: Heard | None = None) -> HostTime:
        """Host time of a reading.

        Args:
            time_s: The device's time [s].
            arrival_ns: Host monotonic clock when the reading arrived [ns].
            heard: What else is known of the device's clock; None = the reading itself.
        """
        ...

    def gauges(self) -> Mapping[str, float]:
        """What is told of it in the status; from any thread."""
        ...


class LiveClock:
    """A live device's clock, followed by offset and drift; see ``Envelope``.

    Mapped times keep the order of the device's times and are never later than the arrival.

    Args:
        wall: The wall clock; None = one of its own.
    """

    clock_id = clock.CLOCK_ID
    paced = False

    def __init__(self, wall: WallClock | None = None) -> None:
        self._wall = wall or WallClock()
        self._envelope = Envelope()
        self._first: Heard | None = None
        self._last_s = -math.inf
        self._last_ns = 0
        self._delays_ns = [0] * _DELAYS
        self._number = 0

    def map(self, time_s: float, arrival_ns: int, heard: Heard | None = None) -> HostTime:
        """See ``ClockMap``."""
        device_s, heard_ns = (time_s, arrival_ns) if heard is None else heard
        first = self._first
        if first is None:
            self._first = first = Heard(device_s, heard_ns)
        # Counted from the first reading, so that a float holds nanoseconds for months.
        since_s = device_s - first.device_s
        since_ns = heard_ns - first.arrival_ns
        self._envelope.add(since_s, since_ns - since_s * 1e9)
        x_s = time_s - first.device_s
        mapped_ns = first.arrival_ns + math.floor(x_s * 1e9 + self._envelope.at(x_s))
        mapped_ns = min(mapped_ns, heard_ns)
        if time_s >= self._last_s:
            self._last_s = time_s
            self._last_ns = mapped_ns = max(mapped_ns, self._last_ns)
        self._delays_ns[self._number % _DELAYS] = heard_ns - mapped_ns
        self._number += 1
        return HostTime(mapped_ns, self._wall.at(mapped_ns, now_ns=heard_ns))

    @property
    def quality(self) -> ClockQuality:
        """How good its stamps are."""
        if self._envelope.span_s < SETTLED_S:
            return ClockQuality.SETTLING
        if abs(self._envelope.drift_ppm) > ODD_PPM:
            return ClockQuality.ODD
        return ClockQuality.FOLLOWED

    def gauges(self) -> Mapping[str, float]:
        """Quality; and once there are any, drift and median delay of the last readings."""
        told = {"clock_quality": float(self.quality)}
        delays_ns = sorted(self._delays_ns[: self._number])
        if delays_ns:
            told["clock_drift_ppm"] = self._envelope.drift_ppm
            told["clock_delay_p50_s"] = 1e-9 * delays_ns[len(delays_ns) // 2]
        return told


class ArrivalClock:
    """Of a live device that tells no time: its readings' times are the host's, of arrival.

    Args:
        wall: The wall clock; None = one of its own.
    """

    clock_id = clock.CLOCK_ID
    paced = False

    def __init__(self, wall: WallClock | None = None) -> None:
        self._wall = wall or WallClock()
        self._last_ns = 0

    def map(self, time_s: float, arrival_ns: int, heard: Heard | None = None) -> HostTime:
        """See ``ClockMap``."""
        self._last_ns = max(self._last_ns, min(round(time_s * 1e9), arrival_ns))
        return HostTime(self._last_ns, self._wall.at(self._last_ns, now_ns=arrival_ns))

    def gauges(self) -> Mapping[str, float]:
        """Its quality; there is no clock that could drift."""
        return {"clock_quality": float(ClockQuality.ARRIVAL)}


class _ForwardTime:
    """Device time [ns] since the first reading; a step back becomes a standstill."""

    def __init__(self) -> None:
        self._shift_s: float | None = None
        self._last_s = 0.0

    def elapsed_ns(self, time_s: float) -> int:
        if self._shift_s is None:
            self._shift_s = -time_s
        if time_s + self._shift_s < self._last_s:
            self._shift_s = self._last_s - time_s
        self._last_s = time_s + self._shift_s
        return round(self._last_s * 1e9)


class PacedClock:
    """A recording at its own pace: its first reading is now."""

    clock_id = clock.CLOCK_ID
    paced = True

    def __init__(self) -> None:
        self._time = _ForwardTime()
        self._start: HostTime | None = None

    def map(self, time_s: float, arrival_ns: int, heard: Heard | None = None) -> HostTime:
        """See ``ClockMap``."""
        if self._start is None:
            self._start = HostTime(*clock.now())
        elapsed_ns = self._time.elapsed_ns(time_s)
        return HostTime(self._start.monotonic_ns + elapsed_ns, self._start.wall_ns + elapsed_ns)

    def gauges(self) -> Mapping[str, float]:
        """None: its times are as good as the recording's."""
        return {}


class FileClock:
    """A recording as fast as possible: times as recorded.

    Args:
        serial: Serial number of the sensor, to name the clock.
        start_wall_ns: Wall clock at the first reading [ns]; None = the recording does not know, the
            Unix epoch stands for it.
    """

    paced = False

    def __init__(self, serial: str, start_wall_ns: int | None) -> None:
        self._time = _ForwardTime()
        self._start_wall_ns = start_wall_ns or 0
        # Another clock than this host's: nobody shall compute an age from these times.
        named = zlib.crc32(f"file:{serial}:{self._start_wall_ns}".encode()) or 1
        self.clock_id = named if named != clock.CLOCK_ID else named ^ 1

    def map(self, time_s: float, arrival_ns: int, heard: Heard | None = None) -> HostTime:
        """See ``ClockMap``."""
        elapsed_ns = self._time.elapsed_ns(time_s)
        return HostTime(elapsed_ns, self._start_wall_ns + elapsed_ns)

    def gauges(self) -> Mapping[str, float]:
        """None: its times are as good as the recording's."""
        return {}
