"""How a record is laid out on the screen. With ``view`` the only place that knows Rerun."""

from __future__ import annotations

import colorsys
from collections.abc import Iterator, Sequence
from typing import Any

from palpate.protos.extras import require
from palpate.services import anatomy

TIMELINE = "sensor_time"
SEQUENCE = "seq"

AXES = ("x", "y", "z")
AXIS_COLOURS = ((236, 98, 66), (74, 186, 118), (66, 146, 246))
TRUTH_COLOUR = (236, 236, 240)
ESTIMATE_COLOUR = (255, 196, 61)
ERROR_COLOUR = (214, 120, 222)
QUIET_COLOUR = (120, 144, 170)
BACKGROUND = (24, 26, 31)

MAX_SENSORS = 8
"""Tabs in one view; more sensors are recorded but not laid out."""


def electrode_names() -> list[str]:
    """E1..E19."""
    return [f"E{at + 1}" for at in range(len(anatomy.ELECTRODE_POSITIONS))]


def electrode_colours() -> list[tuple[int, int, int]]:
    """One colour an electrode, in order around the colour circle."""
    count = len(anatomy.ELECTRODE_POSITIONS)
    wheel = (colorsys.hls_to_rgb(at / count, 0.62, 0.65) for at in range(count))
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in wheel]


def blueprint(sensors: Sequence[str]) -> Any:
    """Layout for these sensors: one tab each, fingertip left, signals right.

    Args:
        sensors: Names of the sensors, in order of their tabs.
    """
    rrb = require("rerun.blueprint", extra="services")
    tabs = [_sensor_tab(rrb, sensor) for sensor in sensors[:MAX_SENSORS]]
    return rrb.Blueprint(
        tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _sensor_tab(rrb: Any, sensor: str) -> Any:
    def plot(origin: str, name: str, *, legend: bool = True) -> Any:
        return rrb.TimeSeriesView(
            origin=f"{sensor}/{origin}",
            name=name,
            axis_x=rrb.TimeAxis(link="LinkToGlobal"),
            plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
            background=rrb.archetypes.PlotBackground(color=BACKGROUND, show_grid=True),
        )

    finger = rrb.Spatial3DView(
        origin=f"{sensor}/finger",
        name="Fingertip [m]: contact and force, estimate against truth",
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        # From the side of the pad, tip to the left, as one looks at one's own finger.
        eye_controls=rrb.EyeControls3D(
            position=(0.009, -0.020, -0.024),
            look_target=(-0.0055, 0.0, -0.003),
            eye_up=(0.0, 0.0, 1.0),
        ),
    )
    signals = rrb.Vertical(
        plot("electrodes", "Electrodes E1-E19 [counts]", legend=False),
        rrb.Horizontal(
            plot("pdc", "PDC, static pressure [counts]", legend=False),
            plot("pac", "PAC, vibration [counts]", legend=False),
        ),
        row_shares=[3, 2],
    )
    forces = rrb.Vertical(
        *(plot(f"force/{axis}", f"Force {axis} [N]") for axis in AXES),
        row_shares=[1, 1, 1],
    )
    errors = rrb.Vertical(
        plot("error/force", "Error of the force [N]", legend=False),
        plot("error/location", "Error of the contact location [m]", legend=False),
    )
    return rrb.Vertical(
        rrb.Horizontal(finger, signals, column_shares=[2, 3]),
        rrb.Horizontal(forces, errors, column_shares=[3, 2]),
        row_shares=[1, 1],
        name=sensor,
    )


def fixtures() -> Iterator[tuple[str, Any]]:
    """What never changes, as entity (below the sensor) and value: names, colours, the body."""
    rr = require("rerun", extra="services")

    def line(names: str | list[str], colours: Sequence[Any], width: float) -> Any:
        return rr.SeriesLines(names=names, colors=colours, widths=[width] * len(colours))

    names, wheel = electrode_names(), electrode_colours()
    yield "electrodes/raw", line(names, wheel, 1.2)
    yield "electrodes/tared", line(names, wheel, 1.2)
    yield "pdc", line("PDC", [QUIET_COLOUR], 1.5)
    yield "pac", line("PAC", [QUIET_COLOUR], 1.0)
    for axis, colour in zip(AXES, AXIS_COLOURS, strict=True):
        # The thin truth is drawn over the thick estimate: what sticks out is the error.
        yield f"force/{axis}/truth", line(f"{axis} truth", [TRUTH_COLOUR], 1.0)
        yield f"force/{axis}/estimate", line(f"{axis} estimate", [colour], 3.0)
    for what in ("force", "location"):
        yield f"error/{what}", line(f"{what} error", [ERROR_COLOUR], 1.2)
    vertices, triangles, normals = anatomy.core_mesh()
    yield (
        "finger/core",
        rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=triangles,
            vertex_normals=normals,
            albedo_factor=(120, 130, 148),
        ),
    )
    skin = rr.LineStrips3D(anatomy.skin_lines(), colors=[(110, 150, 190)], radii=[6e-5])
    yield "finger/skin", skin
    yield "finger/electrodes", rr.Points3D(anatomy.ELECTRODE_POSITIONS, radii=[7.5e-4])
    for name, colour, point_m, arrow_m in (
        ("truth", TRUTH_COLOUR, 7e-4, 2.4e-4),
        ("estimate", ESTIMATE_COLOUR, 9e-4, 3e-4),
    ):
        contact = rr.Points3D.from_fields(colors=[colour], radii=[point_m])
        yield f"finger/contact/{name}", contact
        yield f"finger/force/{name}", rr.Arrows3D.from_fields(colors=[colour], radii=[arrow_m])
