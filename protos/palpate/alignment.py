"""Electrodes, wrench and pose brought to the same instants.

::

    clock = common_clock(frames, wrenches, poses)
    at_ns = electrode_instants(frames, clock)                 # (N, 19), each electrode's own
    force, known = linear(at_ns, times_of(wrenches, clock), forces)
    turned, known = slerp(at_ns, times_of(poses, clock), orientations)

Between two readings, values are interpolated linearly and orientations along the shorter arc. There
is no extrapolation: before the first reading, after the last, and across a gap of more than three
periods the value is NaN. Streams of one host are compared on its monotonic clock, others on wall
clocks (docs/time.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import Enum
from typing import Protocol

import numpy as np
import numpy.typing as npt

from palpate import rigid
from palpate.errors import DatasetError
from palpate.messages import ElectrodeFrame, Stamp
from palpate.sampling import sample_offsets

Times = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Known = npt.NDArray[np.bool_]

GAP_PERIODS = 3.0
"""A stream that is silent for longer has lost readings [periods]."""


class Stamped(Protocol):
    """A message with a stamp."""

    @property
    def stamp(self) -> Stamp:
        """When it was taken."""
        ...


class AlignmentClock(Enum):
    """Which of a stamp's times is compared."""

    MONOTONIC = "monotonic"
    WALL = "wall"


def common_clock(*streams: Iterable[Stamped]) -> AlignmentClock:
    """The monotonic clock if all messages were stamped by the same one, else wall clocks."""
    ids = {message.stamp.clock_id for stream in streams for message in stream}
    return AlignmentClock.MONOTONIC if len(ids) <= 1 else AlignmentClock.WALL


def times_of(stream: Iterable[Stamped], clock: AlignmentClock) -> Times:
    """Times of messages [ns], int64, shape ``(N,)``."""
    stamps = [message.stamp for message in stream]
    times = [s.monotonic_ns if clock is AlignmentClock.MONOTONIC else s.wall_ns for s in stamps]
    return np.array(times, np.int64)


def electrode_instants(frames: Sequence[ElectrodeFrame], clock: AlignmentClock) -> Times:
    """When each electrode of each frame was sampled [ns], int64, shape ``(N, E)``.

    Raises:
        DatasetError: The frames are of different types of sensors.
    """
    if len({frame.sensor_type for frame in frames}) > 1:
        raise DatasetError(
            "frames of sensors with different numbers of electrodes",
            remedy="align one sensor's frames at a time",
        )
    offsets = np.array([sample_offsets(frame).electrodes for frame in frames], np.int64)
    return np.asarray(times_of(frames, clock)[:, None] + offsets)


def linear(
    at_ns: Times, times_ns: Times, values: npt.ArrayLike, *, period_s: float | None = None
) -> tuple[Values, Known]:
    """Values at other times, interpolated linearly.

    Args:
        at_ns: When [ns], of any shape.
        times_ns: When the values were taken [ns], shape ``(N,)``, in any order.
        values: Shape ``(N, K)``.
        period_s: Of the stream [s]; None = the median of its gaps, without those of 0.

    Returns:
        Values of shape ``(*at_ns.shape, K)``, NaN where unknown; and a mask of the known ones.

    Raises:
        DatasetError: Times and values have different lengths or wrong shapes.
    """
    around = _Around(at_ns, times_ns, values, period_s)
    share = around.share[..., None]
    mixed = (1.0 - share) * around.before + share * around.after
    # A reading counts at its own time even if the next one holds no number.
    mixed = np.where(share > 0.0, mixed, around.before)
    return np.where(around.known[..., None], mixed, np.nan), around.known


def slerp(
    at_ns: Times, times_ns: Times, quaternions: npt.ArrayLike, *, period_s: float | None = None
) -> tuple[Values, Known]:
    """Orientations at other times, with constant speed along the shorter arc between neighbours.

    Like ``linear``, of unit quaternions of shape ``(N, 4)``; either sign means the same.
    """
    around = _Around(at_ns, times_ns, quaternions, period_s)
    turned = rigid.slerp(around.before, around.after, around.share)
    return np.where(around.known[..., None], turned, np.nan), around.known


class _Around:
    """Readings directly before and after some times, and how far between them each lies."""

    def __init__(
        self, at_ns: Times, times_ns: Times, values: npt.ArrayLike, period_s: float | None
    ) -> None:
        times, rows = np.asarray(times_ns, np.int64), np.asarray(values, np.float64)
        if times.ndim != 1 or rows.ndim != 2 or len(rows) != len(times) or not len(times):
            raise DatasetError(
                f"{times.shape} times and {rows.shape} values do not form a stream",
                remedy="give one time and one row of values for each reading, one reading at least",
            )
        order = np.argsort(times, kind="stable")
        times, rows = times[order], rows[order]
        at = np.asarray(at_ns, np.int64)
        lower = np.searchsorted(times, at, side="right") - 1
        upper = np.minimum(lower + 1, len(times) - 1)
        inside = lower >= 0
        lower = np.maximum(lower, 0)
        past_ns, gap_ns = at - times[lower], times[upper] - times[lower]
        # Whole nanoseconds are subtracted before anything becomes a float.
        self.share = np.where(gap_ns > 0, past_ns / np.maximum(gap_ns, 1), 0.0)
        narrow = gap_ns <= longest_gap_ns(times, period_s)
        self.known: Known = inside & ((past_ns == 0) | (gap_ns > 0) & narrow)
        self.share = np.where(self.known, self.share, 0.0)
        self.before, self.after = rows[lower], rows[upper]


def longest_gap_ns(times_ns: Times, period_s: float | None = None) -> float:
    """How far apart two readings may be for a value between them [ns]; times in order.

    The period of the stream [s] may be given; None = the median of its gaps. Readings that arrive
    together and share a time have no gap between them.
    """
    if period_s is None:
        steps = np.diff(times_ns)
        steps = steps[steps > 0]
        return GAP_PERIODS * float(np.median(steps)) if len(steps) else 0.0
    return GAP_PERIODS * 1e9 * period_s
