"""``palpate train report``: every system on every split of a data set, as one page."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from palpate.errors import ConfigError, DatasetError
from palpate.process import typed_command

if TYPE_CHECKING:
    from palpate_training.evaluation.cells import Cell
    from palpate_training.evaluation.study import Study, StudySource

console = Console()


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def train_report(
    data: Annotated[
        Path,
        typer.Option(
            help="Folder with experiment.h5 and mixed.h5, with the published files, or with "
            "lasa_force_calibration and lasa_contact_normal."
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Folder for report.html, report.md, pictures and study.json.")
    ],
    tasks: Annotated[str, typer.Option(help="Tasks, with commas between; empty = all.")] = "",
    splits: Annotated[str, typer.Option(help="Splits, with commas between; empty = all.")] = "",
    systems: Annotated[
        str, typer.Option(help="Words of which a system's name has one; empty = all.")
    ] = "",
    seeds: Annotated[
        int,
        typer.Option(
            min=1, help="Seeds of tests of all units in a task's first split; others have 1."
        ),
    ] = 5,
    whole: Annotated[
        bool, typer.Option("--whole", help="Only tests of all units together.")
    ] = False,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0 = one for each core.")] = 0,
    device: Annotated[str, typer.Option(help="Where networks are trained: cpu or cuda.")] = "cpu",
    cells: Annotated[
        Path | None, typer.Option(help="Folder of finished trainings; by default OUT/cells.")
    ] = None,
    so_far: Annotated[
        bool, typer.Option("--so-far", help="Train nothing; show what is finished.")
    ] = False,
) -> None:
    """Train and test every system on every split; goes on where a run was killed.

    palpate train report --data runs/twin --out runs/report

    palpate train report --data runs/twin --out runs/quick --tasks force --splits trajectory --whole
    """
    from palpate_training.evaluation.experiments import TASKS
    from palpate_training.evaluation.page import write_pages
    from palpate_training.evaluation.study import Study, StudyPlan, write_study
    from palpate_training.learning.splits import SPLITS

    wanted = _words(splits)
    unknown = [word for word in wanted if word not in SPLITS]
    if unknown:
        raise ConfigError(
            f"there is no split {', '.join(unknown)}", remedy=f"one of: {', '.join(SPLITS)}"
        )
    plan = StudyPlan(
        tasks=_words(tasks) or TASKS,
        splits=tuple(split for split in SPLITS if not wanted or split in wanted),
        systems=_words(systems),
        seeds=tuple(range(seeds)),
        whole=whole,
    )
    study = Study(read_folder(data), plan)
    folder = cells or out / "cells"
    if not so_far:
        make_with_progress(study, folder, workers or os.cpu_count() or 1, device)
    if len(study.missing(folder)) == len(study.cells):
        raise ConfigError(
            f"{folder} holds no finished training of these tasks and splits",
            remedy="leave --so-far out, or name the folder of the trainings with --cells",
        )
    with console.status("scoring and drawing: minutes for a whole study"):
        values = study.results(folder)
        values["pictures"] = study.draw(folder, out)
    write_study(out / "study.json", values)
    # The file has null where a metric is not known; the pages are made from it.
    read = json.loads((out / "study.json").read_text(encoding="utf-8"))
    for path in (out / "study.json", *write_pages(out, read, command=typed_command())):
        console.print(f"wrote {path}", soft_wrap=True)


def make_with_progress(study: Study, folder: Path, workers: int, device: str) -> None:
    """Make what the folder does not hold, under a bar with the time left."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(elapsed_when_finished=False),
        console=console,
    ) as progress:
        bar = progress.add_task("trainings", total=len(study.cells))

        def on_cell(cell: Cell, made: bool) -> None:
            if not made:
                # What was there before says nothing about how long the rest takes.
                progress.reset(bar, start=True, completed=int(progress.tasks[0].completed) + 1)
                return
            progress.update(bar, advance=1, description=f"{cell.task}: {cell.system}"[:48])

        study.make(folder, workers=workers, device=device, on_cell=on_cell)


def read_folder(folder: Path) -> StudySource:
    """The data of a folder: an experiment, generated, executed or published; or real recordings.

    Raises:
        DatasetError: There is none, or it is damaged.
    """
    from palpate_training.datasets.experiment import read_experiment, read_mixed
    from palpate_training.datasets.published import published_file, read_published
    from palpate_training.evaluation.experiments import ExperimentSource
    from palpate_training.evaluation.recordings import read_recordings

    if (folder / "experiment.h5").is_file():
        mixed = folder / "mixed.h5"
        return ExperimentSource(
            read_experiment(folder / "experiment.h5"),
            read_mixed(mixed) if mixed.is_file() else None,
        )
    if any(published_file(folder, unit).is_file() for unit in (1, 2, 3)):
        return ExperimentSource(read_published(folder, command=typed_command()), None)
    recordings = read_recordings(folder)
    if recordings is not None:
        return recordings
    raise DatasetError(
        f"{folder} holds neither experiment.h5 nor biotac1.hdf5, nor real recordings",
        remedy="generate a data set (palpate data generate), or name the folder of the published "
        "files, or one with lasa_force_calibration or lasa_contact_normal",
    )
