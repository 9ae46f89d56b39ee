"""Command ``palpate data figures``: pictures and statistics page of an experiment's data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.command import typed_command
from palpate.errors import ConfigError

PUBLIC_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
"""Real data beside the project; what is absent there is left out of the page."""


def data_figures(
    experiment: Annotated[Path, typer.Argument(help="Experimental data set (.h5).")],
    out: Annotated[Path, typer.Option(help="Folder for statistics.md and its pictures.")],
    mixed: Annotated[
        Path | None, typer.Option(help="Mixed data set (.h5): skin and skin motion.")
    ] = None,
    idle: Annotated[
        Path | None,
        typer.Option(help="Untouched twin (.npz): rate_hz, and counts (T, 19) for each unit."),
    ] = None,
    public_data: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder that holds lasa_force_calibration, lasa_contact_normal."
        ),
    ] = None,
) -> None:
    """Figures as in the paper and the statistics page of a data set of the experiment.

    palpate data figures experiment.h5 --mixed mixed.h5 --out docs/results/twin
    """
    from palpate_training.twin.hdf5 import read_experiment, read_mixed
    from palpate_training.twin_figures.idle import read_idle_real, read_idle_twin
    from palpate_training.twin_figures.page import PAGE, Sources, write_page
    from palpate_training.twin_figures.plate import read_plate_logs

    if public_data is not None and not public_data.is_dir():
        raise ConfigError(
            f"--public-data {public_data}: there is no such folder",
            remedy="give the folder with lasa_force_calibration and lasa_contact_normal",
        )
    console = Console()
    folder = public_data or PUBLIC_DATA
    with console.status("reading") as status:
        sources = Sources(
            experiment=read_experiment(experiment),
            mixed=read_mixed(mixed) if mixed is not None else None,
            idle=(
                *(read_idle_twin(idle) if idle is not None else ()),
                *read_idle_real(folder),
            ),
            plate=read_plate_logs(folder),
        )
        statistics = write_page(
            out,
            sources,
            command=typed_command(),
            on_step=lambda step: status.update(f"{step} ..."),
        )
    console.print(
        f"{statistics.trajectories} unique trajectories, {statistics.trials} trials,"
        f" {statistics.rows} rows\nwrote {out / PAGE}"
    )
