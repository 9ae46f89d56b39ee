"""How records and simulations are laid out on the screen, and the colours of what never changes."""

from __future__ import annotations

import colorsys
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.anatomy import ELECTRODE_POSITIONS, SP_ELECTRODE_POSITIONS
from palpate.messages import SensorType
from palpate.process import require
from palpate_services.viewer.surfaces import core_mesh, packed_rgba, skin_lines

TIMELINE = "sensor_time"
SEQUENCE = "seq"

AXES = ("x", "y", "z")
AXIS_COLOURS = ((236, 98, 66), (74, 186, 118), (66, 146, 246))
TRUTH_COLOUR = (236, 236, 240)
ESTIMATE_COLOUR = (255, 196, 61)
ERROR_COLOUR = (214, 120, 222)
QUIET_COLOUR = (120, 144, 170)
BACKGROUND = (24, 26, 31)

FIELD_FULL_M = 2e-3
"""Displacement with the last colour of the scale; the same in all views, for comparison [m]."""

_FULL_SCALE_COUNTS = 400.0
"""Tared counts at which an electrode is drawn in full colour."""

MAX_SENSORS = 8
"""Tabs in one view; more sensors are recorded but not laid out."""

STEP = "step"
"""The timeline: number of the step, which is that of the pose in the path; 0 = untouched."""

SIDES = ("left", "right")
"""Halves of the skin, y > 0 and y < 0; without the right one the finger is cut open."""

_POSITIONS = {
    SensorType.BIOTAC: ELECTRODE_POSITIONS,
    SensorType.BIOTAC_SP: SP_ELECTRODE_POSITIONS,
}


def record_layout(sensors: Mapping[str, SensorType], *, with_fields: Collection[str] = ()) -> Any:
    """Layout of a record: a tab for each sensor, its fingertip left, its signals right.

    The tabs of ``with_fields``, the sensors that have fields, get one more row.
    """
    rrb = require("rerun.blueprint", extra="services")
    tabs = [
        _sensor_tab(rrb, sensor, kind, fields=sensor in with_fields)
        for sensor, kind in list(sensors.items())[:MAX_SENSORS]
    ]
    return _screen(rrb, tabs, timeline=TIMELINE)


def simulation_layout(trajectories: Sequence[str], longest_m: float) -> Any:
    """Layout of simulations: a tab for each trajectory; ``longest_m`` has the last colour [m]."""
    rrb = require("rerun.blueprint", extra="services")
    tabs = [_trajectory_tab(rrb, name, longest_m) for name in trajectories]
    return _screen(rrb, tabs, timeline=STEP, fps=5.0)


def _screen(rrb: Any, tabs: list[Any], **time_panel: Any) -> Any:
    return rrb.Blueprint(
        tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs),
        # "following" shows the newest time: live data, or the last step, where most happens.
        rrb.TimePanel(state="collapsed", play_state="following", **time_panel),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _curves(rrb: Any, tab: str, entity: str, name: str, *, legend: bool = False) -> Any:
    return rrb.TimeSeriesView(
        origin=f"{tab}/{entity}",
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
        background=rrb.archetypes.PlotBackground(color=BACKGROUND, show_grid=True),
    )


def _space(
    rrb: Any,
    origin: str,
    name: str,
    position: Sequence[float],
    look_target: Sequence[float],
    **contents: Any,
) -> Any:
    return rrb.Spatial3DView(
        origin=origin,
        name=name,
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            position=position, look_target=look_target, eye_up=(0.0, 0.0, 1.0)
        ),
        **contents,
    )


def _sensor_tab(rrb: Any, sensor: str, kind: SensorType, *, fields: bool) -> Any:
    plot = partial(_curves, rrb, sensor)

    def body(origin: str, name: str) -> Any:
        # From the side of the pad, tip to the left, as one looks at one's own finger.
        eye, target = (0.009, -0.020, -0.024), (-0.0055, 0.0, -0.003)
        return _space(rrb, f"{sensor}/{origin}", name, eye, target)

    finger = body("finger", "Fingertip [m]: contact and force, estimate against truth")
    signals = rrb.Vertical(
        plot("electrodes", f"Electrodes E1-E{kind.layout.electrodes} [counts]"),
        rrb.Horizontal(
            plot("pdc", "PDC, static pressure [counts]"),
            plot("pac", "PAC, vibration [counts]"),
        ),
        row_shares=[3, 2],
    )
    forces = rrb.Vertical(
        *(plot(f"force/{axis}", f"Force {axis} [N]", legend=True) for axis in AXES),
        row_shares=[1, 1, 1],
    )
    errors = rrb.Vertical(
        plot("error/force", "Error of the force [N]"),
        plot("error/location", "Error of the contact location [m]"),
    )
    rows = [
        rrb.Horizontal(finger, signals, column_shares=[2, 3]),
        rrb.Horizontal(forces, errors, column_shares=[3, 2]),
    ]
    if fields:
        scale = f"grey 0 mm to yellow {1e3 * FIELD_FULL_M:g} mm"
        skins = [body(f"field/{of}", f"Skin, {of}: {scale}") for of in ("truth", "estimate")]
        compared = rrb.Vertical(
            plot("electrodes/tared", "Electrodes, measured and tared [counts]"),
            plot("synthesised", "Electrodes, synthesised from a field [counts]"),
        )
        rows.insert(1, rrb.Horizontal(*skins, compared, column_shares=[1, 1, 1]))
    return rrb.Vertical(*rows, row_shares=[1] * len(rows), name=sensor)


