"""Truth and estimate of the same frame, side by side as they arrive."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate import clock
from palpate.bus import Delivery, Session, Subscriber
from palpate.bus.topics import FEATURES, POSE, WRENCH
from palpate.errors import StreamTimeout
from palpate.messages import FeatureEstimate, IndenterPoseFrame, WrenchFrame

_KEPT = 500
"""Truths that wait for their estimate; five seconds at 100 Hz."""

Vector = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Streams:
    """What is compared."""

    features: Subscriber[FeatureEstimate]
    wrench: Subscriber[WrenchFrame]
    pose: Subscriber[IndenterPoseFrame]


@dataclass(frozen=True, slots=True)
class Moment:
    """One frame: forces [N], locations [m], each of shape ``(3,)``; None where there is none."""

    force: Vector
    true_force: Vector
    location: Vector | None
    true_location: Vector | None
    in_contact: bool
    age_s: float


@dataclass(frozen=True, slots=True)
class Medians:
    """Median errors: of the vectors' lengths and per axis, [N] and [m]; median age [s]."""

    force_n: float
    location_m: float
    force_axes_n: Vector
    location_axes_m: Vector
    age_s: float


class Comparison:
    """Matches estimates with the truth of the same instant and keeps the errors in contact."""

    def __init__(self) -> None:
        self.count = 0
        self.newest: Moment | None = None
        self._wrench: OrderedDict[int, WrenchFrame] = OrderedDict()
        self._pose: OrderedDict[int, IndenterPoseFrame] = OrderedDict()
        self._force_errors: list[Vector] = []
        self._location_errors: list[Vector] = []
        self._ages_s: list[float] = []

    def subscribe(self, session: Session, sensor: str, delivery: Delivery) -> Streams:
        """Subscribe to estimate and truth of a sensor."""
        return Streams(
            session.subscriber(FEATURES, sensor=sensor, delivery=delivery),
            session.subscriber(WRENCH, sensor=sensor, delivery=delivery),
            session.subscriber(POSE, sensor=sensor, delivery=delivery),
        )

    def take(self, streams: Streams, *, timeout_s: float) -> None:
        """Take in the next estimate and all truth that has come.

        Raises:
            StreamTimeout: No estimate came in time.
        """
        received = streams.features.next(timeout_s)
        self.add_truth(streams)
        self.add(received.message, received.received_monotonic_ns)

    def add_truth(self, streams: Streams) -> None:
        """Take in the truth that has come."""
        for wrench in _all(streams.wrench):
            _remember(self._wrench, wrench.stamp.monotonic_ns, wrench)
        for pose in _all(streams.pose):
            _remember(self._pose, pose.stamp.monotonic_ns, pose)

    def add(self, estimate: FeatureEstimate, received_ns: int) -> None:
        """Take in one estimate, received at ``received_ns`` of this host's monotonic clock."""
        self.count += 1
        age_s = clock.age_s(estimate.source, monotonic_ns=received_ns)
        self._ages_s.append(age_s)
        wrench = self._wrench.get(estimate.source.monotonic_ns)
        if wrench is None:
            return
        pose = self._pose.get(estimate.source.monotonic_ns)
        # Who cannot know whether it touches counts as one who does not say.
        touched = pose is None or pose.in_contact is not False
        moment = Moment(
            force=estimate.force,
            true_force=wrench.force,
            location=estimate.contact_location,
            true_location=pose.position if pose is not None and touched else None,
            in_contact=touched,
            age_s=age_s,
        )
        self.newest = moment
        if not touched:
            return
        self._force_errors.append(moment.force - moment.true_force)
        if moment.location is not None and moment.true_location is not None:
            self._location_errors.append(moment.location - moment.true_location)

    def medians(self) -> Medians:
        """Medians over all frames in contact so far; NaN where there were none."""
        force, location = _rows(self._force_errors), _rows(self._location_errors)
        return Medians(
            force_n=float(np.median(np.linalg.norm(force, axis=1))),
            location_m=float(np.median(np.linalg.norm(location, axis=1))),
            force_axes_n=np.median(np.abs(force), axis=0),
            location_axes_m=np.median(np.abs(location), axis=0),
            age_s=float(np.median(self._ages_s)) if self._ages_s else float("nan"),
        )


def _rows(errors: list[Vector]) -> Vector:
    return np.array(errors) if errors else np.full((1, 3), np.nan)


def _all(stream: Subscriber[Any]) -> list[Any]:
    found = []
    while True:
        try:
            found.append(stream.next(timeout_s=0).message)
        except StreamTimeout:
            return found


def _remember(known: OrderedDict[int, Any], key: int, value: Any) -> None:
    known[key] = value
    while len(known) > _KEPT:
        known.popitem(last=False)
