"""The condition of one sensor, from its frames: what its gateway says of it beside them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from palpate.messages import ChannelFault, ElectrodeFrame, FaultKind, FrameLayout, Tare
from palpate_gateway.condition.blocks import Block, Blocks
from palpate_gateway.condition.channel_health import ChannelHealth, describe
from palpate_gateway.condition.stillness import (
    WINDOW_BLOCKS,
    StillLimits,
    evidence_of_blocks,
)
from palpate_gateway.condition.untouched import Touch, UntouchedLevel
from palpate_gateway.condition.warm_up import WarmUp

DRIFT_COUNTS = 10.0
"""A baseline that is further off is old [counts]: twice the noise of one frame."""

_UNTRUE = (FaultKind.DEAD, FaultKind.STUCK)
"""Faults that make frames wrong without showing in the frames."""


@dataclass(frozen=True, slots=True)
class Retare:
    """When a gateway tares again by itself.

    Attributes:
        after_s: The sensor has been untouched for this long [s].
        drift_counts: An electrode has drifted from the tare by more than this [counts].
    """

    after_s: float
    drift_counts: float = DRIFT_COUNTS


class Condition:
    """Watches one sensor; belongs to the thread that reads it, but for ``gauges``.

    Args:
        layout: Of its frames.
        rate_hz: Frames per second [Hz].
        limits: What a still sensor does not exceed.
        retare: When to tare again without being asked; None = never.
    """

    def __init__(
        self,
        layout: FrameLayout,
        rate_hz: float,
        limits: StillLimits,
        retare: Retare | None = None,
    ) -> None:
        self._limits, self._retare = limits, retare
        self._blocks = Blocks(layout, rate_hz)
        self._recent: deque[Block] = deque(maxlen=WINDOW_BLOCKS)
        self._level = UntouchedLevel(layout.electrodes)
        self._channels = ChannelHealth(layout.electrodes)
        self._warm_up = WarmUp()
        self._untouched_since_s: float | None = None
        self._now_s = 0.0
        self._tared_s: float | None = None
        self._gauges: dict[str, float] = {}
        self.motion = "not enough frames yet"
        """What speaks against a sensor that is still; empty = it is."""

    @property
    def touch(self) -> Touch:
        """What is known of touches."""
        return self._level.touch

    @property
    def warming(self) -> bool:
        """Whether the core is warming up, as far as is known."""
        return self._warm_up.warming

    @property
    def faults(self) -> tuple[ChannelFault, ...]:
        """Channels that are not to be trusted."""
        return self._channels.faults

    @property
    def untrue(self) -> bool:
        """Whether a channel tells what is not so."""
        return any(fault.kind in _UNTRUE for fault in self.faults)

    @property
    def counters(self) -> dict[str, int]:
        """How often channels failed."""
        return dict(self._channels.counters)

    @property
    def wants_tare(self) -> bool:
        """Whether the rules say to tare now, without being asked."""
        rules, since_s = self._retare, self._untouched_since_s
        if rules is None or since_s is None:
            return False
        return (
            self._now_s - since_s >= rules.after_s
            and self._level.drift_counts > rules.drift_counts
            and not self.faults
        )

    @property
    def message(self) -> str:
        """One line for people; empty = nothing to say."""
        told = [describe(self.faults)] if self.faults else []
        if self.warming and self._warm_up.slope_counts_per_min is not None:
            told.append("warming up, so the baseline drifts: tare before you measure")
        level = self._level
        if level.touch is Touch.UNTOUCHED and level.drift_counts > DRIFT_COUNTS:
            told.append(f"E{level.drift_electrode + 1} has drifted from the tare: tare again")
        elif level.touch is Touch.HELD:
            told.append("still, but not where it rested: it is held, or has to be tared again")
        return "; ".join(told)

    def gauges(self) -> dict[str, float]:
        """Present values; from any thread."""
        return dict(self._gauges)

    def begin(self) -> None:
        """The device was opened, or opened again: what was between is not known."""
        self._blocks.begin()
        self._recent.clear()
        self._channels.begin()
        self._warm_up.begin()
        self._moved("not enough frames yet")

    def tared(self, tare: Tare) -> None:
        """A tare was taken; its time is that of its last frame."""
        self._level.tared(tare)
        self._tared_s = tare.stamp.monotonic_ns * 1e-9
        self._untouched_since_s = None
        self._tell()

    def add(self, frame: ElectrodeFrame) -> bool:
        """Take a frame; whether anything was judged anew."""
        block = self._blocks.add(frame)
        if block is None:
            return False
        self._now_s = block.time_s
        self._recent.append(block)
        self._judge_rest(block)
        untouched = self._level.touch is Touch.UNTOUCHED
        self._channels.add(block, untouched=untouched)
        if untouched or (self._level.touch is Touch.UNKNOWN and not self.motion):
            if block.slow_seen[2]:
                self._warm_up.add(block.time_s, block.tdc_mean)
        else:
            self._warm_up.begin()
        self._tell()
        return True

    def _judge_rest(self, block: Block) -> None:
        usable = self._channels.usable
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
        self._level.rests_at(mean, sum(one.pdc_mean for one in self._recent) / count, usable)
        if self._level.touch is not Touch.UNTOUCHED:
            self._untouched_since_s = None
        elif self._untouched_since_s is None:
            self._untouched_since_s = block.time_s

    def _moved(self, motion: str) -> None:
        self.motion = motion
        self._level.moved()
        self._untouched_since_s = None

    def _tell(self) -> None:
        gauges = self._channels.gauges()
        gauges["warm_up"] = float(self._warm_up.warming)
        if self._warm_up.slope_counts_per_min is not None:
            gauges["tdc_slope_counts_per_min"] = self._warm_up.slope_counts_per_min
        if self._tared_s is not None:
            gauges["tare_age_s"] = max(self._now_s - self._tared_s, 0.0)
            gauges["tare_drift_counts"] = self._level.drift_counts
        self._gauges = gauges
