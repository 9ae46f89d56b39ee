"""What refinement changes and what it costs: a picture of a study."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from palpate_fem.plot.style import MM, grid, label, new_figure, save
from palpate_fem.study import DISPLACEMENT_CHANGE_M, FORCE_CHANGE, StudyRow

COLOURS = ("#2f6fb5", "#d1495b", "#2e8b57", "#e09f3e")
LIMIT = "#9aa0a8"


def plot_study(rows: Sequence[StudyRow], path: Path) -> None:
    """Change of force and displacement by each refinement, and seconds, one line an indenter.

    Args:
        rows: Of `mesh_study` (drawn over unknowns) or `step_study` (drawn over steps).
        path: PNG to write.

    Raises:
        StoreDiskError: The disk is full or refuses.
    """
    meshes = len({row.edge_m for row in rows}) > 1
    figure = new_figure(12.0, 3.6)
    force, moved, cost = figure.subplots(1, 3)
    for name, colour in zip(dict.fromkeys(row.indenter for row in rows), COLOURS, strict=False):
        mine = [row for row in rows if row.indenter == name]
        across = [row.unknowns if meshes else row.steps for row in mine]
        style = {"color": colour, "marker": "o", "ms": 4, "lw": 1.5, "label": name}
        force.plot(across, [100 * abs(row.force_change) for row in mine], **style)
        moved.plot(across, [MM * row.displacement_change_m for row in mine], **style)
        cost.plot(across, [row.seconds for row in mine], **style)
    force.axhline(100 * FORCE_CHANGE, color=LIMIT, ls="--", lw=1)
    moved.axhline(MM * DISPLACEMENT_CHANGE_M, color=LIMIT, ls="--", lw=1)
    label(force, "", "change of the force [%]", "force, against the coarser one")
    label(moved, "", "mean change [mm]", "displacement of the outer skin")
    label(cost, "", "seconds a press", "cost")
    first = [row for row in rows if row.indenter == rows[0].indenter]
    for axes in (force, moved, cost):
        grid(axes)
        axes.set_xscale("log")
        axes.set_ylim(bottom=0.0)
        axes.set_xticks([row.unknowns if meshes else row.steps for row in first], minor=False)
        axes.set_xticklabels([_name(row, meshes=meshes) for row in first], fontsize=7)
        axes.minorticks_off()
    force.legend(frameon=False, fontsize=8)
    save(figure, path)


def _name(row: StudyRow, *, meshes: bool) -> str:
    """What stands under a row's points."""
    if not meshes:
        return f"{row.steps} steps"
    gflop = f"{row.factor_gflop:.1f} GFlop"
    return f"{row.edge_m * MM:g} mm\n{row.unknowns:,}\n{gflop}"
