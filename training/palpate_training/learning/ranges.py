"""What a network was trained on, for the bundle it ships in (docs/adr/0021).

The ends of every value, and representatives of the inputs: rows of the training set, each the one
that lies farthest from those chosen before. So the last distance is a radius within which *every*
training row has a representative. A press that was never seen lies farther away, though the network
is good for it; how far is learned by holding presses out.

Where there are presses enough, also how the values go together (docs/adr/0031): of the values and
their products the combinations that hardly vary. A press moves all electrodes by what happens to
one skin over one core, and an input that breaks these rules is odd long before it is far.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from palpate.files.training_range import InputPattern, KnownInputs, pattern_terms
from palpate.messages import FloatArray, ValueRange

PROTOTYPES = 256
"""Representatives; 512 tell real fingers apart no better (docs/results/quality.md)."""

SCALE_COUNTS = 30.0
"""Changes up to about this many counts are compared as they are, larger ones by their logarithm: an
untouched finger drifts and is noisy by about as much."""

ACCEPTED = 0.98
"""Share of the rows of presses held out that shall lie within the limit."""

_FOLDS = 5

PATTERN_SCALE_COUNTS = 80.0
PATTERN_SHRINK = 0.0003
"""Compression of the values, and what is added to the variance of each combination over that of one
term: chosen with both real fingers in view. Chosen on each of them for the other, the compression
is 60 (docs/results/intervals.md)."""

UNLIKE = 0.006
"""Share of the rows of a press held out that may be flagged by the pattern. One per cent of the
rows of new presses may be flagged in all: rows beyond the training range are flagged, too, and
presses held out are less strange than new ones. Chosen on 500 presses at random and on one real
finger (training/LOG.md)."""

PRESSES_OF_PATTERN = 50
"""Fewer presses do not know 209 combinations."""

_PATTERN_FOLDS = 9

_CONSTANT = 1e-6
"""Spread of a term, which has no unit, that is rounding: a value that never changes."""

_ROWS_AT_ONCE = 1 << 16


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
    known = KnownInputs(every, scale, max(1.001 * radius, unseen, 1e-3))
    if len(names) < PRESSES_OF_PATTERN:
        return known
    return with_pattern(known, rows, groups, among=True)[0]


def with_pattern(
    known: KnownInputs,
    rows: npt.NDArray[np.floating],
    groups: npt.NDArray[np.integer],
    *,
    among: bool = False,
    unlike: float = UNLIKE,
    scale: float = PATTERN_SCALE_COUNTS,
    shrink: float = PATTERN_SHRINK,
) -> tuple[KnownInputs, npt.NDArray[np.float64]]:
    """The same with a pattern of its representatives and of rows ``(N, I)``.

    The limit leaves out a share ``unlike`` of the rows of presses that the pattern was made
    without; each press counts the same.

    Args:
        known: Representatives of the training rows.
        rows: Inputs, shape ``(N, I)``.
        groups: Press of each row, shape ``(N,)``.
        among: The representatives are some of these rows: each row counts once then, and none is
            in a pattern that its own press is measured with.
        unlike: Share of the rows of presses held out that may be flagged.
        scale: Of the compression of the values, in their unit.
        shrink: Added to the variance of each combination, over that of one term.

    Returns:
        What is known then, and how strange each row is without its press, over the limit.
    """
    whole = np.sinh(known.prototypes.astype(np.float64)) * known.scale
    origin = pattern_terms(np.arcsinh(whole / scale)).mean(axis=0)
    names = np.random.default_rng(0).permutation(np.unique(groups))
    held = [
        np.isin(groups, part) for part in np.array_split(names, min(_PATTERN_FOLDS, len(names)))
    ]
    parts = [_products(rows[out], scale, origin) for out in held]
    every = functools.reduce(np.add, parts)
    if not among:
        every = _products(whole, scale, origin) + every
    strange = np.zeros(len(rows))
    for out, part in zip(held, parts, strict=True):
        strange[out] = strangeness(_pattern(every - part, scale, origin, shrink), rows[out])
    pattern = _pattern(every, scale, origin, shrink)
    most = _share_below(strange, groups, 1.0 - unlike)
    return replace(known, pattern=replace(pattern, most=_shorter(most))), strange / most


def strangeness(pattern: InputPattern, rows: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Of each row ``(N, I)``, over the limit, shape ``(N,)``: above one it is flagged."""
    compressed = np.arcsinh(rows.astype(np.float64) / pattern.scale)
    odd = (pattern_terms(compressed) - pattern.centre) @ pattern.weights
    found: npt.NDArray[np.float64] = np.sqrt(np.mean(odd**2, axis=1)) / pattern.most
    return found


