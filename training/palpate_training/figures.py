"""Figures of results, made without a display."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.extras import require

Floats = npt.NDArray[np.float32] | npt.NDArray[np.float64]

_BINS = 64
"""Bins along each axis: densities are drawn, for the rows of a data set may not be ours to show."""


@dataclass(frozen=True, slots=True)
class Panel:
    """Truth and estimate of one test, shape ``(N, 3)`` [N], and its headline."""

    title: str
    truth: Floats
    estimate: Floats


def draw_force(path: Path, panels: Sequence[Panel]) -> None:
    """Truth against estimate, one row of axes for each panel: x, y, z and the magnitude.

    Args:
        path: PNG to write.
        panels: What to draw.
    """
    matplotlib = require("matplotlib", extra="training")
    matplotlib.use("agg")
    pyplot = require("matplotlib.pyplot", extra="training")
    figure = pyplot.figure(figsize=(11, 3.1 * len(panels)), layout="constrained")
    parts = figure.subfigures(len(panels), 1, squeeze=False)[:, 0]
    for part, panel in zip(parts, panels, strict=True):
        part.suptitle(panel.title, x=0.01, ha="left", fontsize=11)
        row = part.subplots(1, 4)
        truth, estimate = _with_norm(panel.truth), _with_norm(panel.estimate)
        for i, (axis, name) in enumerate(zip(row, ("Fx", "Fy", "Fz", "|F|"), strict=True)):
            values = np.concatenate([truth[:, i], estimate[:, i]])
            low, high = float(values.min()), float(values.max())
            margin = 0.04 * (high - low)
            limits = (low - margin, high + margin)
            axis.hist2d(
                truth[:, i],
                estimate[:, i],
                bins=_BINS,
                range=(limits, limits),
                norm="log",
                cmap="viridis_r",
                cmin=1,
            )
            axis.plot(limits, limits, "-", lw=0.8, color="#444444")
            axis.set(xlim=limits, ylim=limits, aspect="equal")
            axis.set_xlabel(f"true {name} [N]")
            axis.set_ylabel(f"estimated {name} [N]")
            axis.locator_params(nbins=5, integer=True)
            axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    pyplot.close(figure)


def _with_norm(force: Floats) -> npt.NDArray[np.float64]:
    norm = np.linalg.norm(force, axis=1, keepdims=True)
    return np.hstack([force, norm]).astype(np.float64)
