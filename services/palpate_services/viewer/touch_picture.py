"""One moment of a touch as a picture: the deformed skin, forces and contact locations on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.files.bundle import FieldMesh
from palpate.files.record import read_record
from palpate.messages import FieldEstimate, FieldFrame, FloatArray, WrenchFrame
from palpate.process import require
from palpate_services.inference.repository import MeshLibrary
from palpate_services.viewer.surfaces import normals_of, shades
from palpate_services.viewer.timeline import line_of_action, message_of
from palpate_services.viewer.touch_errors import TOUCHED_N, RecordedTouches
from palpate_services.viewer.truth import MatchedMessages

INK = "#30343b"
TRUTH = "#16181c"
ESTIMATE = "#d1495b"

MM_PER_M = 1e3
"""People read a fingertip in millimetres; only the picture does [mm/m]."""

_EYE = (0.25, -0.72, -0.65)
"""Direction from the finger to the eye, sensor frame: the pad is seen, and forces on it at most of
their length. A touch of the other side of the finger is seen from there."""

_ARROW_MM = 9.0
"""Length of the longest arrow [mm]."""

_SCALE_BAR_MM = 5.0


View = Callable[[npt.NDArray[Any]], npt.NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class ShownTouch:
    """A touched frame that has a field, with what is known of it.

    Attributes:
        time_ns: Its monotonic time [ns].
        matched: Estimate and truth of features.
        mesh: The skin.
        estimate: Estimated nodal displacement [m], shape ``(V, 3)``.
        truth: True one of this instant [m], shape ``(V, 3)``; None = not recorded.
    """

    time_ns: int
    matched: MatchedMessages
    mesh: FieldMesh
    estimate: FloatArray
    truth: FloatArray | None


def typical_touch(record: Path, touches: RecordedTouches, meshes: MeshLibrary) -> ShownTouch | None:
    """The touched frame with a field whose force error is the median of such frames.

    None where there is none, or where no bundle holds the mesh of its field.

    Raises:
        RecordingError: The record is damaged.
    """
    found: list[tuple[float, int, MatchedMessages]] = []
    for time_ns, each in zip(touches.times_ns.tolist(), touches.matched, strict=True):
        error = each.force_error()
        if time_ns not in touches.fields_ns or error is None or each.wrench is None:
            continue
        if np.linalg.norm(each.wrench.force) >= TOUCHED_N and _acts_at(each) is not None:
            found.append((float(np.linalg.norm(error)), time_ns, each))
    if not found:
        return None
    found.sort(key=lambda item: item[:2])
    _, time_ns, matched = found[len(found) // 2]
    return _with_fields(record, touches.sensor, time_ns, matched, meshes)


def _with_fields(
    record: Path, sensor: str, time_ns: int, matched: MatchedMessages, meshes: MeshLibrary
) -> ShownTouch | None:
    estimate: FieldEstimate | None = None
    before: FieldFrame | None = None
    after: FieldFrame | None = None
    for item in read_record(record):
        if item.address.sensor != sensor or item.address.topic not in ("field", "field_truth"):
            continue
        message = message_of(item, Counter())  # `read_touches` has told what is left out
        if isinstance(message, FieldEstimate):
            if message.source.monotonic_ns == time_ns:
                estimate = message
        elif isinstance(message, FieldFrame):
            if message.stamp.monotonic_ns <= time_ns:
                before = message
            elif after is None:
                after = message
        if estimate is not None and after is not None:
            break  # the rest of a long record is later
    mesh = None if estimate is None else meshes.find(estimate.mesh_sha256)
    if estimate is None or mesh is None or estimate.displacement.shape != mesh.nodes.shape:
        return None
    truth = _between(before, after, time_ns)
    if truth is not None and truth.shape != mesh.nodes.shape:
        truth = None
    return ShownTouch(time_ns, matched, mesh, estimate.displacement, truth)


def _between(before: FieldFrame | None, after: FieldFrame | None, time_ns: int) -> Any:
    """The true field at an instant, on the line between its neighbours, which are 50 ms apart."""
    if before is None:
        return None
    start_ns = before.stamp.monotonic_ns
    if start_ns == time_ns:
        return before.displacement
    if after is None or after.displacement.shape != before.displacement.shape:
        return None
    share = (time_ns - start_ns) / (after.stamp.monotonic_ns - start_ns)
    return before.displacement + np.float32(share) * (after.displacement - before.displacement)


def draw_touch(figure: Any, panels: list[Any], touch: ShownTouch) -> None:
    """Draw truth and estimate side by side on two axes, with one scale of colours for both."""
    fields = {"truth": touch.truth, "estimate": touch.estimate}
    known = [np.linalg.norm(each, axis=1) for each in fields.values() if each is not None]
    top_m = max(float(each.max()) for each in known)
    wrench, estimate, pose = touch.matched.wrench, touch.matched.estimate, touch.matched.pose
    acts_at = _acts_at(touch.matched)
    assert wrench is not None
    assert estimate is not None
    assert acts_at is not None
    view = _view(np.array(_EYE) * (1.0, -1.0 if acts_at[1] > 0 else 1.0, 1.0))
    longest_n = max(float(np.linalg.norm(each.force)) for each in (wrench, estimate))
    skin = touch.mesh.nodes + (touch.estimate if touch.truth is None else touch.truth)
    place = None if pose is None else pose.position
    true_end: Any = where_it_acts(wrench, skin, touch.mesh.outer_faces)
    if true_end is None:
        true_end = acts_at if place is None else place
    true_marks = (TRUTH, wrench.force, true_end, place)
    marks = (ESTIMATE, estimate.force, acts_at, estimate.contact_location)
    # The estimate is drawn over the truth, so that their distance shows.
    drawn: tuple[list[Any], list[Any]] = ([true_marks], [true_marks, marks])
    for axes, (name, field), shown in zip(panels, fields.items(), drawn, strict=True):
        if field is None:
            axes.text(0.5, 0.5, "no true field recorded", ha="center", transform=axes.transAxes)
        else:
            _paint_skin(axes, touch.mesh, field, top_m, view)
        for colour, force, end, place in shown:
            arrow_mm = _ARROW_MM * view(force) / (MM_PER_M * longest_n)
            _paint_force(axes, view(end)[:2], arrow_mm[:2], colour)
            if place is not None:
                across, up = view(place)[:2]
                axes.plot(across, up, "o", ms=8, color=colour, mec="white", mew=1.4, zorder=12)
        size_n = np.linalg.norm((wrench if name == "truth" else estimate).force)
        axes.set_title(f"{name}: {size_n:.2f} N", color=INK, fontsize=13)
        axes.set(aspect="equal", anchor="N", xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    for limits in ("xlim", "ylim"):  # the same for both, so that they can be compared
        ends = np.array([getattr(axes, f"get_{limits}")() for axes in panels])
        for axes in panels:
            axes.set(**{limits: (ends[:, 0].min(), ends[:, 1].max())})
    _scale_bar(panels[0])
    _colour_bar(figure, panels, top_m)


def _view(eye: npt.NDArray[np.float64]) -> View:
    """Turns the sensor frame [m] into right, up and towards the eye [mm], both ``(..., 3)``."""
    towards = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(towards, right), towards], axis=1)
    return lambda points: MM_PER_M * np.asarray(points, np.float64) @ axes


def _paint_skin(
    axes: Any, mesh: FieldMesh, displacement: FloatArray, top_m: float, view: View
) -> None:
    collections = require("matplotlib.collections", extra="services")
    used, faces = np.unique(mesh.outer_faces, return_inverse=True)
    triangles = faces.reshape(-1, 3).astype(np.int32)
    moved = displacement[used]
    positions = mesh.nodes[used] + moved
    colours = _rgb(np.linalg.norm(moved, axis=1) / top_m)[triangles].mean(axis=1)
    facing = np.clip(view(normals_of(positions, triangles))[:, 2] / MM_PER_M, 0.0, 1.0)
    shade = (0.55 + 0.45 * facing[triangles].mean(axis=1))[:, None]
    corners = view(positions)[triangles]
    order = np.argsort(corners[:, :, 2].mean(axis=1))  # what is near covers what is far
    painted = np.clip(colours * shade, 0.0, 1.0)[order]
    skin = collections.PolyCollection(
        corners[order][:, :, :2], facecolors=painted, edgecolors=painted, linewidths=0.3
    )
    axes.add_collection(skin)
    axes.autoscale_view()


def _rgb(share: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    packed = shades(share)
    parts = [(packed >> shift) & 255 for shift in (24, 16, 8)]
    return np.stack(parts, axis=-1) / 255.0


def where_it_acts(
    wrench: WrenchFrame, skin: npt.NDArray[Any], faces: npt.NDArray[np.int32]
) -> npt.NDArray[np.float64] | None:
    """Where a wrench's line of action meets a pressed skin [m], shape ``(3,)``.

    ``skin``: positions of its nodes [m], shape ``(V, 3)``, with the outer ``faces``. It is the
    point of the line beside the node that is nearest to it, of the half that is pressed on. None
    where the wrench says no line.
    """
    line = line_of_action(wrench)
    if line is None:
        return None
    through, along = line
    from_line = np.asarray(skin, np.float64)[np.unique(faces)] - through
    heights = from_line @ along
    away = np.linalg.norm(from_line - heights[:, None] * along, axis=1)
    away[heights > heights.mean()] = np.inf  # where the line would come out again
    return np.asarray(through + heights[away.argmin()] * along)


def _acts_at(touch: MatchedMessages) -> FloatArray | None:
    """Where the estimated force acts [m], or the next best; None where no place is estimated."""
    if touch.estimate is None or touch.estimate.centre_of_pressure is not None:
        return None if touch.estimate is None else touch.estimate.centre_of_pressure
    return touch.estimate.contact_location


def _paint_force(axes: Any, end: Any, arrow_mm: Any, colour: str) -> None:
    """The force on the skin, ending where it acts."""
    arrow = {"arrowstyle": "-|>", "color": colour, "lw": 2.6, "mutation_scale": 18}
    props = {**arrow, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, end - arrow_mm, arrowprops=props, zorder=10)
    axes.update_datalim([end - arrow_mm])


def _scale_bar(axes: Any) -> None:
    left, right = axes.get_xlim()
    low = axes.get_ylim()[0]
    start = left + 0.04 * (right - left)
    axes.plot([start, start + _SCALE_BAR_MM], [low, low], color=INK, lw=2.0)
    axes.annotate(
        f"{_SCALE_BAR_MM:g} mm", (start, low), (0, 4), textcoords="offset points", color=INK
    )


def _colour_bar(figure: Any, panels: list[Any], top_m: float) -> None:
    colors = require("matplotlib.colors", extra="services")
    cm = require("matplotlib.cm", extra="services")
    palette = colors.ListedColormap(_rgb(np.linspace(0.0, 1.0, 256)))
    scale = colors.Normalize(0.0, MM_PER_M * top_m)
    bar = figure.colorbar(
        cm.ScalarMappable(scale, palette), ax=panels, location="bottom", shrink=0.6, aspect=35,
        pad=0.02,
    )  # fmt: skip
    bar.set_label("displacement of the skin [mm]", color=INK, fontsize=10)
    bar.ax.tick_params(colors=INK, labelsize=9)
