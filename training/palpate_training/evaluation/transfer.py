"""How well forces are estimated on a finger that was never met, and after a few presses of it.

The finger that is tested is none of those that are trained on. Three ways of using it: nothing but
its tare; its electrodes without forces, as a minute of ordinary use gives them; and some presses
against a force sensor, of 2 s each, drawn at random several times. Rows within a second of a
labelled press are not tested.

    palpate train transfer --train one.h5 --test two.h5 --shots 5
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.datasets.container import refuse_repeated
from palpate_training.datasets.features import (
    FeatureDataset,
    check_learnable,
    counts_under_force,
    of_sensor,
    period_of,
    rows_at_ends,
)
from palpate_training.datasets.ingest import PRESS_N
from palpate_training.learning.force_process import KnownRows
from palpate_training.learning.metrics import force_errors
from palpate_training.learning.splits import GUARD_S
from palpate_training.learning.twin_line import TwinLine
from palpate_training.systems.transfer import (
    ALIKE,
    LINE_VALIDATION,
    SAME_USE,
    FingerRecording,
    ForceTransfer,
    LabelledPresses,
    line_through,
)

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.integer]

PRESS_S = 2.0
GAP_S = 1.0
"""A longer gap between rows ends an uninterrupted piece."""

LABELLED_HZ = 20.0
"""Labelled rows that are used; those between are nearly copies."""

FIGURES = ("magnitude_median_n", "magnitude_p95_n", "angle_median_rad")
"""What is told of every estimate, those of the constant and the ridge regression included."""

LEVEL = 0.9
"""Share of true magnitudes that the intervals should hold."""

FLOOR_N = 1.0
"""Errors grow with the force: an interval is a multiple of this plus the estimated magnitude."""

PRESSES_OF_OTHERS = 5
"""As many labelled presses count as much as the other fingers where intervals are made."""


@dataclass(frozen=True, slots=True)
class Finger:
    """Rows of one finger and its name."""

    name: str
    recording: FingerRecording
    tared: npt.NDArray[np.float32]


def fingers_of(data: FeatureDataset) -> list[Finger]:
    """The fingers of a data set that have rows, each with all of them.

    Raises:
        DatasetError: Forces or electrodes of one never change, or its forces are not in newtons.
    """
    return [
        _finger(of_sensor(data, name))
        for sensor, name in enumerate(data.sensor_names)
        if (data.sensor == sensor).any()
    ]


def _finger(data: FeatureDataset) -> Finger:
    """The only finger of a data set."""
    check_learnable(data)
    if (most := float(np.linalg.norm(data.force, axis=1).max())) < PRESS_N:
        raise DatasetError(
            f"{data.name}: the largest force is {most:.2g} N, and a press has {PRESS_N:g} N",
            remedy="give forces in newtons, of a finger that was pressed",
        )
    data = _in_time(data)
    broken = np.diff(data.group, prepend=data.group[:1]) != 0
    if data.time_ns is not None:
        steps_s = 1e-9 * np.diff(data.time_ns.astype(np.float64))
        broken = np.concatenate([[False], (steps_s > GAP_S) | (steps_s < 0.0)])
    recording = FingerRecording(
        data.electrodes,
        data.baseline,
        np.cumsum(broken),
        period_of(data.time_ns),
        data.force.astype(np.float64),
    )
    return Finger(data.sensor_names[0], recording, data.tared_counts)


def _in_time(data: FeatureDataset) -> FeatureDataset:
    """The rows of a sensor with its presses in order of time, as far as their times tell it.

    A table may hold them in the order of their labels. Where they overlap in time, as of a clock
    that starts anew with each, they stay as they are.
    """
    if data.time_ns is None:
        return data
    piece = np.cumsum(
        (np.diff(data.group, prepend=data.group[:1]) != 0)
        | (np.diff(data.time_ns, prepend=data.time_ns[:1]) < 0)
    )
    order = np.argsort(data.time_ns, kind="stable")
    if np.count_nonzero(np.diff(piece[order])) > piece[-1]:
        return data
    columns: dict[str, Any] = {name: rows[order] for name, rows in data.arrays().items()}
    return replace(data, **columns)


def refuse_same(names: Sequence[str], fingers: Sequence[Finger]) -> None:
    """Refuse fingers that have rows in common: they would count twice, and be tested on.

    Raw counts of rows with a force tell them, whatever this force and the untouched counts are.

    Args:
        names: Of the fingers, for the error.
        fingers: The fingers.

    Raises:
        DatasetError: Two have.
    """
    recordings = [one.recording for one in fingers]
    refuse_repeated(names, [counts_under_force(one.electrodes, one.force) for one in recordings])


def first_seconds(finger: Finger, seconds: float, *, most: int) -> tuple[KnownRows, Floats, Rows]:
    """What a finger could learn from its own first seconds, as if it had been calibrated then.

    Args:
        finger: The finger.
        seconds: How many.
        most: Rows, evenly over them, at most.

    Returns:
        These rows, in presses of ``PRESS_S``; the finger's untouched counts, shape (19,); and the
        numbers of all rows from ``GUARD_S`` later on.
    """
    per_s = round(1.0 / finger.recording.period_s)
    force, tared = finger.recording.force, finger.tared.astype(np.float64)
    first = np.unique(np.linspace(0, seconds * per_s - 1, most).astype(int))
    known = KnownRows(tared[first], force[first], first // round(PRESS_S * per_s))
    rest = finger.recording.baseline.mean(axis=0, dtype=np.float64)
    return known, rest, np.arange(round((seconds + GUARD_S) * per_s), len(force))


def run_transfer(
    train: Sequence[Finger],
    test: Finger,
    *,
    shots: int = 0,
    unlabelled: bool = False,
    draws: int = 12,
    seed: int = 0,
    line: TwinLine | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Fit to some fingers, and measure on another.

    Args:
        train: Fingers to learn from.
        test: The finger that is tested.
        shots: Its presses whose forces are known.
        unlabelled: Whether mean and spread of its electrodes may be used.
        draws: How often the labelled presses are drawn; results are means over the draws.
        seed: Of the draws.
        line: Prior of the magnitude, through a simulated population; None = none.
        on_step: Called ``steps_of`` times, for a progress bar.

    Returns:
        ``magnitude_median_n``, ``magnitude_p95_n``, ``angle_median_rad``, ``coverage_90`` (share of
        the true magnitudes inside their 90 % intervals), ``interval_median_n`` (half its width),
        and in ``constant`` and ``ridge`` the first three of a constant and of a ridge regression
        that know the same forces; which finger, how many presses and draws; ``rows``, all that the
        finger has, and ``tested_rows``, those further than a second from every labelled press, in
        the draw that leaves the fewest; ``clipped``, by name of the finger and of the electrode, in
        how many rows an electrode is at an end of its range; ``impedance_ratio``,
        the finger's untouched impedance over that of the nearest one trained on, and ``unlike``,
        whether it is so far from 1 that nothing tells how sensitive this finger is (`ALIKE`). Then,
        without a press, every estimate is the others' mean force.
        ``signal_ratio``, the size of its signals over that of the finger trained on with the
        largest; from `SAME_USE` on they are scaled down.

    Raises:
        DatasetError: Two fingers have presses in common, or the tested one has too few.
    """
    refuse_same(
        [*(f"{finger.name} (to train on)" for finger in train), f"{test.name} (to test)"],
        [*train, test],
    )
    drawn = _draws(test, shots, draws if shots else 1, np.random.default_rng(seed))
    sources = [finger.recording for finger in train]
    width = _width_on_others(train, line, on_step)
    model = ForceTransfer(sources, line)
    on_step()
    plain = model.estimate(test.recording, unlabelled=unlabelled)
    ratio = model.impedance_ratio(test.recording)
    unlike = not 1.0 / ALIKE <= ratio <= ALIKE
    if unlike and not shots:
        known, mean = np.vstack([source.force for source in sources]), model.mean_force()
        plain = np.broadcast_to(mean, plain.shape)
        width = _width(np.broadcast_to(mean, known.shape), known)
    on_step()
    found: dict[str, list[dict[str, float]]] = {"": [], "constant": [], "ridge": []}
    for labelled, tested in drawn:
        own_width = width
        force = plain
        if shots:
            corrected = model.correct(test.recording, plain, labelled)
            force = corrected.force
            known = test.recording.force[labelled.rows]
            share = shots / (shots + PRESSES_OF_OTHERS)
            own_width = (1.0 - share) * width + share * _width(corrected.held_out, known)
        truth = test.recording.force[tested]
        result = summary(force[tested], truth)
        half = own_width * (FLOOR_N + np.linalg.norm(force[tested], axis=1))
        errors = force_errors(force[tested], truth)["magnitude_n"]
        result |= {
            "coverage_90": float(np.mean(errors <= half)),
            "interval_median_n": float(np.median(half)),
        }
        found[""].append(result)
        for name, estimate in baselines_of(train, test, labelled.rows, tested).items():
            found[name].append(summary(estimate, truth))
        on_step()
    means = {
        name: {key: float(np.mean([one[key] for one in results])) for key in results[0]}
        for name, results in found.items()
    }
    return {
        **means.pop(""),
        **means,
        "test": test.name,
        "train": [finger.name for finger in train],
        "shots": shots,
        "unlabelled": unlabelled,
        "draws": len(drawn),
        "seed": seed,
        "twin": line is not None,
        "rows": len(test.recording.force),
        "tested_rows": min(len(tested) for _, tested in drawn),
        "clipped": {
            one.name: rows
            for one in (*train, test)
            if (rows := rows_at_ends(one.recording.electrodes))
        },
        "impedance_ratio": ratio,
        "signal_ratio": float(model.signal_ratio(test.recording, whole=True)[-1]),
        "unlike": unlike,
    }


