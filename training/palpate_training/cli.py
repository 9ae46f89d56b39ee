"""Commands of this room: ``palpate train ...`` and ``palpate data ...``, mounted by deploy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from palpate.command import typed_command
from palpate_training import cli_data, cli_fields, cli_figures, cli_testbed
from palpate_training.cli_data import contents
from palpate_training.ingest_lasa import BLOCKS_PER_RECORDING, ELECTRODE_LAG_ROWS, ingest_lasa
from palpate_training.ingest_record import ingest_record
from palpate_training.schema import open_dataset, write_dataset

train_app = typer.Typer(
    no_args_is_help=True, help="Train networks and write model bundles.", rich_markup_mode=None
)
data_app = typer.Typer(
    no_args_is_help=True, help="Make data sets and look into them.", rich_markup_mode=None
)

console = Console()


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
    )


@data_app.command("ingest-lasa")
def data_ingest_lasa(
    source: Annotated[Path, typer.Argument(help="force_calibration.npz")],
    out: Annotated[Path, typer.Argument(help="Data set to write (.h5).")],
    blocks: Annotated[
        int, typer.Option(min=10, help="Contiguous blocks that each recording is cut into.")
    ] = BLOCKS_PER_RECORDING,
    lag_rows: Annotated[
        int, typer.Option(min=0, help="Rows by which electrodes lag the force; 0 = as stored.")
    ] = ELECTRODE_LAG_ROWS,
) -> None:
    """LASA force calibration (two real BioTacs) -> data set. Its rows may not be redistributed.

    palpate data ingest-lasa force_calibration.npz lasa.h5
    """
    data = ingest_lasa(
        source, command=typed_command(), blocks_per_recording=blocks, lag_rows=lag_rows
    )
    write_dataset(out, data)
    console.print(contents(data, str(out)))


@data_app.command("ingest-record")
def data_ingest_record(
    source: Annotated[Path, typer.Argument(help="Record (.mcap) with electrodes, tare, wrench.")],
    out: Annotated[Path, typer.Argument(help="Data set to write (.h5).")],
    licence: Annotated[
        str, typer.Option(help="What may be done with the rows; kept with them.")
    ] = "own record",
) -> None:
    """Record of a sensor with its force/torque sensor and indenter -> data set.

    palpate data ingest-record presses.mcap presses.h5
    """
    with console.status(f"reading {source.name}"):
        data = ingest_record(source, command=typed_command(), licence=licence)
        write_dataset(out, data)
    console.print(contents(data, str(out)))


data_app.command("register")(cli_testbed.data_register)
data_app.command("ingest")(cli_testbed.data_ingest)
data_app.command("inspect")(cli_data.data_inspect)
data_app.command("export")(cli_data.data_export)
data_app.command("features")(cli_data.data_features)
data_app.command("figures")(cli_figures.data_figures)


@train_app.command("force-real")
def train_force_real(
    data: Annotated[Path, typer.Option(help="Data set from `palpate data ingest-lasa`.")],
    out: Annotated[Path, typer.Option(help="Folder for force-real.md, .json and .png.")],
    seeds: Annotated[int, typer.Option(min=1, help="Networks for each fold.")] = 5,
) -> None:
    """Force on real BioTacs: blocks held out and a BioTac never seen, beside the baselines.

    palpate train force-real --data lasa.h5 --out docs/results
    """
    from palpate_training.evaluate import rich_table
    from palpate_training.force_real import experiment_count, run_force_real, write_report

    dataset = open_dataset(data)
    with _progress() as progress:
        task = progress.add_task("networks", total=experiment_count(dataset, seeds))
        report = run_force_real(dataset, seeds=seeds, on_network=lambda: progress.advance(task))
    write_report(out, report, command=typed_command())
    console.print(rich_table(report.results, "Force on real BioTacs"))
    console.print(f"wrote {out}/force-real.md, .json, .png")


@train_app.command("features")
def train_features_command(
    data: Annotated[Path, typer.Option(help="Data set (.h5).")],
    out: Annotated[Path, typer.Option(help="Folder of the bundle; must not exist.")],
    name: Annotated[str, typer.Option(help="Name of the bundle.")] = "features",
    version: Annotated[int, typer.Option(min=1, help="Its version.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of split and weights.")] = 0,
) -> None:
    """Train force and contact location, test on unseen presses, write the bundle.

    palpate train features --data presses.h5 --out models/features-virtual/1 --name features-virtual
    """
    from palpate_training.train_features import train_features

    with _progress() as progress:
        tasks = {}

        def on_epoch(quantity: str, done: int, total: int) -> None:
            if quantity not in tasks:
                tasks[quantity] = progress.add_task(quantity, total=total)
            progress.update(tasks[quantity], completed=done)

        report = train_features(data, out, name=name, version=version, seed=seed, on_epoch=on_epoch)
    table = Table(title=f"{name} {version}: unseen presses", caption=f"wrote {out}")
    table.add_column("metric")
    table.add_column("value", justify="right")
    for key, value in report.metrics.items():
        table.add_row(key, f"{value:.5g}")
    console.print(table)


cli_fields.add_commands(train_app)
