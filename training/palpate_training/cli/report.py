"""``palpate train report`` and ``evaluate``: what systems, or one bundle, are worth on data."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from palpate.errors import ConfigError, DatasetError
from palpate.files.atomic import written_whole
from palpate.process import told_in_log, typed_command
from palpate_training.cli.data import AxesOption, ForceOption

if TYPE_CHECKING:
    from palpate_training.evaluation.cells import Cell
    from palpate_training.evaluation.study import Study, StudySource
    from palpate_training.tasks.evaluate import BundleErrors

console = Console(markup=False)  # names of sensors and files may have brackets


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def train_report(
    data: Annotated[
        Path,
        typer.Option(
            help="Folder with experiment.h5 and mixed.h5, with the published files, or with "
            "lasa_force_calibration and lasa_contact_normal; or a mixed or joined data set (.h5)."
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Folder for report.html, report.md, pictures and study.json.")
    ],
    tasks: Annotated[str, typer.Option(help="Tasks, with commas between; empty = all.")] = "",
    splits: Annotated[str, typer.Option(help="Splits, with commas between; empty = all.")] = "",
    test_part: Annotated[
        str,
        typer.Option(
            help="Of a joined data set: the part whose presses alone are tested; all others are "
            "learned from. Splits: trajectory, execution, unit."
        ),
    ] = "",
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
    device: Annotated[
        str, typer.Option(help="Where networks are trained: cpu, cuda, auto.")
    ] = "cpu",
    cells: Annotated[
        Path | None, typer.Option(help="Folder of finished trainings; by default OUT/cells.")
    ] = None,
    so_far: Annotated[
        bool, typer.Option("--so-far", help="Train nothing; show what is finished.")
    ] = False,
    axes: AxesOption = "x,y,z",
    force_on_indenter: ForceOption = False,
) -> None:
    """Train and test every system on every split; goes on where a run was killed.

    palpate train report --data runs/twin --out runs/report

    palpate train report --data runs/twin --out runs/quick --tasks force --splits trajectory --whole

    palpate train report --data joined.h5 --test-part twin --out runs/more --splits trajectory
    """
    from palpate_training.evaluation.experiments import TASKS
    from palpate_training.evaluation.page import write_pages
    from palpate_training.evaluation.study import Study, StudyPlan, write_study
    from palpate_training.learning.networks import training_device
    from palpate_training.learning.splits import PART_SPLITS, SPLITS

    device = training_device(device)
    wanted = _words(splits)
    unknown = [word for word in wanted if word not in SPLITS]
    if unknown:
        raise ConfigError(
            f"there is no split {', '.join(unknown)}", remedy=f"one of: {', '.join(SPLITS)}"
        )
    beyond = [word for word in wanted if test_part and word not in PART_SPLITS]
    if beyond:
        raise ConfigError(
            f"--test-part has no split {', '.join(beyond)}: what is held out of one part may have"
            " been met in another",
            remedy=f"of {', '.join(PART_SPLITS)}, or without --test-part",
        )
    plan = StudyPlan(
        tasks=_words(tasks) or TASKS,
        splits=tuple(split for split in SPLITS if not wanted or split in wanted),
        systems=_words(systems),
        seeds=tuple(range(seeds)),
        whole=whole,
    )
    source = read_source(data, test_part, axes=axes.split(","), force_on_indenter=force_on_indenter)
    study = Study(source, plan)
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


def train_evaluate(
    bundle: Annotated[Path, typer.Argument(help="Folder of a bundle.")],
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Data sets (.h5) whose truth is known: of features or mixed for a features "
            "bundle, mixed for others."
        ),
    ],
    unit: Annotated[
        str | None,
        typer.Option(help="Rows of this specimen or sensor alone; needed for synthesis."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="JSON file to write, in SI units; must not exist.")
    ] = None,
) -> None:
    """Errors of a bundle on data sets, by force, with confidence intervals over presses.

    palpate train evaluate models/features-twin/12 runs/test/mixed.h5
    """
    from palpate_training.tasks.evaluate import evaluate

    if out is not None and out.exists():
        raise ConfigError(f"{out} exists", remedy="name another file with --out")
    found = evaluate(bundle, data, unit=unit)
    console.print(_table(found))
    if found.assumed_contact_n is not None:
        console.print(
            f"Where in_contact is not known, rows above {found.assumed_contact_n:g} N count as in"
            " contact: others are left out."
        )
    elif found.task == "features":
        console.print("Rows in contact, as in_contact says: others are left out.")
    if found.task == "synthesis":  # no key of its manifest names the specimen, only this line
        console.print(
            f"Electrodes of {unit}, synthesised by a network of one specimen: {found.training}",
        )
    if found.trained_on:
        console.print(
            "[bold]It was trained on presses of these data sets:[/bold] these are known to it. Take"
            " presses that no training has seen.",
            markup=True,
        )
    if out is not None:
        with written_whole(out) as part:
            part.write_text(json.dumps(found.as_dict(), indent=1) + "\n", encoding="utf-8")
        console.print(f"wrote {out}", soft_wrap=True)


def _table(found: BundleErrors) -> Table:
    """Errors by force, one quantity after the other."""
    from palpate_training.tasks.evaluate import KINDS, SHOWN

    table = Table(
        title=f"{found.bundle}: {found.rows} rows of {found.presses} presses",
        caption="constant: the mean of these rows; zero: no force, displacement or change",
        box=SIMPLE,
    )
    for column in ("error", "of rows", "", "95 % over presses", "constant", "zero"):
        left = column in ("error", "of rows")
        table.add_column(column, justify="left" if left else "right", no_wrap=column != "error")
    for name in dict.fromkeys(one.name for one in found.figures):
        kind = KINDS[name]
        unit, factor = SHOWN.get(kind.unit, (kind.unit, 1.0))
        heads = [name.replace("_", " "), f"({kind.statistic}, {unit})"]
        rows = [one for one in found.figures if one.name == name]
        for one, head in zip_longest(rows, heads[: len(rows)], fillvalue=""):
            assert not isinstance(one, str)
            table.add_row(
                head,
                one.where.replace("_", " ").replace("2n", "2 N").replace("8n", "8 N"),
                f"{factor * one.value:.3g}",
                "-" if np.isnan(one.low) else f"{factor * one.low:.3g} to {factor * one.high:.3g}",
                *("-" if np.isnan(v) else f"{factor * v:.3g}" for v in (one.constant, one.zero)),
                end_section=one is rows[-1],
            )
    return table


def make_with_progress(study: Study, folder: Path, workers: int, device: str) -> None:
    """Make what the folder does not hold, under a bar with the time left."""
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(elapsed_when_finished=False),
        console=console,
    )
    with progress, told_in_log(progress):
        bar = progress.add_task("trainings", total=len(study.cells))

        def on_cell(cell: Cell, made: bool) -> None:
            if not made:
                # What was there before says nothing about how long the rest takes.
                progress.reset(bar, start=True, completed=int(progress.tasks[0].completed) + 1)
                return
            progress.update(bar, advance=1, description=f"{cell.task}: {cell.system}"[:48])

        study.make(folder, workers=workers, device=device, on_cell=on_cell)


def read_source(
    path: Path,
    part: str = "",
    *,
    axes: Sequence[str] = ("x", "y", "z"),
    force_on_indenter: bool = False,
) -> StudySource:
    """Data of a study: an experiment, generated, executed or published; or real recordings.

    Args:
        path: Folder of the data, or a mixed data set.
        part: Of a joined data set, whose rows alone are tested.
        axes: Of published files, as in ``read_published``.
        force_on_indenter: Likewise.

    Raises:
        ConfigError: Recordings, which have no parts.
        DatasetError: There is none, or it is damaged.
    """
    from palpate_training.datasets.experiment import read_experiment, read_mixed
    from palpate_training.datasets.published import published_units, read_published
    from palpate_training.evaluation.experiments import ExperimentSource
    from palpate_training.evaluation.recordings import read_recordings

    if path.is_file():
        whole = read_mixed(path)
        return ExperimentSource(whole.experiment, whole, part)
    if (path / "experiment.h5").is_file():
        mixed = path / "mixed.h5"
        return ExperimentSource(
            read_experiment(path / "experiment.h5"),
            read_mixed(mixed) if mixed.is_file() else None,
            part,
        )
    if published_units(path):
        published = read_published(
            path, axes=axes, force_on_indenter=force_on_indenter, command=typed_command()
        )
        return ExperimentSource(published, None, part)
    recordings = read_recordings(path)
    if recordings is None:
        raise DatasetError(
            f"{path} holds neither experiment.h5 nor biotac1.hdf5, nor real recordings",
            remedy="generate a data set (palpate data generate), or name the folder of the"
            " published files, or one with lasa_force_calibration or lasa_contact_normal",
        )
    if part:
        raise ConfigError(
            f"{path} holds recordings, which have no parts",
            remedy="leave --test-part out, or name a joined data set (palpate data join)",
        )
    return recordings
