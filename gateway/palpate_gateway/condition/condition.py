"""The condition of one sensor, judged from its frames: untouched, warm, intact.

Stillness alone does not show that a sensor is untouched, for a constant press is still too; the way
to the present level does. As long as nothing moves, the sensor stays untouched and a change of its
level is drift. After a movement it is untouched again only if it rests at its former level, apart
from the effects of heat and of a relaxing skin: these change all electrodes alike and the pressure
little, whereas a press changes some electrodes, and the pressure much.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from palpate import clock
from palpate.messages import ChannelFault, ElectrodeFrame, FaultKind, FrameLayout, Stamp, Tare
from palpate_gateway.condition.channel_health import ChannelHealth, describe
from palpate_gateway.condition.stillness import (
    WINDOW_BLOCKS,
    Floats,
    FrameBlock,
    FrameBlocks,
    StillLimits,
    evidence_of_blocks,
)

EVEN_COUNTS, EVEN_SHARE = 25.0, 0.2
"""Drift changes no electrode by more than the median change, give or take this many counts and this
share of the median. Real untouched sensors drifted by 169 counts in three minutes, and no electrode
differed from the median by more than 31; a hand that held a finger lightly changed some electrodes
by 230 and the median by 3."""

PDC_BAND_COUNTS = 40.0
"""Drift changes PDC by less [counts]; a hand that held the finger lightly changed it by 330."""

_Usable = npt.NDArray[np.bool_]


class TouchState(Enum):
    """Whether a sensor is touched, as far as is known."""

    UNKNOWN = "not tared yet"
    UNTOUCHED = "untouched"
    MOVING = "touched or moving"
    HELD = "still, but not where it rested untouched"


class UntouchedLevel:
    """The level of the untouched sensor, and how far it has drifted from the tare."""

    def __init__(self) -> None:
        self.touch = TouchState.UNKNOWN
        """Whether the sensor is touched, as far as is known."""
        self._level: tuple[Floats, float] | None = None
        self._tare: tuple[Floats, float] | None = None
        self.drift_counts = 0.0
        """Largest difference of an electrode from the tare, when last untouched [counts]."""
        self.drift_electrode = 0
        """That electrode, from 0."""

    def tared(self, tare: Tare) -> None:
        """A tare was taken: the present level is that of the untouched sensor."""
        self._tare = self._level = tare.electrodes.astype(np.float64), tare.pdc
        self.drift_counts = 0.0

    def moved(self) -> None:
        """The sensor is not still."""
        if self.touch is not TouchState.UNKNOWN or self._tare is not None:
            self.touch = TouchState.MOVING

    def rests_at(self, electrodes: Floats, pdc: float, usable: _Usable) -> None:
        """The sensor is still.

        Args:
            electrodes: Mean raw counts, shape ``(E,)``.
            pdc: Mean raw PDC [counts].
            usable: Electrodes to be used, bool, shape ``(E,)``; at least one.
        """
        if self._level is None or self._tare is None:
            return
        if self.distance(electrodes, pdc, usable):
            self.touch = TouchState.HELD
            return
        self.touch = TouchState.UNTOUCHED
        self._level = np.where(usable, electrodes, self._level[0]), pdc
        distance = np.where(usable, np.abs(electrodes - self._tare[0]), 0.0)
        self.drift_electrode = int(np.argmax(distance))
        self.drift_counts = float(distance[self.drift_electrode])

    def distance(self, electrodes: Floats, pdc: float, usable: _Usable) -> str:
        """A few words on how far this is from the untouched sensor, by more than drift explains.

        Empty = drift explains it, or nothing is known of the untouched sensor; as ``rests_at``
        otherwise.
        """
        # Near the last untouched level, and near the tare: small steps must not add up to a press.
        for from_, level in (("where it last rested", self._level), ("the tare", self._tare)):
            if level is None:
                continue
            change, pdc_change = electrodes - level[0], pdc - level[1]
            if not is_drift(change, pdc_change, usable):
                worst = int(np.argmax(np.where(usable, np.abs(change), 0.0)))
                return (
                    f"E{worst + 1} is {abs(change[worst]):.0f} counts from {from_}, and PDC "
                    f"{abs(pdc_change):.0f}"
                )
        return ""


def is_drift(change: Floats, pdc_change: float, usable: _Usable) -> bool:
    """Whether a change of level can be drift of an untouched sensor.

    Args:
        change: Change of the electrodes [counts], shape ``(E,)``.
        pdc_change: Change of PDC [counts].
        usable: Electrodes to be used, bool, shape ``(E,)``.
    """
    # Plain Python is faster than NumPy for so few numbers.
    looked_at = sorted(change[usable].tolist())
    common = looked_at[len(looked_at) // 2]
    uneven = max(looked_at[-1] - common, common - looked_at[0])
    even: bool = uneven <= EVEN_COUNTS + EVEN_SHARE * abs(common)
    return even and abs(pdc_change) <= PDC_BAND_COUNTS


WARMING_COUNTS_PER_MIN = 30.0
"""A steeper slope is warming up: the settled sensor of the public capture has 7 untouched, and a
sensor that warms by 10 degrees in half an hour starts with twice this."""

SETTLED_COUNTS_PER_MIN = 15.0
"""A flatter slope is settled; between both limits the state does not change."""

WINDOW_S = 30.0
"""The slope of TDC is taken over this time [s]."""

_SPAN_MIN_S = 10.0
_POINT_S = 1.0


class WarmUp:
    """Whether the core is still warming up: the slope of TDC while nothing touches the sensor.

    The core is heated; until its temperature has settled the electrodes drift (hardware reference
    4.3). Sources disagree on degrees per count of TDC (1.9), so slopes are given in counts.
    """

    def __init__(self) -> None:
        self.warming = False
        """Whether it is warming up; keeps its value while the slope is unknown."""
        self.slope_counts_per_min: float | None = None
        """Slope of TDC; None = unknown so far."""
        self._points: deque[tuple[float, float]] = deque()
        self._sum = 0.0
        self._count = 0
        self._since_s: float | None = None

    def begin(self) -> None:
        """Start a new slope: the sensor was touched or lost. The last judgement stays."""
        self._points.clear()
        self._sum, self._count, self._since_s = 0.0, 0, None

    def add(self, time_s: float, tdc: float) -> None:
        """Take the time [s] and the mean raw TDC [counts] of a block."""
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


DRIFT_COUNTS = 10.0
"""A baseline that is off by more is outdated [counts]: twice the noise of one frame."""

_WRONG = (FaultKind.DEAD, FaultKind.STUCK)
"""Faults whose counts are wrong although they are marked valid."""


@dataclass(frozen=True, slots=True)
class RetareRules:
    """When a sensor is tared again without a request.

    Attributes:
        after_s: The sensor has been untouched for this long [s].
        drift_counts: An electrode has drifted from the tare by more than this [counts].
    """

    after_s: float
    drift_counts: float = DRIFT_COUNTS


class Condition:
    """Judges one sensor. Belongs to the thread that reads it; only ``gauges`` is for any thread.

    Args:
        layout: Layout of its frames.
        rate_hz: Frames per second.
        limits: Noise up to which the sensor counts as still.
        retare: When to tare again without a request; None = never.
        unfilled: Channels other than electrodes that its driver never fills.
    """

    def __init__(
        self,
        layout: FrameLayout,
        rate_hz: float,
        limits: StillLimits,
        retare: RetareRules | None = None,
        *,
        unfilled: Collection[str] = (),
    ) -> None:
        self._limits, self._retare = limits, retare
        self._blocks = FrameBlocks(layout, rate_hz)
        self._recent: deque[FrameBlock] = deque(maxlen=WINDOW_BLOCKS)
        self.level = UntouchedLevel()
        self.channels = ChannelHealth(layout.electrodes, unfilled)
        self.warm_up = WarmUp()
        self._untouched_since_s: float | None = None
        self._now_s = 0.0
        self._tared: Stamp | None = None
        self._gauges: dict[str, float] = {}
        self.motion = "not enough frames yet"
        """Why the sensor does not count as still; empty = it is still."""

    @property
    def faults(self) -> tuple[ChannelFault, ...]:
        """Channels whose counts are not to be used."""
        return self.channels.faults

    @property
    def has_wrong_channel(self) -> bool:
        """Whether a channel delivers wrong counts."""
        return any(fault.kind in _WRONG for fault in self.faults)

    @property
    def wants_tare(self) -> bool:
        """Whether the rules ask for a tare now."""
        rules, since_s = self._retare, self._untouched_since_s
        if rules is None or since_s is None:
            return False
        return (
            self._now_s - since_s >= rules.after_s
            and self.level.drift_counts > rules.drift_counts
            and not self.faults
        )

    @property
    def message(self) -> str:
        """One line for the status; empty = all is well."""
        parts = [describe(self.faults)] if self.faults else []
        if self.warm_up.warming and self.warm_up.slope_counts_per_min is not None:
            parts.append("warming up, so the baseline drifts: tare before you measure")
        level = self.level
        if level.touch is TouchState.UNTOUCHED and level.drift_counts > DRIFT_COUNTS:
            parts.append(f"E{level.drift_electrode + 1} has drifted from the tare: tare again")
        elif level.touch is TouchState.HELD:
            parts.append("still, but not where it rested: it is held, or has to be tared again")
        return "; ".join(parts)

    def gauges(self) -> dict[str, float]:
        """Present values; may be called from any thread."""
        gauges = dict(self._gauges)
        if (tared := self._tared) is not None:
            # A tare ages while no frame comes, too; in a file's time the frames say what is now.
            live = tared.clock_id == clock.CLOCK_ID
            now_s = time.monotonic() if live else self._now_s
            gauges["tare_age_s"] = max(now_s - tared.monotonic_ns * 1e-9, 0.0)
        return gauges

    def begin(self, *, exchanged: bool = False) -> None:
        """The device was opened, or opened again: what happened in between is unknown.

        ``exchanged`` = it is another finger: nothing is known of its level.
        """
        if exchanged:
            self.level, self._tared = UntouchedLevel(), None
        self._blocks.begin()
        self._recent.clear()
        self.channels.begin()
        self.warm_up.begin()
        self._moved("not enough frames yet")

    def tared(self, tare: Tare) -> None:
        """A tare was taken; its time is that of its last frame."""
        self.level.tared(tare)
        self._tared = tare.stamp
        self._untouched_since_s = None
        self._tell()

    def distance(self, tare: Tare) -> str:
        """How far a tare is from the untouched sensor, by more than drift; see ``UntouchedLevel``.

        Empty also where no electrode is usable: nothing can be said then.
        """
        usable = self.channels.usable
        electrodes = tare.electrodes.astype(np.float64)
        return self.level.distance(electrodes, tare.pdc, usable) if usable.any() else ""

    def add(self, frame: ElectrodeFrame) -> bool:
        """Take a frame; whether a block was full, so that the condition was judged again."""
        block = self._blocks.add(frame)
        if block is None:
            return False
        self._now_s = block.time_s
        self._recent.append(block)
        self._judge_rest(block)
        untouched = self.level.touch is TouchState.UNTOUCHED
        self.channels.add(block, untouched=untouched)
        if untouched or (self.level.touch is TouchState.UNKNOWN and not self.motion):
            if block.slow_seen[2]:
                self.warm_up.add(block.time_s, block.tdc_mean)
        else:
            self.warm_up.begin()
        self._tell()
        return True

    def _judge_rest(self, block: FrameBlock) -> None:
        usable = self.channels.usable
        if len(self._recent) < WINDOW_BLOCKS or not usable.any():
            self._moved(self.motion)
            return
        motion = evidence_of_blocks(self._recent, usable).motion(self._limits)
        if motion:
            self._moved(motion)
            return
        self.motion = ""
        count = len(self._recent)
        mean = np.add.reduce([one.mean for one in self._recent]) / count
        self.level.rests_at(mean, sum(one.pdc_mean for one in self._recent) / count, usable)
        if self.level.touch is not TouchState.UNTOUCHED:
            self._untouched_since_s = None
        elif self._untouched_since_s is None:
            self._untouched_since_s = block.time_s

    def _moved(self, motion: str) -> None:
        self.motion = motion
        self.level.moved()
        self._untouched_since_s = None

    def _tell(self) -> None:
        gauges = self.channels.gauges()
        gauges["warm_up"] = float(self.warm_up.warming)
        if self.warm_up.slope_counts_per_min is not None:
            gauges["tdc_slope_counts_per_min"] = self.warm_up.slope_counts_per_min
        if self._tared is not None:
            gauges["tare_drift_counts"] = self.level.drift_counts
        self._gauges = gauges
