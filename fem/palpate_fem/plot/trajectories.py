"""Pictures of whole trajectories: the curves of one, and a store on one page."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import DatasetError
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.plot.style import (
    AXES,
    AXIS_COLOURS,
    INK,
    MM,
    OUTCOME_COLOURS,
    grid,
    label,
    new_figure,
    save,
)
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.store.content import TrajectorySummary


def travel_m(path: Floats, pose: Floats) -> Floats:
    """Travel of the indenter from its first pose to each step [m], turns included, shape (K,).

    Args:
        path: Requested poses; only the first is used, shape (1 or more, 7).
        pose: Poses of the steps, shape (K, 7).
    """
    return path_lengths(np.concatenate([path[:1], pose]))[1:]


def travel_mm(trajectory: IndentationResult) -> Floats:
    """Travel of the indenter at each step [mm], shape (K,)."""
    pose = np.array([step.pose for step in trajectory.steps]).reshape(-1, 7)
    return MM * travel_m(trajectory.path, pose)


def draw_force(axes: Any, travel_mm: Floats, force: Floats, *, mark: int | None = None) -> None:
    """Draw the net force on the BioTac against travel; ``mark`` is a step to mark."""
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


COLUMNS = 5
"""Small plots in a row; nine indenters need two rows."""


def plot_overview(
    summaries: Sequence[TrajectorySummary], path: Path, *, title: str = ""
) -> Counter[IndentationOutcome]:
    """Draw all trajectories of a store, simulated or measured.

    Args:
        summaries: One for each trajectory.
        path: The PNG to write.
        title: Title.

    Returns:
        Number of trajectories by outcome.

    Raises:
        DatasetError: There is no trajectory, or the disk is full or refuses.
        MissingExtraError: matplotlib is not installed.
    """
    if not summaries:
        raise DatasetError(
            f"{title or 'the store'} holds no trajectory", remedy="wait for the first, or run some"
        )
    groups: dict[str, list[TrajectorySummary]] = defaultdict(list)
    for summary in summaries:
        groups[summary.indenter].append(summary)
    names = sorted(groups)
    rows = -(-len(names) // COLUMNS)
    figure = new_figure(15, 3.2 + 0.3 * len(names) + 2.5 * rows)
    top, bottom = figure.subfigures(2, 1, height_ratios=[2.0 + 0.3 * len(names), 2.5 * rows])
    left, middle, right = top.subplots(1, 3, width_ratios=[3, 2, 2])
    _draw_range(left, names, groups)
    outcomes = _draw_outcomes(middle, names, groups)
    _draw_seconds(right, summaries)
    panels = bottom.subplots(rows, min(COLUMNS, len(names)), squeeze=False, sharex=True).ravel()
    for axes, name in zip(panels, names, strict=False):
        for summary in groups[name]:
            force = np.linalg.norm(summary.force, axis=1)
            colour = OUTCOME_COLOURS[summary.outcome]
            axes.plot(
                MM * travel_m(summary.path, summary.pose), force, color=colour, lw=0.8, alpha=0.7
            )
        label(axes, "travel [mm]", "|F| [N]", f"{name} ({len(groups[name])})")
        axes.tick_params(labelbottom=True)
        grid(axes)
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    bottom.suptitle("force in each trajectory; colour: how it ended", color=INK, fontsize=10)
    ended = {how: outcomes[how] for how in OUTCOME_COLOURS if outcomes[how]}
    figure.suptitle(
        f"{title}\n{len(summaries)} trajectories: "
        f"{', '.join(f'{count} {how.value}' for how, count in ended.items())}".strip(),
        color=INK,
        fontsize=12,
    )
    save(figure, path)
    return outcomes


def _draw_range(axes: Any, names: list[str], groups: dict[str, list[TrajectorySummary]]) -> None:
    for row, name in enumerate(names):
        peaks = np.array(
            [np.linalg.norm(one.force, axis=1).max(initial=0.0) for one in groups[name]]
        )
        axes.plot([peaks.min(), peaks.max()], [row, row], color="#b9bec7", lw=5, zorder=1)
        axes.plot(np.median(peaks), row, "|", color=INK, ms=14, mew=2, zorder=3)
        # Spread a little, so that equal forces do not cover each other.
        spread = 0.24 * np.sin(2.4 * np.arange(len(peaks)))
        colours = [OUTCOME_COLOURS[summary.outcome] for summary in groups[name]]
        axes.scatter(peaks, row + spread, s=14, c=colours, zorder=2)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(left=0.0)
    label(
        axes,
        "largest |F| of a trajectory [N]",
        "",
        "force: bar range, stroke median, dots trajectories",
    )
    axes.grid(visible=True, axis="x", color="#e4e4e8", lw=0.7)


def _draw_outcomes(
    axes: Any, names: list[str], groups: dict[str, list[TrajectorySummary]]
) -> Counter[IndentationOutcome]:
    total: Counter[IndentationOutcome] = Counter(
        item.outcome for name in names for item in groups[name]
    )
    left = np.zeros(len(names))
    for outcome, colour in OUTCOME_COLOURS.items():
        if not total[outcome]:
            continue
        counts = [sum(item.outcome is outcome for item in groups[name]) for name in names]
        text = f"{outcome.value} ({total[outcome]})"
        axes.barh(range(len(names)), counts, left=left, color=colour, height=0.6, label=text)
        left = left + counts
    axes.set_yticks(range(len(names)), [])
    axes.set_ylim(len(names) - 0.5, -0.5)
    label(axes, "trajectories", "", "how they ended")
    axes.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.07), ncols=3)
    return total


def _draw_seconds(axes: Any, summaries: Sequence[TrajectorySummary]) -> None:
    seconds = np.array([item.seconds for item in summaries if np.isfinite(item.seconds)])
    label(axes, "computing time of a trajectory [s]", "trajectories")
    if not len(seconds):
        axes.text(0.5, 0.5, "measured", ha="center", transform=axes.transAxes, color=INK)
        return
    axes.hist(seconds, bins=30, color="#7aa6c2")
    axes.set_title(
        f"cost: median {np.median(seconds):.1f} s, longest {seconds.max():.1f} s",
        color=INK,
        fontsize=10,
    )
    grid(axes)