def steps_of(train: int, *, shots: int, draws: int) -> int:
    """How often ``run_transfer`` calls ``on_step`` with so many training fingers."""
    return max(2, train) + 2 + (draws if shots else 1)


def summary(estimate: Floats, truth: Floats) -> dict[str, float]:
    """``FIGURES`` of estimated forces [N], each of shape (N, 3); the angle NaN without a force."""
    errors = force_errors(estimate, truth)
    angles = errors["angle_rad"][np.isfinite(errors["angle_rad"])]
    values = (
        np.median(errors["magnitude_n"]),
        np.percentile(errors["magnitude_n"], 95.0),
        np.median(angles) if len(angles) else np.nan,
    )
    return dict(zip(FIGURES, map(float, values), strict=True))


def _presses(recording: FingerRecording) -> list[Rows]:
    """Rows of the presses that may be labelled: pieces of 2 s, none over an interruption."""
    size = max(1, round(PRESS_S / recording.period_s))
    starts = np.flatnonzero(np.diff(recording.segment)) + 1
    pieces: list[Rows] = []
    for rows in np.split(np.arange(len(recording.segment)), starts):
        pieces += [rows[at : at + size] for at in range(0, len(rows) - size + 1, size)]
    return pieces


def _draws(
    test: Finger, shots: int, draws: int, rng: np.random.Generator
) -> list[tuple[LabelledPresses, Rows]]:
    """Labelled rows and rows to test, of each draw."""
    pieces = _presses(test.recording)
    if shots > len(pieces):
        raise DatasetError(
            f"{test.name!r} has {len(pieces)} presses of {PRESS_S:g} s, {shots} are to be labelled",
            remedy="label fewer, so that some are left to test",
        )
    drawn = [_draw(pieces, shots, test.recording, rng) for _ in range(draws)]
    if not all(len(tested) for _, tested in drawn):
        raise DatasetError(
            f"{test.name!r}: no row is left to test: {shots} of {len(pieces)} presses are labelled,"
            f" and rows within {GUARD_S:g} s of them are not tested",
            remedy="label fewer",
        )
    return drawn