def places_of(
    known: KnownInputs, rows: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Where rows ``(N, I)`` lie, as a service finds it.

    Returns:
        How far each is from the known ones, over the limit; and its common mode.
    """
    if known.pattern is not None:
        common = np.arcsinh(rows.astype(np.float64) / known.pattern.scale).mean(axis=1)
        return strangeness(known.pattern, rows), common
    compressed = np.arcsinh(rows.astype(np.float64) / known.scale)
    distance = _nearest(compressed, known.prototypes.astype(np.float64)).astype(np.float64)
    return distance / known.distance_max, compressed.mean(axis=1)


def holds_known(known: KnownInputs, rows: npt.NDArray[np.floating]) -> bool:
    """Whether rows ``(N, I)`` are of the training: a representative, which is a row of it, is here.

    Representatives of which few values differ from zero tell nothing: untouched rows are alike.
    """

    def codes(compressed: npt.NDArray[np.floating]) -> list[bytes]:
        # Rounded: processors differ in the last digit. Plus zero: there is a negative one, too.
        return [row.tobytes() for row in (np.round(compressed, 4) + 0.0).astype(np.float32)]

    telling = 2 * np.count_nonzero(known.prototypes, axis=1) > known.prototypes.shape[1]
    own, scale = set(codes(known.prototypes[telling])), np.float32(known.scale)
    return any(
        not own.isdisjoint(codes(np.arcsinh(rows[first : first + _ROWS_AT_ONCE] / scale)))
        for first in range(0, len(rows), _ROWS_AT_ONCE)
    )


def _products(
    rows: npt.NDArray[np.floating], scale: float, origin: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Sums over rows of the products of ``(1, terms - origin)``, shape ``(1 + T, 1 + T)``.

    The sums of several parts add up, and those of one part can be subtracted. So no row is summed
    twice, whichever presses are held out.
    """
    found = np.zeros((1 + len(origin), 1 + len(origin)))
    for first in range(0, len(rows), _ROWS_AT_ONCE):
        some = rows[first : first + _ROWS_AT_ONCE].astype(np.float64)
        terms = pattern_terms(np.arcsinh(some / scale)) - origin
        terms = np.hstack([np.ones((len(terms), 1)), terms])
        found += terms.T @ terms
    return found


def _pattern(
    products: npt.NDArray[np.float64],
    scale: float,
    origin: npt.NDArray[np.float64],
    shrink: float,
) -> InputPattern:
    """The pattern of the rows that ``_products`` are of, with a limit of one."""
    moments = products / products[0, 0]
    centre = moments[0, 1:]
    covariance = moments[1:, 1:] - np.outer(centre, centre)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    spread = np.where(spread > _CONSTANT, spread, 1.0)
    variance, directions = np.linalg.eigh(covariance / np.outer(spread, spread))
    weights = directions / np.sqrt(np.maximum(variance, 0.0) + shrink) / spread[:, None]
    centre = (origin + centre).astype(np.float32)
    return InputPattern(scale, centre, weights.astype(np.float32), 1.0)


def _share_below(
    values: npt.NDArray[np.float64], groups: npt.NDArray[np.integer], share: float
) -> float:
    """The value below which this share of the rows lies, each group counting the same."""
    _, number, rows = np.unique(groups, return_inverse=True, return_counts=True)
    order = np.argsort(values, kind="stable")
    weight = np.cumsum(1.0 / rows[number[order]]) / len(rows)
    return float(values[order][min(int(np.searchsorted(weight, share)), len(values) - 1)])


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
