"""Force boxes of each unit (the paper's figure of experimental force values)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from palpate_training.twin.content import ExperimentDataset
from palpate_training.twin_figures.boxes import box_of, draw_boxes
from palpate_training.twin_figures.style import (
    caption,
    grid,
    heading,
    label,
    new_figure,
    save,
    unit_legend,
)

FORCE_NAMES = ("$F_x$ (distal)", "$F_y$ (lateral)", "$F_z$ (dorsal)", "$|F|$")


def draw_force_boxes(path: Path, data: ExperimentDataset) -> str:
    """Draw the three components of force, and the magnitude, for each unit.

    Args:
        path: PNG to write.
        data: What to draw.

    Returns:
        The caption.

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
    heading(figure, "Force values, sensor frame")
    caption(figure, text)
    save(figure, path)
    return text
