"""From the streams of one trial to its rows, as the paper's section "Experimental data processing".

The order is: filter, last sample of each increment, tare, threshold. The paper lists the filter
third; it is linear, so it commutes with the tare, but not with the subsampling: after that there
is one sample every 5 s (0.2 Hz), for which a cutoff of 5 Hz means nothing. So it runs on the
stream as recorded. Each step is a pure function; none changes what it is given.

Where a press begins: 0.5 N, in the experiment and in the simulation alike.

Paper, sections "Experimental data processing" (step 3) and "Experimental and simulation data
processing" (step 2).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.messages import COUNTS_MAX
from palpate.process import require
from palpate_training.datasets.trials import RawTrial, TrialRows, reason_of, trial_name

CUTOFF_HZ = 5.0
"""Of the first-order Butterworth low-pass (paper)."""

PADDING_S = 5.0 / (2.0 * np.pi * CUTOFF_HZ)
"""Five time constants of the filter, after which it has forgotten its start."""

LONGEST_GAP_S = 0.5
"""A tenth of the dwell. The force stands still in a dwell, so a short gap shifts nothing."""


def process(raw: RawTrial) -> TrialRows:
    """All steps: filter, last sample of each increment, tare, threshold, row at exactly 0.5 N.

    Raises:
        DatasetError: The streams are damaged, or nothing is left; names the trial.
    """
    return from_half_newton(tare(last_of_increments(filter_force(raw))))


def process_all(trials: Iterable[RawTrial]) -> tuple[list[TrialRows], list[tuple[str, str]]]:
    """Process trial by trial, and account for each.

    Returns:
        Rows of the trials that gave some, and name and reason of every other trial.
    """
    kept, dropped = [], []
    for raw in trials:
        try:
            kept.append(process(raw))
        except DatasetError as error:
            name = trial_name(raw.header)
            dropped.append((name, reason_of(name, error)))
    return kept, dropped


def filter_force(raw: RawTrial) -> RawTrial:
    """Low-pass the force forward and backward, dwell by dwell.

    Forward and backward nothing is delayed, but the backward pass also looks ahead: over the whole
    stream it would draw the step to the next increment into the last sample of each dwell, which is
    the very sample that is kept, and shift the force by up to half an increment. So each increment
    is filtered on its own, mirrored at its ends. (With SciPy's default, odd extension, the
    last sample would keep all its noise.)

    Returns:
        The trial with its force filtered.

    Raises:
        DatasetError: The force is not finite, time runs backward, has a gap or is too slow for the
            cutoff, or ``increment_end`` makes no sense.
    """
    _check_increments(raw)
    name = trial_name(raw.header)
    return replace(raw, force=filter_dwells(name, raw.force, raw.time_s, raw.increment_end))


def filter_dwells(name: str, force: Floats, time_s: Floats, increment_end: Rows) -> Floats:
    """Forces as `filter_force` filters them.

    Args:
        name: Of the trial.
        force: [N], shape (T, 3).
        time_s: Of each sample [s], shape (T,).
        increment_end: Last sample of each increment, shape (I,).

    Raises:
        DatasetError: See `filter_force`.
    """
    signal = require("scipy.signal", extra="training")
    if not np.isfinite(force).all():
        raise DatasetError(
            f"{name}: force is not finite in sample {_first_bad(force)}",
            remedy="record the trial again",
        )
    steps = np.diff(time_s)
    if len(steps) == 0 or steps.min() <= 0 or steps.max() > LONGEST_GAP_S:
        raise DatasetError(
            f"{name}: time_s must increase without a gap over {LONGEST_GAP_S} s;"
            f" its steps are {steps.min(initial=np.inf):.3g}..{steps.max(initial=-np.inf):.3g} s",
            remedy="record the trial again with a monotonic clock and nothing lost",
        )
    rate_hz = 1.0 / float(np.median(steps))
    if rate_hz <= 2.0 * CUTOFF_HZ:
        raise DatasetError(
            f"{name}: {rate_hz:.3g} Hz is too slow for a filter of {CUTOFF_HZ:g} Hz",
            remedy="filter the stream as recorded (100 Hz), before the subsampling",
        )
    sections = signal.butter(1, CUTOFF_HZ, fs=rate_hz, output="sos")
    padding = round(PADDING_S * rate_hz)
    # The first and what follows each end; those of one length at once, as there are many.
    starts = np.array([0, *(increment_end + 1)])
    lengths = np.diff(starts, append=len(force))
    filtered = np.empty_like(force)
    for length in set(lengths.tolist()) - {0}:
        rows = starts[lengths == length][:, None] + np.arange(length)
        filtered[rows] = signal.sosfiltfilt(
            sections, force[rows], axis=1, padtype="even", padlen=min(padding, length - 1)
        )
    return filtered


def last_of_increments(raw: RawTrial) -> RawTrial:
    """Keep the last sample of each displacement increment (paper, step 1).

    Raises:
        DatasetError: ``increment_end`` is empty, out of range or not increasing, or the travel does
            not grow from increment to increment.
    """
    _check_increments(raw)
    ends = raw.increment_end
    travel_m = raw.travel_m[ends]
    if (np.diff(travel_m) <= 0).any():
        first = int(np.flatnonzero(np.diff(travel_m) <= 0)[0]) + 1
        raise DatasetError(
            f"{trial_name(raw.header)}: travel does not grow at increment {first}",
            remedy="record the press only, without the way back",
        )
    return replace(
        raw,
        time_s=raw.time_s[ends],
        electrodes=raw.electrodes[ends],
        force=raw.force[ends],
        tip=raw.tip[ends],
        travel_m=travel_m,
        increment_end=np.arange(len(ends), dtype=np.int64),
    )


def tare(raw: RawTrial) -> TrialRows:
    """Subtract force and electrodes of the first row, before contact (paper, step 2).

    Returns:
        All its rows: force [N] from 0, electrodes as (E - E0) / 4095, and E0 as ``rest``.

    Raises:
        DatasetError: A value is not finite.
    """
    for what, values in (("force", raw.force), ("tip", raw.tip), ("travel_m", raw.travel_m)):
        if not np.isfinite(values).all():
            raise DatasetError(
                f"{trial_name(raw.header)}: {what} is not finite in row {_first_bad(values)}",
                remedy="record the trial again",
            )
    counts = raw.electrodes.astype(np.float64)  # uint16 would wrap round
    return TrialRows(
        header=raw.header,
        rest=counts[0],
        travel_m=raw.travel_m - raw.travel_m[0],
        tared=(counts - counts[0]) / COUNTS_MAX,
        force=raw.force - raw.force[0],
        location=raw.tip,
    )


def from_half_newton(rows: TrialRows) -> TrialRows:
    """Keep what is at 0.5 N or more, and begin at exactly 0.5 N (paper, step 3).

    Dropped is everything before the first crossing that stays (`onset`: a noisy row in free motion
    is no contact), and after it each row below. The first row is interpolated linearly in all
    quantities, unless a row is at 0.5 N already; travel counts from it.

    Raises:
        DatasetError: The trial begins above 0.5 N, or no row is left.
    """
    start = _onset(rows)
    travel_m = start.rows(rows.travel_m)
    return replace(
        rows,
        travel_m=travel_m - travel_m[0],
        tared=start.rows(rows.tared),
        force=start.rows(rows.force),
        location=start.rows(rows.location),
    )


def _onset(rows: TrialRows) -> ForceOnset:
    start = from_threshold(rows.force)
    if start is not None:
        return start
    magnitude = np.linalg.norm(rows.force, axis=1)
    if magnitude[0] >= THRESHOLD_N:
        raise DatasetError(
            f"{trial_name(rows.header)}: the first row is at {magnitude[0]:.3g} N already",
            remedy="begin the trial before contact",
        )
    raise DatasetError(
        f"{trial_name(rows.header)}: the force never stays at {THRESHOLD_N} N or more; its largest"
        f" is {magnitude.max():.3g} N",
        remedy="the indenter pressed too lightly or missed the finger: press deeper, check its "
        "start, or drop the trajectory",
    )


def _check_increments(raw: RawTrial) -> None:
    ends, samples = raw.increment_end, len(raw.electrodes)
    if len(ends) == 0 or (np.diff(ends) <= 0).any() or ends[0] < 0 or ends[-1] >= samples:
        raise DatasetError(
            f"{trial_name(raw.header)}: increment_end must hold increasing indices of its {samples}"
            " samples",
            remedy="mark the last sample of each increment when recording",
        )


def _first_bad(values: Floats) -> int:
    return int(np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))[0])


THRESHOLD_N = 0.5
"""Below this the paper's force/torque sensor shows noise."""

