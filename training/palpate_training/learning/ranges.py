"""What a network was trained on, for the bundle it ships in (docs/adr/0021).

The ends of every value, and representatives of the inputs: rows of the training set, each the one
that lies farthest from those chosen before. So the last distance is a radius within which *every*
training row has a representative. A press that was never seen lies farther away, though the network
is good for it; how far is learned by holding presses out.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from palpate.files.training_range import KnownInputs
from palpate.messages import FloatArray, ValueRange

PROTOTYPES = 256
"""Representatives; 512 tell real fingers apart no better (docs/results/quality.md)."""

SCALE_COUNTS = 30.0
"""Changes up to about this many counts are compared as they are, larger ones by their logarithm: an
untouched finger drifts and is noisy by about as much."""

ACCEPTED = 0.98
"""Share of the rows of presses held out that shall lie within the limit."""

SHRINK = 3.0
"""Variance added to that of every direction before it is divided by its root [compressed counts^2]:
chosen on each of two real fingers for the other, which agree (docs/results/quality.md)."""

_FOLDS = 5


def ends_of(name: str, unit: str, rows: npt.NDArray[np.floating]) -> ValueRange:
    """Smallest and largest of every value of rows ``(N, I)``, and of vectors the longest."""
    length_max = 0.0
    if rows.shape[1] == 3:
        length_max = float(np.linalg.norm(rows, axis=1).max())
    return ValueRange(
        name, unit, _short(rows.min(axis=0)), _short(rows.max(axis=0)), _shorter(length_max)
    )


def longest_of(name: str, unit: str, parts: Iterable[npt.NDArray[np.floating]]) -> ValueRange:
    """The longest vector in any of the parts, each of shape ``(N, V, 3)``."""
    longest = max(float(np.linalg.norm(part, axis=2).max()) for part in parts)
    return ValueRange(name, unit, length_max=_shorter(longest))


def known_inputs(
    rows: FloatArray,
    groups: npt.NDArray[np.integer],
    *,
    scale: float = SCALE_COUNTS,
    most: int = PROTOTYPES,
) -> KnownInputs:
    """Representatives of rows ``(N, I)``, the same each time.

    ``groups`` names the press of each row, shape ``(N,)``. Presses are held out in five parts; the
    limit is the distance within which ``ACCEPTED`` of their rows lie from the other presses'
    representatives, and no training row lies beyond it.
    """
    compressed = np.arcsinh(rows / np.float32(scale)).astype(np.float32)
    every = _spread(compressed, most)
    metric = metric_of(every)
    radius = float(_nearest(compressed @ metric, every @ metric).max())
    names = np.unique(groups)
    parts = np.array_split(np.random.default_rng(0).permutation(names), min(_FOLDS, len(names)))
    held = [np.isin(groups, part) for part in parts if len(parts) > 1]
    distances = [
        _nearest(compressed[out] @ metric, _spread(compressed[~out], most) @ metric) for out in held
    ]
    unseen = float(np.quantile(np.concatenate(distances), ACCEPTED)) if distances else 0.0
    # A handful of rows may all be representatives of their own; noise must still be let through.
    return KnownInputs(every, scale, max(1.001 * radius, unseen, 1e-3), metric)


def metric_of(representatives: FloatArray, shrink: float = SHRINK) -> FloatArray:
    """The matrix that makes directions count more in which representatives ``(P, I)`` vary less.

    A press moves the electrodes together, in few ways; what is not one of these ways is odd long
    before it is large.
    """
    centred = representatives.astype(np.float64) - representatives.mean(axis=0)
    variance, directions = np.linalg.eigh(centred.T @ centred / len(centred))
    scaled = directions / np.sqrt(np.maximum(variance, 0.0) + shrink)
    return np.asarray(scaled @ directions.T, np.float32)


def places_of(
    known: KnownInputs, rows: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Where rows ``(N, I)`` lie, as a service finds it.

    Returns:
        Distance of each from the nearest representative, over the limit; and its common mode.
    """
    compressed = np.arcsinh(rows.astype(np.float64) / known.scale)
    metric = np.eye(rows.shape[1]) if known.metric is None else known.metric.astype(np.float64)
    distance = _nearest(compressed @ metric, known.prototypes.astype(np.float64) @ metric)
    return distance / known.distance_max, compressed.mean(axis=1)


def _spread(rows: FloatArray, most: int) -> FloatArray:
    """Representatives of rows."""
    norms = np.einsum("ij,ij->i", rows, rows)
    chosen = [int(np.argmax(norms))]
    squared = _squared_distance(rows, norms, chosen[0])
    for _ in range(min(most, len(rows)) - 1):
        chosen.append(int(np.argmax(squared)))
        squared = np.minimum(squared, _squared_distance(rows, norms, chosen[-1]))
    return rows[chosen]


def _nearest(
    rows: npt.NDArray[np.floating], representatives: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64]:
    """Distance of each row from its nearest representative, shape ``(N,)``."""
    own = np.einsum("ij,ij->i", rows, rows)
    theirs = np.einsum("ij,ij->i", representatives, representatives)
    squared = theirs - 2.0 * (rows @ representatives.T)
    nearest: npt.NDArray[np.float64] = np.maximum(squared.min(axis=1) + own, 0.0).astype(np.float64)
    return np.sqrt(nearest)


def _squared_distance(rows: FloatArray, norms: FloatArray, at: int) -> FloatArray:
    found: FloatArray = norms - 2.0 * (rows @ rows[at]) + norms[at]
    return found


def _short(values: npt.NDArray[np.floating]) -> tuple[float, ...]:
    return tuple(map(_shorter, values.tolist()))


def _shorter(value: float) -> float:
    """Six digits: float32 has no more, and people read them."""
    return float(f"{value:.6g}")
