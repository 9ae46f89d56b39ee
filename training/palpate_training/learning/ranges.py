"""What a network was trained on, for the bundle it ships in (docs/adr/0019).

The ends of every value, and representatives of the inputs: rows of the training set, each the one
that lies farthest from those chosen before. So the last distance is a radius within which *every*
training row has a representative, and what lies outside of it is unlike all of them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from palpate.files.training_range import KnownInputs
from palpate.messages import FloatArray, ValueRange

PROTOTYPES = 256
"""Representatives. More of them draw a tighter border: held-out rows are flagged three times as
often with 512, and real fingers are told apart with 256 already (docs/results/quality.md)."""

SCALE_COUNTS = 30.0
"""Changes up to about this many counts are compared as they are, larger ones by their logarithm: an
untouched finger drifts and is noisy by about as much."""

SLACK = 1.1
"""Share by which the radius is widened: held-out rows lie between the training rows."""


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
    rows: FloatArray, *, scale: float = SCALE_COUNTS, most: int = PROTOTYPES
) -> KnownInputs:
    """Representatives of rows ``(N, I)``, the same each time."""
    compressed = np.arcsinh(rows / np.float32(scale)).astype(np.float32)
    norms = np.einsum("ij,ij->i", compressed, compressed)
    chosen = [int(np.argmax(norms))]
    squared = _squared_distance(compressed, norms, chosen[0])
    for _ in range(min(most, len(rows)) - 1):
        chosen.append(int(np.argmax(squared)))
        squared = np.minimum(squared, _squared_distance(compressed, norms, chosen[-1]))
    radius = float(np.sqrt(max(float(squared.max()), 0.0)))
    # A handful of rows may all be representatives of their own; noise must still be let through.
    return KnownInputs(compressed[chosen], scale, max(SLACK * radius, 1e-3))


def _squared_distance(rows: FloatArray, norms: FloatArray, at: int) -> FloatArray:
    found: FloatArray = norms - 2.0 * (rows @ rows[at]) + norms[at]
    return found


def _short(values: npt.NDArray[np.floating]) -> tuple[float, ...]:
    return tuple(map(_shorter, values.tolist()))


def _shorter(value: float) -> float:
    """Six digits: float32 has no more, and people read them."""
    return float(f"{value:.6g}")
