"""How often each point of the skin moves (the paper's figure of mesh motion)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate_training.twin.content import MixedDataset, SkinMesh
from palpate_training.twin_figures.style import INK, MM, caption, heading, label, new_figure, save

Floats = npt.NDArray[np.float64]

SIGNIFICANT_M = 0.1e-3
"""A node that moves further than this moves significantly [m] (the paper's caption)."""

_BLOCK_ROWS = 256
_VIEWS = (
    # title, horizontal, vertical, axis towards the viewer, its sign
    ("front view (from +x)", 1, 2, 0, 1.0),
    ("ventral view (from −z)", 0, 1, 2, -1.0),
)
_AXES = ("x, distal [mm]", "y, lateral [mm]", "z, dorsal [mm]")


def motion_share(
    data: MixedDataset,
    *,
    threshold_m: float = SIGNIFICANT_M,
    block_rows: int = _BLOCK_ROWS,
) -> Floats:
    """Share of all rows in which each node moves significantly, shape (V,), 0..1.

    Args:
        data: Fields as coefficients; so many rows at a time are decoded.
        threshold_m: What is significant [m].
        block_rows: Rows decoded at once.
    """
    rows = len(data)
    moved = np.zeros(len(data.mesh.nodes), np.int64)
    for start in range(0, rows, block_rows):
        block = data.displacement(slice(start, start + block_rows))
        moved += np.count_nonzero(np.linalg.norm(block, axis=2) > threshold_m, axis=0)
    return moved / rows


def draw_motion(path: Path, mesh: SkinMesh, share: Floats, rows: int) -> str:
    """Draw the share on the outer skin, from the front and from below.

    Args:
        path: PNG to write.
        mesh: Whose nodes move.
        share: From `motion_share`, shape (V,).
        rows: How many rows it is a share of.

    Returns:
        The caption.

    Raises:
        DatasetError: The disk refused.
    """
    outer = share[np.unique(mesh.outer_faces)]
    text = (
        f"Colour: share of {rows:,} rows in which a point of the skin moves more than"
        f" {MM * SIGNIFICANT_M:g} mm from the pressurised, untouched state. Outer skin: mean"
        f" {100 * outer.mean():.0f} %, most {100 * outer.max():.0f} %,"
        f" {np.count_nonzero(outer == 0)} of {len(outer)} points never."
    )
    figure = new_figure(10.5, 4.6)
    panels = figure.subplots(1, 2, width_ratios=(1.0, 1.75))
    top = max(100 * float(outer.max()), 1e-9)
    drawn: Any = None
    for axes, (title, across, up, towards, sign) in zip(panels, _VIEWS, strict=True):
        corners = mesh.nodes[mesh.outer_faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        seen = sign * normal[:, towards] > 0
        # Far triangles first: those behind are painted over.
        depth = sign * corners[seen, :, towards].mean(axis=1)
        drawn = axes.tripcolor(
            MM * mesh.nodes[:, across],
            MM * mesh.nodes[:, up],
            100 * share,
            triangles=mesh.outer_faces[seen][np.argsort(depth)],
            shading="gouraud",
            cmap="viridis",
            vmin=0,
            vmax=top,
        )
        label(axes, _AXES[across], _AXES[up], title)
        axes.set_aspect("equal")
    panels[1].invert_yaxis()
    bar = figure.colorbar(drawn, ax=panels, shrink=0.8, pad=0.02)
    bar.set_label("rows with motion > 0.1 mm [%]", color=INK, fontsize=9)
    bar.ax.tick_params(colors=INK, labelsize=8)
    heading(figure, "Frequency of skin motion")
    caption(figure, text)
    save(figure, path)
    return text
