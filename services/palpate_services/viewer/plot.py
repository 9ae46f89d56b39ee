"""A record as a picture: a touch, truth against estimate in time, and errors by force."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.files.atomic import written_whole
from palpate.process import require
from palpate_services.inference.repository import MeshLibrary
from palpate_services.viewer.touch_errors import TOUCHED_N, RecordErrors, read_touches
from palpate_services.viewer.touch_picture import (
    ESTIMATE,
    INK,
    MM_PER_M,
    TRUTH,
    ShownTouch,
    draw_touch,
    typical_touch,
)
from palpate_services.viewer.truth import MatchedMessages

Points = npt.NDArray[np.float64]

_AXES = ("x", "y", "z")


def plot_record(
    record: Path, picture: Path, *, sensor: str | None = None, bundles: Sequence[str] = ()
) -> RecordErrors:
    """Draw truth against estimate of one sensor, by default that with the most estimates, as PNG.

    Above, the touched frame with the median error: the skin where the record has its field and a
    bundle its mesh (the packaged ones and ``bundles``), and the errors by force. Below, force and
    contact location in time. Returns these errors.

    Raises:
        ConfigError: One of ``bundles`` does not exist.
        RecordingError: The record is damaged or holds no estimates.
        DatasetError: The disk is full or refuses.
        MissingExtraError: matplotlib is not installed.
    """
    figures = require("matplotlib.figure", extra="services")
    touches = read_touches(record, sensor=sensor)
    errors = touches.errors()
    touch = typical_touch(record, touches, MeshLibrary(bundles))
    figure = figures.Figure(
        figsize=(11, 8.6 if touch else 7.5), layout="constrained", facecolor="white"
    )
    above, below = figure.subfigures(2, 1, height_ratios=[3.9, 4.7] if touch else [2.4, 5.1])
    _draw_above(above, touch, errors)
    seconds = (touches.times_ns - touches.times_ns[0]) * 1e-9
    shown_s = None if touch is None else (touch.time_ns - int(touches.times_ns[0])) * 1e-9
    _draw_curves(below, seconds, touches.matched, shown_s)
    figure.suptitle(_headline(errors), fontsize=14, color=INK)
    with written_whole(picture) as partial:
        figure.savefig(partial, dpi=110, format="png")
    return errors


def _draw_above(figure: Any, touch: ShownTouch | None, errors: RecordErrors) -> None:
    if touch is None:
        _error_table(figure.subplots(), errors)
        return
    grid = figure.add_gridspec(1, 3, width_ratios=[3.4, 3.4, 3.4])
    panels = [figure.add_subplot(grid[0, at]) for at in range(2)]
    draw_touch(figure, panels, touch)
    table = figure.add_subplot(grid[0, 2])
    _error_table(table, errors)
    table.text(
        0.0, -0.08,
        "Left: the touched frame with the median force error.\n"
        "Arrow: force, where it acts. Dot: contact location,\n"
        "the tip of the indenter. Red: estimate. Black: truth.",
        color=INK, fontsize=9.5, transform=table.transAxes,
    )  # fmt: skip


def _headline(errors: RecordErrors) -> str:
    touched = errors.touched
    if not touched.frames:
        return f"{errors.sensor}: {errors.estimates:,} estimates, no truth of a touch recorded"
    text = (
        f"{errors.sensor}: touched (≥ {TOUCHED_N:g} N) in {touched.frames:,} of"
        f" {errors.estimates:,} estimates; median error {_number(touched.force_median_n, 2)} N"
    )
    place = touched.location_median_m
    return text if place is None else f"{text}, {MM_PER_M * place:.1f} mm"


def _error_table(axes: Any, errors: RecordErrors) -> None:
    """Median errors by true force, as text."""
    axes.set_axis_off()
    axes.set_title("median error, by true force", color=INK, fontsize=13)
    columns = ((0.0, "left"), (0.54, "right"), (0.74, "right"), (1.06, "right"))
    lines = [("", "frames", "force [N]", "location [mm]")]
    for each in errors.bins:
        place = each.location_median_m
        name = each.name.replace(">=", "≥")
        lines.append(
            (
                f"touched, {name}" if each is errors.touched else name,
                f"{each.frames:,}",
                _number(each.force_median_n, 2),
                _number(None if place is None else MM_PER_M * place, 1),
            )
        )
    for row, line in enumerate(lines):
        height = 0.92 - row * 0.125
        for (across, side), text in zip(columns, line, strict=True):
            axes.text(
                across, height, text, ha=side, va="center", color=INK, fontsize=10,
                weight="bold" if row == 1 else "normal", transform=axes.transAxes,
            )  # fmt: skip
    axes.plot([0, 1.06], [0.86, 0.86], color=INK, lw=0.8, transform=axes.transAxes, clip_on=False)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _draw_curves(
    figure: Any, seconds: Points, matched: Sequence[MatchedMessages], shown_s: float | None
) -> None:
    grid = figure.add_gridspec(3, 2)
    columns = (
        ("force {} [N]", _force_rows(matched)),
        ("contact {} [mm]", _location_rows(matched)),
    )
    for column, (name, (truth, estimate)) in enumerate(columns):
        first = None
        for row, axis in enumerate(_AXES):
            axes = figure.add_subplot(grid[row, column], sharex=first)
            first = first or axes
            # The thin truth is drawn over the thick estimate: what sticks out is the error.
            axes.plot(seconds, estimate[:, row], color=ESTIMATE, lw=2.6, label="estimate")
            axes.plot(seconds, truth[:, row], color=TRUTH, lw=1.1, label="truth")
            if shown_s is not None:
                axes.axvline(shown_s, color="#8a8f98", lw=1.0, ls="--", label="shown above")
            axes.set_ylabel(name.format(axis), color=INK, fontsize=11)
            _tidy(axes)
            axes.tick_params(labelbottom=row == len(_AXES) - 1)
        axes.set_xlabel("time [s]", color=INK, fontsize=11)
    handles, names = axes.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", fontsize=11, frameon=False, ncols=3)


def _force_rows(matched: Sequence[MatchedMessages]) -> tuple[Points, Points]:
    truth = [_or_nan(item.wrench and item.wrench.force) for item in matched]
    estimate = [_or_nan(item.estimate and item.estimate.force) for item in matched]
    return np.stack(truth), np.stack(estimate)


def _location_rows(matched: Sequence[MatchedMessages]) -> tuple[Points, Points]:
    truth = [_or_nan(item.true_location) for item in matched]
    estimate = [_or_nan(item.estimate and item.estimate.contact_location) for item in matched]
    return MM_PER_M * np.stack(truth), MM_PER_M * np.stack(estimate)


def _or_nan(values: Any) -> Points:
    """Three numbers, or three gaps in the line."""
    return np.full(3, np.nan) if values is None else np.asarray(values, np.float64)


def _tidy(axes: Any) -> None:
    axes.set_axisbelow(True)
    axes.grid(visible=True, color="#e4e4e8", lw=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=9)
