"""Write docs/results/study/presses.json and .png: what our networks gain from more presses.

``python docs/make_learning_curve.py DATA --cells FOLDER``           makes what is missing
``... --device cuda --workers 20``                                   on GPUs

Test and validation trajectories are those of the study's split by trajectory; of the training
trajectories an eighth, a quarter, a half or all are kept, drawn anew for each seed. So the last
column is the study's own test, and the slope says whether presses or the network hold an error
back. ``docs/make_study.py`` puts the result on its page.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from palpate.files.atomic import written_whole
from palpate_training.cli.report import read_source
from palpate_training.evaluation.cells import (
    Cell,
    CellResult,
    Task,
    cell_path,
    make_cells,
    read_cell,
)
from palpate_training.evaluation.experiments import ExperimentSource
from palpate_training.evaluation.features import FeatureTask
from palpate_training.evaluation.skin import FieldTask, SynthesisTask
from palpate_training.evaluation.study import score_task
from palpate_training.figures.style import INK, finish, grid, label, new_figure, unit_colour
from palpate_training.learning.splits import ALL_UNITS, Fold, RowSplit

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "docs" / "results" / "study" / "presses.json"

SHARES = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "all": 1.0}
SEEDS = range(3)
UNIT = "biotac-2"
"""Whose electrodes are synthesised."""

SYSTEMS = {
    "force": "residual networks, mean of three",
    "location": "residual networks, mean of three",
    "field": "networks to modes, mean of three",
    "synthesis": "film networks, mean of three",
}

CURVES = (
    ("force", "magnitude_over_norm_median_from_2n", 100.0, "force from 2 N [%]", 8.0),
    ("force", "angle_rad_median_from_2n", 1e3, "its angle [mrad]", 25.0),
    ("location", "distance_m_median_below_2n", 1e3, "location below 2 N [mm]", 1.2),
    ("field", "all_m_mean", 1e6, "skin, all nodes [um]", 25.0),
    ("field", "all_m_mean_above_8n", 1e6, "skin above 8 N [um]", 60.0),
    ("synthesis", "rmse_counts", 1.0, f"electrodes of {UNIT} [counts]", 12.0),
)
"""Task, metric, factor, what it is, the goal."""


class Curve:
    """Trainings on a part of the presses.

    Args:
        source: An experiment.

    Attributes:
        tasks: By name.
        cells: All trainings.
        presses: Trajectories that were trained on, by task and share.
    """

    def __init__(self, source: ExperimentSource) -> None:
        self.tasks: dict[str, Task] = {}
        self.cells: list[Cell] = []
        self.presses: dict[tuple[str, str], int] = {}
        for name, system in SYSTEMS.items():
            task = source.task(name)
            assert task is not None, "the folder holds no mixed.h5"
            self.tasks[name] = task
            test = UNIT if name == "synthesis" else ALL_UNITS
            (fold,) = (
                fold
                for fold in source.folds(name, "trajectory", seed=0, whole=False)
                if fold.test == test
            )
            trajectory = trajectories(task)
            for share, part in SHARES.items():
                for seed in SEEDS:
                    rows = fewer(fold.rows, trajectory, part, seed)
                    self.presses[name, share] = len(np.unique(trajectory[rows.train]))
                    cut = Fold("trajectory", fold.test if part == 1.0 else share, fold.part, rows)
                    self.cells.append(Cell(name, cut, system, seed))


def trajectories(task: Task) -> Any:
    """Trajectory of each row."""
    if isinstance(task, FeatureTask):
        return task.cluster
    assert isinstance(task, FieldTask | SynthesisTask)
    return task.data.experiment.row_trajectory


def fewer(rows: RowSplit, trajectory: Any, share: float, seed: int) -> RowSplit:
    """The same split with a share of its training trajectories."""
    if share == 1.0:
        return rows
    known = np.unique(trajectory[rows.train])
    kept = np.random.default_rng(seed).permutation(known)[: round(share * len(known))]
    return replace(rows, train=rows.train[np.isin(trajectory[rows.train], kept)])


def result(curve: Curve, made: dict[Cell, CellResult]) -> dict[str, Any]:
    """What the page and the picture need."""
    found = {
        (name, one.test): one
        for name, task in curve.tasks.items()
        for one in score_task(task, {cell: made[cell] for cell in made if cell.task == name})
    }
    rows = []
    for task, metric, factor, what, goal in CURVES:
        tests = [one for one in (ALL_UNITS, UNIT) if (task, one) in found]
        values = {
            share: float(f"{factor * found[task, test].metrics[metric]:.4g}")
            for share, test in zip(SHARES, (*list(SHARES)[:-1], *tests), strict=True)
        }
        presses = {share: curve.presses[task, share] for share in SHARES}
        rows.append({"what": what, "goal": goal, "values": values, "trajectories": presses})
    return {"schema": "palpate.learning-curve 1", "seeds": len(SEEDS), "rows": rows}


def draw(values: dict[str, Any], path: Path) -> None:
    """One plot for each error."""
    figure = new_figure(9.0, 5.2)
    for axes, row in zip(figure.subplots(2, 3).flat, values["rows"], strict=True):
        counts = [row["trajectories"][share] for share in SHARES]
        axes.loglog(counts, list(row["values"].values()), "o-", color=unit_colour(0), ms=4)
        axes.axhline(row["goal"], color=INK, lw=0.9, ls="--")
        axes.set_xticks(counts, [str(one) for one in counts])
        axes.minorticks_off()
        axes.set_yticks([row["values"]["1/8"], row["values"]["all"], row["goal"]])
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
        label(axes, "trajectories to train on", "", row["what"])
        grid(axes)
    finish(
        figure, path, "What our networks gain from more presses",
        "Unseen trajectories of the twin, all units; means of three networks, averaged over "
        f"{values['seeds']} seeds. Both axes are logarithmic. Dashed: the goal.",
    )  # fmt: skip


def main() -> None:
    """Make, write, draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("--cells", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    source = read_source(options.data)
    assert isinstance(source, ExperimentSource)
    curve = Curve(source)
    tasks = list(curve.tasks.values())
    left, console = len(curve.cells), Console(highlight=False)

    def on_cell(cell: Cell, _: bool) -> None:
        nonlocal left
        left -= 1
        console.print(f"{left} left: {cell.task}, {cell.fold.test}, seed {cell.seed}")

    make_cells(
        tasks, curve.cells, options.cells,
        workers=options.workers, device=options.device, on_cell=on_cell,
    )  # fmt: skip
    made = {
        cell: read_cell(cell_path(options.cells, curve.tasks[cell.task], cell))
        for cell in curve.cells
    }
    values = result(curve, made)
    with written_whole(RESULT) as part:
        part.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    draw(values, RESULT.with_suffix(".png"))


if __name__ == "__main__":
    main()
