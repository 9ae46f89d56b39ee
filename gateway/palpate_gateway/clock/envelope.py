"""Offset and drift of a device's clock, from arrivals that are all late by an unknown delay.

Delays are never negative (hardware reference 5.2). Plotted as arrival minus device time over device
time, all readings lie on or above the line of the clock: its best estimate is the edge of their
lower convex hull at the middle of the window. Bursts of late readings, clumps of an adapter and
stalls of the host lie above that edge and do not move it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise

EnvelopePoint = tuple[float, float]
"""Device time [s], and arrival minus device time [ns]; both since the first reading."""

PART_S = 0.25
"""The window consists of parts of this length [s]; each keeps its reading with the least delay."""

WINDOW_S = 16.0
"""Length of the window [s]; longer ones are wrong, for quartzes warm up by some ppm a minute."""

SETTLED_S = 4.0
"""Any drift up to ``_WILD_PPM`` is accepted once the readings span this time [s]."""

_SLOPE_S = 1.0
"""Over a shorter span, delays that differ by a millisecond can look like any drift [s]."""

_PPM = 1e3
"""A part in a million [ns/s]."""

QUARTZ_PPM = 600.0
"""Largest drift that is accepted before that: quartzes are off by less than 100 ppm each, cheap
resonators by 500."""

_STEP_NS = 1e6
"""A single reading that is below the line by more shows that the clock has stepped [ns]. This
happens where the gateway counts a device's time itself and has miscounted; no drift explains it."""

_WILD_PPM = 50_000.0
"""No clock drifts by more than this [ppm]."""


_STOPPED_NS = 5e8
"""A delay that jumps by more than this and stays there is no wait of readings: the clock of the
device has stopped and gone on, as that of a simulation does [ns]."""

_STOPPED_S = 2.0
"""How long it must stay there, by both clocks [s]: what a stall held back comes all at once."""

_STOPPED_READINGS = 5
"""How many readings must have come since, however rare they are."""


