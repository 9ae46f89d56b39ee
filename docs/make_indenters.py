"""Draw docs/pictures/indenters.png: the nine indenters of the finite-element fingertip."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.layout_engine import ConstrainedLayoutEngine

from palpate.rigid import unit
from palpate_fem.indenter.catalogue import BASE_M, indenter_names, make_indenter
from palpate_fem.indenter.distance import distance, signed_distance
from palpate_fem.indenter.shape import Indenter

PICTURE = Path(__file__).resolve().parent / "pictures" / "indenters.png"
HALF_M, PIXELS = 16e-3, 420  # of each picture
EYE = unit((-0.55, -0.75, 0.62))  # from the side and from ahead of the tip
LIGHT = unit((-0.25, -0.85, 1.0))
STEEL, STAND_IN = np.array([0.55, 0.66, 0.78]), np.array([0.80, 0.66, 0.50])

Floats = npt.NDArray[np.float64]


def axes_of_view() -> tuple[Floats, Floats]:
    """Right and up of the picture, indenter frame; the tip, +z, is up."""
    right = unit(np.cross((0.0, 0.0, 1.0), EYE))
    return right, np.cross(EYE, right)


def picture(indenter: Indenter) -> Floats:
    """Shaded view by sphere tracing: rays go on by the distance until there is none; (H, W, 4)."""
    right, up = axes_of_view()
    side = np.linspace(-HALF_M, HALF_M, PIXELS)
    u, v = np.meshgrid(side, side[::-1])
    middle = np.array([0.0, 0.0, BASE_M / 2])
    points = middle + u.reshape(-1, 1) * right + v.reshape(-1, 1) * up + 30e-3 * EYE
    alive = np.arange(len(points))
    hit = np.zeros(len(points), bool)
    for _ in range(160):
        gap = signed_distance(indenter, points[alive])
        points[alive] -= gap[:, None] * EYE
        hit[alive[gap < 2e-6]] = True
        alive = alive[(gap >= 2e-6) & (gap < 60e-3)]
    image = np.zeros((len(points), 4))
    normal = distance(indenter, points[hit])[1]
    light = 0.30 + 0.70 * np.clip(normal @ LIGHT, 0.0, 1.0)
    gloss = 0.25 * np.clip(normal @ unit(LIGHT + EYE), 0.0, 1.0) ** 40
    colour = STAND_IN if indenter.name == "texture" else STEEL
    image[hit, :3] = np.clip(light[:, None] * colour + gloss[:, None], 0.0, 1.0)
    image[hit, 3] = 1.0
    return image.reshape(PIXELS, PIXELS, 4)


def draw(axes: Axes, name: str) -> None:
    """One indenter with its three axes at the tip, and its cut along x."""
    indenter = make_indenter(name)
    half = HALF_M * 1e3
    axes.imshow(picture(indenter), extent=(-half, half, -half, half), interpolation="bilinear")
    right, up = axes_of_view()
    middle = np.array([0.0, 0.0, BASE_M / 2 * 1e3])
    for axis, colour in zip(np.eye(3), ("#c0392b", "#1e8449", "#6c3483"), strict=True):
        start, end = (np.array([p @ right, p @ up]) for p in (-middle, 5.0 * axis - middle))
        label = end + 1.1 * (end - start) / np.linalg.norm(end - start)
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.4}
        axes.annotate("", tuple(end), tuple(start), arrowprops=arrow)
        text = "xyz"[int(axis.argmax())]
        x, y = map(float, label)
        axes.text(x, y, text, color=colour, ha="center", va="center", fontsize=8)
    title = f"{name} (stand-in)" if name == "texture" else name
    axes.set_title(title, fontsize=10)
    axes.set(xlim=(-half, half), ylim=(-half, half))
    axes.axis("off")


def cut(axes: Axes, name: str) -> None:
    """Section y = 0 near the tip: outline, and lines of equal distance on the skin's side."""
    x, z = np.meshgrid(np.linspace(-15e-3, 15e-3, 301), np.linspace(-10e-3, 4e-3, 141))
    points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    gap = signed_distance(make_indenter(name), points).reshape(x.shape) * 1e3
    axes.contourf(x * 1e3, z * 1e3, gap, levels=[-20, 0], colors=["#b9c6d4"])
    axes.contour(x * 1e3, z * 1e3, gap, levels=[0], colors="#34495e", linewidths=1.2)
    axes.contour(x * 1e3, z * 1e3, gap, levels=[1, 2, 3], colors="#c0392b", linewidths=0.5)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25, lw=0.5)


def main() -> None:
    """Nine views, and below each the section through its tip."""
    names = indenter_names()
    # Room below each section, so that the next name is not read as its own.
    figure = plt.figure(figsize=(13.5, 14.5), layout=ConstrainedLayoutEngine(h_pad=0.12))
    rows = figure.subplots(6, 3, height_ratios=[2.6, 1] * 3)
    for index, name in enumerate(names):
        draw(rows[2 * (index // 3), index % 3], name)
        cut(rows[2 * (index // 3) + 1, index % 3], name)
    for axes in rows[5]:
        axes.set_xlabel("x [mm]")
    for row in rows[1::2]:
        row[0].set_ylabel("z [mm]")
    figure.suptitle(
        "Indenters in their frame: tip at the origin, pressing along +z;\n"
        "below each its section y = 0, red: at distances of 1, 2 and 3 mm"
    )
    PICTURE.parent.mkdir(exist_ok=True)
    figure.savefig(PICTURE, dpi=90, metadata={"Software": None})


if __name__ == "__main__":
    main()
