"""Estimates of the demo compared with the truth: forces, locations, fields and electrodes."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate import clock
from palpate.bus import Delivery, Session, Subscriber
from palpate.bus.tares import TareBook
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, FIELD_TRUTH, POSE, SYNTHESIS, WRENCH
from palpate.errors import PalpateError, StreamTimeout
from palpate.messages import (
    NO_TARE,
    ElectrodeFrame,
    FieldEstimate,
    FieldFrame,
    SynthesisEstimate,
    Tare,
)
from palpate_services.viewer.touch_errors import TOUCHED_N
from palpate_services.viewer.truth import TruthMatcher

_KEPT = 500
"""Readings of the truth that an estimate may ask for: five seconds at 100 Hz."""

_WAITING = 200
"""Estimates and frames that wait for what they are compared with."""

MOVED_M = 0.05e-3
"""A skin counts as touched if its nodes move by more than this on average [m]."""

_TOUCHED_COUNTS = 40.0
"""The sensor counts as touched if one electrode moves by this: above noise and drift [counts]."""

Vector = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class TouchMoment:
    """One frame: forces [N], locations [m], each of shape ``(3,)``; None where there is none.

    ``bound`` is what the estimate says that its force may be off by [N].
    """

    force: Vector
    true_force: Vector
    location: Vector | None
    true_location: Vector | None
    in_contact: bool
    age_s: float
    bound: float | None = None


@dataclass(frozen=True, slots=True)
class TouchMedians:
    """Median errors of touched frames, per axis, [N] and [m]; median age of all estimates [s].

    ``held_share`` is the share of touched frames whose force's error is within its bound; None
    without bounds.
    """

    force_axes_n: Vector
    location_axes_m: Vector
    age_s: float
    held_share: float | None = None


class TouchComparison:
    """Matches estimates with the truth of the same instant; keeps the errors of touched frames."""

    def __init__(self) -> None:
        self.count = 0
        self.newest: TouchMoment | None = None
        self._matcher = TruthMatcher(_KEPT)
        self._truth: list[Subscriber[Any]] = []
        self._force_errors: list[Vector] = []
        self._location_errors: list[Vector] = []
        self._ages_s: list[float] = []
        self._held: list[bool] = []

    def subscribe(self, session: Session, sensor: str) -> None:
        """Subscribe to estimates and truth of a sensor."""
        self._features = session.subscriber(FEATURES, sensor=sensor, delivery=Delivery.QUEUE)
        self._truth = [
            session.subscriber(WRENCH, sensor=sensor, delivery=Delivery.QUEUE),
            session.subscriber(POSE, sensor=sensor, delivery=Delivery.QUEUE),
        ]

    def take(self, *, timeout_s: float) -> None:
        """Take the next estimate and all truth that has arrived.

        Raises:
            StreamTimeout: No estimate came in time.
        """
        received = self._features.next(timeout_s)
        # After the wait: the truth of this estimate was published before it.
        for stream in self._truth:
            for message in _all(stream):
                self._matcher.add(message)
        estimate = received.message
        self.count += 1
        age_s = clock.age_s(estimate.source, monotonic_ns=received.received_monotonic_ns)
        self._ages_s.append(age_s)
        (match,) = self._matcher.add(estimate)
        wrench, pose = match.wrench, match.pose
        if wrench is None:
            return
        # None = the source cannot tell; that counts as contact, as does a missing pose.
        touched = pose is None or pose.in_contact is not False
        moment = TouchMoment(
            force=estimate.force,
            true_force=wrench.force,
            location=estimate.contact_location,
            true_location=pose.position if pose is not None and touched else None,
            in_contact=touched,
            age_s=age_s,
            bound=None if estimate.bounds is None else estimate.bounds.force,
        )
        self.newest = moment
        if np.linalg.norm(moment.true_force) < TOUCHED_N:
            return
        self._force_errors.append(moment.force - moment.true_force)
        if moment.bound is not None:
            error_n = float(np.linalg.norm(self._force_errors[-1]))
            self._held.append(error_n <= moment.bound)
        if moment.location is not None and moment.true_location is not None:
            self._location_errors.append(moment.location - moment.true_location)

    def medians(self) -> TouchMedians:
        """Of all frames so far that are touched with ``TOUCHED_N``; NaN where there were none."""
        force, location = _rows(self._force_errors), _rows(self._location_errors)
        return TouchMedians(
            force_axes_n=np.median(np.abs(force), axis=0),
            location_axes_m=np.median(np.abs(location), axis=0),
            age_s=float(np.median(self._ages_s)) if self._ages_s else float("nan"),
            held_share=float(np.mean(self._held)) if self._held else None,
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


@dataclass(frozen=True, slots=True)
class FieldStreams:
    """Streams of fields, syntheses and their truth; ``tare`` finds a tare by its id."""

    field: Subscriber[FieldEstimate]
    truth: Subscriber[FieldFrame]
    synthesis: Subscriber[SynthesisEstimate]
    electrodes: Subscriber[ElectrodeFrame]
    tare: Callable[[int], Tare]


@dataclass(frozen=True, slots=True)
class FieldMedians:
    """Medians so far over touched frames; NaN before the first comparison.

    ``moved_m`` is the mean displacement of a node [m], ``field_m`` its mean error [m], ``counts``
    the r.m.s. error of the 19 electrodes [counts]; compared were ``fields`` and ``syntheses``.
    """

    fields: int
    moved_m: float
    field_m: float
    syntheses: int
    counts: float

    def as_json(self) -> dict[str, float | None]:
        """The same as plain values; None for NaN, which JSON lacks."""
        return {name: None if np.isnan(value) else value for name, value in asdict(self).items()}


class FieldComparison:
    """Matches fields with the truth, and synthesised electrodes with the measured ones."""

    def __init__(self) -> None:
        self._truth: deque[tuple[int, Vector]] = deque(maxlen=_WAITING)
        self._waiting: deque[tuple[int, Vector]] = deque(maxlen=_WAITING)
        self._counts: OrderedDict[int, tuple[int, Vector]] = OrderedDict()
        self._moved: list[float] = []
        self._errors: list[float] = []
        self._electrodes: list[float] = []
        self._came: set[str] = set()

    @property
    def complete(self) -> bool:
        """Whether a field and a synthesis have come."""
        return len(self._came) == 2

    def subscribe(self, session: Session, sensor: str) -> FieldStreams:
        """Subscribe to estimates and truth of a sensor."""
        book = TareBook(session)
        queue = Delivery.QUEUE
        return FieldStreams(
            session.subscriber(FIELD, sensor=sensor, delivery=queue),
            session.subscriber(FIELD_TRUTH, sensor=sensor, delivery=queue),
            session.subscriber(SYNTHESIS, sensor=sensor, delivery=queue),
            session.subscriber(ELECTRODES, sensor=sensor, delivery=queue),
            lambda tare_id: book.baseline(sensor, tare_id),
        )

    def take(self, streams: FieldStreams) -> None:
        """Take all messages that have arrived; never waits."""
        for frame in _all(streams.electrodes):
            counts = np.asarray(frame.electrodes, np.float64)
            self._counts[frame.stamp.monotonic_ns] = (frame.tare_id, counts)
            while len(self._counts) > _WAITING:
                self._counts.popitem(last=False)
        for truth in _all(streams.truth):
            self._truth.append((truth.stamp.monotonic_ns, truth.displacement))
        for estimate in _all(streams.field):
            self._came.add("field")
            self._waiting.append((estimate.source.monotonic_ns, estimate.displacement))
        self._match()
        for synthesis in _all(streams.synthesis):
            self._came.add("synthesis")
            self._compare(synthesis, streams.tare)

    def medians(self) -> FieldMedians:
        """Medians of all comparisons so far."""
        return FieldMedians(
            fields=len(self._errors),
            moved_m=_median(self._moved),
            field_m=_median(self._errors),
            syntheses=len(self._electrodes),
            counts=_median(self._electrodes),
        )

    def _match(self) -> None:
        """Compare estimates that lie between two known fields, which are 50 ms apart."""
        while self._waiting and self._truth and self._waiting[0][0] <= self._truth[-1][0]:
            at, estimate = self._waiting.popleft()
            truth = self._truth_at(at)
            if truth is None or truth.shape != estimate.shape:
                continue
            moved = float(np.linalg.norm(truth, axis=1).mean())
            if moved > MOVED_M:
                self._moved.append(moved)
                self._errors.append(float(np.linalg.norm(estimate - truth, axis=1).mean()))

    def _truth_at(self, at: int) -> Vector | None:
        before: tuple[int, Vector] | None = None
        for when, field in self._truth:
            if when == at:
                return field
            if when > at:
                if before is None:
                    return None
                share = (at - before[0]) / (when - before[0])
                return np.asarray(before[1] + np.float32(share) * (field - before[1]))
            before = (when, field)
        return None

    def _compare(self, synthesis: SynthesisEstimate, find: Callable[[int], Tare]) -> None:
        tare_id, counts = self._counts.get(synthesis.source.monotonic_ns, (NO_TARE, None))
        if counts is None or tare_id == NO_TARE:
            return
        try:
            rest = find(tare_id)
        except PalpateError:  # the gateway has ended; earlier comparisons stay
            return
        tared = counts - np.asarray(rest.electrodes, np.float64)
        if np.abs(tared).max() < _TOUCHED_COUNTS:
            return
        difference = np.asarray(synthesis.tared_counts, np.float64) - tared
        self._electrodes.append(float(np.sqrt(np.mean(difference**2))))


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
