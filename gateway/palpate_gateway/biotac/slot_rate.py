"""Whether slots come at the rate by which their times are counted."""

from __future__ import annotations

_TOLERANCE = 0.02
"""Relative tolerance of the rate: a clock that is wrong by less is followed, see ``LiveClock``."""

_ALIKE = 0.005
"""Measurements that differ by less agree."""

_AGREED = 6
"""So many in a row must agree: a sender that cannot keep up may look steady for a few."""

RATE_S = 0.4
"""Time over which the rate is measured until it was right once [s]: stamps scatter by 1 ms."""

_LATER_S = 4.0
"""Time over which it is measured then [s]: now and then a host or a sender stands still."""


class SlotRate:
    """Measures the rate of slots, again and again.

    Args:
        rate_hz: The rate that is expected [Hz].
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._first: tuple[int, int, float] | None = None
        self._wrong_hz: list[float] = []
        self.right = False
        """Whether it has been right once."""

    def begin(self) -> None:
        """Begin anew to count slots."""
        self._first, self._wrong_hz = None, []

    def follow(self, placed: int, lost: int, stamp_s: float) -> float | None:
        """Take the newest slot; the measured rate [Hz] if it is wrong, else None.

        A pause looks like a low rate, so six measurements in a row must agree; none of them may
        hold a loss, for then whole frames may have been lost, too.

        Args:
            placed: Number of slots up to it.
            lost: Number of those known to be lost up to it.
            stamp_s: Its stamp [s].
        """
        first = self._first
        if first is None or lost != first[1]:
            self._first, self._wrong_hz = (placed, lost, stamp_s), []
            return None
        waited_s = stamp_s - first[2]
        if waited_s < (_LATER_S if self.right else RATE_S):
            return None
        self._first = placed, lost, stamp_s
        measured_hz = (placed - first[0]) / waited_s
        if abs(measured_hz / self._rate_hz - 1.0) <= _TOLERANCE:
            self.right, self._wrong_hz = True, []
            return None
        wrong_hz = [*self._wrong_hz, measured_hz]
        self._wrong_hz = [one for one in wrong_hz if abs(one / measured_hz - 1.0) <= _ALIKE]
        return measured_hz if len(self._wrong_hz) == _AGREED else None
