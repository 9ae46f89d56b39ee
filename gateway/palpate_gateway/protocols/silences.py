"""Stalls of the host and losses of frames, distinguished by the stamps of a steady stream.

Delays are never negative (hardware reference 5.2). After a stall of the host the late slots come in
a burst, and the delay returns to its usual value; after a loss it stays larger. A busy sender or
host falls behind and catches up in turns for a while, so a loss can be told only while the delays
are as steady as they were before it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

_GAP_S = 5e-3
"""Shorter silences are no loss; stamps of a bus scatter by 1 ms (hardware reference 5.1) [s]."""

_SCATTER_S = 1.5e-3
"""Delays whose spread exceeds the usual one by more than this are not steady [s]."""

_ENVELOPE_S = 0.1
"""The smallest delay is taken over this time and the one before [s]."""

_SPREADS = 30
"""The smallest spread in so many of these times is the usual one."""

_SETTLE_S = 20e-3
"""After a loss, delays must be steady for at least this time [s],"""

_LONGER = 10.0
"""and for this many times their usual spread: unsteady delays may be steady by chance."""

_PATIENCE_S = 2.0
"""No sender or host falls behind and catches up in turns for longer than this [s]."""


class FrameLoss(NamedTuple):
    """Loss directly before a slot.

    Attributes:
        frames: Whole frames.
        shift_s: How much later than on the old grid the slots come now [s], up to half a frame: a
            sender that paused need not stay on its grid.
    """

    frames: int
    shift_s: float


NO_LOSS = FrameLoss(0, 0.0)


@dataclass(slots=True)
class _Gap:
    """A silence that is not yet judged.

    Attributes:
        until_s: When to judge it, if delays are steady until then [s].
        stall_s: Delay beyond the usual one at its end [s].
        low_s: Smallest delay since the delays became steady [s].
        high_s: The largest [s].
        give_up_s: When to judge it even if delays are not steady [s].
        least_s: Smallest delay in the last half of the time until then [s].
    """

    until_s: float
    stall_s: float
    low_s: float
    high_s: float
    give_up_s: float
    least_s: float = math.inf

    def take(self, stamp_s: float, delay_s: float) -> None:
        """Look at a slot's delay [s]."""
        if self.give_up_s - stamp_s < _PATIENCE_S / 2:
            self.least_s = min(self.least_s, delay_s)
        self.low_s = min(self.low_s, delay_s)
        self.high_s = max(self.high_s, delay_s)


