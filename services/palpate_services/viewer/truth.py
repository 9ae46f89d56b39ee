"""Estimates matched with the truth of their instant, and what they are off by.

A force/torque sensor and a robot have clocks of their own, so that they hardly ever measure at the
very instant of a frame. Between two of their readings the truth is interpolated, as ``palpate data
ingest`` does.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from palpate.alignment import GAP_PERIODS
from palpate.messages import FeatureEstimate, IndenterPoseFrame, Stamp, WrenchFrame

Values = npt.NDArray[Any]
Reading = TypeVar("Reading", WrenchFrame, IndenterPoseFrame)

REMEMBERED = 2048
"""Readings of each kind for which a later message may ask: 2 s at 1 kHz, 2 MB."""

LEAST_N = 0.1
"""A smaller force [N] is mostly noise: it says neither a touch nor where it acts."""

_RECENT = 16
"""Readings whose distances say the period of a stream."""


@dataclass(slots=True)
class MatchedMessages:
    """Truth and estimate of one sensor at one instant; what lies between readings is interpolated.

    An indenter's orientation, which nothing here needs, is that of the nearer reading.

    Attributes:
        wrench: True wrench; None = not known, or not yet.
        pose: True pose of the indenter; None = not known, or not yet.
        estimate: Estimate; None where there is only the truth.
    """

    wrench: WrenchFrame | None = None
    pose: IndenterPoseFrame | None = None
    estimate: FeatureEstimate | None = None

    @property
    def touched(self) -> bool | None:
        """Whether the indenter touches; None = not known.

        Where the source of the pose cannot know (a robot), the true force says it.
        """
        if self.pose is not None and self.pose.in_contact is not None:
            return self.pose.in_contact
        return None if self.wrench is None else bool(np.linalg.norm(self.wrench.force) >= LEAST_N)

    @property
    def true_location(self) -> Values | None:
        """Where the indenter touches [m], shape ``(3,)``; None = it does not, or not known."""
        return self.pose.position if self.pose is not None and self.touched else None

    def force_error(self) -> Values | None:
        """Estimate minus truth [N], shape ``(3,)``; None without both."""
        if self.estimate is None or self.wrench is None:
            return None
        return self.estimate.force.astype(np.float64) - self.wrench.force

    def location_error(self) -> Values | None:
        """Estimate minus truth [m], shape ``(3,)``; None without both, or without contact."""
        truth = self.true_location
        if self.estimate is None or self.estimate.contact_location is None or truth is None:
            return None
        return self.estimate.contact_location.astype(np.float64) - truth


class TruthMatcher:
    """Finds the true wrench and pose of each estimate, and the true wrench of each pose.

    Messages of one kind come in order of time; which kind comes first does not matter.

    Args:
        remember: Readings of each kind that are kept; the oldest are forgotten first. None = all.
    """

    def __init__(self, remember: int | None = REMEMBERED) -> None:
        self._wrenches = _Readings(_wrench_between, remember)
        self._poses = _Readings(_pose_between, remember)

    def add(
        self, message: WrenchFrame | IndenterPoseFrame | FeatureEstimate
    ) -> list[MatchedMessages]:
        """Add a message; returns the match of this estimate or pose, and those it adds truth to."""
        if isinstance(message, WrenchFrame):
            wrenches = self._wrenches.add(message)
            for match, wrench in wrenches:
                match.wrench = wrench
            return [match for match, _ in wrenches]
        if isinstance(message, IndenterPoseFrame):
            poses = self._poses.add(message)
            for match, pose in poses:
                match.pose = pose
            own = MatchedMessages(pose=message)
            own.wrench = self._wrenches.at(message.stamp, own)
            return [own, *(match for match, _ in poses)]
        own = MatchedMessages(estimate=message)
        own.wrench = self._wrenches.at(message.source, own)
        own.pose = self._poses.at(message.source, own)
        return [own]


class _Readings(Generic[Reading]):
    """Readings of one stream of truth in order of time, and matches that wait for the next one."""

    def __init__(
        self, between: Callable[[Stamp, Reading, Reading, float], Reading], remember: int | None
    ) -> None:
        self._between: Callable[[Stamp, Reading, Reading, float], Reading] = between
        self._remember = remember
        self._kept: list[Reading] = []
        # Of poses and of estimates (True), which may be stamped by clocks that are far apart.
        self._waiting: dict[bool, deque[tuple[Stamp, MatchedMessages]]] = {
            kind: deque(maxlen=remember) for kind in (False, True)
        }

    def add(self, reading: Reading) -> list[tuple[MatchedMessages, Reading]]:
        """Keep a reading; returns matches that have waited for it, each with its truth."""
        if self._kept:
            last, now = self._kept[-1].stamp, reading.stamp
            if now.clock_id != last.clock_id or _apart_ns(now, last) < 0:
                self._kept.clear()  # another host, or a record that is replayed again
                for waiting in self._waiting.values():
                    waiting.clear()
        self._kept.append(reading)
        if self._remember is not None and len(self._kept) > 2 * self._remember:
            del self._kept[: -self._remember]
        known = []
        for waiting in self._waiting.values():
            while waiting and _apart_ns(reading.stamp, waiting[0][0]) >= 0:
                stamp, match = waiting.popleft()
                if (truth := self._find(stamp)) is not None:
                    known.append((match, truth))
        return known

    def at(self, stamp: Stamp, match: MatchedMessages) -> Reading | None:
        """The truth at an instant; where the stream has not come so far, the match waits for it."""
        truth = self._find(stamp)
        if truth is None and (not self._kept or _apart_ns(stamp, self._kept[-1].stamp) > 0):
            self._waiting[match.estimate is not None].append((stamp, match))
        return truth

    def _find(self, stamp: Stamp) -> Reading | None:
        """The reading of an instant, or one between its neighbours; None = there is none."""
        after = bisect_right(self._kept, 0, key=lambda one: _apart_ns(one.stamp, stamp))
        if not after:
            return None
        past_ns = _apart_ns(stamp, self._kept[after - 1].stamp)
        if past_ns == 0:
            return self._kept[after - 1]
        if after == len(self._kept):
            return None
        recent = self._kept[max(0, after - _RECENT) : after + 1]
        gaps_ns = [_apart_ns(late.stamp, early.stamp) for early, late in pairwise(recent)]
        # Readings that arrive together and share a time have no gap between them.
        period_ns = median([gap for gap in gaps_ns if gap > 0] or [0])
        gap_ns = gaps_ns[-1]
        if not past_ns < gap_ns <= GAP_PERIODS * period_ns:
            return None
        return self._between(stamp, recent[-2], recent[-1], past_ns / gap_ns)


def _apart_ns(late: Stamp, early: Stamp) -> int:
    """From one stamp to another [ns]: by the monotonic clock of one host, else by wall clocks."""
    if late.clock_id == early.clock_id:
        return late.monotonic_ns - early.monotonic_ns
    return late.wall_ns - early.wall_ns


def _wrench_between(
    stamp: Stamp, before: WrenchFrame, after: WrenchFrame, share: float
) -> WrenchFrame:
    return replace(
        before,
        stamp=stamp,
        force=before.force + np.float32(share) * (after.force - before.force),
        torque=before.torque + np.float32(share) * (after.torque - before.torque),
        overload=before.overload or after.overload,
    )


def _pose_between(
    stamp: Stamp, before: IndenterPoseFrame, after: IndenterPoseFrame, share: float
) -> IndenterPoseFrame:
    nearer = before if share < 0.5 else after
    known = before.in_contact is not None and after.in_contact is not None
    return replace(
        nearer,
        stamp=stamp,
        position=before.position + share * (after.position - before.position),
        in_contact=nearer.in_contact if known else None,
    )
