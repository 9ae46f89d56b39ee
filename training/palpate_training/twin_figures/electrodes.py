"""Electrode boxes beside the unwrapped map (the paper's figure of electrode values)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from palpate.anatomy import ELECTRODE_POSITIONS, EXCITATION_POSITIONS
from palpate.extras import require
from palpate_training.twin.content import ExperimentDataset
from palpate_training.twin_figures.boxes import box_of, draw_boxes
from palpate_training.twin_figures.outline import unwrap, unwrapped
from palpate_training.twin_figures.style import (
    CORE_EDGE,
    INK,
    MM,
    SKIN_LIGHT,
    caption,
    grid,
    heading,
    label,
    new_figure,
    save,
    unit_legend,
)

ELECTRODE_NAMES = tuple(f"E{i}" for i in range(1, len(ELECTRODE_POSITIONS) + 1))
EXCITATION_NAMES = tuple(f"X{i}" for i in range(1, len(EXCITATION_POSITIONS) + 1))

_DISC_RADIUS_MM = 1.25  # discs of 2.5 mm (learning notes, section 4.3)
_ELECTRODE = "#2563a6"


def draw_electrode_boxes(path: Path, data: ExperimentDataset) -> str:
    """Draw the tared values of each electrode and unit, and where the electrodes are.

    Args:
        path: PNG to write.
        data: What to draw.

    Returns:
        The caption.

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
    heading(figure, "Electrode values")
    caption(figure, text)
    save(figure, path)
    return text


def draw_map(axes: Any) -> None:
    """The unwrapped electrode map, seen from below: distal to the right, y down."""
    axes.fill(*(MM * unwrapped()).T, facecolor=SKIN_LIGHT, edgecolor=CORE_EDGE, lw=1.2, alpha=0.6)
    kinds = (
        (ELECTRODE_POSITIONS, ELECTRODE_NAMES, _ELECTRODE, "white"),
        (EXCITATION_POSITIONS, EXCITATION_NAMES, "white", INK),
    )
    for positions, names, fill, ink in kinds:
        for place, name in zip(MM * unwrap(positions), names, strict=True):
            axes.add_patch(_disc(place, fill, _ELECTRODE if ink == "white" else INK))
            axes.annotate(
                name, place, ha="center", va="center_baseline", fontsize=7, color=ink, weight="bold"
            )
    label(axes, "distal, along the core [mm]", "lateral, along the core [mm]")
    axes.set(aspect="equal", xlim=(-19.9, 10.2), ylim=(10.2, -10.2))
    axes.set_yticks(range(-10, 11, 5))


def _disc(place: Any, fill: str, edge: str) -> Any:
    patches = require("matplotlib.patches", extra="training")
    return patches.Circle(place, _DISC_RADIUS_MM, facecolor=fill, edgecolor=edge, lw=0.9)
