"""Whether an input, or an output, lies beyond what a bundle was trained on (docs/adr/0021)."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from palpate.files.bundle import Bundle
from palpate.files.training_range import KnownInputs
from palpate.messages import FloatArray, QualityFlag, TrainingRange, ValueRange

MARGIN = 0.05
"""A value may lie this share of its range beyond the ends: training rows do not reach the very ends
of what the model can do."""


class RangeCheck:
    """Compares inputs and outputs of a bundle with its training range. Keeps no state.

    Some 10 microseconds for 19 electrodes (docs/results/quality.md).
    """

    def __init__(self, known: TrainingRange | None, inputs: KnownInputs | None) -> None:
        self._known = known
        self._inputs = [] if known is None else [_Ends(one) for one in known.inputs]
        self._outputs = {} if known is None else {one.name: _Ends(one) for one in known.outputs}
        self._combinations = None if inputs is None else _Combinations(inputs)

    @classmethod
    def of(cls, bundle: Bundle) -> RangeCheck:
        """The check of a bundle; of one that does not know its range, one that says so."""
        return cls(bundle.manifest.training_range, bundle.known_inputs)

    def flags(
        self, sample: FloatArray, outputs: Mapping[str, FloatArray], *, without: Collection[str]
    ) -> tuple[QualityFlag, ...]:
        """What is to be said of an estimate.

        Args:
            sample: What the model got, flat.
            outputs: What it made of it, by name.
            without: Outputs that are not part of the estimate.
        """
        if self._known is None:
            return (QualityFlag.RANGE_UNKNOWN,)
        unlike = any(ends.exceeded(sample) for ends in self._inputs) or (
            self._combinations is not None and self._combinations.unknown(sample)
        )
        beyond = any(
            name not in without and ends.exceeded(outputs[name])
            for name, ends in self._outputs.items()
        )
        return _FLAGS[unlike, beyond]


_FLAGS: dict[tuple[bool, bool], tuple[QualityFlag, ...]] = {
    (False, False): (),
    (True, False): (QualityFlag.OUT_OF_RANGE,),
    (False, True): (QualityFlag.EXTRAPOLATING,),
    (True, True): (QualityFlag.OUT_OF_RANGE, QualityFlag.EXTRAPOLATING),
}


class _Ends:
    """The ends of one tensor's values, widened by ``MARGIN``."""

    def __init__(self, known: ValueRange) -> None:
        low, high = (np.array(side, np.float32) for side in (known.low, known.high))
        widened = np.float32(MARGIN) * (high - low)
        self._low, self._high = low - widened, high + widened
        self._squared_max = (known.length_max * (1.0 + MARGIN)) ** 2

    def exceeded(self, values: FloatArray) -> bool:
        """Whether any value, or the length of any vector, lies beyond them."""
        if len(self._low) and bool(((values < self._low) | (values > self._high)).any()):
            return True
        if not self._squared_max:
            return False
        vectors = values.reshape(-1, 3)
        return bool(np.einsum("ij,ij->i", vectors, vectors).max() > self._squared_max)


class _Combinations:
    """Which values occur together: the distance from the nearest representative."""

    def __init__(self, known: KnownInputs) -> None:
        self._scale = np.float32(known.scale)
        self._prototypes = np.ascontiguousarray(known.prototypes)
        # |q - p|^2 = |q|^2 + (|p|^2 - 2 q.p): what does not depend on q is computed once.
        self._squared = np.einsum("ij,ij->i", known.prototypes, known.prototypes)
        self._limit = np.float32(known.distance_max**2)

    def unknown(self, sample: FloatArray) -> bool:
        compressed = np.arcsinh(sample / self._scale)
        nearest = (self._squared - 2.0 * (self._prototypes @ compressed)).min()
        return bool(nearest + compressed @ compressed > self._limit)
