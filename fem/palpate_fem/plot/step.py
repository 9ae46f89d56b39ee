"""Picture of one simulated step: sections of the fingertip, the pad from below, and the force."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpate.errors import ConfigError
from palpate.process import require
from palpate.rigid import rotation_matrices
from palpate_fem.arrays import Floats
from palpate_fem.plot.section import cut_sides, cut_solid, cut_surface, outline
from palpate_fem.plot.style import (
    CORE,
    INDENTER,
    INK,
    KPA,
    MM,
    PATCH,
    SKIN,
    label,
    new_figure,
    save,
)
from palpate_fem.plot.trajectories import draw_force, travel_mm
from palpate_fem.result import IndentationResult, IndentationStep
from palpate_fem.store.content import Outline, StoredFingertip

Quantity = Literal["displacement", "von_mises"]

_MARGIN_M = 2.5e-3
_COLOUR_MAPS = {"displacement": "viridis", "von_mises": "YlGnBu"}
_NAMES = {"displacement": "displacement [mm]", "von_mises": "von Mises stress [kPa]"}


def von_mises(stress: Floats) -> Floats:
    """Equivalent stress [Pa], shape (E,), of Cauchy stresses xx yy zz yz xz xy, shape (E, 6)."""
    xx, yy, zz, yz, xz, xy = stress.T
    normal = (xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2
    found: Floats = np.sqrt(0.5 * normal + 3.0 * (yz**2 + xz**2 + xy**2))
    return found


def plot_step(
    tip: StoredFingertip,
    trajectory: IndentationResult,
    path: Path,
    *,
    step: int = -1,
    quantity: Quantity = "displacement",
    indenter: Outline | None = None,
    y_m: float = 0.0,
    title: str = "",
) -> None:
    """Draw one step: sections undeformed, pressurised and indented, from below, and the force.

    Args:
        tip: The fingertip.
        trajectory: The indentation.
        path: The PNG to write.
        step: Number of the step; negative counts from the end.
        quantity: Shown by colour. Displacement counts from the state in the panel before. Stress of
            the pressurised state is only known if the first step does not touch.
        indenter: Its surface in its own frame; None = only its tip is drawn.
        y_m: Position of the lengthwise section [m].
        title: Above it all; empty = the indenter.

    Raises:
        ConfigError: There is no such step, or stress was not stored.
        DatasetError: The disk is full or refuses.
        MissingExtraError: matplotlib is not installed.
    """
    shown = _chosen(trajectory, step, quantity)
    deformed = tip.pressurised_nodes + shown.displacement
    bulge = np.linalg.norm(tip.pressurised_nodes - tip.mesh.nodes, axis=1)
    moved = np.linalg.norm(shown.displacement, axis=1)
    rest: Floats | None = MM * bulge
    now: Floats = MM * moved
    if quantity == "von_mises":
        first = trajectory.steps[0]
        rest = None if first.contact_area_m2 > 0 else KPA * von_mises(first.stress)
        now = KPA * von_mises(shown.stress)
    scale = require("matplotlib.colors", extra="fem").Normalize(
        0.0, max(float(values.max()) for values in (now, rest) if values is not None) or 1.0
    )
    paint = {"norm": scale, "cmap": _COLOUR_MAPS[quantity]}
    body = None if indenter is None else _placed(indenter, shown.pose)
    figure = new_figure(15, 8.5)
    panels = figure.subplots(2, 3)
    _draw_section(panels[0, 0], tip, tip.mesh.nodes, None, paint, axis=1, at_m=y_m)
    _draw_section(panels[0, 1], tip, tip.pressurised_nodes, rest, paint, axis=1, at_m=y_m)
    _draw_section(panels[0, 2], tip, deformed, now, paint, axis=1, at_m=y_m)
    across = float(shown.pose[0])
    _draw_section(panels[1, 0], tip, deformed, now, paint, axis=0, at_m=across)
    _draw_indenter(panels[0, 2], body, shown.pose, axis=1, at_m=y_m)
    _draw_indenter(panels[1, 0], body, shown.pose, axis=0, at_m=across)
    _frame(panels[0], np.concatenate([tip.mesh.nodes, tip.pressurised_nodes, deformed])[:, [0, 2]])
    _frame(panels[1, :1], deformed[:, [1, 2]])
    where = f"section y = {MM * y_m:.1f} mm"
    thickness = f"fluid {KPA * tip.fluid_pressure_pa:.1f} kPa, {MM * tip.total_thickness_m:.1f} mm"
    force = f"|F| = {np.linalg.norm(shown.force):.2f} N, {KPA * shown.fluid_pressure_pa:.1f} kPa"
    label(panels[0, 0], "x [mm]", "z [mm]", f"undeformed; {where}")
    label(panels[0, 1], "x [mm]", "", f"pressurised: {thickness}")
    label(panels[0, 2], "x [mm]", "", f"indented: {force}")
    label(panels[1, 0], "y [mm]", "z [mm]", f"indented; section x = {MM * across:.1f} mm")
    drawn = _draw_below(panels[1, 1], tip, shown, deformed, now, paint)
    number = step % len(trajectory.steps)
    draw_force(panels[1, 2], travel_mm(trajectory), trajectory.forces, mark=number)
    figure.colorbar(drawn, ax=panels[0], label=_NAMES[quantity], shrink=0.9, pad=0.01)
    figure.suptitle(
        f"{title or trajectory.indenter}, step {number + 1} of {len(trajectory.path) - 1}",
        color=INK,
        fontsize=12,
    )
    save(figure, path)


def _chosen(trajectory: IndentationResult, step: int, quantity: Quantity) -> IndentationStep:
    count = len(trajectory.steps)
    if not -count <= step < count:
        raise ConfigError(
            f"there is no step {step}: the trajectory has {count} steps", remedy="choose another"
        )
    shown = trajectory.steps[step]
    if quantity == "von_mises" and not len(shown.stress):
        raise ConfigError(
            "the stress of this trajectory was not kept", remedy="run it again with --stress"
        )
    return shown


def _draw_section(
    axes: Any,
    tip: StoredFingertip,
    nodes: Floats,
    colours: Floats | None,
    paint: dict[str, Any],
    *,
    axis: int,
    at_m: float,
) -> None:
    """Draw skin, layers and core; ``colours`` are by node or element, None = plain."""
    right = 0 if axis == 1 else 1
    cut = cut_solid(nodes, tip.mesh.elements, axis=axis, at_m=at_m)
    points = MM * cut.at(nodes)
    if len(cut.triangles):
        flat = points[:, right], points[:, 2], cut.triangles
        if colours is None:
            plain = require("matplotlib.colors", extra="fem").ListedColormap([SKIN])
            axes.tripcolor(*flat, facecolors=np.zeros(len(cut.triangles)), cmap=plain)
        elif len(colours) == len(nodes):
            axes.tripcolor(*flat, cut.at(colours), shading="gouraud", **paint)
        else:
            axes.tripcolor(*flat, facecolors=colours[cut.elements], edgecolors="face", **paint)
    lines = require("matplotlib.collections", extra="fem").LineCollection
    sides = MM * cut_sides(nodes, tip.mesh.elements, axis=axis, at_m=at_m)[:, :, [right, 2]]
    axes.add_collection(lines(sides, colors=INK, linewidths=0.35, alpha=0.55))
    for loop in cut_surface(tip.core_vertices, tip.core_faces, axis=axis, at_m=at_m):
        axes.fill(*(MM * loop[:, [right, 2]].T), facecolor=CORE, edgecolor=INK, lw=0.8)


def _draw_indenter(
    axes: Any, body: Outline | None, pose: Floats, *, axis: int, at_m: float
) -> None:
    right = 0 if axis == 1 else 1
    if body is not None:
        for loop in cut_surface(np.asarray(body[0]), body[1], axis=axis, at_m=at_m):
            axes.fill(*(MM * loop[:, [right, 2]].T), facecolor=INDENTER, edgecolor=INK, lw=0.8)
    axes.plot(MM * pose[right], MM * pose[2], "x", color=INK, ms=5)


def _draw_below(
    axes: Any,
    tip: StoredFingertip,
    shown: IndentationStep,
    deformed: Floats,
    colours: Floats,
    paint: dict[str, Any],
) -> Any:
    """Draw the pad from below, with the outline of the contact."""
    collections = require("matplotlib.collections", extra="fem")
    faces = tip.mesh.outer_faces
    corners = deformed[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = np.flatnonzero(normal[:, 2] < 0)
    seen = seen[np.argsort(-corners[seen, :, 2].mean(axis=1))]  # the farthest first
    values = (
        colours[faces[seen]].mean(axis=1)
        if len(colours) == len(deformed)
        else colours[tip.mesh.outer_elements[seen]]
    )
    polygons = collections.PolyCollection(
        MM * corners[seen][:, :, :2],
        array=values,
        edgecolors=(0.2, 0.2, 0.2, 0.25),
        lw=0.3,
        **paint,
    )
    axes.add_collection(polygons)
    loaded = np.linalg.norm(shown.indenter_force, axis=1) > 0
    patch = faces[loaded[faces].mean(axis=1) >= 0.5]
    if len(patch):
        edges = MM * deformed[outline(patch)][:, :, :2]
        axes.add_collection(collections.LineCollection(edges, colors=PATCH, linewidths=1.8))
        axes.plot(*(MM * shown.centre_of_pressure[:2]), "+", color=PATCH, ms=10, mew=2)
    axes.set_aspect("equal")
    axes.autoscale_view()
    # Seen from below with the tip to the right, +y points down.
    axes.invert_yaxis()
    area = MM**2 * shown.contact_area_m2
    label(axes, "x [mm]", "y [mm]", f"from below; contact {area:.1f} mm², + centre of pressure")
    return polygons


def _placed(body: Outline, pose: Floats) -> Outline:
    """A surface in the indenter's frame, moved to where the indenter is."""
    return np.asarray(body[0], np.float64) @ rotation_matrices(pose[3:]).T + pose[:3], body[1]


def _frame(panels: Any, points: Floats) -> None:
    """Use the same window in all panels: the finger with a margin, but not the whole indenter."""
    low, high = MM * (points.min(axis=0) - _MARGIN_M), MM * (points.max(axis=0) + _MARGIN_M)
    for axes in panels:
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
