"""An experiment as the study sees it: presses on known points, simulated, executed or published."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import numpy.typing as npt

from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    content_sha256,
)
from palpate_training.datasets.trials import press_kind
from palpate_training.evaluation.cells import Task
from palpate_training.evaluation.features import FeatureTask, force_shares, systems_of
from palpate_training.evaluation.pictures import Made, Picture, draw_forces, draw_task
from palpate_training.evaluation.skin import FieldTask, SynthesisTask, of_one_unit
from palpate_training.learning.splits import (
    ALL_UNITS,
    PART_SPLITS,
    Fold,
    SplitName,
    folds_of,
    folds_of_part,
    rows_of_part,
)
from palpate_training.systems.samples import Quantity, samples_of

TASKS = (*get_args(Quantity), "field", "synthesis")

TASK_SPLITS: dict[str, tuple[SplitName, ...]] = {
    "location": ("trajectory", "execution", "point", "indenter", "unit", "neighbour"),
    "force": ("trajectory", "execution", "point", "indenter", "unit", "neighbour"),
    "centre": ("trajectory", "point", "indenter", "unit", "neighbour"),
    "normal": ("trajectory", "point", "indenter", "unit", "neighbour"),
    "field": ("trajectory", "point", "indenter", "unit", "neighbour"),
    "synthesis": ("trajectory", "point", "indenter", "neighbour"),
}
"""Synthesis has no unseen unit: its network is of one unit."""

OF_EACH_UNIT: tuple[SplitName, ...] = ("trajectory", "unit")
"""Splits that are made of each unit alone, too; the others of all units together."""


@dataclass(frozen=True, slots=True)
class ExperimentSource:
    """One or two data sets of an experiment.

    Attributes:
        experiment: For location and force.
        mixed: For the other tasks; None leaves them out.
        part: Part of joined data sets whose rows alone are tested; all the others' are learned
            from. Empty: the rows of all parts are dealt to the sides.
    """

    experiment: ExperimentDataset
    mixed: MixedDataset | None
    part: str = ""

    def task(self, name: str) -> Task | None:
        """A task by name; None if the data does not hold it."""
        if name in ("location", "force"):
            return self._features("force" if name == "force" else "location", self.experiment)
        if self.mixed is None:
            return None
        if name in ("centre", "normal"):
            if self.mixed.contact is None:
                return None
            return self._features("centre" if name == "centre" else "normal", self.mixed)
        digest = content_sha256(self.mixed)
        return (FieldTask if name == "field" else SynthesisTask)(digest, self.mixed)

    def _features(self, name: Quantity, data: ExperimentDataset | MixedDataset) -> FeatureTask:
        rows = data.experiment if isinstance(data, MixedDataset) else data
        contact = data.contact if isinstance(data, MixedDataset) else None
        kind = np.array([press_kind(each) for each in rows.trajectories])
        return FeatureTask(
            name,
            content_sha256(data),
            samples_of(rows, contact),
            cluster=rows.row_trajectory,
            kind=kind[rows.row_trajectory],
            systems=systems_of(name),
        )

    def splits(self, task: str) -> tuple[SplitName, ...]:
        """Splits of a task that the data can be split by; the first gets several seeds."""
        splits = TASK_SPLITS[task]
        if self.part:
            return tuple(one for one in splits if one in PART_SPLITS)
        if not all(press_kind(each) for each in self._rows(task).trajectories):
            return tuple(one for one in splits if one != "point")
        return splits

    def folds(self, task: str, split: SplitName, *, seed: int, whole: bool) -> list[Fold]:
        """Trainings of a split; ``whole``: only those of all units together, in every split."""
        rows = self._rows(task)
        if self.part:
            folds = folds_of_part(rows, self.part, split, seed=seed)
        else:
            folds = folds_of(rows, split, seed=seed)
        if task == "synthesis":
            assert self.mixed is not None
            return of_one_unit(folds, self.mixed)
        together = [fold for fold in folds if fold.test == ALL_UNITS or " + " in fold.test]
        return together if together and (whole or split not in OF_EACH_UNIT) else folds

    def _rows(self, task: str) -> ExperimentDataset:
        if task in ("location", "force"):
            return self.experiment
        assert self.mixed is not None
        return self.mixed.experiment

    @property
    def provenance(self) -> tuple[Provenance, ...]:
        """Where the data comes from."""
        mixed = () if self.mixed is None else (self.mixed.experiment.provenance,)
        return (self.experiment.provenance, *mixed)

    @property
    def row_counts(self) -> dict[str, int]:
        """Rows of each data set, and trajectories."""
        counts = {
            "trajectories": len(self.experiment.trajectories),
            "rows of the experiment": len(self.experiment),
        }
        if self.mixed is not None:
            counts["mixed rows with fields"] = len(self.mixed)
        if self.part:
            tested = rows_of_part(self.experiment, self.part)
            counts[f"rows of {self.part}, of which alone some are tested"] = int(tested.sum())
        return counts

    @property
    def _force_n(self) -> npt.NDArray[np.float64]:
        """Magnitude of the force of each row of the experiment, or of its part [N]."""
        force = self.experiment.force.astype(np.float64)
        if self.part:
            force = force[rows_of_part(self.experiment, self.part)]
        return np.asarray(np.linalg.norm(force, axis=1))

    @property
    def forces(self) -> dict[str, float]:
        """How strong the presses are."""
        return force_shares(self._force_n)

    def draw(self, out: Path, made: Mapping[str, tuple[Task, Made]]) -> list[Picture]:
        """Draw what there is to show of each task into ``out``."""
        pictures = [draw_forces(out, self._force_n)]
        for name, (task, results) in made.items():
            pictures += draw_task(out, task, self._rows(name), results)
        return pictures