def _trajectory_tab(rrb: Any, trajectory: str, longest_m: float) -> Any:
    def space(name: str, position: Sequence[float], *, without: str) -> Any:
        contents = ["$origin/**", f"- $origin/{without}/**"]
        target = (-0.005, 0.0, -0.003)
        return _space(rrb, f"{trajectory}/finger", name, position, target, contents=contents)

    plot = partial(_curves, rrb, trajectory)
    return rrb.Horizontal(
        rrb.Vertical(
            space(
                f"Skin, indenter left out; colour: displacement, 0 to {1e3 * longest_m:.2g} mm",
                (0.002, -0.011, -0.034),
                without="indenter",
            ),
            space("Cut open at y = 0", (-0.001, -0.034, -0.010), without=f"skin/{SIDES[1]}"),
        ),
        rrb.Vertical(
            plot("force", "Force on the BioTac [N]", legend=True),
            plot("pressure", "Fluid pressure [Pa]"),
            rrb.Horizontal(plot("area", "Contact area [m²]"), plot("newton", "Newton iterations")),
            rrb.TextDocumentView(origin=f"{trajectory}/about", name="About"),
            row_shares=[3, 2, 2, 2],
        ),
        column_shares=[3, 2],
        name=trajectory,
    )


def record_fixtures(kind: SensorType, *, again: bool = False) -> Iterator[tuple[str, Any]]:
    """What never changes, as entity (below the sensor) and value: names, colours, the body.

    The electrodes of a BioTac SP are drawn in the sensor frame of their table and without a body,
    because no source gives its shape. ``again``: these replace the fixtures of another type (an
    exchanged finger).
    """
    rr = require("rerun", extra="services")

    def line(names: str | list[str], colours: Sequence[Any], width: float) -> Any:
        return rr.SeriesLines(names=names, colors=colours, widths=[width] * len(colours))

    names, wheel = (
        electrode_names(kind.layout.electrodes),
        electrode_colours(kind.layout.electrodes),
    )
    yield "electrodes/raw", line(names, wheel, 1.2)
    yield "electrodes/tared", line(names, wheel, 1.2)
    yield "synthesised", line(names, wheel, 1.2)
    yield "pdc", line("PDC", [QUIET_COLOUR], 1.5)
    yield "pac", line("PAC", [QUIET_COLOUR], 1.0)
    for axis, colour in zip(AXES, AXIS_COLOURS, strict=True):
        # The thin truth is drawn over the thick estimate: what sticks out is the error.
        yield f"force/{axis}/truth", line(f"{axis} truth", [TRUTH_COLOUR], 1.0)
        yield f"force/{axis}/estimate", line(f"{axis} estimate", [colour], 3.0)
    for what in ("force", "location"):
        yield f"error/{what}", line(f"{what} error", [ERROR_COLOUR], 1.2)
    if kind is SensorType.BIOTAC:
        vertices, triangles, normals = core_mesh()
        core = rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=triangles,
            vertex_normals=normals,
            albedo_factor=(120, 130, 148),
        )
        yield "finger/core", core
        skin = rr.LineStrips3D(skin_lines(), colors=[(110, 150, 190)], radii=[6e-5])
        yield "finger/skin", skin
    elif again:
        yield "finger/core", rr.Mesh3D.cleared()
        yield "finger/skin", rr.LineStrips3D.cleared()
    yield "finger/electrodes", rr.Points3D(_POSITIONS[kind], radii=[7.5e-4])
    for name, colour, point_m, arrow_m in (
        ("truth", TRUTH_COLOUR, 7e-4, 2.4e-4),
        ("estimate", ESTIMATE_COLOUR, 9e-4, 3e-4),
    ):
        contact = rr.Points3D.from_fields(colors=[colour], radii=[point_m])
        yield f"finger/contact/{name}", contact
        yield f"finger/force/{name}", rr.Arrows3D.from_fields(colors=[colour], radii=[arrow_m])


def simulation_fixtures(rr: Any) -> dict[str, Any]:
    """Colours and names of the curves, by entity below the trajectory."""
    curves = [
        *((f"force/{axis}", f"F{axis}", AXIS_COLOURS[at]) for at, axis in enumerate(AXES)),
        ("pressure", "fluid", QUIET_COLOUR),
        ("area", "contact", QUIET_COLOUR),
        ("newton", "Newton iterations", QUIET_COLOUR),
    ]
    return {
        entity: rr.SeriesLines(names=[name], colors=[colour], widths=[2.0])
        for entity, name, colour in curves
    }


def electrode_names(count: int) -> list[str]:
    """E1, E2, ..."""
    return [f"E{at + 1}" for at in range(count)]


def electrode_colours(count: int) -> list[tuple[int, int, int]]:
    """One colour an electrode, in order around the colour circle."""
    wheel = (colorsys.hls_to_rgb(at / count, 0.62, 0.65) for at in range(count))
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in wheel]


def electrode_shades(tared: npt.NDArray[np.float32]) -> npt.NDArray[np.uint32]:
    """Packed RGBA of tared counts: blue where negative, orange where positive; the same shape."""
    strength = np.sqrt(np.clip(np.abs(tared) / _FULL_SCALE_COUNTS, 0, 1))[..., None]
    rest = np.array([150.0, 156.0, 166.0])
    full = np.where((tared < 0)[..., None], (60.0, 170.0, 255.0), (255.0, 120.0, 50.0))
    rgb = (rest + strength * (full - rest)).astype(np.uint32)
    return packed_rgba(rgb)
