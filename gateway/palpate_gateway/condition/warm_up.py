"""Whether the core is still warming up: the slope of TDC while nothing touches the sensor.

The core is heated; until it has settled the electrodes drift (hardware reference 4.3). What a count
of TDC is in degrees differs from source to source (1.9), so that slopes are told in counts.
"""

from __future__ import annotations

from collections import deque

import numpy as np

WARMING_COUNTS_PER_MIN = 30.0
"""Steeper is warming up: the settled sensor of the public capture rises by 7 untouched, and a
sensor that warms by 10 degrees in half an hour begins with twice this."""

SETTLED_COUNTS_PER_MIN = 15.0
"""Flatter is settled; between both it stays what it was."""

WINDOW_S = 30.0
"""TDC is followed over this time [s]."""

_SPAN_MIN_S = 10.0
_POINT_S = 1.0


class WarmUp:
    """Follows TDC of one sensor."""

    def __init__(self) -> None:
        self.warming = False
        """Whether it is warming up, as far as is known."""
        self.slope_counts_per_min: float | None = None
        """Slope of TDC; None = not known yet."""
        self._points: deque[tuple[float, float]] = deque()
        self._sum = 0.0
        self._count = 0
        self._since_s: float | None = None

    def begin(self) -> None:
        """Begin anew: the sensor was touched, or was away. What is known stays."""
        self._points.clear()
        self._sum, self._count, self._since_s = 0.0, 0, None

    def add(self, time_s: float, tdc: float) -> None:
        """Take the mean of a block.

        Args:
            time_s: When [s].
            tdc: Mean raw TDC [counts].
        """
        if self._since_s is None or not 0.0 <= time_s - self._since_s < WINDOW_S:
            self.begin()
            self._since_s = time_s
        self._sum += tdc
        self._count += 1
        if time_s - self._since_s < _POINT_S:
            return
        self._points.append((0.5 * (time_s + self._since_s), self._sum / self._count))
        self._sum, self._count, self._since_s = 0.0, 0, time_s
        while self._points[-1][0] - self._points[0][0] > WINDOW_S:
            self._points.popleft()
        if self._points[-1][0] - self._points[0][0] >= _SPAN_MIN_S:
            self._judge()

    def _judge(self) -> None:
        times, values = np.array(self._points).T
        times = times - times.mean()
        slope = 60.0 * float(times @ (values - values.mean()) / (times @ times))
        self.slope_counts_per_min = slope
        if abs(slope) > WARMING_COUNTS_PER_MIN:
            self.warming = True
        elif abs(slope) < SETTLED_COUNTS_PER_MIN:
            self.warming = False
