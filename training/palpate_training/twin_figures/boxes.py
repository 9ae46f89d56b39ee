"""Boxes as the paper draws them (captions of its force and electrode figures)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.twin_figures.style import INK, unit_colour

Floats = npt.NDArray[np.float32] | npt.NDArray[np.float64]

FENCE_IQR = 1.5
"""Length of a fence in interquartile ranges (the paper's captions)."""


@dataclass(frozen=True, slots=True)
class Box:
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


def box_of(values: Floats) -> Box:
    """The box of some values, shape (N,).

    Fences are 1.5 IQR long, rounded down to the nearest value; what lies beyond is not shown.

    Raises:
        DatasetError: There is no value, or one is not a number.
    """
    if not len(values) or not np.isfinite(values).all():
        raise DatasetError(
            f"a box of {len(values)} values, {int(np.isnan(values).sum())} of them not a number",
            remedy="check the data set: each unit needs rows, all of them finite",
        )
    exact = np.asarray(values, np.float64)
    q1, median, q3 = np.percentile(exact, [25, 50, 75])
    reach = FENCE_IQR * (q3 - q1)
    # Where no value lies between box and fence, the fence is the edge of the box.
    low = min(float(exact[exact >= q1 - reach].min()), float(q1))
    high = max(float(exact[exact <= q3 + reach].max()), float(q3))
    return Box(low, float(q1), float(median), float(exact.mean()), float(q3), high)


def draw_boxes(axes: Any, groups: Sequence[Sequence[Box]], names: Sequence[str]) -> None:
    """Groups of boxes side by side, one colour for each unit.

    Args:
        axes: Where to.
        groups: For each place on the x axis the boxes of all units.
        names: Of the places.
    """
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