STAY_ROWS = 3
"""Rows that a crossing must hold to be the contact and not noise: 0.3 mm of travel."""

_SAME = 1e-9
"""Rounding: of a force at the threshold [N], of a row at the crossing as a share of a segment."""

Floats = npt.NDArray[np.float64]
Values = npt.NDArray[Any]
Rows = npt.NDArray[np.int64]


def onset(force: Floats) -> int | None:
    """First row of the contact, the first crossing that stays, of forces [N], shape (R, 3).

    A crossing stays if `STAY_ROWS` rows from it on, as far as the trial has them, are all at or
    above the threshold. So a single noisy row in free motion is no contact, while a dip late in a
    press does not move its beginning. None where the force never stays above.
    """
    above = np.linalg.norm(force, axis=1) >= THRESHOLD_N
    for row in np.flatnonzero(above):
        if above[row : row + STAY_ROWS].all():
            return int(row)
    return None


def crossing(before: Floats, after: Floats) -> float:
    """Where on the segment between two forces the magnitude is exactly the threshold.

    The magnitude of an interpolated vector is not the interpolated magnitude: where the direction
    turns, it is smaller. So ``|a + s (b - a)|^2 = threshold^2`` is solved for s.

    Args:
        before: Force [N] of magnitude below the threshold, shape (3,).
        after: Force [N] of magnitude at or above it, shape (3,).

    Returns:
        Share s of the way from ``before`` to ``after``, in [0, 1].
    """
    step = after - before
    a, b = float(step @ step), float(before @ step)
    c = float(before @ before) - THRESHOLD_N**2
    if np.linalg.norm(before) > THRESHOLD_N + _SAME or np.linalg.norm(after) < THRESHOLD_N - _SAME:
        raise ValueError("the segment does not cross the threshold upwards")
    root = math.sqrt(max(b * b - a * c, 0.0))
    # Of the two forms of the positive root the one without a difference of like numbers.
    share = -c / (b + root) if b > 0 else (root - b) / a
    return min(max(share, 0.0), 1.0)


