"""Curves of one trajectory: force, fluid pressure, contact, and how hard Newton worked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_fem.plot.style import AXES, AXIS_COLOURS, INK, KPA, MM, grid, label, new_figure, save
from palpate_fem.result import IndentationResult

Floats = NDArray[np.float64]


def travel_m(path: Floats, pose: Floats) -> Floats:
    """Way of the indenter from where it started to each step [m], shape (K,).

    Args:
        path: Requested poses; only the first is used, shape (1 or more, 7).
        pose: Poses of the steps, shape (K, 7).
    """
    places = np.concatenate([path[:1, :3], pose[:, :3]])
    pieces = np.linalg.norm(np.diff(places, axis=0), axis=1)
    found: Floats = np.cumsum(pieces)
    return found


def plot_curves(trajectory: IndentationResult, path: Path, *, title: str = "") -> None:
    """Draw how one indentation went, step by step.

    Args:
        trajectory: The indentation; without a step the curves are empty.
        path: The PNG to write.
        title: Above it all; empty = the indenter.

    Raises:
        StoreDiskError: The disk is full or refuses.
        MissingExtraError: matplotlib is not installed.
    """
    figure = new_figure(11, 7.5)
    panels = figure.subplots(2, 2)
    steps = trajectory.steps
    travel = travel_mm(trajectory)
    draw_force(panels[0, 0], travel, trajectory.forces)
    pressure = KPA * np.array([step.fluid_pressure_pa for step in steps])
    area = MM**2 * np.array([step.contact_area_m2 for step in steps])
    for axes, values, name in (
        (panels[0, 1], pressure, "fluid pressure [kPa]"),
        (panels[1, 0], area, "contact area [mm²]"),
    ):
        axes.plot(travel, values, "o-", color=INK, lw=1.4, ms=3)
        label(axes, "indenter travel [mm]", name)
        grid(axes)
    _draw_newton(panels[1, 1], trajectory)
    ending = trajectory.outcome.value + (f": {trajectory.reason}" if trajectory.reason else "")
    figure.suptitle(
        f"{title or trajectory.indenter}\n{ending}, "
        f"{len(steps)} of {len(trajectory.path) - 1} steps, {trajectory.seconds:.1f} s",
        color=INK,
        fontsize=11,
    )
    save(figure, path)


def travel_mm(trajectory: IndentationResult) -> Floats:
    """Travel of the indenter at each step, for people [mm], shape (K,)."""
    pose = np.array([step.pose for step in trajectory.steps]).reshape(-1, 7)
    return MM * travel_m(trajectory.path, pose)


def draw_force(axes: Any, travel_mm: Floats, force: Floats, *, mark: int | None = None) -> None:
    """Components of the net force on the BioTac against travel; ``mark`` is a step to point out."""
    for at, (name, colour) in enumerate(zip(AXES, AXIS_COLOURS, strict=True)):
        axes.plot(travel_mm, force[:, at], "o-", color=colour, lw=1.4, ms=3, label=f"F{name}")
    touching = np.flatnonzero(np.linalg.norm(force, axis=1) > 0)
    if len(touching):
        axes.axvline(
            travel_mm[touching[0]], color=INK, lw=0.7, ls=":", label="first step in contact"
        )
    if mark is not None:
        axes.axvline(travel_mm[mark], color=INK, lw=1.0, label="shown")
    label(axes, "indenter travel [mm]", "force on the BioTac [N]")
    grid(axes)
    axes.legend(fontsize=8, frameon=False)


def _draw_newton(axes: Any, trajectory: IndentationResult) -> None:
    """Iterations and factorisations as bars, seconds as a line on its own scale."""
    table = [step.convergence for step in trajectory.steps]
    number = 1 + np.arange(len(table))
    axes.bar(
        number - 0.2, [row.iterations for row in table], 0.4, color="#7aa6c2", label="iterations"
    )
    axes.bar(
        number + 0.2,
        [row.factorisations for row in table],
        0.4,
        color="#c9b26d",
        label="factorisations",
    )
    cut = [at for at, row in zip(number, table, strict=True) if row.increments > 1]
    if cut:
        axes.plot(cut, [0] * len(cut), "v", color="#d1495b", ms=6, clip_on=False, label="cut back")
    label(axes, "step", "Newton")
    seconds = axes.twinx()
    seconds.plot(number, [row.seconds for row in table], color=INK, lw=1.0)
    seconds.set_ylabel("time [s] (line)", color=INK, fontsize=9)
    seconds.set_ylim(bottom=0)
    seconds.tick_params(colors=INK, labelsize=8)
    seconds.spines["top"].set_visible(False)
    axes.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
