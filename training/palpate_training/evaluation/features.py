"""Location, force, centre of pressure and contact normal from electrodes, in every split."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from palpate_training.evaluation.cells import Arrays, Cell, CellResult, Tested, grouped
from palpate_training.learning.metrics import (
    FORCE_BINS_N,
    angles,
    drawn_medians,
    force_errors,
    interval,
    location_errors,
)
from palpate_training.learning.splits import RowSplit
from palpate_training.systems.analytic import ANALYTIC
from palpate_training.systems.ours import OURS
from palpate_training.systems.perceptrons import PERCEPTRONS
from palpate_training.systems.points import POINTS
from palpate_training.systems.samples import IndexArray, Quantity, Samples, System
from palpate_training.systems.statistical import STATISTICAL
from palpate_training.systems.voxels import VOXELS

Floats = npt.NDArray[np.float64]

FEATURE_SYSTEMS: tuple[System, ...] = (
    *STATISTICAL,
    *ANALYTIC,
    *PERCEPTRONS,
    *VOXELS,
    *POINTS,
    *OURS,
)

OUR_NAMES = tuple(system.name for system in OURS)

PAPER_SYSTEMS = ("MLP (the paper's)", "voxel network (the paper's)", "PointNet++ (the paper's)")
"""Ours are compared with the best of these."""

PAPER_SD_N = 4.6
"""Standard deviation of |F| in the paper's data, all units [N]: 0.64 N over 0.14."""


@dataclass(frozen=True, slots=True)
class FeatureTask:
    """One quantity of all rows.

    Attributes:
        name: The quantity.
        data_sha256: Content hash of the data set.
        samples: All rows.
        cluster: What is drawn as a whole for intervals, of each row, shape (N,): its trajectory, or
            its part of a recording.
        kind: How the finger was pressed, as ``press_kind`` tells it, of each row, shape (N,).
        systems: That can estimate it.
    """

    name: Quantity
    data_sha256: str
    samples: Samples
    cluster: IndexArray
    kind: npt.NDArray[np.str_]
    systems: tuple[System, ...]

    def fit_and_test(self, system: Tested, rows: RowSplit, seed: int) -> Arrays:
        """Train, and estimate the test rows: ``estimate``, shape (N, 3)."""
        sides = (self.samples.take(part) for part in (rows.train, rows.validation))
        estimate = system.fit(self.name, *sides, seed)
        return {"estimate": estimate(self.samples.take(rows.test))}


def systems_of(quantity: Quantity) -> tuple[System, ...]:
    """Every system that can estimate a quantity."""
    return tuple(system for system in FEATURE_SYSTEMS if quantity in system.quantities)


@dataclass(frozen=True, slots=True)
class Scores:
    """A row of a table: one system in one test of a split.

    Attributes:
        task: What was estimated.
        split: What was held out.
        test: On what was tested.
        system: Name.
        metrics: By name, averaged over the seeds.
        intervals: 95 % intervals of some of them.
        seconds: Mean time of a training and its test [s].
        seeds: How many.
        parts: The headline metric of each part of the test: of each indenter that was held out.
    """

    task: str
    split: str
    test: str
    system: str
    metrics: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    seconds: float
    seeds: int
    parts: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class TestedRows:
    """Test rows of all parts of one test.

    Attributes:
        truth: The quantity, shape (N, 3).
        force_n: True magnitude of the force [N], shape (N,).
        kind: How the finger was pressed, shape (N,).
        part: Part of each row, shape (N,).
    """

    truth: Floats
    force_n: Floats
    kind: npt.NDArray[np.str_]
    part: npt.NDArray[np.str_]


RowErrors = dict[str, Floats]


def row_errors(quantity: Quantity, estimate: Floats, truth: Floats) -> RowErrors:
    """Errors of every row by name; the first is the headline."""
    if quantity in ("location", "centre"):
        return location_errors(estimate, truth)
    if quantity == "force":
        return force_errors(estimate, truth)
    return {"angle_rad": angles(estimate, truth)}


