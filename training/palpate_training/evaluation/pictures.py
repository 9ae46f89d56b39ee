"""Pictures of a study: errors as boxes, a press in time, pairs on the skin, electrodes on the map.

They show what the first split of a task holds out, and are drawn from what is kept of the
trainings. Which press is shown follows from a rule, not from how it looks: the trial whose error is
the median.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate.process import require
from palpate_training.datasets.experiment import ExperimentDataset
from palpate_training.evaluation.cells import Cell, CellResult, grouped
from palpate_training.evaluation.features import (
    HEADLINES,
    OUR_NAMES,
    PAPER_SD_N,
    PAPER_SYSTEMS,
    FeatureTask,
    force_shares,
    row_errors,
)
from palpate_training.evaluation.skin import SynthesisTask
from palpate_training.figures import outline
from palpate_training.figures.boxes import box_of
from palpate_training.figures.style import (
    CORE_EDGE,
    INK,
    MARK,
    MM,
    SKIN_DARK,
    SKIN_LIGHT,
    finish,
    grid,
    label,
    new_figure,
    unit_colour,
)
from palpate_training.learning.splits import SplitName
from palpate_training.systems.synthesis import SYNTHESIS_SYSTEMS
from palpate_training.tasks.fields import tared_counts

Floats = npt.NDArray[np.float64]
Made = Mapping[Cell, CellResult]

_HELD_OUT = {
    "trajectory": "unseen trajectories",
    "block": "unseen blocks of 18 s",
    "touch": "unseen touches",
}
_UNITS = {"distance_m": ("mm", 1e3), "magnitude_n": ("N", 1.0), "angle_rad": ("rad", 1.0)}
_WHAT = {"distance_m": "distance", "magnitude_n": "error of the magnitude", "angle_rad": "angle"}


@dataclass(frozen=True, slots=True)
class Picture:
    """A file beside the page.

    Attributes:
        task: Under whose heading it stands; empty = on top.
        file: Its name.
        caption: What it shows.
    """

    task: str
    file: str
    caption: str


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """Estimates of one system for the test rows of the widest test, by the first seed."""

    test: str
    system: str
    rows: npt.NDArray[np.int64]
    estimate: Floats


def draw_task(
    folder: Path,
    task: Any,
    data: ExperimentDataset | None,
    made: Made,
    *,
    split: SplitName = "trajectory",
) -> list[Picture]:
    """Draw what there is to show of a task; nothing if the split was not tested.

    Without ``data``, which is that of an experiment, errors alone are drawn.

    Raises:
        DatasetError: The disk refused.
    """
    if not isinstance(task, FeatureTask | SynthesisTask):
        return []
    shown = _shown(made, split)
    if not shown:
        return []
    drawn: list[tuple[str, Callable[[Path], str]]] = []
    if isinstance(task, SynthesisTask):
        drawn.append(("map", lambda path: _draw_map(path, task, shown)))
    else:
        drawn.append(("errors", lambda path: _draw_errors(path, task, shown, split)))
        pair = _compared(task, shown)
        if data is None:
            pass
        elif task.name == "force":
            drawn.append(("press", lambda path: _draw_press(path, task, data, pair)))
        elif task.name in ("location", "centre"):
            drawn.append(("pairs", lambda path: _draw_pairs(path, task, pair)))
    return [
        Picture(task.name, f"{task.name}-{kind}.png", draw(folder / f"{task.name}-{kind}.png"))
        for kind, draw in drawn
    ]


def draw_forces(folder: Path, force_n: Floats) -> Picture:
    """Draw how strong the presses are, beside the spread of the paper's.

    Args:
        folder: Where to.
        force_n: Magnitude of the force of each row [N], shape (N,).

    Raises:
        DatasetError: The disk refused.
    """
    figure = new_figure(7.0, 3.2)
    axes = figure.subplots()
    axes.hist(force_n, bins=60, color=unit_colour(0), alpha=0.8)
    for bound, name in ((2.0, "2 and 8 N"), (8.0, None)):
        axes.axvline(bound, color=INK, lw=0.8, ls="--", label=name)
    axes.legend(frameon=False, fontsize=8)
    label(axes, "magnitude of the force [N]", "rows")
    grid(axes, "y")
    of = force_shares(force_n)
    caption = finish(
        figure,
        folder / "forces.png",
        "How strong the presses are",
        f"Median {of['median_n']:.2f} N, standard deviation {of['sd_n']:.2f} N (the paper's "
        f"rows: about {PAPER_SD_N:g} N), below 2 N {100 * of['below_2n']:.0f} %, above 8 N "
        f"{100 * of['above_8n']:.0f} % of {len(force_n):,} rows.",
    )
    return Picture("", "forces.png", caption)


def _shown(made: Made, shown_split: SplitName) -> list[_Shown]:
    """The widest test of a split, a system after another."""
    tests: dict[str, list[_Shown]] = {}
    for (split, test, system), by_seed in grouped(made):
        cells = by_seed[0]
        if split == shown_split:
            tests.setdefault(test, []).append(
                _Shown(
                    test,
                    system,
                    np.concatenate([cell.fold.rows.test for cell in cells]),
                    np.concatenate([made[cell].arrays["estimate"] for cell in cells]).astype(
                        np.float64
                    ),
                )
            )
    return max(tests.values(), key=lambda shown: len(shown[0].rows), default=[])


def _headline(task: FeatureTask, one: _Shown) -> Floats:
    truth = task.samples.truth(task.name)[one.rows].astype(np.float64)
    return row_errors(task.name, one.estimate, truth)[HEADLINES[task.name][0]]


def _compared(task: FeatureTask, shown: Sequence[_Shown]) -> list[_Shown]:
    """The best of the paper's networks and the best of ours; all of either may be missing."""
    found = []
    for names in (PAPER_SYSTEMS, OUR_NAMES):
        these = [one for one in shown if one.system in names]
        if these:
            found.append(min(these, key=lambda one: float(np.nanmedian(_headline(task, one)))))
    return found or list(shown[:1])