class Silences:
    """Judges the silences of one run.

    A silence is judged at once where the order of the slots is broken too and the host has not
    stalled for as long before. Otherwise it is judged at the beginning of a frame, when slots have
    come steadily for two frames (at least 20 ms, longer where they usually scatter), or after two
    seconds if they never do.

    Args:
        frame_s: Duration of a frame [s].
        stamp_s: Stamp of the first slot [s]; its delay counts as 0.
    """

    def __init__(self, frame_s: float, stamp_s: float) -> None:
        self._frame_s = frame_s
        self._gap_s = max(frame_s, _GAP_S)
        self._settle_s = max(2 * frame_s, _SETTLE_S)
        self._last_s = stamp_s
        self._lows = [0.0, 0.0]  # smallest delays, of this time and of the one before
        self._high_s = 0.0  # largest delay now
        self._spreads_s: deque[float] = deque(maxlen=_SPREADS)
        self._lows_until_s = stamp_s + _ENVELOPE_S
        self._gap: _Gap | None = None
        self._stall_s = 0.0  # longest stall whose slots all came

    @property
    def usual_s(self) -> float:
        """Smallest delay in the last tenths of a second [s]."""
        return min(self._lows)

    def judge(self, stamp_s: float, delay_s: float, *, broken: bool, edge: bool) -> FrameLoss:
        """Take a slot; return the loss before it, as soon as that is known.

        Args:
            stamp_s: Its stamp [s].
            delay_s: Its stamp less its time on the grid [s]; a loss moves the grid.
            broken: Its place is certain, and slots are missing before it.
            edge: Its place is certain, and it is the first of a frame.
        """
        silence_s = stamp_s - self._last_s
        self._last_s = stamp_s
        usual_s = self.usual_s
        if self._gap is None and silence_s < self._gap_s:
            self._remember(stamp_s, delay_s)
            return NO_LOSS
        spread_s = min(self._spreads_s, default=0.0)
        settle_s = self._settle_s + _LONGER * spread_s
        if self._gap is None:
            until_s, give_up_s = stamp_s + settle_s, stamp_s + _PATIENCE_S
            self._gap = _Gap(until_s, delay_s - usual_s, delay_s, delay_s, give_up_s)
        gap = self._gap
        gap.take(stamp_s, delay_s)
        if delay_s - usual_s < self._gap_s / 2:
            self._stall_s = max(self._stall_s, gap.stall_s)
            self._begin(stamp_s, delay_s)
            return NO_LOSS
        if silence_s >= self._gap_s or gap.high_s - gap.low_s > spread_s + _SCATTER_S:
            # The sender or host is catching up, or was held up again while it did.
            gap.low_s = gap.high_s = delay_s
            gap.until_s = stamp_s + settle_s
        # A broken order shows that slots were lost, so this silence is no mere stall; except where
        # the host has stalled for as long before, and both may have come together.
        at_once = broken and delay_s - usual_s >= max(0.75 * self._gap_s, 2 * self._stall_s)
        if not at_once and (stamp_s < min(gap.until_s, gap.give_up_s) or not edge):
            return NO_LOSS
        late_s = delay_s if at_once else gap.low_s if stamp_s >= gap.until_s else gap.least_s
        # What remains of the delay after whole frames moves the grid of slots.
        frames = math.floor((late_s - usual_s) / self._frame_s + 0.5)
        self._begin(stamp_s, usual_s)
        return FrameLoss(frames, late_s - usual_s - frames * self._frame_s)

    def pass_over(self, stamps_s: Floats, delays_s: Floats) -> bool:
        """Take slots of an unbroken order at once, if there is no silence among them.

        Args:
            stamps_s: Their stamps [s], one at least.
            delays_s: Their stamps less their times on the grid [s].

        Returns:
            False if they must be judged one by one; then none was taken.
        """
        if self._gap is not None or stamps_s[0] - self._last_s >= self._gap_s:
            return False
        if len(stamps_s) > 1 and (stamps_s[1:] - stamps_s[:-1]).max() >= self._gap_s:
            return False
        self._last_s = float(stamps_s[-1])
        late = stamps_s >= self._lows_until_s
        while late.any():
            first = int(late.argmax())
            if first:
                self._note(float(delays_s[:first].min()), float(delays_s[:first].max()))
            self._turn(float(stamps_s[first]), float(delays_s[first]))
            stamps_s, delays_s = stamps_s[first:], delays_s[first:]
            late = stamps_s >= self._lows_until_s
        self._note(float(delays_s.min()), float(delays_s.max()))
        return True

    def _begin(self, stamp_s: float, delay_s: float) -> None:
        self._gap = None
        self._lows = [delay_s, delay_s]
        self._high_s = delay_s
        self._lows_until_s = stamp_s + _ENVELOPE_S

    def _remember(self, stamp_s: float, delay_s: float) -> None:
        if stamp_s >= self._lows_until_s:
            self._turn(stamp_s, delay_s)
        else:
            self._note(delay_s, delay_s)

    def _note(self, low_s: float, high_s: float) -> None:
        self._lows[0] = min(self._lows[0], low_s)
        self._high_s = max(self._high_s, high_s)

    def _turn(self, stamp_s: float, delay_s: float) -> None:
        self._spreads_s.append(self._high_s - self._lows[0])
        self._lows = [delay_s, self._lows[0]]
        self._high_s = delay_s
        self._lows_until_s = stamp_s + _ENVELOPE_S