@dataclass(frozen=True, slots=True)
class ForceOnset:
    """Where a press reaches 0.5 N, and its rows from there on.

    Attributes:
        before: Last row before the contact.
        share: Share of the way to the next row where the force is exactly 0.5 N.
        kept: Rows at or above 0.5 N after ``before``.
    """

    before: int
    share: float
    kept: Rows

    def rows(self, values: Values) -> Values:
        """The row at exactly 0.5 N and those after it, of a quantity (R, ...)."""
        first, second = values[self.before], values[self.before + 1]
        exact = self.share > 1.0 - _SAME  # the first kept row is it, so it is not doubled
        row = np.asarray(first + self.share * (second - first), values.dtype)
        return np.concatenate([row[None], values[self.kept[int(exact) :]]])


def from_threshold(force: Floats) -> ForceOnset | None:
    """Which rows to keep and which to prepend, of forces [N] in order of travel, shape (R, 3).

    Rows below the threshold are left out wherever they are, as the paper says, a late dip included.

    Returns:
        The rows, or None where the force never stays above, or where the first row is above already
        and there is nothing to interpolate from.
    """
    first = onset(force)
    if first is None or first == 0:
        return None
    kept = first + np.flatnonzero(np.linalg.norm(force[first:], axis=1) >= THRESHOLD_N)
    share = crossing(force[first - 1], force[first])
    return ForceOnset(first - 1, share, kept)
