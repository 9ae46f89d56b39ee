"""Pictures of calibration, validation and refinement studies, after the paper's figures."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from palpate_fem.calibration.result import Calibration, TrajectoryFit
from palpate_fem.plot.style import AXES, AXIS_COLOURS, GRID, INK, MM, grid, label, new_figure, save
from palpate_fem.study import DISPLACEMENT_CHANGE_M, FORCE_CHANGE, StudyRow
from palpate_fem.validation.validate import (
    PAPER_INDENTER_N,
    PAPER_MEDIAN_N,
    PAPER_RANGE_N,
    ComparedTrajectory,
    Validation,
)

_PANELS = 4
_ROWS = 6
_LEAST_SPAN_N = 1.0
"""Smallest range of a force axis [N]; a smaller one would exaggerate noise."""
_MARKERS = ("o", "s", "^", "D", "v")
_SENSOR_COLOURS = ("#2f6fb5", "#e09f3e", "#2e8b57", "#8d5fb0", "#d1495b")


def plot_calibration(result: Calibration, path: Path) -> None:
    """Draw the calibrated simulation against each sensor's measurement, one trajectory in a row.

    Args:
        result: Of the calibration.
        path: The PNG to write; the first six trajectories are drawn.

    Raises:
        DatasetError: The disk is full or refuses.
        MissingExtraError: matplotlib is not installed.
    """
    groups: dict[str, list[TrajectoryFit]] = {}
    for fit in result.trajectories:
        groups.setdefault(fit.name.removesuffix(f"/{fit.sensor}"), []).append(fit)
    rows = list(groups.items())[:_ROWS]
    figure = new_figure(10, 0.6 + 2.3 * len(rows))
    figure.suptitle(_parameters(result), color=INK, fontsize=11)
    panels = figure.subplots(len(rows), 3, squeeze=False, sharex="row")
    for at, (row, (name, fits)) in enumerate(zip(panels, rows, strict=True)):
        below = "displacement from 0.5 N [mm]" if at == len(rows) - 1 else ""
        for axis, panel in enumerate(row):
            _axis_panel(panel, fits, axis)
            label(panel, below, "", f"F{AXES[axis]} [N]" if at == 0 else "")
        row[0].set_ylabel(name.replace("/", "\n"), color=INK, fontsize=8)
    panels[0][0].legend(frameon=False, fontsize=8)
    save(figure, path)


def _axis_panel(panel: Any, fits: Sequence[TrajectoryFit], axis: int) -> None:
    """Draw one axis of one trajectory: a line for the simulation, dots for each sensor."""
    grid(panel)
    longest = max(fits, key=lambda fit: fit.pair.displacement_m[-1])
    way = MM * longest.pair.displacement_m
    panel.plot(way, longest.pair.simulated_n[:, axis], color=INK, lw=1.6, label="simulation")
    for fit, colour in zip(fits, cycle(_SENSOR_COLOURS), strict=False):
        panel.plot(
            MM * fit.pair.displacement_m,
            fit.pair.measured_n[:, axis],
            "o",
            ms=3,
            color=colour,
            label=fit.sensor,
        )
    low, high = panel.get_ylim()
    missing = max(_LEAST_SPAN_N - (high - low), 0.0) / 2
    panel.set_ylim(low - missing, high + missing)


def plot_examples(validation: Validation, path: Path) -> None:
    """Draw four trajectories with all axes: simulation as lines, sensors as dots.

    As in the paper, the one with the highest force for each of four random indenters.

    Args:
        validation: With at least one compared trajectory.
        path: The PNG to write.

    Raises:
        DatasetError: The disk is full or refuses.
        MissingExtraError: matplotlib is not installed.
    """
    chosen = examples(validation)
    figure = new_figure(10, 7)
    figure.suptitle(validation.title, color=INK, fontsize=11)
    panels = figure.subplots(2, 2).ravel()
    for panel in panels[len(chosen) :]:
        panel.set_axis_off()
    for panel, name in zip(panels, chosen, strict=False):
        items = [item for item in validation.compared if item.path_name == name]
        _example_panel(panel, name, items)
    save(figure, path)


def examples(validation: Validation) -> list[str]:
    """The trajectory with the highest force for each of four random indenters."""
    best: dict[str, ComparedTrajectory] = {}
    for item in validation.compared:
        known = best.get(item.indenter)
        if known is None or item.peak_n > known.peak_n:
            best[item.indenter] = item
    names = sorted(best)
    count = min(_PANELS, len(names))
    drawn = np.random.default_rng(0).choice(len(names), count, replace=False)
    return [best[names[i]].path_name for i in sorted(drawn.tolist())]


def _example_panel(panel: Any, name: str, items: Sequence[ComparedTrajectory]) -> None:
    grid(panel)
    longest = max(items, key=lambda item: item.displacement_m)
    for axis, colour in enumerate(AXIS_COLOURS):
        panel.plot(
            MM * longest.pair.displacement_m,
            longest.pair.simulated_n[:, axis],
            color=colour,
            lw=1.6,
            label=f"F{AXES[axis]} simulation",
        )
        for item, marker in zip(items, cycle(_MARKERS), strict=False):
            panel.plot(
                MM * item.pair.displacement_m,
                item.pair.measured_n[:, axis],
                marker,
                ms=3.2,
                mfc="none",
                color=colour,
            )
    for item, marker in zip(items, cycle(_MARKERS), strict=False):
        panel.plot([], [], marker, ms=3.2, mfc="none", color=INK, label=item.sensor)
    error = ", ".join(f"{item.rms_n:.2f}" for item in items)
    label(panel, "displacement from 0.5 N [mm]", "force [N]", f"{name}: RMS {error} N")
    panel.legend(frameon=False, fontsize=7)


def plot_indenters(validation: Validation, path: Path) -> None:
    """Draw the mean RMS error of each indenter as bars, with the paper's range and median.

    Args:
        validation: With at least one compared trajectory.
        path: The PNG to write.

    Raises:
        DatasetError: The disk is full or refuses.
        MissingExtraError: matplotlib is not installed.
    """
    rows = validation.by_indenter
    figure = new_figure(9, 4.6)
    panel = figure.subplots()
    low, high = PAPER_RANGE_N
    at = np.arange(len(rows))
    panel.axhspan(low, high, color=GRID, zorder=0, label=f"paper: {low:.3f} to {high:.3f} N")
    panel.axhline(
        PAPER_MEDIAN_N, color="#8d97a6", lw=1.4, label=f"paper: median {PAPER_MEDIAN_N:.3f} N"
    )
    panel.bar(at, [row.rms_n for row in rows], 0.62, color="#9dbfe3", label="ours: mean")
    panel.axhline(
        validation.median_n,
        color="#d1495b",
        lw=1.4,
        ls="--",
        label=f"ours: median {validation.median_n:.3f} N",
    )
    for i, row in enumerate(rows):
        dots = [item.rms_n for item in validation.compared if item.indenter == row.indenter]
        panel.plot(np.full(len(dots), i), dots, ".", color=INK, ms=4, alpha=0.6)
        paper = PAPER_INDENTER_N.get(row.indenter)
        if paper is not None:
            panel.plot([i - 0.4, i + 0.4], [paper, paper], color=INK, lw=2)
    names = [f"{row.indenter.replace('_', chr(10))}\nn={row.trajectories}" for row in rows]
    panel.set_xticks(at, names)
    label(panel, "", "RMS force error [N], sum of axes", validation.title)
    panel.legend(frameon=False, fontsize=8)
    save(figure, path)


def _parameters(result: Calibration) -> str:
    found, rms = result.parameters, sum(result.axis_rms_n)
    kind = "SELF-TEST on simulations: " if result.self_test else ""
    return (
        f"{kind}skin {found.skin_thickness_m * 1e3:.3f} mm,"
        f" modulus {found.shear_modulus_pa * 1e-3:.1f} kPa,"
        f" friction {found.friction_coefficient:.3f},"
        f" fluid {result.fluid_volume_m3 * 1e9:.0f} mm³; RMS {rms:.3f} N"
    )


COLOURS = ("#2f6fb5", "#d1495b", "#2e8b57", "#e09f3e")
LIMIT = "#9aa0a8"


def plot_study(rows: Sequence[StudyRow], path: Path) -> None:
    """Draw the change of force and displacement by each refinement, and its computing time.

    Args:
        rows: From `mesh_study` (drawn over unknowns) or `step_study` (drawn over steps).
        path: PNG to write.

    Raises:
        DatasetError: The disk is full or refuses.
    """
    meshes = len({row.edge_m for row in rows}) > 1
    figure = new_figure(12.0, 3.6)
    force, moved, cost = figure.subplots(1, 3)
    for name, colour in zip(dict.fromkeys(row.press for row in rows), COLOURS, strict=False):
        mine = [row for row in rows if row.press == name]
        across = [row.unknowns if meshes else row.steps for row in mine]
        style = {"color": colour, "marker": "o", "ms": 4, "lw": 1.5, "label": name}
        force.plot(across, [100 * abs(row.force_change) for row in mine], **style)
        moved.plot(across, [MM * row.displacement_change_m for row in mine], **style)
        cost.plot(across, [row.seconds for row in mine], **style)
    limit = {"color": LIMIT, "ls": "--", "lw": 1, "label": "accepted below"}
    force.axhline(100 * FORCE_CHANGE, **limit)
    moved.axhline(MM * DISPLACEMENT_CHANGE_M, **limit)
    across_name = "edge on the pad, unknowns, factorisation" if meshes else "steps of a press"
    coarser = "coarser mesh" if meshes else "fewer steps"
    label(force, across_name, "change of the force [%]", f"force, against the {coarser}")
    label(moved, across_name, "mean change [mm]", f"outer skin, against the {coarser}")
    label(cost, across_name, "computing time of a press [s]", "cost")
    first = [row for row in rows if row.press == rows[0].press]
    for axes in (force, moved, cost):
        grid(axes)
        axes.set_xscale("log")
        axes.set_ylim(bottom=0.0)
        axes.set_xticks([row.unknowns if meshes else row.steps for row in first], minor=False)
        axes.set_xticklabels([_study_tick(row, meshes=meshes) for row in first], fontsize=7)
        axes.minorticks_off()
    force.legend(frameon=False, fontsize=8)
    save(figure, path)


def _study_tick(row: StudyRow, *, meshes: bool) -> str:
    """Tick label of a row."""
    if not meshes:
        return f"{row.steps} steps"
    gflop = f"{row.factor_gflop:.1f} GFlop"
    return f"{row.edge_m * MM:g} mm\n{row.unknowns:,}\n{gflop}"
