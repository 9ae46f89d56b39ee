"""Hold out whole trajectories: what one finger was tested on, no finger was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.splits import Rows, Split, by_group
from palpate_training.twin.content import ExperimentDataset


@dataclass(frozen=True, slots=True)
class Held:
    """Rows of some units, dealt by trajectory.

    Attributes:
        units: Their names.
        split: Rows of train, validation and test.
    """

    units: tuple[str, ...]
    split: Split


def by_trajectory(data: ExperimentDataset, *, seed: int = 0) -> Split:
    """Deal 70, 20 and 10 % of the unique trajectories to train, test and validation.

    The paper keeps a trajectory's rows together (section "Contiguity"); here every execution of
    it, on whatever unit, is also on the same side, so that no network has seen the same press on a
    sister finger.

    Args:
        data: Rows with their unique trajectories.
        seed: Seed of the deal.

    Raises:
        DatasetError: There are fewer than three trajectories.
    """
    return by_group(data.row_trajectory, test_share=0.2, validation_share=0.1, seed=seed)


def of_units(data: ExperimentDataset, split: Split, units: Sequence[str]) -> Held:
    """The rows of a split that belong to some units.

    Args:
        data: Rows with their units.
        split: Rows of all units.
        units: Names of units.

    Raises:
        DatasetError: A unit is not in the data set, or one side of the split has no row of them.
    """
    unknown = [unit for unit in units if unit not in data.unit_names]
    if unknown or not units:
        raise DatasetError(
            f"the data set has no unit {', '.join(unknown) or '(none was asked for)'}",
            remedy=f"choose from {', '.join(data.unit_names)}",
        )
    wanted = np.isin(data.row_unit, [data.unit_names.index(unit) for unit in units])

    def keep(rows: Rows) -> npt.NDArray[np.int64]:
        return rows[wanted[rows]]

    sides = {side: keep(getattr(split, side)) for side in ("train", "validation", "test")}
    for side, rows in sides.items():
        if not rows.size:
            raise DatasetError(
                f"no {side} row of {', '.join(units)} is left after holding trajectories out",
                remedy="use a data set with more trajectories of these units, or another seed",
            )
    guard = keep(split.guard)
    return Held(tuple(units), Split(sides["train"], sides["validation"], sides["test"], guard))


def unit_sets(data: ExperimentDataset) -> list[tuple[str, ...]]:
    """Each unit that has rows by itself, then all of them together if there are several."""
    present = [name for i, name in enumerate(data.unit_names) if bool(np.any(data.row_unit == i))]
    each = [(name,) for name in present]
    return each + ([tuple(present)] if len(present) > 1 else [])
