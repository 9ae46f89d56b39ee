"""Stalls of the host and losses of frames, told apart by the stamps of a steady stream.

Delay only ever adds (hardware reference 5.2): what comes late and is then made up for was held up;
a silence that is not made up for is a loss.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from palpate.gateway.protocols.places import Floats

_GAP_S = 5e-3
"""Silence that is worth a thought; stamps of a bus scatter by 1 ms (hardware reference 5.1) [s]."""

_PROGRESS_S = 1.5e-3
"""Delays that fall by more than stamps scatter show that a stall is being made up for [s]."""

_ENVELOPE_S = 0.1
"""How long the least delay is remembered [s]."""

_SETTLE_S = 20e-3
"""A host makes up for a stall faster than this, or shows that it is doing so [s]."""


class Loss(NamedTuple):
    """What a slot shows to be gone before it.

    Attributes:
        frames: Whole frames.
        shift_s: How much later than on the old grid the slots come now [s], by up to half a frame:
            a sender that paused need not have kept its pace.
    """

    frames: int
    shift_s: float


NO_LOSS = Loss(0, 0.0)


@dataclass(slots=True)
class _Gap:
    """A silence that is not yet judged.

    Attributes:
        until_s: When to judge it, unless its delay still falls [s].
        stall_s: Delay beyond the usual at its end [s].
        least_s: Least delay since [s].
        mark_s: The least delay when ``until_s`` was set [s].
    """

    until_s: float
    stall_s: float
    least_s: float
    mark_s: float


class Silences:
    """Judges the silences of one run.

    A silence is judged at once where the order of the slots is broken too and the host has not
    stalled alike before; else after two frames (at least 20 ms), at the edge of a frame.

    Args:
        frame_s: Duration of a frame [s].
        stamp_s: Stamp of the first slot [s]; its delay counts as 0.
    """

    def __init__(self, frame_s: float, stamp_s: float) -> None:
        self._frame_s = frame_s
        self._worth_s = max(frame_s, _GAP_S)
        self._settle_s = max(2 * frame_s, _SETTLE_S)
        self._last_s = stamp_s
        self._lows = [0.0, 0.0]  # least delays, now and before
        self._lows_until_s = stamp_s + _ENVELOPE_S
        self._gap: _Gap | None = None
        self._stall_s = 0.0  # longest silence that was made up for

    @property
    def usual_s(self) -> float:
        """Least delay of late [s]."""
        return min(self._lows)

    def judge(self, stamp_s: float, delay_s: float, *, broken: bool, edge: bool) -> Loss:
        """Take a slot; return what is now known to be gone before it.

        Args:
            stamp_s: Its stamp [s].
            delay_s: Its stamp less its time on the grid [s]; a loss moves the grid.
            broken: Its place is certain, and slots are missing before it.
            edge: Its place is certain, and it is the first of a frame.
        """
        silence_s = stamp_s - self._last_s
        self._last_s = stamp_s
        usual_s = self.usual_s
        if self._gap is None:
            if silence_s < self._worth_s:
                self._remember(stamp_s, delay_s)
                return NO_LOSS
            until_s = stamp_s + self._settle_s
            self._gap = _Gap(until_s, delay_s - usual_s, delay_s, delay_s)
        gap = self._gap
        gap.least_s = min(gap.least_s, delay_s)
        if gap.least_s - usual_s < self._worth_s / 2:
            self._stall_s = max(self._stall_s, gap.stall_s)
            self._begin(stamp_s, gap.least_s)
            return NO_LOSS
        # It is being made up for; or who makes up for it was held up again.
        if gap.least_s < gap.mark_s - _PROGRESS_S or silence_s >= self._worth_s:
            gap.mark_s = min(gap.mark_s, gap.least_s)
            gap.until_s = stamp_s + self._settle_s
        at_once = broken and delay_s - usual_s >= max(0.75 * self._worth_s, 2 * self._stall_s)
        if not at_once and (stamp_s < gap.until_s or not edge):
            return NO_LOSS
        late_s = delay_s if at_once else gap.least_s
        frames = math.floor((late_s - usual_s) / self._frame_s + 0.5)
        self._begin(stamp_s, usual_s)
        return Loss(frames, late_s - usual_s - frames * self._frame_s)

    def pass_over(self, stamps_s: Floats, delays_s: Floats) -> bool:
        """Take slots of an unbroken order at once, if none of them is worth a thought.

        Args:
            stamps_s: Their stamps [s], one at least.
            delays_s: Their stamps less their times on the grid [s].

        Returns:
            False if they must be judged one by one; then none was taken.
        """
        if self._gap is not None or stamps_s.max() >= self._lows_until_s:
            return False
        if stamps_s[0] - self._last_s >= self._worth_s:
            return False
        if len(stamps_s) > 1 and (stamps_s[1:] - stamps_s[:-1]).max() >= self._worth_s:
            return False
        self._last_s = float(stamps_s[-1])
        self._lows[0] = min(self._lows[0], float(delays_s.min()))
        return True

    def _begin(self, stamp_s: float, delay_s: float) -> None:
        self._gap = None
        self._lows = [delay_s, delay_s]
        self._lows_until_s = stamp_s + _ENVELOPE_S

    def _remember(self, stamp_s: float, delay_s: float) -> None:
        if stamp_s >= self._lows_until_s:
            self._lows = [delay_s, self._lows[0]]
            self._lows_until_s = stamp_s + _ENVELOPE_S
        else:
            self._lows[0] = min(self._lows[0], delay_s)
