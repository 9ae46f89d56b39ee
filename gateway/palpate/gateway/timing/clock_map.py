"""Device time to host time.

Three kinds of source need three maps: a live device (its delay is unknown but never negative), a
recording replayed at its pace (its first frame is now), and one replayed as fast as possible (its
times stay as recorded, so that the result does not depend on when it is replayed).
"""

from __future__ import annotations

import zlib
from typing import NamedTuple, Protocol

from palpate.protos import clock

_DRIFT = 200e-6
"""Quartz clocks differ by less than 100 ppm each; the lower envelope may rise by twice that."""

_WALL_CHECK_NS = 1_000_000_000


class HostTime(NamedTuple):
    """Monotonic and wall time [ns]."""

    monotonic_ns: int
    wall_ns: int


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

    def map(self, time_s: float, arrival_ns: int) -> HostTime:
        """Host time of a reading.

        Args:
            time_s: The device's time [s].
            arrival_ns: Host monotonic clock when the reading arrived [ns].
        """
        ...


class LiveClock:
    """A live device's clock by its lower envelope.

    Delay only ever adds, so the least difference of arrival and device time is the clock
    (hardware reference 5.2). The envelope may rise slowly, to follow a device that runs slow.
    """

    clock_id = clock.CLOCK_ID
    paced = False

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._arrival_ns = 0
        self._last_ns = 0
        self._wall_offset_ns = 0
        self._wall_checked_ns: int | None = None

    def map(self, time_s: float, arrival_ns: int) -> HostTime:
        """See ``ClockMap``."""
        device_ns = time_s * 1e9
        offset_ns = arrival_ns - device_ns
        if self._offset_ns is None or offset_ns < self._offset_ns:
            self._offset_ns = offset_ns
        else:
            allowed = max(arrival_ns - self._arrival_ns, 0) * _DRIFT
            self._offset_ns += min(offset_ns - self._offset_ns, allowed)
        self._arrival_ns = arrival_ns
        self._last_ns = max(self._last_ns, round(device_ns + self._offset_ns))
        if self._wall_checked_ns is None or arrival_ns - self._wall_checked_ns > _WALL_CHECK_NS:
            monotonic_ns, wall_ns = clock.now()
            self._wall_offset_ns = wall_ns - monotonic_ns
            self._wall_checked_ns = arrival_ns
        return HostTime(self._last_ns, self._last_ns + self._wall_offset_ns)


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

    def map(self, time_s: float, arrival_ns: int) -> HostTime:
        """See ``ClockMap``."""
        if self._start is None:
            self._start = HostTime(*clock.now())
        elapsed_ns = self._time.elapsed_ns(time_s)
        return HostTime(self._start.monotonic_ns + elapsed_ns, self._start.wall_ns + elapsed_ns)


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

    def map(self, time_s: float, arrival_ns: int) -> HostTime:
        """See ``ClockMap``."""
        elapsed_ns = self._time.elapsed_ns(time_s)
        return HostTime(elapsed_ns, self._start_wall_ns + elapsed_ns)
