"""What a system is given, and what a system is: the interface that all share.

A system sees rows with all that was known about them, fits on the training rows, may choose on the
validation rows, and then estimates one quantity of rows that it has never seen. Everything random
in it comes from the seed, so the same rows and seed give the same estimates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX
from palpate_training.datasets.experiment import ExperimentDataset, SimulatedContact

FloatArray = npt.NDArray[np.float32]
IndexArray = npt.NDArray[np.int32]
Rows = npt.NDArray[np.int64]

Quantity = Literal["location", "force", "centre", "normal"]
"""Contact location [m], force [N], centre of pressure [m], contact normal (unit vector)."""

LOAD_OHM = 10_000.0
"""Resistor over which an electrode's voltage is read [ohm] (BioTac SP manual)."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Rows of pressed fingers; sensor frame, SI.

    Attributes:
        tared: Tared electrodes [counts], shape (N, 19).
        rest: Untouched electrodes [counts], shape (N, 19); NaN where the source does not hold them.
        trial: Trial of each row, shape (N,); rows of a trial are together, in order of travel.
        location: Contact location [m], shape (N, 3).
        force: Force on the BioTac [N], shape (N, 3).
        centre: Centre of pressure [m], shape (N, 3); NaN where it is not known.
        normal: Contact normal, out of the skin, shape (N, 3); NaN where it is not known.
    """

    tared: FloatArray
    rest: FloatArray
    trial: IndexArray
    location: FloatArray
    force: FloatArray
    centre: FloatArray
    normal: FloatArray

    def __len__(self) -> int:
        return len(self.tared)

    def take(self, rows: Rows) -> Samples:
        """Some of the rows."""
        return Samples(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Samples]) -> Samples:
        """The rows of several, one after another."""
        names = [field.name for field in fields(cls)]
        return cls(
            **{name: np.concatenate([getattr(one, name) for one in parts]) for name in names}
        )

    def truth(self, quantity: Quantity) -> FloatArray:
        """A quantity of every row, shape (N, 3)."""
        values: FloatArray = getattr(self, quantity)
        return values

    @property
    def knows_rest(self) -> bool:
        """Whether the untouched counts of every row are known."""
        return bool(np.isfinite(self.rest).all())


def samples_of(data: ExperimentDataset, contact: SimulatedContact | None = None) -> Samples:
    """All rows of a data set; ``contact`` is that of the same rows."""
    unknown = np.full((len(data), 3), np.nan, np.float32)
    return Samples(
        tared=np.asarray(data.tared * np.float32(COUNTS_MAX), np.float32),
        rest=data.trial_rest[data.trial],
        trial=data.trial,
        location=data.location,
        force=data.force,
        centre=unknown if contact is None else contact.centre,
        normal=unknown if contact is None else contact.normal,
    )


def impedance_ohm(counts: npt.NDArray[np.number]) -> npt.NDArray[np.float64]:
    """Impedance of electrodes that read so many counts [ohm] (BioTac SP manual).

    Readings at either end of the range are taken as one count inside it.
    """
    inside = np.clip(np.asarray(counts, np.float64), 1.0, COUNTS_MAX - 1.0)
    return (COUNTS_MAX / inside - 1.0) * LOAD_OHM


def counts_at(ohm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """What electrodes with such an impedance [ohm] read, not rounded; undoes `impedance_ohm`."""
    return COUNTS_MAX / (1.0 + ohm / LOAD_OHM)


Estimate = Callable[[Samples], FloatArray]
"""Estimates a quantity of rows, shape (N, 3)."""

Fit = Callable[[Quantity, Samples, Samples, int], Estimate]
"""Fits a system: quantity, training rows, validation rows, seed."""


@dataclass(frozen=True, slots=True)
class System:
    """A row of the tables.

    Attributes:
        name: As tables call it.
        source: Where it is specified.
        fit: Fits it.
        quantities: What it can estimate.
        seeded: Whether its estimates depend on the seed.
        version: To be raised when its estimates change, so that kept results are made again.
    """

    name: str
    source: str
    fit: Fit
    quantities: tuple[Quantity, ...]
    seeded: bool = False
    version: int = 1


def error_of(estimate: npt.NDArray[np.floating], truth: npt.NDArray[np.floating]) -> float:
    """Median distance of estimates from the truth, both (N, 3): what choices are made by."""
    return float(np.median(np.linalg.norm(np.asarray(estimate, np.float64) - truth, axis=1)))
