"""Stamps of one sensor: a sequence for each stream, and the device's time on the host's clocks."""

from __future__ import annotations

from typing import Protocol

from palpate.messages import Origin, Stamp
from palpate_gateway.timing.clock_map import ClockMap, Heard, HostTime


class Timed(Protocol):
    """A reading that has its device's tick and time."""

    @property
    def tick(self) -> int:
        """The device's own unwrapped counter."""
        ...

    @property
    def time_s(self) -> float:
        """The device's time [s]."""
        ...

    @property
    def heard(self) -> Heard | None:
        """What arrived last of the device; None = this."""
        ...


class Stamps:
    """Makes stamps; belongs to one thread.

    Args:
        origin: Where the readings come from.
    """

    def __init__(self, origin: Origin) -> None:
        self._origin = origin
        self._clock: ClockMap | None = None
        self._sequences: dict[str, int] = {}

    def begin(self, clock: ClockMap) -> None:
        """The device was opened, or opened again: another clock, the same sequences."""
        self._clock = clock

    def times(
        self, time_s: float, arrival_ns: int, heard: Heard | None = None
    ) -> tuple[HostTime, int]:
        """Host time of a device time [s], and when it is to be published [ns]; 0 = at once."""
        clock = self._begun()
        times = clock.map(time_s, arrival_ns, heard)
        return times, times.monotonic_ns if clock.paced else 0

    def stamp(
        self, topic: str, reading: Timed, arrival_ns: int, missed_before: int = 0
    ) -> tuple[Stamp, int]:
        """The next stamp of a stream, and when its message is to be published [ns].

        Args:
            topic: Name of the stream.
            reading: What is stamped.
            arrival_ns: Host monotonic clock when it arrived [ns].
            missed_before: Frames lost directly before it.
        """
        times, due_ns = self.times(reading.time_s, arrival_ns, reading.heard)
        sequence = self._sequences.get(topic, 0) + 1
        self._sequences[topic] = sequence
        stamp = Stamp(
            sequence,
            reading.tick,
            times.monotonic_ns,
            times.wall_ns,
            self._begun().clock_id,
            self._origin,
            missed_before,
        )
        return stamp, due_ns

    def _begun(self) -> ClockMap:
        if self._clock is None:
            raise RuntimeError("begin() comes before push()")
        return self._clock
