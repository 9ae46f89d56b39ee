"""How wrong a field or a set of electrode values is: the protocol's metrics, in pure NumPy.

Field: the distance of a node's estimated displacement from its true one [m]; of a row its mean over
the paper's 128-node subset, over all nodes, over the nodes that truly move by more than 0.1 mm, and
its largest value over all nodes. Electrodes: the root mean square over rows and the 19 electrodes,
over full scale [-] and in counts, and the median over rows of the norm in R^19 [counts]. Skill is
one minus the error over that of predicting zero.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX

Float = npt.NDArray[np.floating]
Rows64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.integer]

MOVING_M = 1e-4
"""The paper's "significant motion": nodes that move by more [m]."""


def field_errors(
    estimate: Float, truth: Float, subset: Indices, *, moving_m: float = MOVING_M
) -> dict[str, Rows64]:
    """Errors of every row [m].

    Args:
        estimate: Estimated displacement [m], shape ``(N, V, 3)``.
        truth: True displacement [m], shape ``(N, V, 3)``.
        subset: The 128 nodes of the paper's metric.
        moving_m: True length from which a node counts as moving [m].

    Returns:
        ``subset_m``, ``all_m``, ``moving_m``, ``max_m``, each of shape ``(N,)``; ``moving_m`` is
        NaN in a row in which no node moves.
    """
    if estimate.shape != truth.shape or truth.ndim != 3 or truth.shape[2] != 3:
        raise ValueError(f"shapes {estimate.shape} and {truth.shape}, expected twice (N, V, 3)")
    distance = np.linalg.norm(estimate - truth, axis=2).astype(np.float64)
    moves = np.linalg.norm(truth, axis=2) > moving_m
    count = moves.sum(axis=1)
    with np.errstate(invalid="ignore"):
        moving = np.where(moves, distance, 0.0).sum(axis=1) / np.where(count > 0, count, np.nan)
    return {
        "subset_m": distance[:, subset].mean(axis=1),
        "all_m": distance.mean(axis=1),
        "moving_m": moving,
        "max_m": distance.max(axis=1),
    }


def join(parts: Iterable[dict[str, Rows64]]) -> dict[str, Rows64]:
    """Errors of rows that were computed part by part."""
    listed = list(parts)
    return {name: np.concatenate([part[name] for part in listed]) for name in listed[0]}


def field_summary(errors: dict[str, Rows64], zero: dict[str, Rows64]) -> dict[str, float]:
    """Mean over rows of each error [m], and the skill over predicting zero.

    Args:
        errors: From ``field_errors``.
        zero: The same of an estimate of zero on the same rows.
    """
    summary: dict[str, float] = {}
    for name, values in errors.items():
        summary[f"nodal_{name}"] = _mean(values)
    for name in ("subset_m", "all_m", "moving_m"):
        summary[f"skill_{name.removesuffix('_m')}"] = 1.0 - _over(
            _mean(errors[name]), _mean(zero[name])
        )
    return summary


def electrode_errors(estimate: Float, truth: Float) -> dict[str, Rows64]:
    """Errors of every row.

    Args:
        estimate: Estimated tared counts [counts], shape ``(N, 19)``.
        truth: True tared counts [counts], shape ``(N, 19)``.

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
