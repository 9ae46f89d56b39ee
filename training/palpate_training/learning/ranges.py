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
    every, radius = _spread(compressed, most)
    names = np.unique(groups)
    parts = np.array_split(np.random.default_rng(0).permutation(names), min(_FOLDS, len(names)))
    held = [np.isin(groups, part) for part in parts if len(parts) > 1]
    distances = [_nearest(compressed[out], _spread(compressed[~out], most)[0]) for out in held]
    unseen = float(np.quantile(np.concatenate(distances), ACCEPTED)) if distances else 0.0
    # A handful of rows may all be representatives of their own; noise must still be let through.
    return KnownInputs(every, scale, max(1.001 * radius, unseen, 1e-3))


def _spread(rows: FloatArray, most: int) -> tuple[FloatArray, float]:
    """Representatives of rows, and the largest distance of any row from its nearest."""
    norms = np.einsum("ij,ij->i", rows, rows)
    chosen = [int(np.argmax(norms))]
    squared = _squared_distance(rows, norms, chosen[0])
    for _ in range(min(most, len(rows)) - 1):
        chosen.append(int(np.argmax(squared)))
        squared = np.minimum(squared, _squared_distance(rows, norms, chosen[-1]))
    return rows[chosen], float(np.sqrt(max(float(squared.max()), 0.0)))


def _nearest(rows: FloatArray, representatives: FloatArray) -> npt.NDArray[np.floating]:
    """Distance of each row from its nearest representative, shape ``(N,)``."""
    own = np.einsum("ij,ij->i", rows, rows)
    theirs = np.einsum("ij,ij->i", representatives, representatives)
    squared = theirs - 2.0 * (rows @ representatives.T)
    distances: npt.NDArray[np.floating] = np.sqrt(np.maximum(squared.min(axis=1) + own, 0.0))
    return distances


def _squared_distance(rows: FloatArray, norms: FloatArray, at: int) -> FloatArray:
    found: FloatArray = norms - 2.0 * (rows @ rows[at]) + norms[at]
    return found


def _short(values: npt.NDArray[np.floating]) -> tuple[float, ...]:
    return tuple(map(_shorter, values.tolist()))


def _shorter(value: float) -> float:
    """Six digits: float32 has no more, and people read them."""
    return float(f"{value:.6g}")
