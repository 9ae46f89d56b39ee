"""Boxes as the paper draws them (captions of its force and electrode figures).

Force boxes of each unit (the paper's figure of experimental force values).

Electrode boxes beside the unwrapped map (the paper's figure of electrode values).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.anatomy import ELECTRODE_POSITIONS, EXCITATION_POSITIONS
from palpate.errors import DatasetError
from palpate.process import require
from palpate_training.datasets.experiment import ExperimentDataset
from palpate_training.figures.outline import unwrap, unwrapped
from palpate_training.figures.style import (
    CORE_EDGE,
    INK,
    MM,
    SKIN_LIGHT,
    finish,
    grid,
    label,
    new_figure,
    unit_colour,
    unit_legend,
)

Floats = npt.NDArray[np.float32] | npt.NDArray[np.float64]

FENCE_IQR = 1.5
"""Length of a fence in interquartile ranges (the paper's captions)."""


@dataclass(frozen=True, slots=True)
class BoxStatistics:
    """What a box shows, in the unit of the values.

    Attributes:
        low: Lower fence: the lowest value within 1.5 IQR of the box.
        q1: Lower edge, the first quartile.
        median: Solid line.
        mean: Dashed line.
        q3: Upper edge, the third quartile.
        high: Upper fence: the highest value within 1.5 IQR of the box.
    """

    low: float
    q1: float
    median: float
    mean: float
    q3: float
    high: float


def box_of(values: Floats) -> BoxStatistics:
    """The box of some values, shape (N,).

    Fences are 1.5 IQR long, rounded down to the nearest value; what lies beyond is not shown.

    Raises:
        DatasetError: There is no value, or one is not finite.
    """
    wrong = len(values) - int(np.isfinite(values).sum())
    if not len(values) or wrong:
        raise DatasetError(
            f"a box of {len(values)} values, {wrong} of them not finite",
            remedy="check the data set: each unit needs rows, all of them finite",
        )
    exact = np.asarray(values, np.float64)
    q1, median, q3 = np.percentile(exact, [25, 50, 75])
    reach = FENCE_IQR * (q3 - q1)
    # Where no value lies between box and fence, the fence is the edge of the box.
    low = min(float(exact[exact >= q1 - reach].min()), float(q1))
    high = max(float(exact[exact <= q3 + reach].max()), float(q3))
    return BoxStatistics(low, float(q1), float(median), float(exact.mean()), float(q3), high)


def draw_boxes(axes: Any, groups: Sequence[Sequence[BoxStatistics]], names: Sequence[str]) -> None:
    """Groups of boxes side by side, one colour for each unit."""
    units = len(groups[0])
    width = 0.78 / units
    for unit in range(units):
        places = np.arange(len(groups)) + (unit - (units - 1) / 2) * width
        axes.bxp(
            [
                {
                    "whislo": box.low, "q1": box.q1, "med": box.median, "mean": box.mean,
                    "q3": box.q3, "whishi": box.high,
                }
                for box in (group[unit] for group in groups)
            ],
            positions=places,
            widths=0.82 * width,
            manage_ticks=False,
            patch_artist=True,
            showmeans=True,
            meanline=True,
            showfliers=False,
            boxprops={"facecolor": unit_colour(unit), "alpha": 0.75, "edgecolor": INK, "lw": 0.7},
            medianprops={"color": "black", "lw": 1.3},
            meanprops={"color": "black", "lw": 1.0, "ls": (0, (2, 1.2))},
            whiskerprops={"color": INK, "lw": 0.8},
            capprops={"color": INK, "lw": 0.8},
        )  # fmt: skip
    axes.set_xticks(np.arange(len(groups)), names)
    axes.set_xlim(-0.55, len(groups) - 0.45)
    axes.axhline(0, color=INK, lw=0.6, zorder=0)


FORCE_NAMES = ("$F_x$ (distal)", "$F_y$ (lateral)", "$F_z$ (dorsal)", "$|F|$")


def draw_force_boxes(path: Path, data: ExperimentDataset) -> str:
    """Draw the three components of force, and the magnitude, for each unit.

    Raises:
        DatasetError: A unit has no rows, or the disk refused.
    """
    norm = np.linalg.norm(data.force, axis=1, keepdims=True)
    columns = np.hstack([data.force, norm])
    of_unit = [data.row_unit == unit for unit in range(len(data.unit_names))]
    groups = [[box_of(columns[rows, i]) for rows in of_unit] for i in range(columns.shape[1])]
    largest = ", ".join(
        f"{name} {columns[rows, 3].max():.1f} N"
        for name, rows in zip(data.unit_names, of_unit, strict=True)
    )
    text = (
        "Box: interquartile range (IQR); solid line: median; dashed: mean; fences: 1.5 IQR, rounded"
        " down to the nearest value; nothing beyond them is drawn. Largest magnitudes (not"
        f" pictured): {largest}."
    )
    figure = new_figure(7.6, 4.6)
    axes = figure.subplots()
    draw_boxes(axes, groups, FORCE_NAMES)
    label(axes, "", "force on the BioTac [N]")
    axes.tick_params(axis="x", labelsize=10, length=0)
    grid(axes, "y")
    unit_legend(figure, data.unit_names, loc="outside upper right", ncols=len(data.unit_names))
    return finish(figure, path, "Force values, sensor frame", text)


ELECTRODE_NAMES = tuple(f"E{i}" for i in range(1, len(ELECTRODE_POSITIONS) + 1))
EXCITATION_NAMES = tuple(f"X{i}" for i in range(1, len(EXCITATION_POSITIONS) + 1))

_DISC_RADIUS_MM = 1.25  # discs of 2.5 mm (learning notes, section 4.3)
_ELECTRODE = "#2563a6"


def draw_electrode_boxes(path: Path, data: ExperimentDataset) -> str:
    """Draw the tared values of each electrode and unit, and where the electrodes are.

    Raises:
        DatasetError: A unit has no rows, or the disk refused.
    """
    of_unit = [data.row_unit == unit for unit in range(len(data.unit_names))]
    groups = [
        [box_of(data.tared[rows, electrode]) for rows in of_unit]
        for electrode in range(len(ELECTRODE_NAMES))
    ]
    ranges = ", ".join(
        f"{name} [{data.tared[rows].min():.2f}, {data.tared[rows].max():.2f}]"
        for name, rows in zip(data.unit_names, of_unit, strict=True)
    )
    text = (
        "Left: tared electrodes over full scale; box: interquartile range (IQR); solid line:"
        " median; dashed: mean; fences: 1.5 IQR, rounded down to the nearest value; nothing beyond"
        f" them is drawn. Full range (not pictured): {ranges}. Right: electrodes on the unwrapped"
        " core over a rounded outline, seen from below; X: excitation."
    )
    figure = new_figure(15.5, 5.4)
    left, right = figure.subplots(1, 2, width_ratios=(2.7, 1.0))
    draw_boxes(left, groups, ELECTRODE_NAMES)
    label(left, "electrode", "tared counts / full scale [1]")
    grid(left, "y")
    unit_legend(left, data.unit_names, loc="upper left", ncols=len(data.unit_names))
    low, high = left.get_ylim()
    left.set_ylim(low, high + 0.1 * (high - low))  # the legend's line
    draw_map(right)
    return finish(figure, path, "Electrode values", text)


def draw_map(axes: Any) -> None:
    """The unwrapped electrode map, seen from below: distal to the right, y down."""
    axes.fill(*(MM * unwrapped()).T, facecolor=SKIN_LIGHT, edgecolor=CORE_EDGE, lw=1.2, alpha=0.6)
    kinds = (
        (ELECTRODE_POSITIONS, ELECTRODE_NAMES, _ELECTRODE, "white"),
        (EXCITATION_POSITIONS, EXCITATION_NAMES, "white", INK),
    )
    Circle = require("matplotlib.patches", extra="training").Circle  # noqa: N806
    for positions, names, fill, ink in kinds:
        for place, name in zip(MM * unwrap(positions), names, strict=True):
            edge = _ELECTRODE if ink == "white" else INK
            axes.add_patch(Circle(place, _DISC_RADIUS_MM, facecolor=fill, edgecolor=edge, lw=0.9))
            axes.annotate(
                name, place, ha="center", va="center_baseline", fontsize=7, color=ink, weight="bold"
            )
    label(axes, "distal, along the core [mm]", "lateral, along the core [mm]")
    axes.set(aspect="equal", xlim=(-19.9, 10.2), ylim=(10.2, -10.2))
    axes.set_yticks(range(-10, 11, 5))
