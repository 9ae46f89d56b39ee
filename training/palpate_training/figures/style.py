"""How pictures and tables look. matplotlib is loaded when the first picture is drawn."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from palpate.files.atomic import written_whole
from palpate.process import require

INK = "#30343b"
GRID = "#e4e4e8"
SKIN_LIGHT, SKIN_DARK = "#cfe0f1", "#4f83b8"
CORE = "#e4e9ee"
CORE_EDGE = "#7a8793"
MARK = "#c0392b"
UNIT_COLOURS = ("#2f6fb5", "#e09f3e", "#2e8b57", "#8e5ea2", "#5fa8a8", "#9aa0a8")
REAL_COLOURS = ("#30343b", "#9aa0a8")
"""Of what was measured on a real sensor, beside the colours of the twin's units."""

MM = 1e3
"""People read a fingertip in millimetres; only the picture does [mm/m]."""

_CAPTION_POINTS = 8.5
_LETTERS_PER_INCH = 15.5
"""Of a caption; measured on a long line of prose in the default font."""


def unit_colour(unit: int) -> str:
    """Colour of a unit by its index; repeats after six."""
    return UNIT_COLOURS[unit % len(UNIT_COLOURS)]


def new_figure(width: float, height: float) -> Any:
    """An empty figure without a window, of so many inches."""
    require("matplotlib", extra="training").use("agg")
    figures = require("matplotlib.figure", extra="training")
    return figures.Figure(figsize=(width, height), layout="constrained", facecolor="white")


def save(figure: Any, path: Path) -> None:
    """Write a figure as PNG, whole or not at all.

    Raises:
        DatasetError: The disk refused.
    """
    with written_whole(path) as partial:
        figure.savefig(partial, dpi=110, format="png", metadata={"Software": None})


def label(axes: Any, across: str, up: str, title: str = "") -> None:
    """Name the axes, with units, and make them quiet."""
    axes.set_xlabel(across, color=INK, fontsize=9)
    axes.set_ylabel(up, color=INK, fontsize=9)
    axes.set_title(title, color=INK, fontsize=10)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=8)


def grid(axes: Any, axis: str = "both") -> None:
    """Lines to read values by."""
    axes.grid(visible=True, axis=axis, color=GRID, lw=0.7)


def finish(figure: Any, path: Path, heading: str, caption: str) -> str:
    """Put a heading above and a caption, wrapped, below a figure, write it, return the caption.

    Raises:
        DatasetError: The disk refused.
    """
    figure.suptitle(heading, x=0.01, ha="left", color=INK, fontsize=11)
    letters = int(_LETTERS_PER_INCH * figure.get_figwidth())
    figure.supxlabel(
        textwrap.fill(caption, letters), x=0.01, ha="left", color=INK, fontsize=_CAPTION_POINTS
    )
    save(figure, path)
    return caption


def unit_legend(where: Any, names: Sequence[str], **options: Any) -> None:
    """A patch of colour for each unit, on axes or on the whole figure."""
    patches = require("matplotlib.patches", extra="training")
    handles = [
        patches.Patch(facecolor=unit_colour(i), edgecolor=INK, lw=0.6, label=name)
        for i, name in enumerate(names)
    ]
    where.legend(handles=handles, frameon=False, fontsize=9, labelcolor=INK, **options)


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> str:
    """A Markdown table; the first ``words`` columns are words, the others are numbers."""
    lines = [headings, ["---"] * words + ["---:"] * (len(headings) - words)]
    first, rule, *rest = ("| " + " | ".join(cells) + " |" for cells in (*lines, *rows))
    return "\n".join([first, rule.replace(" ", ""), *rest]) + "\n"