HEADLINES: dict[str, tuple[str, ...]] = {
    "location": ("distance_m",),
    "centre": ("distance_m",),
    "force": ("magnitude_n", "angle_rad"),
    "normal": ("angle_rad",),
}
"""Errors that get intervals; the first is the one that parts are told by."""


@dataclass(frozen=True, slots=True)
class _Test:
    """One system in one test of a split, its parts put together."""

    split: str
    test: str
    system: str
    rows: npt.NDArray[np.int64]
    part: npt.NDArray[np.str_]
    estimates: list[Floats]
    seconds: float


def _tests(results: Mapping[Cell, CellResult]) -> Iterator[_Test]:
    for key, by_seed in grouped(results):
        cells = by_seed[0]
        rows = [cell.fold.rows.test for cell in cells]
        yield _Test(
            *key,
            rows=np.concatenate(rows),
            part=np.repeat([cell.fold.part for cell in cells], [len(each) for each in rows]),
            estimates=[
                np.concatenate([results[cell].arrays["estimate"] for cell in made]).astype(
                    np.float64
                )
                for made in by_seed
            ],
            seconds=float(np.mean([results[one].seconds for each in by_seed for one in each])),
        )


def score(task: FeatureTask, results: Mapping[Cell, CellResult]) -> list[Scores]:
    """The table of a task: one row for each split, test and system."""
    headlines = HEADLINES[task.name]
    found = []
    for one in _tests(results):
        tested = TestedRows(
            truth=task.samples.truth(task.name)[one.rows].astype(np.float64),
            force_n=_magnitude(task, one.rows),
            kind=task.kind[one.rows],
            part=one.part,
        )
        errors = [row_errors(task.name, each, tested.truth) for each in one.estimates]
        cluster = task.cluster[one.rows]
        found.append(
            Scores(
                task=task.name,
                split=one.split,
                test=one.test,
                system=one.system,
                metrics=summary(errors, tested),
                intervals={
                    f"{name}_median": interval(
                        drawn_medians([each[name] for each in errors], cluster)
                    )
                    for name in headlines
                },
                seconds=one.seconds,
                seeds=len(one.estimates),
                parts=_parts(errors, tested, headlines[0]),
            )
        )
    return found


def _magnitude(task: FeatureTask, rows: npt.NDArray[np.int64]) -> Floats:
    return np.asarray(np.linalg.norm(task.samples.force[rows].astype(np.float64), axis=1))


def summary(errors: Sequence[RowErrors], tested: TestedRows) -> dict[str, float]:
    """Metrics of a test, averaged over the seeds.

    Of each error its median, mean and inter-quartile range over all rows; its median in each bin of
    the force, for normal and for angled presses, and re-weighted to the paper's spread of forces.
    """
    masks: dict[str, npt.NDArray[np.bool_]] = {
        name: (tested.force_n >= low) & (tested.force_n < high)
        for name, (low, high) in FORCE_BINS_N.items()
    }
    masks["from_2n"] = tested.force_n >= FORCE_BINS_N["2_to_8n"][0]
    masks |= {f"{kind}_presses": tested.kind == kind for kind in ("normal", "angled")}
    weights = paper_weights(tested.force_n)
    each = []
    for one in errors:
        metrics: dict[str, float] = {}
        for name, values in one.items():
            kept = values[~np.isnan(values)]
            low, median, high = np.percentile(kept, [25, 50, 75])
            metrics |= {
                f"{name}_median": float(median),
                f"{name}_mean": float(kept.mean()),
                f"{name}_iqr": float(high - low),
                f"{name}_median_reweighted": weighted_median(values, weights),
            }
            for where, mask in masks.items():
                metrics[f"{name}_median_{where}"] = _median(values[mask])
        each.append(metrics)
    return {name: float(np.mean([one[name] for one in each])) for name in each[0]}


