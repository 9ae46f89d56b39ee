"""How far the estimates of a record are from the truth, by how hard the finger is pressed.

Most frames of a record show an untouched finger, whose force is known to 0.01 N without any skill.
So errors are counted by the true force, and those of touched frames come first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import RecordingError
from palpate.files.record import read_record
from palpate.messages import FeatureEstimate, FieldEstimate, IndenterPoseFrame, WrenchFrame
from palpate_services.viewer.timeline import message_of, tell_left_out
from palpate_services.viewer.truth import MatchedMessages, TruthMatcher

TOUCHED_N = 0.5
"""A finger counts as touched from this true force on [N]: less than a robot grips anything with."""

FORCE_EDGES_N = (TOUCHED_N, 1.0, 2.0, 8.0)
"""Lower ends of the ranges of force in which errors are counted [N]; the last has no upper end."""

_MATCHED = ("wrench", "pose", "features")


@dataclass(frozen=True, slots=True)
class ForceBin:
    """Errors of the frames whose true force lies in one range.

    Attributes:
        least_n: Lower end of the range [N]; 0 = all frames.
        below_n: Upper end of the range [N], not in it; None = there is none.
        frames: How many have an estimate and a true force.
        force_median_n: Median length of the force's error [N]; None without frames.
        force_p90_n: 90 % of these errors are below it [N].
        located: How many have a contact location, estimated and true.
        location_median_m: Median length of the location's error [m]; None without any.
        location_p90_m: 90 % of these errors are below it [m].
        held_share: Share of the frames whose force's error is within the bound that the estimate
            gives; None without bounds.
    """

    least_n: float
    below_n: float | None
    frames: int
    force_median_n: float | None
    force_p90_n: float | None
    located: int
    location_median_m: float | None
    location_p90_m: float | None
    held_share: float | None = None

    @property
    def name(self) -> str:
        """The range in words, e.g. ``1 to 2 N``."""
        if self.below_n is not None:
            return f"{self.least_n:g} to {self.below_n:g} N"
        return f">= {self.least_n:g} N" if self.least_n else "all frames"


@dataclass(frozen=True, slots=True)
class RecordErrors:
    """What the estimates of one sensor of a record are worth.

    Attributes:
        sensor: Its name.
        estimates: How many estimates of features there are.
        duration_s: From the first of them to the last [s].
        bins: Touched frames, then those by force, then all frames.
    """

    sensor: str
    estimates: int
    duration_s: float
    bins: tuple[ForceBin, ...]

    @property
    def touched(self) -> ForceBin:
        """Frames of at least ``TOUCHED_N``."""
        return self.bins[0]

    @property
    def all_frames(self) -> ForceBin:
        """All frames, the untouched ones too."""
        return self.bins[-1]

    def as_json(self) -> dict[str, Any]:
        """The same as plain values; the ranges by their names."""
        plain = asdict(self)
        plain["bins"] = {each.name: asdict(each) for each in self.bins}
        return plain


@dataclass(frozen=True, slots=True)
class RecordedTouches:
    """Estimates of one sensor of a record, matched with their truth, in order of time.

    Attributes:
        sensor: Its name.
        times_ns: Monotonic time of each estimate [ns], increasing, shape ``(N,)``.
        matched: Estimate and truth of each, ``N``.
        fields_ns: Monotonic times that have an estimate of the field as well [ns].
    """

    sensor: str
    times_ns: npt.NDArray[np.int64]
    matched: Sequence[MatchedMessages]
    fields_ns: frozenset[int]

    def errors(self) -> RecordErrors:
        """Errors by force."""
        seconds = float(self.times_ns[-1] - self.times_ns[0]) * 1e-9
        return RecordErrors(self.sensor, len(self.matched), seconds, bins_of(self.matched))


def bins_of(matched: Iterable[MatchedMessages]) -> tuple[ForceBin, ...]:
    """Errors of touched frames, of each range of ``FORCE_EDGES_N``, and of all frames."""
    forces, locations, held = [], [], []
    for each in matched:
        force, location = each.force_error(), each.location_error()
        if force is None or each.wrench is None:
            continue
        size_n = float(np.linalg.norm(each.wrench.force))
        forces.append((size_n, float(np.linalg.norm(force))))
        bounds = None if each.estimate is None else each.estimate.bounds
        if bounds is not None and bounds.force is not None:
            held.append((size_n, float(forces[-1][1] <= bounds.force)))
        if location is not None:
            locations.append((size_n, float(np.linalg.norm(location))))
    tops = (*FORCE_EDGES_N[1:], None)
    ranges = [(TOUCHED_N, None), *zip(FORCE_EDGES_N, tops, strict=True), (0.0, None)]
    return tuple(_bin(least, below, forces, locations, held) for least, below in ranges)


def _bin(
    least_n: float,
    below_n: float | None,
    forces: list[tuple[float, float]],
    locations: list[tuple[float, float]],
    held: list[tuple[float, float]],
) -> ForceBin:
    def within(pairs: list[tuple[float, float]]) -> list[float]:
        top = np.inf if below_n is None else below_n
        return [error for size_n, error in pairs if least_n <= size_n < top]

    force, location, bounded = within(forces), within(locations), within(held)
    return ForceBin(
        least_n,
        below_n,
        len(force),
        *_middle_and_tail(force),
        len(location),
        *_middle_and_tail(location),
        float(np.mean(bounded)) if bounded else None,
    )


def _middle_and_tail(errors: list[float]) -> tuple[float | None, float | None]:
    """Median and 90th percentile."""
    if not errors:
        return None, None
    return float(np.median(errors)), float(np.percentile(errors, 90))


def read_touches(record: Path, *, sensor: str | None = None) -> RecordedTouches:
    """Estimates and truth of one sensor of a record, by default that with the most estimates.

    Messages that break the contract are left out, which the log tells.

    Raises:
        RecordingError: The record is damaged or holds no estimates.
    """
    matchers: dict[str, TruthMatcher] = {}
    matches: dict[str, dict[int, MatchedMessages]] = {}
    fields: dict[str, set[int]] = {}
    counts: Counter[str] = Counter()
    for item in read_record(record):
        topic, whose = item.address.topic, item.address.sensor
        if topic not in (*_MATCHED, "field") or sensor not in (None, whose):
            continue
        message = message_of(item, counts)
        if message is None:
            continue
        if isinstance(message, FieldEstimate):
            fields.setdefault(whose, set()).add(message.source.monotonic_ns)
            continue
        assert isinstance(message, FeatureEstimate | IndenterPoseFrame | WrenchFrame)
        found = matchers.setdefault(whose, TruthMatcher(remember=None)).add(message)
        if isinstance(message, FeatureEstimate):
            matches.setdefault(whose, {})[message.source.monotonic_ns] = found[0]
    tell_left_out(record, counts)
    if not matches:
        of_whom = "" if sensor is None else f" of the sensor {sensor!r}"
        raise RecordingError(
            f"{record} holds no estimates{of_whom}", remedy="record while the features service runs"
        )
    name = max(matches, key=lambda key: len(matches[key]))
    times = sorted(matches[name])
    return RecordedTouches(
        name,
        np.array(times, np.int64),
        [matches[name][ns] for ns in times],
        frozenset(fields.get(name, ())),
    )
