"""Draw docs/pictures/electrode-map.png from the table in docs/conventions.md (``make docs``)."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

DOCS = Path(__file__).resolve().parent
PICTURE = DOCS / "pictures" / "electrode-map.png"
ROW = re.compile(r"^\| E(\d+) \|((?: -?\d+\.\d+ \|){6})$", flags=re.MULTILINE)

# Outlines [mm]: core radius fits the table; skin profiles are those of the inflated public mesh,
# rounded, and only drawn to show where the skin is.
CORE_RADIUS, CORE_TOP, BACK = 5.08, 1.91, -26.0
SKIN_BELOW = [
    (-26, -8.0),
    (-19, -8.05),
    (-13, -8.1),
    (-9, -8.28),
    (-7, -8.3),
    (-1, -8.14),
    (3, -7.5),
    (5, -6.0),
]
SKIN_TIP, SKIN_TOP, SKIN_SIDE = (6.65, -2.0), 3.48, 7.11
ARROWS, COLOURS = (8.6, 8.6, 5.4), ("#c0392b", "#1e8449", "#6c3483")

Points = npt.NDArray[np.float64]


def electrode_table(page: str) -> tuple[Points, Points]:
    """Positions [mm] and normals of E1..E19 in the table of ``page``, each shape ``(19, 3)``."""
    rows = {int(number): values for number, values in ROW.findall(page)}
    if sorted(rows) != list(range(1, 20)):
        raise SystemExit(f"docs/conventions.md: the electrode table has rows {sorted(rows)}")
    numbers = np.array([[float(v) for v in rows[i].split("|")[:-1]] for i in range(1, 20)])
    return numbers[:, :3], numbers[:, 3:]


def smooth(points: Points) -> Points:
    """A closed outline through ``points`` with its corners rounded (Chaikin), shape ``(M, 2)``."""
    for _ in range(4):
        ahead = np.roll(points, -1, axis=0)
        points = np.stack([0.75 * points + 0.25 * ahead, 0.25 * points + 0.75 * ahead], 1)
        points = points.reshape(-1, 2)
    return points


def outlines() -> dict[str, tuple[Points, Points]]:
    """Skin and core of each view, in the view's two coordinates [mm]."""
    quarter = np.linspace(-np.pi / 2, np.arcsin(CORE_TOP / CORE_RADIUS), 60)
    tip = CORE_RADIUS * np.stack([np.cos(quarter), np.sin(quarter)], 1)
    core_side = np.array([(BACK, -CORE_RADIUS), *tip, (BACK, CORE_TOP)])
    skin_side = np.array([*SKIN_BELOW, SKIN_TIP, (5.6, 1.5), (2.0, SKIN_TOP), (BACK, SKIN_TOP)])
    half = np.linspace(-np.pi / 2, np.pi / 2, 90)
    bow = np.stack([np.cos(half), np.sin(half)], 1)
    back_low, back_high = (BACK, -1.0), (BACK, 1.0)
    core_below = np.array([back_low, *CORE_RADIUS * bow, back_high])
    core_below[[0, -1], 1] = -CORE_RADIUS, CORE_RADIUS
    skin_below = np.array([back_low, *(bow * (SKIN_TIP[0], SKIN_SIDE)), back_high])
    skin_below[[0, -1], 1] = -SKIN_SIDE, SKIN_SIDE
    left = np.pi - np.arcsin(CORE_TOP / CORE_RADIUS)
    turn = np.linspace(left, 2 * np.pi + np.arcsin(CORE_TOP / CORE_RADIUS), 90)
    core_tip = CORE_RADIUS * np.stack([np.cos(turn), np.sin(turn)], 1)
    turn = np.linspace(np.pi, 2 * np.pi, 60)
    skin_tip = np.stack([SKIN_SIDE * np.cos(turn), 8.3 * np.sin(turn)], 1)
    skin_tip = np.array([(-6.2, SKIN_TOP), *skin_tip, (6.2, SKIN_TOP)])
    return {
        "below": (skin_below, core_below),
        "side": (smooth(skin_side), core_side),
        "tip": (skin_tip, core_tip),
    }


def draw(
    axes: Axes, view: str, horizontal: int, vertical: int, title: str, seen_from: Points
) -> None:
    """One view: outlines, electrodes that face the viewer filled, axes arrows at the origin."""
    positions, normals = electrode_table((DOCS / "conventions.md").read_text(encoding="utf-8"))
    skin, core = outlines()[view]
    axes.fill(*skin.T, facecolor="#f3e3d3", edgecolor="#b08968", lw=1.2, zorder=0)
    axes.fill(*core.T, facecolor="#e4e9ee", edgecolor="#7a8793", lw=1.0, zorder=1)
    for index, (position, normal) in enumerate(zip(positions, normals, strict=True)):
        facing = float(normal @ seen_from) > 0.05
        if (view == "side" and position[1] > 0) or (view != "side" and not facing):
            continue
        at = (float(position[horizontal]), float(position[vertical]))
        axes.plot(*at, "o", ms=14, mfc="#2563a6" if facing else "white", mec="#2563a6", zorder=3)
        axes.annotate(
            str(index + 1), at, ha="center", va="center_baseline", fontsize=7.5, zorder=4,
            color="white" if facing else "#2563a6", fontweight="bold",
        )  # fmt: skip
    for axis, colour in ((horizontal, COLOURS[horizontal]), (vertical, COLOURS[vertical])):
        tip = np.zeros(3)
        tip[axis] = ARROWS[axis]
        end = (float(tip[horizontal]), float(tip[vertical]))
        away = tuple(9.0 * np.sign(end) * (1, -1 if view == "below" else 1))
        axes.annotate(
            "", end, (0, 0), zorder=2, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8}
        )
        axes.annotate(
            "xyz"[axis], end, textcoords="offset points", zorder=5, color=colour, fontsize=11,
            fontweight="bold", ha="center", va="center", xytext=(float(away[0]), float(away[1])),
        )  # fmt: skip
    axes.plot(0, 0, "k.", ms=6, zorder=2.5)
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(f"{'xyz'[horizontal]} [mm]")
    axes.set_ylabel(f"{'xyz'[vertical]} [mm]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.25, lw=0.5)


def main() -> None:
    """Three views in one picture."""
    figure, (below, side, tip) = plt.subplots(
        1, 3, figsize=(14, 4.2), width_ratios=(28, 28, 19), layout="constrained"
    )
    # Seen from below (from -z) with x to the right, y points down: the frame is right-handed.
    draw(below, "below", 0, 1, "pad, seen from below (from −z)", np.array([0.0, 0.0, -1.0]))
    side_title = "seen from the side (from −y); white: facing down, not sideways"
    draw(side, "side", 0, 2, side_title, np.array([0.0, -1.0, 0.0]))
    draw(tip, "tip", 1, 2, "seen from the tip (from +x)", np.array([1.0, 0.0, 0.0]))
    below.set(xlim=(-17.5, 10.5), ylim=(10.5, -8.5))
    side.set(xlim=(-17.5, 10.5), ylim=(-9.3, 7.2))
    tip.set(xlim=(-8.5, 10.5), ylim=(-9.3, 7.2))
    figure.suptitle("BioTac electrodes in the sensor frame: x distal, y lateral, z dorsal")
    PICTURE.parent.mkdir(exist_ok=True)
    figure.savefig(PICTURE, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