def _median(values: Floats) -> float:
    kept = values[~np.isnan(values)]
    return float(np.median(kept)) if kept.size else float("nan")


def _parts(errors: Sequence[RowErrors], tested: TestedRows, name: str) -> dict[str, float]:
    return {
        str(part): float(np.mean([_median(one[name][tested.part == part]) for one in errors]))
        for part in np.unique(tested.part)
        if part
    }


def paper_weights(force_n: Floats) -> Floats:
    """Weight of each row with which |F| has the paper's standard deviation, shape (N,).

    Of all such weights the most even: exponential in the force. Rows that vary too little, or more
    already, or whose force is not known, keep equal weights.
    """
    if not np.isfinite(force_n).all():
        return np.full(len(force_n), 1.0 / len(force_n))
    scaled = (force_n - force_n.mean()) / max(float(force_n.max()), 1e-9)

    def spread(tilt: float) -> tuple[float, Floats]:
        weight = np.exp(tilt * scaled - (tilt * scaled).max())
        weight /= weight.sum()
        mean = float(weight @ force_n)
        return float(np.sqrt(weight @ np.square(force_n - mean))), weight

    tilts = np.linspace(0.0, 12.0, 241)
    spreads = np.array([spread(tilt)[0] for tilt in tilts])
    if spreads[0] >= PAPER_SD_N or spreads.max() < PAPER_SD_N:
        return np.full(len(force_n), 1.0 / len(force_n))
    return spread(float(tilts[(spreads >= PAPER_SD_N).argmax()]))[1]


def force_shares(force_n: Floats) -> dict[str, float]:
    """How strong presses are: median and standard deviation [N], shares of light and hard rows."""
    return {
        "median_n": float(np.median(force_n)),
        "sd_n": float(force_n.std()),
        "below_2n": float(np.mean(force_n < 2)),
        "above_8n": float(np.mean(force_n > 8)),
    }


def weighted_median(values: Floats, weights: Floats) -> float:
    """The value below which half of the weight lies; NaN rows do not count."""
    kept = ~np.isnan(values)
    if not kept.any():
        return float("nan")
    order = np.argsort(values[kept], kind="stable")
    reached = np.cumsum(weights[kept][order])
    return float(values[kept][order][int((reached >= 0.5 * reached[-1]).argmax())])


def ratios_to_paper(
    task: FeatureTask,
    results: Mapping[Cell, CellResult],
    *,
    error: str,
    least_n: float = 0.0,
    most_n: float = np.inf,
) -> dict[tuple[str, str, str], tuple[float, float, float]]:
    """Median error of each of ours over that of the best of the paper's three, with its interval.

    By split, test and system. Only rows between two forces [N] count. The best of the three is the
    one with the least error in that same test, which favours it.
    """
    wanted = {*OUR_NAMES, *PAPER_SYSTEMS}
    kept = {cell: result for cell, result in results.items() if cell.system in wanted}
    drawn: dict[tuple[str, str], dict[str, tuple[float, Floats]]] = defaultdict(dict)
    for one in _tests(kept):
        force_n = _magnitude(task, one.rows)
        # An unknown force counts where every force does.
        counts = ~((force_n < least_n) | (force_n >= most_n))
        truth = task.samples.truth(task.name)[one.rows].astype(np.float64)
        errors = [
            np.where(counts, row_errors(task.name, each, truth)[error], np.nan)
            for each in one.estimates
        ]
        median = float(np.mean([_median(each) for each in errors]))
        medians = drawn_medians(errors, task.cluster[one.rows])
        drawn[one.split, one.test][one.system] = (median, medians)
    found = {}
    for (split, test), systems in drawn.items():
        papers = [systems[name] for name in PAPER_SYSTEMS if name in systems]
        if not papers:
            continue
        best = min(papers, key=lambda one: one[0])
        for name in OUR_NAMES:
            if name in systems:
                low, high = interval(systems[name][1] / best[1])
                found[split, test, name] = (systems[name][0] / best[0], low, high)
    return found
