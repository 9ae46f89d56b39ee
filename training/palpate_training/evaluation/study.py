"""The whole study: every task, split, system and seed of a data set, as one JSON.

What the page shows is in that file, so tables and documents never disagree with what was measured.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from palpate import __version__
from palpate.errors import ConfigError
from palpate.files.atomic import written_whole
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    content_sha256,
)
from palpate_training.evaluation.cells import (
    Cell,
    CellResult,
    Task,
    cell_path,
    cells_of,
    make_cells,
    read_cell,
)
from palpate_training.evaluation.features import (
    FeatureTask,
    Scores,
    feature_task,
    ratios_to_paper,
    score,
)
from palpate_training.evaluation.pictures import draw_forces, draw_task
from palpate_training.evaluation.skin import (
    FieldTask,
    SynthesisTask,
    of_one_unit,
    score_fields,
    score_synthesis,
)
from palpate_training.learning.splits import ALL_UNITS, Fold, SplitName, folds_of
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


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """What is to be made.

    Attributes:
        tasks: Names of tasks.
        splits: Names of splits; a task leaves out those that it does not have.
        systems: Words of which a system's name must contain one; empty = all.
        seeds: Seeds of ``trajectory``; of the other splits the first alone.
        split_seed: Deals trajectories and points to the sides.
        whole: Only the folds of all units together; for a first look.
    """

    tasks: tuple[str, ...] = TASKS
    splits: tuple[SplitName, ...] = get_args(SplitName)
    systems: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    split_seed: int = 0
    whole: bool = False


class Study:
    """Tasks and cells of one or two data sets.

    Args:
        experiment: For location and force.
        mixed: For the other tasks; None leaves them out.
        plan: What is to be made.

    Raises:
        ConfigError: A task is not known or the data does not hold it, or no cell is left.
    """

    def __init__(
        self, experiment: ExperimentDataset, mixed: MixedDataset | None, plan: StudyPlan
    ) -> None:
        self.plan = plan
        self.experiment, self.mixed = experiment, mixed
        self.tasks: dict[str, Task] = {}
        self.cells: list[Cell] = []
        for name in plan.tasks:
            self._add(name)
        if not self.cells:
            raise ConfigError(
                "nothing is to be made: no system of these tasks and splits has such a name",
                remedy=f"tasks: {', '.join(TASKS)}; splits: {', '.join(get_args(SplitName))}",
            )

    def _add(self, name: str) -> None:
        task, data = self._task(name)
        if task is None or data is None:
            return
        self.tasks[name] = task
        for split in TASK_SPLITS[name]:
            if split not in self.plan.splits:
                continue
            folds = self._folds(name, data, split)
            seeds = self.plan.seeds if split == "trajectory" else self.plan.seeds[:1]
            self.cells += [
                cell for cell in cells_of(task, folds, seeds) if self._wanted(cell.system)
            ]

    def _task(self, name: str) -> tuple[Task | None, ExperimentDataset | None]:
        if name not in TASKS:
            raise ConfigError(f"there is no task {name!r}", remedy=f"one of: {', '.join(TASKS)}")
        if name in ("location", "force"):
            digest = content_sha256(self.experiment)
            return (
                feature_task("force" if name == "force" else "location", digest,
                             samples_of(self.experiment)),
                self.experiment,
            )  # fmt: skip
        if self.mixed is None:
            return None, None
        digest = content_sha256(self.mixed)
        rows = self.mixed.experiment
        if name in ("centre", "normal"):
            if self.mixed.contact is None:
                return None, None
            samples = samples_of(rows, self.mixed.contact)
            return feature_task("centre" if name == "centre" else "normal", digest, samples), rows
        if name == "field":
            return FieldTask(digest, self.mixed), rows
        return SynthesisTask(digest, self.mixed), rows

    def _folds(self, name: str, data: ExperimentDataset, split: SplitName) -> list[Fold]:
        folds = folds_of(data, split, seed=self.plan.split_seed)
        if name == "synthesis":
            assert self.mixed is not None
            return of_one_unit(folds, self.mixed)
        if not self.plan.whole:
            return folds
        together = [fold for fold in folds if fold.test == ALL_UNITS or " + " in fold.test]
        return together or folds

    def _wanted(self, system: str) -> bool:
        words = self.plan.systems
        return not words or any(word.lower() in system.lower() for word in words)

    def make(
        self,
        folder: Path,
        *,
        workers: int,
        device: str = "cpu",
        on_cell: Callable[[Cell, bool], None] = lambda *_: None,
    ) -> None:
        """Make the cells that the folder does not hold; see ``make_cells``."""
        make_cells(
            list(self.tasks.values()),
            self.cells,
            folder,
            workers=workers,
            device=device,
            on_cell=on_cell,
        )

    def results(self, folder: Path) -> dict[str, Any]:
        """All tables as plain values, from cells that are all made.

        Raises:
            DatasetError: A cell is missing or damaged.
        """
        scores: list[Scores] = []
        ratios: list[dict[str, Any]] = []
        for name, task in self.tasks.items():
            made = self._made(folder, name)
            scores += self._scores(task, made)
            if isinstance(task, FeatureTask):
                ratios += list(self._ratios(task, made))
        return {
            "schema": "palpate.study 1",
            "palpate": __version__,
            "sources": [asdict(self.experiment.provenance)]
            + ([] if self.mixed is None else [asdict(self.mixed.experiment.provenance)]),
            "rows": {"experiment": len(self.experiment), "mixed": len(self.mixed or ())},
            "plan": asdict(self.plan),
            "scores": [asdict(one) for one in scores],
            "ratios": ratios,
        }

    def draw(self, folder: Path, out: Path) -> list[dict[str, str]]:
        """Draw the pictures of all tasks into ``out``, from cells that are all made.

        Returns:
            Of each its ``task``, ``file`` and ``caption``, for the page.

        Raises:
            DatasetError: A cell is missing or damaged, or the disk refused.
        """
        pictures = [draw_forces(out, self.experiment)]
        for name, task in self.tasks.items():
            pictures += draw_task(out, task, self._data_of(name), self._made(folder, name))
        return [asdict(one) for one in pictures]

    def _made(self, folder: Path, name: str) -> dict[Cell, CellResult]:
        task = self.tasks[name]
        return {
            cell: read_cell(cell_path(folder, task, cell))
            for cell in self.cells
            if cell.task == name
        }

    def _data_of(self, name: str) -> ExperimentDataset:
        if name in ("location", "force"):
            return self.experiment
        assert self.mixed is not None
        return self.mixed.experiment

    def _scores(self, task: Task, made: dict[Cell, CellResult]) -> list[Scores]:
        if isinstance(task, FieldTask):
            return score_fields(task, made)
        if isinstance(task, SynthesisTask):
            return score_synthesis(task, made)
        assert isinstance(task, FeatureTask)
        return score(task, self._data_of(task.name), made)

    def _ratios(self, task: FeatureTask, made: dict[Cell, CellResult]) -> Iterable[dict[str, Any]]:
        """Ours over the best of the paper's networks, where the goals count."""
        distance, angle = "distance_m", "angle_rad"
        wanted: Sequence[tuple[str, float, float]] = {
            "location": [(distance, 0.0, float("inf")), (distance, 0.0, 2.0)],
            "force": [
                ("magnitude_n", 0.0, float("inf")), ("magnitude_n", 2.0, float("inf")),
                ("magnitude_over_norm", 2.0, float("inf")), (angle, 2.0, float("inf")),
            ],
            "centre": [(distance, 0.0, float("inf"))],
            "normal": [(angle, 0.0, float("inf"))],
        }[task.name]  # fmt: skip
        for error, least_n, most_n in wanted:
            found = ratios_to_paper(
                task, self._data_of(task.name), made, error=error, least_n=least_n, most_n=most_n
            )
            for (split, test, system), (ratio, low, high) in found.items():
                yield {
                    "task": task.name, "split": split, "test": test, "system": system,
                    "error": error, "least_n": least_n, "ratio": ratio, "interval": [low, high],
                    "most_n": most_n if most_n != float("inf") else None,
                }  # fmt: skip


def write_study(path: Path, values: dict[str, Any]) -> None:
    """Write the JSON, whole or not at all; numbers with six digits.

    Raises:
        DatasetError: The disk refused.
    """
    text = json.dumps(_short(values), indent=1) + "\n"
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


def _short(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}") if value == value else None
    if isinstance(value, dict):
        return {key: _short(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_short(each) for each in value]
    return value
