"""How wrong an estimate is: the metrics of the protocol, defined once, in pure NumPy.

Force: magnitude error ``| |F^| - |F| |`` [N] (also over the standard deviation of the true
magnitudes, and over the true magnitude of the row), vector error ``|F^ - F|`` [N], root mean square
per axis [N], angle ``arccos(cos)`` [rad] and ``1 - cos`` [-]. Both angles are given because the
literature writes "cosine error" for either. Contact location: distance ``|p^ - p|`` [m].

Field: the distance of a node's estimated displacement from its true one [m]; of a row its mean over
the paper's 128-node subset, over all nodes, over the nodes that truly move by more than 0.1 mm, and
its largest value over all nodes. Electrodes: the root mean square over rows and the 19 electrodes,
over full scale [-] and in counts, and the median over rows of the norm in R^19 [counts]. Skill is
one minus the error over that of predicting zero.

Rows of one block are nearly copies, so confidence intervals resample whole blocks (clusters).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX

Float = npt.NDArray[np.floating]
Labels = npt.NDArray[np.int32]
Number = TypeVar("Number", bound=np.floating)
Statistic = Callable[[npt.NDArray[np.float64]], float]

FORCE_BINS_N = {"below_2n": (0.0, 2.0), "2_to_8n": (2.0, 8.0), "above_8n": (8.0, np.inf)}
"""The paper's bounds of low and high force; its rows begin at 0.5 N."""

DRAWS = 2000
_PART = 250

MIN_MAGNITUDE_N = 1e-3
"""Below this true force a direction has no meaning [N]; such rows have no angle."""


_SUMMARY = {
    "magnitude_n": "force_magnitude_{}_n",
    "magnitude_over_norm": "force_magnitude_over_norm_{}",
    "vector_n": "force_vector_{}_n",
    "angle_rad": "force_angle_{}_rad",
    "one_minus_cos": "force_one_minus_cos_{}",
}
"""Names of the summaries: the unit stands last, as everywhere."""