def _draw_errors(path: Path, task: FeatureTask, shown: Sequence[_Shown], split: SplitName) -> str:
    """A box of every system, best on top."""
    error = HEADLINES[task.name][0]
    unit, factor = _UNITS[error]
    named = [(one.system, factor * _headline(task, one)) for one in shown]
    named.sort(key=lambda item: float(np.nanmedian(item[1])), reverse=True)
    figure = new_figure(9.0, 1.4 + 0.27 * len(named))
    axes = figure.subplots()
    boxes = [box_of(values[~np.isnan(values)]) for _, values in named]
    colours = [
        unit_colour(2) if name in OUR_NAMES else unit_colour(1) if name in PAPER_SYSTEMS
        else unit_colour(0)
        for name, _ in named
    ]  # fmt: skip
    parts = axes.bxp(
        [
            {"whislo": b.low, "q1": b.q1, "med": b.median, "mean": b.mean, "q3": b.q3,
             "whishi": b.high}
            for b in boxes
        ],
        positions=np.arange(len(boxes)), widths=0.66, orientation="horizontal",
        manage_ticks=False, patch_artist=True, showmeans=True, meanline=True, showfliers=False,
        medianprops={"color": "black", "lw": 1.3},
        meanprops={"color": "black", "lw": 1.0, "ls": (0, (2, 1.2))},
    )  # fmt: skip
    for patch, colour in zip(parts["boxes"], colours, strict=True):
        patch.set(facecolor=colour, alpha=0.75, edgecolor=INK, lw=0.7)
    axes.set_yticks(np.arange(len(named)), [name for name, _ in named], fontsize=8)
    # One that is far worse than all others must not flatten them.
    axes.set_xlim(0.0, 1.1 * float(np.percentile([box.high for box in boxes], 75)))
    label(axes, f"{_WHAT[error]} [{unit}]", "")
    grid(axes, "x")
    return finish(
        figure,
        path,
        f"{task.name.capitalize()}: {_HELD_OUT[split]}, {shown[0].test}",
        f"{len(shown[0].rows):,} rows. Box: interquartile range (IQR); solid line: median; dashed:"
        " mean; whiskers: 1.5 IQR, rounded down to the nearest value. Green: ours; yellow: the"
        " paper's networks. Boxes may leave the picture on the right.",
    )


