"""Draw docs/pictures/fingertip-mesh.png: the parametric mesh, what holds it, and its core."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from palpate_fem.mesh.parametric import biotac
from palpate_fem.mesh.solid import FingertipGeometry

PICTURE = Path(__file__).resolve().parent / "pictures" / "fingertip-mesh.png"
# Title, direction to the viewer, axes to the right and up, sign of the axis to the right.
VIEWS = (
    ("from the side", (0, -1, 0), 0, 2, 1),
    ("from below: the pad", (0, 0, -1), 0, 1, 1),
    ("from above: nail", (0, 0, 1), 0, 1, 1),
    ("from the tip", (1, 0, 0), 1, 2, 1),
    ("from the clamp", (-1, 0, 0), 1, 2, -1),
)
SKIN, HELD, CORE, LINE = "#e8d5c4", "#c0392b", "#566573", "#333333"
NAMES = "xyz"

Points = npt.NDArray[np.float64]
Ids = npt.NDArray[np.int32]


def draw_surface(axes: Axes, points: Points, faces: Ids, held: Ids, view: int) -> None:
    """Draw the outer surface [mm] as seen from one side, held faces in red."""
    title, direction, right, up, sign = VIEWS[view]
    corner = points[faces]
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    facing: Points = normal @ np.array(direction) / np.linalg.norm(normal, axis=1)
    order = np.argsort(corner.mean(axis=1) @ np.array(direction))
    order = np.array([i for i in order if facing[i] > 0])
    light = 0.55 + 0.45 * facing[order, None]
    red = np.isin(faces[order], held).all(axis=1, keepdims=True)
    base = np.where(
        red,
        mpl.colors.to_rgb(HELD),
        mpl.colors.to_rgb(SKIN),
    )
    flat = corner[order][:, :, [right, up]] * [sign, 1]
    axes.add_collection(
        PolyCollection(list(flat), facecolors=base * light, edgecolors=LINE, linewidths=0.25)
    )
    axes.set_title(title)
    axes.set_xlabel(f"{'-' if sign < 0 else ''}{NAMES[right]} [mm]")
    axes.set_ylabel(f"{NAMES[up]} [mm]")


def cut(points: Points, faces: Ids, axis: int, value: float) -> list[Points]:
    """Lines along which a plane cuts the faces of a surface."""
    side = points[:, axis] > value
    lines = []
    for face in faces[side[faces].any(axis=1) & ~side[faces].all(axis=1)]:
        ends = []
        for a, b in zip(face, np.roll(face, -1), strict=True):
            if side[a] != side[b]:
                share = (value - points[a, axis]) / (points[b, axis] - points[a, axis])
                ends.append(points[a] + share * (points[b] - points[a]))
        lines.append(np.array(ends[:2]))
    return lines


def draw_section(axes: Axes, geometry: FingertipGeometry, axis: int, value: float) -> None:
    """Draw elements cut by a plane, and the core."""
    mesh, core = geometry.mesh, geometry.core
    shown = [i for i in range(3) if i != axis]
    sides = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
    quads = np.concatenate([mesh.elements[:, list(side)] for side in sides])
    for points, faces, colour, width in (
        (mesh.nodes * 1e3, quads, "#b08968", 0.4),
        (mesh.nodes * 1e3, mesh.outer_faces, LINE, 1.0),
        (mesh.nodes * 1e3, mesh.inner_faces, LINE, 1.0),
        (core.vertices * 1e3, core.faces, CORE, 1.6),
    ):
        lines = [line[:, shown] for line in cut(points, faces, axis, value)]
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=width))
    axes.set_title(f"section at {NAMES[axis]} = {value:.0f} mm: skin, fluid film, core")
    axes.set_xlabel(f"{NAMES[shown[0]]} [mm]")
    axes.set_ylabel(f"{NAMES[shown[1]]} [mm]")


def main() -> None:
    """Draw the picture."""
    geometry = biotac()
    mesh = geometry.mesh
    figure = plt.figure(figsize=(15, 13.5), layout="constrained")
    grid = figure.add_gridspec(3, 6)
    for view, place in enumerate(
        (grid[0, :3], grid[0, 3:], grid[1, :3], grid[2, :2], grid[2, 2:4])
    ):
        draw_surface(
            figure.add_subplot(place), mesh.nodes * 1e3, mesh.outer_faces, mesh.fixed, view
        )
    # Just beside the planes that nodes lie in.
    draw_section(figure.add_subplot(grid[1, 3:]), geometry, 1, 1e-3)
    draw_section(figure.add_subplot(grid[2, 4:]), geometry, 0, -6.999)
    for axes in figure.axes:
        axes.autoscale_view()
        axes.set_aspect("equal")
    free = 3 * (len(mesh.nodes) - len(mesh.fixed))
    figure.suptitle(
        f"Parametric BioTac, unpressurised, sensor frame: {len(mesh.elements)} hexahedra, "
        f"{len(mesh.outer_nodes) + len(mesh.inner_nodes)} surface nodes, {free} degrees of "
        "freedom; red: held by nail and clamp"
    )
    figure.savefig(PICTURE, dpi=85)


if __name__ == "__main__":
    main()