def force_errors(estimate: Float, truth: Float) -> dict[str, npt.NDArray[np.float64]]:
    """Errors of every row, of forces [N], shape ``(N, 3)``.

    Returns:
        ``magnitude_n``, ``magnitude_over_norm``, ``vector_n``, ``angle_rad``, ``one_minus_cos``,
        each of shape ``(N,)``; NaN where the true force is too small to have a direction.
    """
    estimate, truth = _pair(estimate, truth)
    true_norm = np.linalg.norm(truth, axis=1)
    norm = np.linalg.norm(estimate, axis=1)
    directed = true_norm >= MIN_MAGNITUDE_N
    # An estimate of exactly zero has no direction: counted as perpendicular, not as perfect.
    product = np.where(norm > 0, norm * true_norm, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.clip(np.sum(estimate * truth, axis=1) / product, -1.0, 1.0)
        over_norm = np.abs(norm - true_norm) / true_norm
    return {
        "magnitude_n": np.abs(norm - true_norm),
        "magnitude_over_norm": np.where(directed, over_norm, np.nan),
        "vector_n": np.linalg.norm(estimate - truth, axis=1),
        "angle_rad": np.where(directed, np.arccos(cosine), np.nan),
        "one_minus_cos": np.where(directed, 1.0 - cosine, np.nan),
    }


def force_metrics(estimate: Float, truth: Float) -> dict[str, float]:
    """Summary of ``force_errors``: median, mean, IQR; over std; root mean square per axis."""
    summary: dict[str, float] = {}
    for name, values in force_errors(estimate, truth).items():
        summary |= summarise(_SUMMARY[name], values)
    estimate, truth = _pair(estimate, truth)
    spread = float(np.std(np.linalg.norm(truth, axis=1)))
    median = summary["force_magnitude_median_n"]
    summary["force_magnitude_over_std_median"] = median / spread if spread > 0 else float("nan")
    for axis, value in zip("xyz", rms(estimate - truth), strict=True):
        summary[f"force_rmse_{axis}_n"] = float(value)
    return summary


def angles(estimate: Float, truth: Float) -> npt.NDArray[np.float64]:
    """Angle between two vectors of every row [rad], shape ``(N,)``.

    A vector of length zero counts as perpendicular.
    """
    estimate, truth = _pair(estimate, truth)
    norms = np.linalg.norm(estimate, axis=1) * np.linalg.norm(truth, axis=1)
    cosine = np.sum(estimate * truth, axis=1) / np.where(norms > 0, norms, 1.0)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def location_errors(estimate: Float, truth: Float) -> dict[str, npt.NDArray[np.float64]]:
    """Distance of every row: ``distance_m``, shape ``(N,)``; positions [m], shape ``(N, 3)``."""
    estimate, truth = _pair(estimate, truth)
    return {"distance_m": np.linalg.norm(estimate - truth, axis=1)}


def location_metrics(estimate: Float, truth: Float) -> dict[str, float]:
    """Summary of ``location_errors``: median, mean, IQR; root mean square per axis."""
    summary = summarise("location_distance_{}_m", location_errors(estimate, truth)["distance_m"])
    estimate, truth = _pair(estimate, truth)
    for axis, value in zip("xyz", rms(estimate - truth), strict=True):
        summary[f"location_rmse_{axis}_m"] = float(value)
    return summary


def summarise(pattern: str, values: npt.NDArray[np.float64]) -> dict[str, float]:
    """Median, mean and inter-quartile range of the rows that are not NaN.

    ``{}`` in the pattern is where the word goes, so that the unit can stand last.
    """
    kept = values[~np.isnan(values)]
    if not kept.size:
        return {pattern.format(word): float("nan") for word in ("median", "mean", "iqr")}
    low, median, high = np.percentile(kept, [25, 50, 75])
    return {
        pattern.format("median"): float(median),
        pattern.format("mean"): float(np.mean(kept)),
        pattern.format("iqr"): float(high - low),
    }


def rms(residual: Float) -> npt.NDArray[np.float64]:
    """Root mean square over rows, one value for each column."""
    return np.asarray(np.sqrt(np.mean(np.square(residual, dtype=np.float64), axis=0)))


def cluster_bootstrap(
    errors: Mapping[str, npt.NDArray[np.float64]],
    cluster: Labels,
    *,
    statistic: Statistic = lambda values: float(np.nanmedian(values)),
    draws: int = 2000,
    level: float = 0.95,
    seed: int = 0,
) -> dict[str, tuple[float, float]]:
    """Confidence interval of a statistic when only whole clusters are independent.

    Args:
        errors: Errors of every row by name; each of shape ``(N,)`` or ``(N, S)`` (S seeds: the
            statistic is taken for each seed and averaged).
        cluster: Block, press or trajectory of every row, shape ``(N,)``.
        statistic: Number made of the rows of one draw.
        draws: How often whole clusters are drawn with replacement.
        level: Share of the draws inside the interval.
        seed: Seed of the draws.

    Returns:
        ``(low, high)`` for each name.
    """
    names = list(errors)
    order = np.argsort(cluster, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1)
    rng = np.random.default_rng(seed)
    results = np.empty((draws, len(names)))
    columns = [np.atleast_2d(errors[name].T) for name in names]  # each (S, N)
    for draw in range(draws):
        picked = rng.integers(len(members), size=len(members))
        rows = np.concatenate([members[i] for i in picked])
        for i, column in enumerate(columns):
            results[draw, i] = np.mean([statistic(seed_errors[rows]) for seed_errors in column])
    tail = 50.0 * (1.0 - level)
    low, high = np.percentile(results, [tail, 100.0 - tail], axis=0)
    return {name: (float(low[i]), float(high[i])) for i, name in enumerate(names)}


def drawn_medians(
    errors: Sequence[Rows64], cluster: npt.NDArray[np.integer], *, draws: int = DRAWS, seed: int = 0
) -> Rows64:
    """The median error in each draw of whole clusters, averaged over seeds, shape (draws,).

    A median of such a draw is that of all rows with a weight for each cluster: rows are sorted
    once, and all draws are made at the same time.

    The same clusters, draws and seed give the same draws, so those of two systems can be divided.

    Args:
        errors: Of every row, shape (N,), one for each seed of a system; rows that are NaN do not
            count; without any row the medians are NaN.
        cluster: Trajectory of every row, shape (N,).
        draws: How many.
        seed: Of the draws.
    """
    if any(np.isnan(values).all() for values in errors):
        return np.full(draws, np.nan)
    names, number = np.unique(cluster, return_inverse=True)
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(len(names), np.full(len(names), 1.0 / len(names)), size=draws)
    total = np.zeros(draws)
    for values in errors:
        order = np.argsort(values, kind="stable")
        order = order[: np.count_nonzero(~np.isnan(values))]
        for start in range(0, draws, _PART):
            part = slice(start, start + _PART)
            weight = np.cumsum(counts[part][:, number[order]], axis=1)
            middle = (weight >= 0.5 * weight[:, -1:]).argmax(axis=1)
            total[part] += np.where(weight[:, -1] > 0, values[order][middle], np.nan)
    return total / len(errors)


def interval(drawn: Rows64, level: float = 0.95) -> tuple[float, float]:
    """Ends of the interval that holds a share of the draws; NaN if all of them are."""
    if np.isnan(drawn).all():
        return float("nan"), float("nan")
    tail = 50.0 * (1.0 - level)
    low, high = np.nanpercentile(drawn, [tail, 100.0 - tail])
    return float(low), float(high)


def _pair(estimate: Float, truth: Float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    if estimate.shape != truth.shape or truth.ndim != 2 or truth.shape[1] != 3:
        raise ValueError(f"shapes {estimate.shape} and {truth.shape}, expected twice (N, 3)")
    return estimate.astype(np.float64), truth.astype(np.float64)


Rows64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.integer]

MOVING_M = 1e-4
"""The paper's "significant motion": nodes that move by more [m]."""


def field_errors(estimate: Float, truth: Float, subset: Indices) -> dict[str, Rows64]:
    """Errors of every row [m].

    Args:
        estimate: Estimated displacement [m], shape ``(N, V, 3)``.
        truth: True displacement [m], shape ``(N, V, 3)``.
        subset: The 128 nodes of the paper's metric.

    Returns:
        ``subset_m``, ``all_m``, ``moving_m``, ``max_m``, each of shape ``(N,)``; ``moving_m`` is
        NaN in a row in which no node moves.
    """
    if estimate.shape != truth.shape or truth.ndim != 3 or truth.shape[2] != 3:
        raise ValueError(f"shapes {estimate.shape} and {truth.shape}, expected twice (N, V, 3)")
    distance = np.linalg.norm(estimate - truth, axis=2).astype(np.float64)
    moves = np.linalg.norm(truth, axis=2) > MOVING_M
    count = moves.sum(axis=1)
    with np.errstate(invalid="ignore"):
        moving = np.where(moves, distance, 0.0).sum(axis=1) / np.where(count > 0, count, np.nan)
    return {
        "subset_m": distance[:, subset].mean(axis=1),
        "all_m": distance.mean(axis=1),
        "moving_m": moving,
        "max_m": distance.max(axis=1),
    }


def join(parts: Iterable[dict[str, npt.NDArray[Number]]]) -> dict[str, npt.NDArray[Number]]:
    """Arrays of the same names that were computed part by part."""
    listed = list(parts)
    return {name: np.concatenate([part[name] for part in listed]) for name in listed[0]}


def field_summary(errors: dict[str, Rows64], zero: dict[str, Rows64]) -> dict[str, float]:
    """Mean over rows of each error [m], and the skill over predicting zero.

    Both arguments come from ``field_errors`` on the same rows.
    """
    summary: dict[str, float] = {}
    for name, values in errors.items():
        summary[f"nodal_{name}"] = _mean(values)
    for name in ("subset_m", "all_m", "moving_m"):
        summary[f"skill_{name.removesuffix('_m')}"] = 1.0 - _over(
            _mean(errors[name]), _mean(zero[name])
        )
    return summary


def by_force(name: str, values: Rows64, force_n: Rows64, statistic: Statistic) -> dict[str, float]:
    """A statistic of the rows of each of ``FORCE_BINS_N`` that has some.

    Args:
        name: The key of a bin is this and the bin's name.
        values: Of each row, shape ``(N, ...)``.
        force_n: Magnitude of each row's force [N], shape ``(N,)``.
        statistic: Of values.
    """
    inside = {
        where: (force_n >= low) & (force_n < high) for where, (low, high) in FORCE_BINS_N.items()
    }
    return {
        f"{name}_{where}": statistic(values[rows]) for where, rows in inside.items() if rows.any()
    }


def contact_errors(estimate: Float, truth: Float) -> dict[str, Rows64]:
    """Errors of every row's contact forces on nodes.

    Args:
        estimate: Estimated forces [N], shape ``(N, V, 3)``.
        truth: True forces [N], shape ``(N, V, 3)``.

    Returns:
        ``misplaced``: the share of the force that would have to be moved to other nodes or turned:
        half of the sum of the nodal errors over the sum of the true nodal forces; ``net_n``: error
        of the net force [N]. Each of shape ``(N,)``.
    """
    if estimate.shape != truth.shape or truth.ndim != 3 or truth.shape[2] != 3:
        raise ValueError(f"shapes {estimate.shape} and {truth.shape}, expected twice (N, V, 3)")
    left = np.asarray(estimate - truth, np.float64)
    total = np.linalg.norm(truth, axis=2).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        misplaced = 0.5 * np.linalg.norm(left, axis=2).sum(axis=1) / total
    return {"misplaced": misplaced, "net_n": np.linalg.norm(left.sum(axis=1), axis=1)}


def electrode_errors(estimate: Float, truth: Float) -> dict[str, Rows64]:
    """Errors of every row, of tared counts [counts], shape ``(N, 19)``.

    Returns:
        ``mean_square`` over the electrodes [counts^2] and ``l2_counts``, each ``(N,)``.
    """
    if estimate.shape != truth.shape or truth.ndim != 2:
        raise ValueError(f"shapes {estimate.shape} and {truth.shape}, expected twice (N, 19)")
    squares = np.square(np.asarray(estimate, np.float64) - truth)
    return {"mean_square": squares.mean(axis=1), "l2_counts": np.sqrt(squares.sum(axis=1))}


def root_mean(squares: Rows64) -> float:
    """Root of the mean over rows."""
    return float(np.sqrt(np.mean(squares)))


def electrode_summary(errors: dict[str, Rows64], zero: dict[str, Rows64]) -> dict[str, float]:
    """RMSE [-] and [counts], median norm [counts], and the skill over predicting zero."""
    rmse = root_mean(errors["mean_square"])
    return {
        "electrode_rmse": rmse / COUNTS_MAX,
        "electrode_rmse_counts": rmse,
        "electrode_l2_median_counts": float(np.median(errors["l2_counts"])),
        "skill_rmse": 1.0 - _over(rmse, root_mean(zero["mean_square"])),
    }


def _mean(values: Rows64) -> float:
    kept = values[~np.isnan(values)]
    return float(kept.mean()) if kept.size else float("nan")


def _over(value: float, reference: float) -> float:
    return value / reference if reference > 0 else float("nan")
