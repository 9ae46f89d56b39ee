"""How simulations are laid out on the screen: a tab for each trajectory, one timeline of steps."""

from __future__ import annotations

import colorsys
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.anatomy import ELECTRODE_POSITIONS, SP_ELECTRODE_POSITIONS
from palpate.messages import FloatArray, SensorType
from palpate.process import require
from palpate_services.viewer.simulation_file import Floats, Ints

CORE_RADIUS_M = 0.0049
"""Just below the electrodes, which sit at 5.08 mm, so that they stand out."""

SKIN_RADIUS_M = 0.0070
"""Outer skin of an inflated BioTac, rounded."""

BACK_X_M = -0.017
"""Where the drawn part of the finger ends."""


def core_mesh(segments: int = 32, rings: int = 12) -> tuple[FloatArray, np.ndarray, FloatArray]:
    """Core as a mesh: vertices [m] ``(V, 3)``, triangles int32 ``(T, 3)``, normals ``(V, 3)``."""
    profile_x, profile_r, normal_x, normal_r = _profile(CORE_RADIUS_M, rings)
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    around = np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    axis = np.array([1.0, 0.0, 0.0])
    vertices = profile_r[:, None, None] * around + profile_x[:, None, None] * axis
    normals = normal_r[:, None, None] * around + normal_x[:, None, None] * axis
    triangles = []
    for ring in range(len(profile_x) - 1):
        for at in range(segments):
            a, b = ring * segments + at, ring * segments + (at + 1) % segments
            triangles += [[a, b, a + segments], [b, b + segments, a + segments]]
    return (
        vertices.reshape(-1, 3).astype(np.float32),
        np.array(triangles, np.int32),
        normals.reshape(-1, 3).astype(np.float32),
    )


def skin_lines(lines: int = 9, hoops: int = 7) -> list[FloatArray]:
    """Skin as a wire basket around pad and sides: polylines [m], each ``(n, 3)``."""
    profile_x, profile_r, _, _ = _profile(SKIN_RADIUS_M, 16)
    spread = np.radians(115.0)
    drawn: list[FloatArray] = []
    for angle in np.linspace(-spread, spread, lines):
        y, z = np.sin(angle), -np.cos(angle)
        drawn.append(np.stack([profile_x, profile_r * y, profile_r * z], 1).astype(np.float32))
    around = np.linspace(-spread, spread, 41)
    for x in np.linspace(BACK_X_M, 0.0, hoops):
        ring = [np.full_like(around, x), np.sin(around), -np.cos(around)]
        ring[1:] = [SKIN_RADIUS_M * part for part in ring[1:]]
        drawn.append(np.stack(ring, 1).astype(np.float32))
    for polar in np.radians([30.0, 60.0]):
        radius, x = SKIN_RADIUS_M * np.cos(polar), SKIN_RADIUS_M * np.sin(polar)
        ring = [np.full_like(around, x), radius * np.sin(around), -radius * np.cos(around)]
        drawn.append(np.stack(ring, 1).astype(np.float32))
    return drawn


