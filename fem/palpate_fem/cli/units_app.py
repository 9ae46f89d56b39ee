"""``palpate fem units``: signatures and help only."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate_fem.cli.group import FemGroup
from palpate_fem.cli.options import JsonOption

units_app = typer.Typer(
    cls=FemGroup,
    help="BioTacs on the simulated finger: fit them to published ranges, show them.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@units_app.command(epilog="Example: palpate fem units fit runs/twin/mechanics.sim --out three.json")
def fit(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="Simulated trajectories.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.json", help="Where to write.")],
    overtravel_mm: Annotated[
        float, typer.Option(help="How much deeper than the paper's depths the paths go [mm].")
    ] = 0.6,
) -> None:
    """Fit three units to the ranges and forces that the paper tells of its BioTacs."""
    from palpate_fem.cli.units import fit_command

    raise typer.Exit(fit_command(store, out, overtravel_m=overtravel_mm * 1e-3))


@units_app.command(epilog="Example: palpate fem units show")
def show(
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE.json]", help="Population; none = the shipped.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Say what the units are and what they were fitted to."""
    from palpate_fem.cli.units import show_command

    raise typer.Exit(show_command(file, as_json=as_json))