class ClockEnvelope:
    """Follows one clock: a few comparisons for each reading, a small fit every 0.25 s."""

    def __init__(self) -> None:
        self._parts: deque[EnvelopePoint] = deque(maxlen=math.ceil(WINDOW_S / PART_S))
        self._lowest: EnvelopePoint = (0.0, 0.0)
        self._low_ns = math.inf  # of this part, above the line
        self._part_ends_s = self._last_s = self._last_ns = 0.0
        # Readings in a row, all too far above the line for a delay: first, lowest, how many.
        self._far_first = self._far_lowest = (0.0, 0.0)
        self._far = 0
        self.steps = 0
        """How often the clock has stopped and gone on."""
        # The line: delay(x) = base + slope * (x - at).
        self._base_ns, self._slope, self._at_s = math.inf, 0.0, 0.0

    @property
    def drift_ppm(self) -> float:
        """By how much the device's clock runs faster than the host's [ppm]; 0 while unknown."""
        return -self._slope / _PPM

    @property
    def span_s(self) -> float:
        """Device time that the readings of the line span [s]."""
        return self._parts[-1][0] - self._parts[0][0] if self._parts else 0.0

    @property
    def in_doubt(self) -> bool:
        """Whether the clock seems to have stopped, and the line is not that of its readings."""
        return self._far > 0

    def add(self, x_s: float, late_ns: float) -> None:
        """Take a reading.

        Args:
            x_s: Device time [s].
            late_ns: Arrival minus device time [ns]; any origin, the same for all.
        """
        # Between two fits the line only moves down, at once, when a reading lies below it.
        above_ns = late_ns - self.at(x_s)
        if above_ns < self._low_ns:
            self._low_ns, self._lowest = above_ns, (x_s, late_ns)
        if above_ns < 0.0:  # below the line: the line was too high, for no delay is negative
            if above_ns < -_STEP_NS - _WILD_PPM * _PPM * (x_s - self._last_s):
                self._parts.clear()
                self._base_ns, self._at_s, self._part_ends_s = late_ns, x_s, x_s + PART_S
            else:
                self._base_ns += above_ns
            self._low_ns = 0.0
        self._watch(x_s, late_ns, above_ns)
        self._last_s, self._last_ns = x_s, late_ns
        if x_s >= self._part_ends_s:
            self._end_part(x_s)

    def at(self, x_s: float) -> float:
        """Least delay at a device time [ns]."""
        return self._base_ns + self._slope * (x_s - self._at_s)

    def _watch(self, x_s: float, late_ns: float, above_ns: float) -> None:
        """Begin anew where the clock has stopped and gone on."""
        here = x_s, late_ns
        if above_ns <= _STOPPED_NS:
            self._far = 0
        elif late_ns - self._last_ns > _STOPPED_NS:
            self._far_first, self._far_lowest, self._far = here, here, 1
        elif self._far:  # a delay that grows from reading to reading is a queue: its line stays
            self._far_lowest = min(self._far_lowest, here, key=lambda one: one[1])
            self._far += 1
            since_s = x_s - self._far_first[0]
            arrived_s = since_s + 1e-9 * (late_ns - self._far_first[1])
            if min(since_s, arrived_s) >= _STOPPED_S and self._far >= _STOPPED_READINGS:
                self._begin_anew(x_s)

    def _begin_anew(self, x_s: float) -> None:
        self.steps += 1
        self._far = 0
        self._parts.clear()
        self._lowest, self._low_ns, self._part_ends_s = self._far_lowest, 0.0, x_s + PART_S
        self._base_ns, self._slope, self._at_s = self._far_lowest[1], 0.0, x_s

    def _end_part(self, x_s: float) -> None:
        parts = self._parts
        if not parts or self._lowest[0] > parts[-1][0]:
            parts.append(self._lowest)
        while parts[0][0] < x_s - WINDOW_S and len(parts) > 1:
            parts.popleft()
        self._low_ns, self._part_ends_s = math.inf, x_s + PART_S
        points = tuple(parts)
        span_s = points[-1][0] - points[0][0]
        if span_s < _SLOPE_S:
            self._lie_under(points, self._slope)  # after a long silence the earlier slope stays
            return
        accepted = _PPM * (_WILD_PPM if span_s >= SETTLED_S else QUARTZ_PPM)
        slope = middle_slope(points)
        if abs(slope) <= accepted:
            self._lie_under(points, slope)
            return
        # No clock drifts like that, so its past is no guide: only the last second counts.
        recent = tuple(point for point in points if point[0] >= points[-1][0] - _SLOPE_S)
        self._lie_under(recent, math.copysign(accepted, slope))

    def _lie_under(self, points: Sequence[EnvelopePoint], slope: float) -> None:
        at_s = points[-1][0]
        # Readings above this have waited; fitted to them alone, the line would hide their delay.
        highest_ns = self.at(at_s) + _PPM * _WILD_PPM * max(at_s - self._at_s, 0.0)
        base_ns = min(late_ns - slope * (x_s - at_s) for x_s, late_ns in points)
        self._base_ns = min(base_ns, highest_ns)
        self._slope, self._at_s = slope, at_s


def middle_slope(points: Sequence[EnvelopePoint]) -> float:
    """Slope of the lower convex hull at the middle of the points [ns/s].

    Of all lines with no point below them, it is the one with the smallest sum of distances, if the
    points are evenly spread. They are in order of device time, of at least two different times.
    """
    hull: list[EnvelopePoint] = []
    for point in points:
        while len(hull) >= 2 and _is_above(hull[-1], hull[-2], point):
            hull.pop()
        hull.append(point)
    middle_s = (points[0][0] + points[-1][0]) / 2.0
    for (left_s, left_ns), (right_s, right_ns) in pairwise(hull):
        if right_s >= middle_s and right_s > left_s:
            return (right_ns - left_ns) / (right_s - left_s)
    return 0.0


def _is_above(point: EnvelopePoint, before: EnvelopePoint, after: EnvelopePoint) -> bool:
    """Whether a point is on or above the line between two others."""
    (x, y), (x0, y0), (x1, y1) = point, before, after
    return (y - y0) * (x1 - x0) >= (y1 - y0) * (x - x0)
