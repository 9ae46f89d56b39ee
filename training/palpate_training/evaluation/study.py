"""The whole study: every task, split, system and seed of a data set, as one JSON.

What the page shows is in that file, so tables and documents never disagree with what was measured.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, get_args

from palpate import __version__
from palpate.errors import ConfigError
from palpate.files.atomic import written_whole
from palpate_training.datasets.container import Provenance
from palpate_training.evaluation.cells import (
    Cell,
    CellResult,
    Task,
    cell_path,
    cells_of,
    make_cells,
    read_cell,
)
from palpate_training.evaluation.experiments import TASKS
from palpate_training.evaluation.features import (
    PAPER_SYSTEMS,
    FeatureTask,
    Scores,
    ratios_to_paper,
    score,
)
from palpate_training.evaluation.pictures import Made, Picture
from palpate_training.evaluation.skin import (
    FieldTask,
    SynthesisTask,
    score_fields,
    score_synthesis,
)
from palpate_training.learning.splits import ALL_UNITS, Fold, SplitName


class StudySource(Protocol):
    """Data that a study is made of."""

    def task(self, name: str) -> Task | None:
        """A task by name; None if the data does not hold it."""

    def splits(self, task: str) -> tuple[SplitName, ...]:
        """Splits of a task; the first is trained with several seeds."""

    def folds(self, task: str, split: SplitName, *, seed: int, whole: bool) -> list[Fold]:
        """Trainings of a split; ``whole``: only those of all units together."""

    @property
    def provenance(self) -> tuple[Provenance, ...]:
        """Where the data comes from."""

    @property
    def row_counts(self) -> dict[str, int]:
        """Rows of each data set."""

    @property
    def forces(self) -> dict[str, float]:
        """How strong the presses of an experiment are; empty for recordings."""

    def draw(self, out: Path, made: Mapping[str, tuple[Task, Made]]) -> list[Picture]:
        """Draw what there is to show of each task into ``out``."""


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """What is to be made.

    Attributes:
        tasks: Names of tasks.
        splits: Names of splits; a task leaves out those that it does not have.
        systems: Words of which a system's name must contain one; empty = all.
        seeds: Of the first split of a task, where all units are trained together (of recordings:
            all of it); every other test has the first alone.
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
    """Tasks and cells of some data.

    Args:
        source: The data.
        plan: What is to be made.

    Raises:
        ConfigError: A task is not known, or no cell is left.
    """

    def __init__(self, source: StudySource, plan: StudyPlan) -> None:
        self.plan = plan
        self.source = source
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
        if name not in TASKS:
            raise ConfigError(f"there is no task {name!r}", remedy=f"one of: {', '.join(TASKS)}")
        plan = self.plan
        task = self.source.task(name)
        if task is None:
            return
        self.tasks[name] = task
        for number, split in enumerate(self.source.splits(name)):
            if split not in plan.splits:
                continue
            folds = self.source.folds(name, split, seed=plan.split_seed, whole=plan.whole)
            together = [fold for fold in folds if fold.test == ALL_UNITS] or folds
            for fold in folds:
                seeds = plan.seeds if number == 0 and fold in together else plan.seeds[:1]
                self.cells += [
                    cell for cell in cells_of(task, [fold], seeds) if self._wanted(cell.system)
                ]

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

    def missing(self, folder: Path) -> list[Cell]:
        """Cells that are not made."""
        return [cell for cell in self.cells if not self._path(folder, cell).exists()]

    def results(self, folder: Path) -> dict[str, Any]:
        """All tables as plain values, of the tests whose cells are all made.

        Raises:
            DatasetError: A cell is damaged.
        """
        scores: list[Scores] = []
        ratios: list[dict[str, Any]] = []
        for name, task in self.tasks.items():
            made = self._made(folder, name)
            scores += score_task(task, made)
            if isinstance(task, FeatureTask):
                ratios += list(self._ratios(task, made))
        return {
            "schema": "palpate.study 1",
            "palpate": __version__,
            "sources": [asdict(one) for one in self.source.provenance],
            "rows": self.source.row_counts,
            "forces": self.source.forces,
            "plan": asdict(self.plan),
            "trainings": len(self.cells),
            "missing": len(self.missing(folder)),
            "scores": [asdict(one) for one in scores],
            "ratios": ratios,
        }

    def draw(self, folder: Path, out: Path) -> list[dict[str, str]]:
        """Draw the pictures of all tasks into ``out``, of the tests whose cells are all made.

        Returns:
            Of each its ``task``, ``file`` and ``caption``, for the page.

        Raises:
            DatasetError: A cell is damaged, or the disk refused.
        """
        made = {name: (task, self._made(folder, name)) for name, task in self.tasks.items()}
        return [asdict(one) for one in self.source.draw(out, made)]

    def _path(self, folder: Path, cell: Cell) -> Path:
        return cell_path(folder, self.tasks[cell.task], cell)

    def _made(self, folder: Path, name: str) -> dict[Cell, CellResult]:
        """Cells of a task; none of a system in a test that lacks one of its cells."""
        paths = {cell: self._path(folder, cell) for cell in self.cells if cell.task == name}
        lacking = {_tested(cell) for cell, path in paths.items() if not path.exists()}
        return {
            cell: read_cell(path) for cell, path in paths.items() if _tested(cell) not in lacking
        }

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
        papers = {system.name for system in task.systems} & set(PAPER_SYSTEMS)
        there: dict[tuple[str, str], set[str]] = defaultdict(set)
        for cell in made:
            there[cell.fold.split, cell.fold.test].add(cell.system)
        for error, least_n, most_n in wanted:
            found = ratios_to_paper(task, made, error=error, least_n=least_n, most_n=most_n)
            for (split, test, system), (ratio, low, high) in found.items():
                if not papers <= there[split, test]:
                    continue  # not planned, or not made yet: the best of the three is not known
                yield {
                    "task": task.name, "split": split, "test": test, "system": system,
                    "error": error, "least_n": least_n, "ratio": ratio, "interval": [low, high],
                    "most_n": most_n if most_n != float("inf") else None,
                }  # fmt: skip


def score_task(task: Task, made: Mapping[Cell, CellResult]) -> list[Scores]:
    """The table of any task."""
    if isinstance(task, FieldTask):
        return score_fields(task, made)
    if isinstance(task, SynthesisTask):
        return score_synthesis(task, made)
    assert isinstance(task, FeatureTask)
    return score(task, made)


def _tested(cell: Cell) -> tuple[str, str, str]:
    """What a row of a task's table is of."""
    return cell.fold.split, cell.fold.test, cell.system


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