def _median_trial(task: FeatureTask, one: _Shown) -> npt.NDArray[np.int64]:
    """Places in the test rows of the trial whose mean error is the median of all trials."""
    trial = task.samples.trial[one.rows]
    errors = _headline(task, one)
    ids = np.unique(trial)
    means = np.array([np.nanmean(errors[trial == each]) for each in ids])
    return np.flatnonzero(trial == ids[np.argsort(means)[len(ids) // 2]])


def _draw_press(
    path: Path, task: FeatureTask, data: ExperimentDataset, compared: Sequence[_Shown]
) -> str:
    """The components of force over the travel of one press."""
    at = _median_trial(task, compared[-1])
    figure = new_figure(11.0, 3.6)
    panels = figure.subplots(1, 3)
    rows = compared[-1].rows[at]
    travel_mm = MM * data.travel_m[rows]
    for axis, (axes, name) in enumerate(zip(panels, ("distal", "lateral", "dorsal"), strict=True)):
        axes.plot(travel_mm, task.samples.force[rows, axis], color="black", lw=2.2, label="truth")
        for number, one in enumerate(compared):
            axes.plot(
                travel_mm, one.estimate[at, axis], color=unit_colour(2 - (number == 0)), lw=1.4,
                label=one.system,
            )  # fmt: skip
        label(axes, "travel past first contact [mm]", f"$F_{'xyz'[axis]}$ ({name}) [N]")
        grid(axes)
    # Above the panels: within one it would cover the curves of some press.
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside upper right", ncols=len(names), frameon=False, fontsize=8,
        labelcolor=INK,
    )  # fmt: skip
    trajectory = data.trajectories[int(data.row_trajectory[rows[0]])]
    return finish(
        figure,
        path,
        "A press that was not seen in training",
        f"{trajectory} on {data.unit_names[int(data.row_unit[rows[0]])]}: the trial whose mean"
        f" error of {compared[-1].system} is the median of all tested trials.",
    )


def _draw_pairs(path: Path, task: FeatureTask, compared: Sequence[_Shown]) -> str:
    """Truth and estimate at the end of every trial, seen from below and from the side."""
    figure = new_figure(5.4 * len(compared), 7.4)
    panels = figure.subplots(2, len(compared), squeeze=False, sharex=True, sharey="row")
    collections = require("matplotlib.collections", extra="training")
    for column, one in enumerate(compared):
        trial = task.samples.trial[one.rows]
        last = np.flatnonzero(np.append(trial[1:] != trial[:-1], True))
        truth = MM * task.samples.truth(task.name)[one.rows][last]
        estimate = MM * one.estimate[last]
        for row, up in enumerate((1, 2)):
            axes = panels[row, column]
            skin, core = outline.ventral() if up == 1 else outline.lateral()
            axes.fill(*(MM * skin).T, facecolor=SKIN_LIGHT, edgecolor=SKIN_DARK, lw=1.0, alpha=0.5)
            axes.plot(*(MM * core).T, color=CORE_EDGE, lw=0.8)
            lines = np.stack([truth[:, [0, up]], estimate[:, [0, up]]], axis=1)
            axes.add_collection(collections.LineCollection(lines, colors=INK, linewidths=0.7))
            axes.plot(*truth[:, [0, up]].T, "o", ms=3.0, color=INK)
            axes.plot(*estimate[:, [0, up]].T, "o", ms=3.0, color=MARK, mfc="white")
            label(
                axes,
                "x, distal [mm]" if row else "",
                ("y, lateral [mm]", "z, dorsal [mm]")[row] if column == 0 else "",
                f"{one.system}: {len(last)} trials" if row == 0 else "",
            )
            axes.set_aspect("equal")
    panels[0, 0].invert_yaxis()
    return finish(
        figure,
        path,
        f"{task.name.capitalize()}: truth and estimate",
        "At the last row of each tested trial. Black: truth; red ring: estimate. From below and "
        "from the side, on the outline of a nominal fingertip.",
    )


def _draw_map(path: Path, task: SynthesisTask, shown: Sequence[_Shown]) -> str:
    """Root mean square of each electrode of the best system, on the unwrapped core."""
    counts = tared_counts(task.data)
    squares = [np.square(one.estimate - counts[one.rows]).mean(axis=0) for one in shown]
    best = min(range(len(shown)), key=lambda i: float(squares[i].mean()))
    rmse = np.sqrt(squares[best])
    figure = new_figure(6.4, 4.6)
    axes = figure.subplots()
    axes.fill(*(MM * outline.unwrapped()).T, facecolor=SKIN_LIGHT, edgecolor=CORE_EDGE, alpha=0.4)
    places = MM * outline.unwrap(ELECTRODE_POSITIONS)
    drawn = axes.scatter(*places.T, c=rmse, s=430, cmap="viridis", edgecolors=INK, linewidths=0.8)
    for place, value in zip(places, rmse, strict=True):
        ink = "white" if value < rmse.min() + 0.6 * np.ptp(rmse) else "black"
        axes.annotate(f"{value:.0f}", place, ha="center", va="center", fontsize=8, color=ink)
    label(axes, "distal, along the core [mm]", "lateral, along the core [mm]")
    axes.set(aspect="equal", ylim=(10.2, -10.2))
    bar = figure.colorbar(drawn, ax=axes, shrink=0.8, pad=0.02)
    bar.set_label("root mean square [counts]", color=INK, fontsize=9)
    sources = {system.name: system.source for system in SYNTHESIS_SYSTEMS}
    return finish(
        figure,
        path,
        "Electrodes from the skin: error of each electrode",
        f"{shown[best].system} ({sources[shown[best].system]}), {len(shown[best].rows):,} rows of"
        f" unseen trajectories; all together {np.sqrt(squares[best].mean()):.1f} counts.",
    )
