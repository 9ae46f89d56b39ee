"""How records and simulations are laid out on the screen, and the colours of what never changes."""

from __future__ import annotations

import colorsys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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
TRUTH_COLOUR = (240, 90, 200)
"""Not white: the legend of Rerun's light theme is."""
ESTIMATE_COLOUR = (255, 196, 61)
ERROR_COLOUR = (150, 176, 208)
QUIET_COLOUR = (120, 144, 170)
BACKGROUND = (24, 26, 31)

FIELD_FULL_M = 2e-3
"""Displacement with the last colour of the scale; the same in all views, for comparison [m]."""

_FULL_SCALE_COUNTS = 400.0
"""Tared counts at which an electrode is drawn in full colour."""

_LOST_COLOUR = (70, 74, 82)
"""Of an electrode without a valid reading: darker than one at rest."""

MAX_SENSORS = 8
"""Tabs in one view; more sensors are recorded but not laid out."""

STEP = "step"
"""The timeline: number of the step, which is that of the pose in the path; 0 = untouched."""

SIDES = ("left", "right")
"""Halves of the skin, y > 0 and y < 0; without the right one the finger is cut open."""

ELECTRODE_PLACES = {
    SensorType.BIOTAC: ELECTRODE_POSITIONS,
    SensorType.BIOTAC_SP: SP_ELECTRODE_POSITIONS,
}


@dataclass(frozen=True, slots=True)
class SensorContents:
    """What there is to lay out of one sensor of a record.

    Attributes:
        kind: Its type.
        tared: Whether there are tared counts.
        fields: Whether there are fields or syntheses.
    """

    kind: SensorType
    tared: bool
    fields: bool


def record_layout(sensors: Mapping[str, SensorContents]) -> Any:
    """Layout of a record: a tab for each sensor, what it looks like above, its curves below."""
    rrb = require("rerun.blueprint", extra="services")
    tabs = [
        _sensor_tab(rrb, sensor, contents)
        for sensor, contents in list(sensors.items())[:MAX_SENSORS]
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


def _sensor_tab(rrb: Any, sensor: str, contents: SensorContents) -> Any:
    plot = partial(_curves, rrb, sensor)

    def body(origin: str, name: str) -> Any:
        # From the side of the pad, tip to the left, as one looks at one's own finger.
        eye, target = (0.006, -0.0165, -0.0195), (-0.0055, 0.0, -0.003)
        return _space(rrb, f"{sensor}/{origin}", name, eye, target)

    bodies = [body("finger", "Force (arrow) and contact: estimate yellow, truth pink")]
    electrodes = f"Electrodes E1-E{contents.kind.layout.electrodes}"
    # Raw counts are thousands, tared ones tens: in one plot nothing would be seen of a touch.
    counts = plot("electrodes/raw", f"{electrodes}, raw [counts]")
    if contents.tared:
        tared = plot("electrodes/tared", f"{electrodes}, tared [counts]")
        counts = rrb.Tabs(tared, counts, active_tab=0)
    electrode_plots = [counts]
    if contents.fields:
        scale = f"grey 0 mm to yellow {1e3 * FIELD_FULL_M:g} mm"
        bodies += [body(f"field/{of}", f"Skin, {of}: {scale}") for of in ("truth", "estimate")]
        electrode_plots.append(plot("synthesised", "Electrodes, synthesised from a field [counts]"))
    forces = rrb.Vertical(
        *(plot(f"force/{axis}", f"Force {axis} [N]", legend=axis == AXES[0]) for axis in AXES)
    )
    errors = rrb.Vertical(
        plot("error/force", "Error of the force [N]"),
        plot("error/location_mm", "Error of the contact location [mm]"),
    )
    pressures = rrb.Vertical(
        plot("pdc", "PDC, static pressure [counts]"), plot("pac", "PAC, vibration [counts]")
    )
    return rrb.Vertical(
        rrb.Horizontal(*bodies),
        rrb.Horizontal(*electrode_plots, pressures, column_shares=[3] * len(electrode_plots) + [2]),
        rrb.Horizontal(forces, errors, column_shares=[3, 2]),
        row_shares=[4, 3, 4],
        name=sensor,
    )


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


def record_fixtures(kind: SensorType) -> Iterator[tuple[str, Any]]:
    """What never changes, as entity (below the sensor) and value: names, colours, the body.

    The electrodes of a BioTac SP are drawn in the sensor frame of their table and without a body,
    because no source gives its shape; that of a finger which was there before is taken away.
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
    for axis in AXES:
        # The thin truth is drawn over the thick estimate: what sticks out is the error.
        yield f"force/{axis}/truth", line(f"{axis} truth", [TRUTH_COLOUR], 1.5)
        yield f"force/{axis}/estimate", line(f"{axis} estimate", [ESTIMATE_COLOUR], 4.0)
    for what, name in (("force", "force error"), ("location_mm", "location error")):
        yield f"error/{what}", line(name, [ERROR_COLOUR], 1.5)
        yield f"error/{what}/bound", line("bound of 90 %", [QUIET_COLOUR], 1.0)
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
    else:
        yield "finger/core", rr.Mesh3D.cleared()
        yield "finger/skin", rr.LineStrips3D.cleared()
    positions = ELECTRODE_PLACES[kind]
    yield "finger/electrodes", rr.Points3D(positions, radii=[7.5e-4])
    # A text has the colour of its point. These are too small to be seen, and have the colours of
    # the curves; those of the electrodes themselves change with their counts.
    numbers = [name.removeprefix("E") for name in names]
    texts = {"colors": wheel, "labels": numbers, "show_labels": True}
    yield "finger/numbers", rr.Points3D(positions, radii=[1e-6], **texts)
    for name, colour, point_m, arrow_m in (
        ("truth", TRUTH_COLOUR, 5e-4, 2.2e-4),
        ("estimate", ESTIMATE_COLOUR, 6.5e-4, 3e-4),
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
    """Packed RGBA of tared counts: blue where negative, orange where positive; the same shape.

    Dark grey where there are none (NaN).
    """
    strength = np.sqrt(np.clip(np.abs(tared) / _FULL_SCALE_COUNTS, 0, 1))[..., None]
    rest = np.array([150.0, 156.0, 166.0])
    full = np.where((tared < 0)[..., None], (60.0, 170.0, 255.0), (255.0, 120.0, 50.0))
    rgb = np.where(np.isnan(strength), _LOST_COLOUR, rest + strength * (full - rest))
    return packed_rgba(rgb.astype(np.uint32))
