"""The statistics that the paper reports of its data set, for any data set; targets of the twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.anatomy import core_normal
from palpate_training.datasets.experiment import ExperimentDataset
from palpate_training.datasets.trials import press_kind
from palpate_training.figures.skin import final_rows

Floats = npt.NDArray[np.float64]

SHEARED = 0.3
"""Tangential over whole force from which a press counts as sheared; tan of 17 degrees."""


@dataclass(frozen=True, slots=True)
class PaperSpecimen:
    """What the captions of the paper's figures state about one BioTac."""

    tared_min: float
    tared_max: float
    force_max_n: float


PAPER_UNITS = (
    PaperSpecimen(-0.65, 0.13, 23.4),
    PaperSpecimen(-0.78, 0.11, 32.1),
    PaperSpecimen(-0.51, 0.17, 29.0),
)
"""BioTac 1, 2 and 3 (captions of the paper's force and electrode figures)."""

PAPER_TRAJECTORIES, PAPER_TRIALS, PAPER_ROWS = 411, 889, 17_703
"""Unique trajectories, trajectories over all BioTacs, time steps (section on data processing)."""

PAPER_SHEARED = 0.7
"""Share of trajectories "designed to induce shear" (contributions of the paper)."""


@dataclass(frozen=True, slots=True)
class ElectrodeGroupTarget:
    """Electrodes that share a target of the standard deviation of their tared values.

    Attributes:
        name: For people.
        electrodes: Indices.
        low: Least standard deviation of the target [1].
        high: Largest.
    """

    name: str
    electrodes: tuple[int, ...]
    low: float
    high: float

    def within(self, sd: Floats) -> bool:
        """Whether the mean of the group's standard deviations meets the target."""
        return self.low <= float(sd[list(self.electrodes)].mean()) <= self.high


ELECTRODE_GROUPS = (
    ElectrodeGroupTarget("E1-E6, E11-E14", (0, 1, 2, 3, 4, 5, 10, 11, 12, 13), 0.041, 0.059),
    ElectrodeGroupTarget("E7-E10", (6, 7, 8, 9), 0.016, 0.020),
    ElectrodeGroupTarget("E15-E19", (14, 15, 16, 17, 18), 0.025, 0.034),
)
"""Of real sensors, dominated by light contacts (learning notes, section 4.5)."""

ELECTRODE_MEANS = (-0.016, 0.009)
"""Range of the mean tared values of real electrodes (the same section)."""


@dataclass(frozen=True, slots=True)
class SpecimenStatistics:
    """One BioTac's part of a data set.

    Attributes:
        name: Its name.
        trials: How many it executed, of those that left rows.
        trajectories: How many unique ones among them.
        rows: Rows of all its trials.
        rows_per_trial: Fewest, mean and most.
        tared_min: Lowest tared value of any electrode [1].
        tared_max: Highest.
        electrode_mean: Mean tared value of each electrode [1], shape (19,).
        electrode_sd: Standard deviation of the same [1], shape (19,).
        force_max_n: Largest magnitude of force [N].
        force_median_n: Its median [N].
        angled_share: Share of trials whose trajectory was planned angled, see `angled_share`.
        sheared_share: Share of trials whose last force is sheared, see `shear_ratio`.
    """

    name: str
    trials: int
    trajectories: int
    rows: int
    rows_per_trial: tuple[int, float, int]
    tared_min: float
    tared_max: float
    electrode_mean: Floats
    electrode_sd: Floats
    force_max_n: float
    force_median_n: float
    angled_share: float
    sheared_share: float


@dataclass(frozen=True, slots=True)
class DatasetStatistics:
    """All units of a data set.

    Attributes:
        units: One by one, in the data set's order; those without rows are left out.
        trajectories: Unique trajectories that left rows.
        trials: Over all units.
        rows: Over all units.
        angled_share: Share of unique trajectories that were planned angled, see `angled_share`.
    """

    units: tuple[SpecimenStatistics, ...]
    trajectories: int
    trials: int
    rows: int
    angled_share: float


def shear_ratio(force: Floats, location: Floats) -> Floats:
    """Tangential over whole force, 0..1, shape (N,); NaN where there is no force.

    The normal is that of the core's form, cylinder and spherical tip, at the contact location: the
    data set does not hold the skin's. For long and flat indenters, whose tip is not where they
    touch, it is a rough number.

    Args:
        force: [N], shape (N, 3), sensor frame.
        location: [m], shape (N, 3), sensor frame.
    """
    exact = np.asarray(force, np.float64)
    normal = core_normal(np.asarray(location, np.float64))
    along = np.einsum("nc,nc->n", exact, normal)
    tangential = np.linalg.norm(exact - along[:, None] * normal, axis=1)
    whole = np.linalg.norm(exact, axis=1)
    return np.asarray(
        np.divide(tangential, whole, out=np.full(len(whole), np.nan), where=whole > 0)
    )


def angled_share(trajectories: Sequence[str]) -> float:
    """Share of trajectories planned angled, by their ids ``<indenter>/<point>/<normal|angled-k>``.

    NaN where an id has another form, as those of published files.
    """
    kinds = [press_kind(name) for name in trajectories]
    if not kinds or not set(kinds) <= {"normal", "angled"}:
        return float("nan")
    return kinds.count("angled") / len(kinds)


def dataset_statistics(data: ExperimentDataset) -> DatasetStatistics:
    """Count and measure a data set."""
    last = final_rows(data)
    used = np.unique(data.row_trajectory[last])
    units = tuple(
        _unit(data, unit, last[data.row_unit[last] == unit])
        for unit in range(len(data.unit_names))
        if (data.row_unit[last] == unit).any()
    )
    return DatasetStatistics(
        units, len(used), len(last), len(data), angled_share([data.trajectories[i] for i in used])
    )


def _unit(
    data: ExperimentDataset,
    unit: int,
    last: npt.NDArray[np.int64],
) -> SpecimenStatistics:
    """One unit, whose trials end at rows ``last``."""
    rows = data.row_unit == unit
    tared = data.tared[rows].astype(np.float64)
    force = np.linalg.norm(data.force[rows].astype(np.float64), axis=1)
    lengths = np.unique(data.trial[rows], return_counts=True)[1]
    trajectory = data.row_trajectory[last]
    ratio = shear_ratio(data.force[last].astype(np.float64), data.location[last].astype(np.float64))
    return SpecimenStatistics(
        name=data.unit_names[unit],
        trials=len(last),
        trajectories=len(np.unique(trajectory)),
        rows=int(np.count_nonzero(rows)),
        rows_per_trial=(int(lengths.min()), float(lengths.mean()), int(lengths.max())),
        tared_min=float(tared.min()),
        tared_max=float(tared.max()),
        electrode_mean=tared.mean(axis=0),
        electrode_sd=tared.std(axis=0),
        force_max_n=float(force.max()),
        force_median_n=float(np.median(force)),
        angled_share=angled_share([data.trajectories[i] for i in trajectory]),
        sheared_share=float(np.mean(ratio > SHEARED)),
    )