def _draw(
    pieces: Sequence[Rows], shots: int, recording: FingerRecording, rng: np.random.Generator
) -> tuple[LabelledPresses, Rows]:
    """Labelled rows, and the rows to test."""
    guard = round(GUARD_S / recording.period_s)
    step = max(1, round(1.0 / (LABELLED_HZ * recording.period_s)))
    tested = np.ones(len(recording.segment), bool)
    labelled: list[Rows] = []
    for at in rng.choice(len(pieces), shots, replace=False):
        rows = pieces[at]
        tested[max(0, rows[0] - guard) : rows[-1] + 1 + guard] = False
        labelled.append(rows[::step])
    press = np.repeat(np.arange(shots), [len(rows) for rows in labelled])
    known = np.concatenate(labelled) if labelled else np.zeros(0, np.int64)
    return LabelledPresses(known, press), np.flatnonzero(tested)


def _width(estimate: Floats, truth: Floats) -> float:
    """Half width of the intervals over ``FLOOR_N`` plus the magnitude, from known forces."""
    errors = force_errors(estimate, truth)["magnitude_n"]
    return float(np.quantile(errors / (FLOOR_N + np.linalg.norm(estimate, axis=1)), LEVEL))


def _width_on_others(
    train: Sequence[Finger], line: TwinLine | None, on_step: Callable[[], None]
) -> float:
    """The same from the training fingers: each estimated from the others, or a half from the other.

    Halves of one finger know nothing of what differs from finger to finger, so the intervals of one
    training finger are too narrow. Magnitudes do not depend on what unlabelled electrodes tell.
    """
    if len(train) > 1:
        held_out = [
            ([other.recording for other in train if other is not finger], finger.recording)
            for finger in train
        ]
    else:
        (finger,) = train
        halves = [_half(finger.recording, k) for k in range(2)]
        held_out = [([halves[1 - k]], halves[k]) for k in range(2)]
    estimates, truths = [], []
    for sources, tested in held_out:
        estimates.append(ForceTransfer(sources, line).estimate(tested, unlabelled=False))
        truths.append(tested.force)
        on_step()
    return _width(np.vstack(estimates), np.vstack(truths))


