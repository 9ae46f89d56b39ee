"""Style of all pictures of simulations. matplotlib is loaded when the first one is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from palpate.files.atomic import written_whole
from palpate.process import require
from palpate_fem.result import IndentationOutcome

INK = "#30343b"
GRID = "#e4e4e8"
SKIN = "#cfdbe6"
CORE = "#8d97a6"
INDENTER = "#f0c48a"
PATCH = "#d1495b"
AXES = ("x", "y", "z")
AXIS_COLOURS = ("#d1495b", "#2e8b57", "#2f6fb5")
OUTCOME_COLOURS = {
    IndentationOutcome.COMPLETE: "#2e8b57",
    IndentationOutcome.FORCE_LIMIT: "#2f6fb5",
    IndentationOutcome.DIVERGED: "#d1495b",
    IndentationOutcome.DEADLINE: "#e09f3e",
    IndentationOutcome.CANCELLED: "#9aa0a8",
}

MM = 1e3
"""[mm/m]; only pictures and tables are in millimetres."""

KPA = 1e-3
"""[kPa/Pa]."""


def new_figure(width: float, height: float) -> Any:
    """An empty figure without a window; size in inch."""
    figures = require("matplotlib.figure", extra="fem")
    return figures.Figure(figsize=(width, height), layout="constrained", facecolor="white")


def save(figure: Any, path: Path) -> None:
    """Write a figure as PNG, whole or not at all.

    Raises:
        DatasetError: The disk is full or refuses.
    """
    with written_whole(path) as partial:
        figure.savefig(partial, dpi=120, format="png")


def label(axes: Any, across: str, up: str, title: str = "") -> None:
    """Label axes, and apply our style to them."""
    axes.set_xlabel(across, color=INK, fontsize=9)
    axes.set_ylabel(up, color=INK, fontsize=9)
    axes.set_title(title, color=INK, fontsize=10)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=8)


def grid(axes: Any) -> None:
    """Draw grid lines."""
    axes.grid(visible=True, color=GRID, lw=0.7)
