"""One figure for each task: error by force, and a typical held-out row, truth beside estimate."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.extras import require
from palpate_training.dataset import ELECTRODES
from palpate_training.fields.evaluate import Picture
from palpate_training.twin.content import SkinMesh

FORCE_BINS_N = (0.0, 2.0, 8.0, np.inf)
"""Below 2 N, 2 to 8 N, above 8 N [N] (learning notes, 6.1); rows start at 0.5 N."""

_BIN_NAMES = ("< 2 N", "2-8 N", "> 8 N")


def draw_field(path: Path, picture: Picture, mesh: SkinMesh) -> None:
    """Error by force bin and the example on the skin, seen from below.

    Args:
        path: PNG to write.
        picture: What to draw; fields (V, 3) [m].
        mesh: The skin.
    """
    figure = _figure(13.0)
    left, *right = figure.subplots(1, 4, width_ratios=[1.5, 1, 1, 1])
    _boxes(left, picture, 1e3, "mean nodal error, all nodes [mm]")
    truth, estimate = (
        1e3 * np.linalg.norm(field, axis=1) for field in (picture.truth, picture.estimate)
    )
    wrong = 1e3 * np.linalg.norm(picture.estimate - picture.truth, axis=1)
    top = float(max(truth.max(), estimate.max(), 1e-3))
    faces = ventral_faces(mesh)
    for axis, values, title in zip(
        right, (truth, estimate, wrong), ("truth", "estimate", "error"), strict=True
    ):
        drawn = axis.tripcolor(
            1e3 * mesh.nodes[:, 1],
            1e3 * mesh.nodes[:, 0],
            faces,
            values,
            shading="gouraud",
            cmap="viridis",
            vmin=0.0,
            vmax=top,
        )
        axis.set(aspect="equal", title=title, xlabel="y [mm]")
        axis.spines[["top", "right"]].set_visible(False)
    right[0].set_ylabel("x [mm]")
    figure.colorbar(drawn, ax=right, label="displacement [mm]", shrink=0.8)
    figure.suptitle(f"Held-out trajectory of typical error: {picture.example}", fontsize=10)
    _save(figure, path)


def draw_synthesis(path: Path, picture: Picture) -> None:
    """Error by force bin and the 19 electrodes of the example.

    Args:
        path: PNG to write.
        picture: What to draw; tared counts (19,).
    """
    figure = _figure(11.0)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.6])
    _boxes(left, picture, 1.0, "norm of the error in R^19 [counts]")
    at = np.arange(ELECTRODES)
    right.bar(at - 0.2, picture.truth, 0.4, label="truth", color="#222222")
    right.bar(at + 0.2, picture.estimate, 0.4, label="estimate", color="#d1672a")
    right.set_xticks(at, [f"E{i + 1}" for i in at], fontsize=7)
    right.set_ylabel("tared counts")
    right.legend(frameon=False)
    right.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"Held-out trajectory of typical error: {picture.example}", fontsize=10)
    _save(figure, path)


def ventral_faces(mesh: SkinMesh) -> npt.NDArray[np.int32]:
    """Outer triangles that look down, to the pad's side: what one sees from below, shape (F, 3)."""
    a, b, c = (mesh.nodes[mesh.outer_faces[:, i]] for i in range(3))
    return np.asarray(mesh.outer_faces[np.cross(b - a, c - a)[:, 2] < 0])


def by_force(
    force_n: npt.NDArray[np.floating], error: npt.NDArray[np.float64]
) -> list[npt.NDArray[np.float64]]:
    """Errors of the rows of each force bin.

    Args:
        force_n: True force magnitude [N], shape (N,).
        error: Error of the same rows, shape (N,).
    """
    return [error[(force_n >= low) & (force_n < high)] for low, high in pairwise(FORCE_BINS_N)]


def _boxes(axis: Any, picture: Picture, factor: float, label: str) -> None:
    units = list(picture.error)
    width = 0.8 / len(units)
    for i, unit in enumerate(units):
        bins = by_force(picture.force_n[unit], picture.error[unit])
        filled = [k for k, values in enumerate(bins) if values.size]
        axis.boxplot(
            [factor * bins[k] for k in filled],
            positions=[k + (i - (len(units) - 1) / 2) * width for k in filled],
            widths=0.8 * width,
            showfliers=False,
            medianprops={"color": f"C{i}"},
            boxprops={"color": f"C{i}"},
        )
        axis.plot([], [], color=f"C{i}", label=unit)
    axis.set_xticks(range(len(_BIN_NAMES)), _BIN_NAMES)
    axis.set(xlabel="true force", ylabel=label, ylim=(0, None))
    axis.legend(frameon=False, fontsize=8)
    axis.spines[["top", "right"]].set_visible(False)


def _figure(width: float) -> Any:
    matplotlib = require("matplotlib", extra="training")
    matplotlib.use("agg")
    pyplot = require("matplotlib.pyplot", extra="training")
    return pyplot.figure(figsize=(width, 4.2), layout="constrained")


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=110, metadata={"Software": None})
    require("matplotlib.pyplot", extra="training").close(figure)
