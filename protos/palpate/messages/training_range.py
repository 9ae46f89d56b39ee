"""What a bundle was trained on, as far as its estimates are compared with it (docs/adr/0021)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ValueRange:
    """Values that one input or output of a model had in the training rows.

    Attributes:
        name: Name of the tensor, e.g. ``"electrodes"``.
        unit: Unit of the values below.
        low: Smallest of each value; empty = the values have no range of their own.
        high: Largest of each value, likewise.
        length_max: Longest vector: the largest force, or the farthest that any node moved;
            0 = not known.
    """

    name: str
    unit: str
    low: Sequence[float] = ()
    high: Sequence[float] = ()
    length_max: float = 0.0


@dataclass(frozen=True, slots=True)
class TrainingRange:
    """What a bundle was trained on.

    Attributes:
        source: One line for people.
        data_sha256: Digest of the data set, hex.
        rows: Rows of it that were trained on.
        combinations: Whether the bundle also knows which inputs occur together.
    """

    source: str
    data_sha256: str
    rows: int
    inputs: Sequence[ValueRange]
    outputs: Sequence[ValueRange]
    combinations: bool = False
