"""What a file of robot poses yields, whatever its format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from palpate.messages import Pose


@dataclass(frozen=True, slots=True)
class Row:
    """One pose of the flange in the robot's base.

    Attributes:
        tick: Number of the row, or the sequence that the robot's program told.
        time_s: When the robot was there [s], from any origin.
        pose: Position [m] and unit quaternion w x y z, but for rounding.
        missed_before: Poses known to have been lost directly before this one.
    """

    tick: int
    time_s: float
    pose: Pose
    missed_before: int = 0


class PoseSource(Protocol):
    """An open file of robot poses."""

    @property
    def counters(self) -> Mapping[str, int]:
        """What was left out, by reason."""
        ...

    @property
    def start_wall_ns(self) -> int | None:
        """Wall clock at the first row [ns], where it is told; known when that has been read."""
        ...

    def rows(self) -> Iterator[Row]:
        """Poses in order of time; raises ``RecordingError`` where the file is broken."""
        ...

    def close(self) -> None:
        """Let go of the file."""
        ...