def _half(recording: FingerRecording, which: int) -> FingerRecording:
    middle = len(recording.force) // 2
    rows = slice(0, middle) if which == 0 else slice(middle, None)
    return replace(
        recording,
        electrodes=recording.electrodes[rows],
        baseline=recording.baseline[rows],
        segment=recording.segment[rows],
        force=recording.force[rows],
    )


def baselines_of(
    train: Sequence[Finger], test: Finger, labelled: Rows, tested: Rows
) -> dict[str, Floats]:
    """Estimates of the tested rows by a constant and by a ridge regression on tared counts.

    The constant is the mean of what is known of the tested finger, else of the others. The
    regression knows both; labelled rows count as much as all others together.
    """
    known = test.recording.force[labelled]
    others = [(finger.tared.astype(np.float64), finger.recording.force) for finger in train]
    learned = [force[: round(len(force) * (1.0 - LINE_VALIDATION))] for _, force in others]
    mean = known.mean(axis=0) if len(labelled) else np.vstack(learned).mean(axis=0)
    line = line_through(others, (test.tared[labelled].astype(np.float64), known))
    return {
        "constant": np.tile(mean, (len(tested), 1)),
        "ridge": line.predict(test.tared[tested]),
    }


def worst_of(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of several tested fingers: the one with the largest median error of the magnitude.

    Returns:
        Its result, all figures of this one finger; its name, ``worst_finger``; and all results by
        name of the finger, ``fingers``.
    """
    worst = max(results, key=lambda one: one["magnitude_median_n"])
    fingers = {one["test"]: one for one in results}
    return {**worst, "worst_finger": worst["test"], "fingers": fingers}


def as_dict(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """For a JSON file: ``worst_of`` the results, or the only one; None where nothing is known."""

    def known(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: known(each) for key, each in value.items()}
        return None if isinstance(value, float) and not np.isfinite(value) else value

    told: dict[str, Any] = known(results[0] if len(results) == 1 else worst_of(results))
    return told


def remarks(result: dict[str, Any]) -> list[str]:
    """What a reader must know of the figures of a tested finger, in sentences."""
    name, clipped = result["test"], result["clipped"]
    told = []
    for finger, electrodes in clipped.items():
        rows = ", ".join(f"{electrode} ({count})" for electrode, count in electrodes.items())
        told.append(
            f"Electrodes of {finger} are at an end of their range, where they tell no force; in"
            f" brackets, in how many rows: {rows}"
        )
    if result["unlike"]:
        told.append(
            f"{name} is unlike the others: untouched, its impedance is"
            f" {result['impedance_ratio']:.2g} times that of the nearest one. Only labelled presses"
            " tell how sensitive it is: --shots 1 or more"
        )
    elif result["signal_ratio"] > SAME_USE:
        perhaps = ", perhaps by electrodes at an end of their range" if name in clipped else ""
        told.append(
            f"The signals of {name} are {result['signal_ratio']:.2g} times as large as those of the"
            f" others{perhaps}. It is taken for more sensitive, not for pressed harder; labelled"
            " presses tell: --shots 1 or more"
        )
    return told
