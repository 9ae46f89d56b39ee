"""Contact locations on the translucent skin (the paper's figure of contact locations).

How often each point of the skin moves (the paper's figure of mesh motion).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.process import require
from palpate_training.datasets.experiment import ExperimentDataset, MixedDataset, SkinMesh
from palpate_training.figures import outline
from palpate_training.figures.style import (
    CORE,
    CORE_EDGE,
    INK,
    MARK,
    MM,
    SKIN_DARK,
    SKIN_LIGHT,
    finish,
    label,
    new_figure,
)

_VIEWS = (
    ("from below", (0, 1), "x, distal [mm]", "y, lateral [mm]"),
    ("from the side", (0, 2), "x, distal [mm]", "z, dorsal [mm]"),
)


_MARGIN_INCH, _CAPTIONS_INCH = 0.8, 1.9
"""What labels need beside the panels, and titles, labels and caption above and below them."""


def final_rows(data: ExperimentDataset) -> npt.NDArray[np.int64]:
    """Index of the last row of each trial, shape (M,), increasing."""
    trial = data.trial
    return np.flatnonzero(np.append(trial[1:] != trial[:-1], True))


def draw_contacts(path: Path, data: ExperimentDataset, mesh: SkinMesh | None) -> str:
    """Draw the last contact location of each trial, a column for each unit; returns the caption.

    Without a mesh of the skin they are drawn on the outline of a nominal fingertip.
    """
    last = final_rows(data)
    units = len(data.unit_names)
    surface = (
        "Blue, translucent: ventral half of the inner and outer skin, pressurised, not deformed."
        if mesh is not None
        else "Outline: a nominal fingertip (no mesh was given), ventral half."
    )
    text = f"Red: contact location at the final increment of each trial. {surface}"
    bounds = _bounds(data.location[last], mesh)
    spans = np.ptp(bounds, axis=0)
    # The panels keep the finger's proportions, so the figure is as high as they come out.
    width = max(4.3 * units, 6.0)
    inch_per_mm = (width - _MARGIN_INCH) / units / spans[0]
    figure = new_figure(width, inch_per_mm * (spans[1] + spans[2]) + _CAPTIONS_INCH)
    panels = figure.subplots(
        2, units, squeeze=False, sharex=True, sharey="row", height_ratios=spans[1:]
    )
    for unit, name in enumerate(data.unit_names):
        points = MM * data.location[last[data.row_unit[last] == unit]]
        for row, (view, (across, up), x_name, y_name) in enumerate(_VIEWS):
            axes = panels[row, unit]
            if mesh is not None:
                _draw_skin(axes, mesh, across, up)
            else:
                _draw_outline(axes, up)
            axes.plot(
                points[:, across], points[:, up], "o", ms=4.2, color=MARK, mec="white", mew=0.4,
                alpha=0.75, zorder=5,
            )  # fmt: skip
            label(
                axes,
                x_name if row == 1 else "",
                y_name if unit == 0 else "",
                f"{name}: {len(points)} trials, {view}" if row == 0 else view,
            )
            axes.set(aspect="equal", xlim=bounds[:, across], ylim=bounds[:, up])
    panels[0, 0].invert_yaxis()  # seen from below with x to the right, y points down
    return finish(figure, path, "Contact locations", text)


def _bounds(points: npt.NDArray[np.float32], mesh: SkinMesh | None) -> npt.NDArray[np.float64]:
    """Corners of the box around all that is drawn, with a margin [mm], shape (2, 3)."""
    if mesh is not None:
        skin = mesh.nodes[np.unique(mesh.outer_faces)]
    else:
        below, side = outline.ventral()[0], outline.lateral()[0]
        skin = np.vstack(
            [np.insert(below, 2, side[:, 1].min(), axis=1), np.insert(side, 1, 0.0, axis=1)]
        )
    drawn = MM * np.vstack([skin, points])
    low, high = drawn.min(axis=0) - 0.5, drawn.max(axis=0) + 0.5
    high[2] = max(0.5, MM * float(points[:, 2].max()) + 0.5)  # the skin's ventral half ends at 0
    return np.stack([low, high])


def _draw_skin(axes: Any, mesh: SkinMesh, across: int, up: int) -> None:
    collections = require("matplotlib.collections", extra="training")
    colors = require("matplotlib.colors", extra="training")
    patches = require("matplotlib.patches", extra="training")
    light, dark = np.array(colors.to_rgb(SKIN_LIGHT)), np.array(colors.to_rgb(SKIN_DARK))
    # Two nested sheets of tinted glass. The inner one's colour is mixed beforehand and both are
    # painted opaque: translucent triangles would show every seam.
    for faces, shade in ((mesh.outer_faces, 0.55), (mesh.inner_faces, 0.75)):
        corners = mesh.nodes[faces]
        corners = corners[(corners[:, :, 2] < 0).any(axis=1)]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        steep = 1 - np.abs(normal[:, 3 - across - up])  # 0 = faces the viewer, 1 = seen on edge
        tint = light + (dark - light) * (shade * steep + (shade - 0.55))[:, None]
        skin = collections.PolyCollection(
            MM * corners[:, :, [across, up]], facecolors=tint, edgecolors=tint, linewidths=0.4
        )
        skin.set_in_layout(False)  # it is clipped below, which the layout does not see
        axes.add_collection(skin)
        if up == 2:  # the dorsal part of the triangles that reach over
            below = patches.Rectangle((-1e3, -1e3), 2e3, 1e3, transform=axes.transData)
            skin.set_clip_path(below)


def _draw_outline(axes: Any, up: int) -> None:
    skin, core = outline.ventral() if up == 1 else outline.lateral()
    axes.fill(*(MM * skin).T, facecolor=SKIN_LIGHT, edgecolor=SKIN_DARK, lw=1.1, alpha=0.7)
    axes.fill(*(MM * core).T, facecolor=CORE, edgecolor=CORE_EDGE, lw=0.9)


Floats = npt.NDArray[np.float64]

SIGNIFICANT_M = 0.1e-3
"""A node that moves further than this moves significantly [m] (the paper's caption)."""

_BLOCK_ROWS = 256
_MOTION_VIEWS = (
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
    """Draw the share on the outer skin, from the front and from below; returns the caption.

    Args:
        path: PNG to write.
        mesh: Whose nodes move.
        share: From `motion_share`, shape (V,).
        rows: How many rows it is a share of.
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
    for axes, (title, across, up, towards, sign) in zip(panels, _MOTION_VIEWS, strict=True):
        drawn = paint_outer(axes, mesh, 100 * share, top, (across, up, towards), sign)
        label(axes, _AXES[across], _AXES[up], title)
    panels[1].invert_yaxis()
    bar = figure.colorbar(drawn, ax=panels, shrink=0.8, pad=0.02)
    bar.set_label("rows with motion > 0.1 mm [%]", color=INK, fontsize=9)
    bar.ax.tick_params(colors=INK, labelsize=8)
    return finish(figure, path, "Frequency of skin motion", text)


def paint_outer(
    axes: Any,
    mesh: SkinMesh,
    values: npt.NDArray[np.floating],
    top: float,
    view: tuple[int, int, int] = (0, 1, 2),
    sign: float = -1.0,
) -> Any:
    """Colour the outer skin by values of its nodes, 0 to ``top``; returns what a colour bar needs.

    Args:
        axes: Where to draw; in mm.
        mesh: The skin.
        values: Of all nodes, shape (V,).
        top: Value of the last colour.
        view: Coordinates that point across, up and towards the viewer; by default from below.
        sign: Of the coordinate towards the viewer.
    """
    across, up, towards = view
    corners = mesh.nodes[mesh.outer_faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = sign * normal[:, towards] > 0
    # Far triangles first: those behind are painted over.
    depth = sign * corners[seen, :, towards].mean(axis=1)
    axes.set_aspect("equal")
    return axes.tripcolor(
        MM * mesh.nodes[:, across],
        MM * mesh.nodes[:, up],
        values,
        triangles=mesh.outer_faces[seen][np.argsort(depth)],
        shading="gouraud",
        cmap="viridis",
        vmin=0,
        vmax=top,
    )