def _profile(radius_m: float, rings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Half outline from the back end to the tip: x, r [m] and the normal's x, r."""
    polar = np.linspace(0.0, np.pi / 2, rings)
    x = np.concatenate([[BACK_X_M], radius_m * np.sin(polar)])
    r = np.concatenate([[radius_m], radius_m * np.cos(polar)])
    return x, r, np.concatenate([[0.0], np.sin(polar)]), np.concatenate([[1.0], np.cos(polar)])


_COLOURS = np.array(
    [[150, 156, 166], [62, 116, 178], [33, 165, 150], [94, 201, 98], [253, 231, 37]], np.float64
)
"""From unmoved, a grey that shows the shape on a dark ground, to most moved."""


def shades(share: Floats) -> npt.NDArray[np.uint32]:
    """Colours of shares of the longest displacement: packed RGBA, the same shape."""
    at = np.clip(share, 0.0, 1.0) * (len(_COLOURS) - 1)
    low = np.minimum(at.astype(int), len(_COLOURS) - 2)
    part = (at - low)[..., None]
    rgb = ((1 - part) * _COLOURS[low] + part * _COLOURS[low + 1]).round().astype(np.uint32)
    packed: npt.NDArray[np.uint32] = (
        (rgb[..., 0] << 24) | (rgb[..., 1] << 16) | (rgb[..., 2] << 8) | 255
    ).astype(np.uint32)
    return packed


def normals_of(positions: Floats, faces: Ints) -> Floats:
    """Normals at vertices: those of their triangles, weighted by area; shape (V, 3)."""
    corners = positions[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(total, faces[:, corner], across)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals: Floats = (total / np.where(length > 0, length, 1.0)).astype(np.float32)
    return normals


def border_of(triangles: Ints) -> npt.NDArray[np.intp]:
    """Edges that belong to one triangle only, shape (B, 2)."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    found, count = np.unique(edges, axis=0, return_counts=True)
    border: npt.NDArray[np.intp] = found[count == 1].astype(np.intp)
    return border


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
"""Displacement drawn in the last colour; the same in every file, so that files can be compared."""

_FULL_SCALE_COUNTS = 400.0
"""Tared counts at which an electrode is drawn in full colour."""

MAX_SENSORS = 8
"""Tabs in one view; more sensors are recorded but not laid out."""


_POSITIONS = {
    SensorType.BIOTAC: ELECTRODE_POSITIONS,
    SensorType.BIOTAC_SP: SP_ELECTRODE_POSITIONS,
}


def electrode_names(count: int) -> list[str]:
    """E1, E2, ..."""
    return [f"E{at + 1}" for at in range(count)]


def electrode_colours(count: int) -> list[tuple[int, int, int]]:
    """One colour an electrode, in order around the colour circle."""
    wheel = (colorsys.hls_to_rgb(at / count, 0.62, 0.65) for at in range(count))
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in wheel]


def electrode_shades(tared: npt.NDArray[np.float32]) -> npt.NDArray[np.uint32]:
    """Colours of electrodes by their tared counts: cool where lowered, warm where raised.

    Args:
        tared: Tared counts, shape ``(N, 19)`` (SP: 24).

    Returns:
        Packed RGBA, uint32, of the same shape.
    """
    strength = np.sqrt(np.clip(np.abs(tared) / _FULL_SCALE_COUNTS, 0, 1))[..., None]
    rest = np.array([150.0, 156.0, 166.0])
    full = np.where((tared < 0)[..., None], (60.0, 170.0, 255.0), (255.0, 120.0, 50.0))
    rgb = (rest + strength * (full - rest)).astype(np.uint32)
    packed = (rgb[..., 0] << 24) | (rgb[..., 1] << 16) | (rgb[..., 2] << 8) | 255
    shades: npt.NDArray[np.uint32] = packed.astype(np.uint32)
    return shades


def blueprint(sensors: Mapping[str, SensorType], *, with_fields: Collection[str] = ()) -> Any:
    """Layout for these sensors: one tab each, fingertip left, signals right.

    Args:
        sensors: Types of the sensors by name, in order of their tabs.
        with_fields: Those of them that have fields, which get a row more.
    """
    rrb = require("rerun.blueprint", extra="services")
    tabs = [
        _sensor_tab(rrb, sensor, kind, fields=sensor in with_fields)
        for sensor, kind in [*sensors.items()][:MAX_SENSORS]
    ]
    return rrb.Blueprint(
        tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _sensor_tab(rrb: Any, sensor: str, kind: SensorType, *, fields: bool) -> Any:
    def plot(origin: str, name: str, *, legend: bool = True) -> Any:
        return rrb.TimeSeriesView(
            origin=f"{sensor}/{origin}",
            name=name,
            axis_x=rrb.TimeAxis(link="LinkToGlobal"),
            plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
            background=rrb.archetypes.PlotBackground(color=BACKGROUND, show_grid=True),
        )

    def body(origin: str, name: str) -> Any:
        return rrb.Spatial3DView(
            origin=f"{sensor}/{origin}",
            name=name,
            background=BACKGROUND,
            line_grid=rrb.LineGrid3D(visible=False),
            # From the side of the pad, tip to the left, as one looks at one's own finger.
            eye_controls=rrb.EyeControls3D(
                position=(0.009, -0.020, -0.024),
                look_target=(-0.0055, 0.0, -0.003),
                eye_up=(0.0, 0.0, 1.0),
            ),
        )

    finger = body("finger", "Fingertip [m]: contact and force, estimate against truth")
    signals = rrb.Vertical(
        plot("electrodes", f"Electrodes E1-E{kind.electrode_count} [counts]", legend=False),
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
    rows = [
        rrb.Horizontal(finger, signals, column_shares=[2, 3]),
        rrb.Horizontal(forces, errors, column_shares=[3, 2]),
    ]
    if fields:
        scale = f"grey 0 mm to yellow {1e3 * FIELD_FULL_M:g} mm"
        skins = [body(f"field/{of}", f"Skin, {of}: {scale}") for of in ("truth", "estimate")]
        compared = rrb.Vertical(
            plot("electrodes/tared", "Electrodes, measured and tared [counts]", legend=False),
            plot("synthesised", "Electrodes, synthesised from a field [counts]", legend=False),
        )
        rows.insert(1, rrb.Horizontal(*skins, compared, column_shares=[1, 1, 1]))
    return rrb.Vertical(*rows, row_shares=[1] * len(rows), name=sensor)


def fixtures(kind: SensorType, *, again: bool = False) -> Iterator[tuple[str, Any]]:
    """What never changes, as entity (below the sensor) and value: names, colours, the body.

    The electrodes of a BioTac SP are drawn in the frame of their table and without a body, whose
    shape no source tells.

    Args:
        kind: Type of the sensor.
        again: Instead of those of another type: the finger was exchanged.
    """
    rr = require("rerun", extra="services")

    def line(names: str | list[str], colours: Sequence[Any], width: float) -> Any:
        return rr.SeriesLines(names=names, colors=colours, widths=[width] * len(colours))

    names, wheel = electrode_names(kind.electrode_count), electrode_colours(kind.electrode_count)
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
        yield from _body(rr)
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


def _body(rr: Any) -> Iterator[tuple[str, Any]]:
    vertices, triangles, normals = core_mesh()
    core = rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=triangles,
        vertex_normals=normals,
        albedo_factor=(120, 130, 148),
    )
    skin = rr.LineStrips3D(skin_lines(), colors=[(110, 150, 190)], radii=[6e-5])
    yield "finger/core", core
    yield "finger/skin", skin


STEP = "step"
"""The timeline: number of the step, which is that of the pose in the path; 0 = untouched."""

SIDES = ("left", "right")
"""Halves of the skin, y > 0 and y < 0; without the right one the finger is cut open."""


def layout(trajectories: Sequence[str], longest_m: float) -> Any:
    """Blueprint of these trajectories.

    Args:
        trajectories: Ids, in order of their tabs.
        longest_m: Displacement that has the last colour [m].
    """
    rrb = require("rerun.blueprint", extra="services")
    tabs = [_tab(rrb, name, longest_m) for name in trajectories]
    return rrb.Blueprint(
        tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs),
        # Following begins at the last step, where there is most to see.
        rrb.TimePanel(timeline=STEP, state="collapsed", play_state="following", fps=5.0),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def series(rr: Any) -> dict[str, Any]:
    """Looks of the curves, by entity below the trajectory."""
    looks = {
        f"force/{axis}": rr.SeriesLines(names=[f"F{axis}"], colors=[colour], widths=[2.0])
        for axis, colour in zip(AXES, AXIS_COLOURS, strict=True)
    }
    for name, words in (
        ("pressure", "fluid"),
        ("area", "contact"),
        ("newton", "Newton iterations"),
    ):
        looks[name] = rr.SeriesLines(names=[words], colors=[QUIET_COLOUR], widths=[2.0])
    return looks


def _tab(rrb: Any, trajectory: str, longest_m: float) -> Any:
    def space(name: str, position: Sequence[float], *, without: str) -> Any:
        return rrb.Spatial3DView(
            origin=f"{trajectory}/finger",
            contents=["$origin/**", f"- $origin/{without}/**"],
            name=name,
            background=BACKGROUND,
            line_grid=rrb.LineGrid3D(visible=False),
            eye_controls=rrb.EyeControls3D(
                position=position, look_target=(-0.005, 0.0, -0.003), eye_up=(0.0, 0.0, 1.0)
            ),
        )

    def plot(entity: str, name: str, *, legend: bool = False) -> Any:
        return rrb.TimeSeriesView(
            origin=f"{trajectory}/{entity}",
            name=name,
            axis_x=rrb.TimeAxis(link="LinkToGlobal"),
            plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
            background=rrb.archetypes.PlotBackground(color=BACKGROUND, show_grid=True),
        )

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
