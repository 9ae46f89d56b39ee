"""``palpate fem study``: what mesh and steps change, as a table, a picture and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.table import Table

from palpate_fem.cli.show import progress_bar

if TYPE_CHECKING:
    from palpate_fem.study import StudyRow


def study_command(what: str, *, png: Path | None, as_json: bool) -> int:
    """Run a study.

    Args:
        what: ``mesh`` or ``steps``.
        png: Picture to draw.
        as_json: Print JSON instead of a table.

    Returns:
        0, or 1 if the last refinement changed more than is accepted or a press did not end well.
    """
    from palpate_fem.study import EDGES_M, PRESSES, STEPS, mesh_study, step_study

    total = len(PRESSES) * (len(EDGES_M) if what == "mesh" else len(STEPS))
    with progress_bar() as bar:
        task = bar.add_task(f"{what} study", total=total)

        def on_row(row: StudyRow) -> None:
            bar.update(task, advance=1, info=f"{row.indenter}, {row.seconds:.0f} s")

        rows = (mesh_study if what == "mesh" else step_study)(on_row=on_row)
    if png is not None:
        from palpate_fem.plot.study import plot_study

        plot_study(rows, png)
    if as_json:
        typer.echo(json.dumps([row.plain() for row in rows], indent=1))
    else:
        _show(rows)
    return 0 if all(row.accepted for row in rows[-len(PRESSES) :]) else 1


def _show(rows: list[StudyRow]) -> None:
    table = Table(title="what refinement changes")
    for heading in (
        "indenter", "edge [mm]", "unknowns", "steps", "force [N]", "change [%]", "moved [um]",
        "at most [um]", "iterations", "seconds", "outcome",
    ):  # fmt: skip
        table.add_column(heading, justify="left" if heading == "indenter" else "right")
    for row in rows:
        table.add_row(
            row.indenter,
            f"{row.edge_m * 1e3:g}",
            f"{row.unknowns:,}",
            str(row.steps),
            f"{row.force_n:.4f}",
            f"{100 * row.force_change:.2f}",
            f"{1e6 * row.displacement_change_m:.1f}",
            f"{1e6 * row.largest_change_m:.1f}",
            str(row.iterations),
            f"{row.seconds:.1f}",
            row.outcome,
        )
    Console().print(table)
