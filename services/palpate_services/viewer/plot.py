"""A record as a picture: truth against estimate, and how far they are apart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.bus.topics import TOPICS
from palpate.errors import RecordingError
from palpate.files.record import read_record
from palpate.messages import FeatureEstimate, IndenterPoseFrame, WrenchFrame
from palpate.process import require
from palpate_services.viewer.timeline import MatchedMessages, TruthMatcher

Points = npt.NDArray[np.float64]

_MATCHED = ("wrench", "pose", "features")
_AXES = ("x", "y", "z")
_COLOURS = ("#d1495b", "#2e8b57", "#2f6fb5")
_INK = "#30343b"
_MM_PER_M = 1e3  # the picture is in millimetres, everything else in SI units


def plot_record(record: Path, picture: Path, *, sensor: str | None = None) -> dict[str, float]:
    """Draw truth against estimate of one sensor, by default that with the most estimates, as PNG.

    Returns:
        Summary: ``estimates`` and ``matched`` (how many), ``duration_s``, ``force_median_error_n``,
        ``force_p90_error_n``, ``location_median_error_m``, ``location_p90_error_m``; an error is
        absent where there is no truth to compare with.

    Raises:
        RecordingError: The record is damaged or holds no estimates.
        MissingExtraError: matplotlib is not installed.
    """
    whose, instants = _instants(record, sensor)
    times = np.array(sorted(ns for ns, item in instants.items() if item.estimate is not None))
    matched = [instants[ns] for ns in times.tolist()]
    seconds = (times - times[0]) * 1e-9
    force_errors = _errors(instant.force_error() for instant in matched)
    location_errors = _errors(instant.location_error() for instant in matched)
    summary = {
        "estimates": float(len(matched)),
        "matched": float(len(force_errors)),
        "duration_s": float(seconds[-1]),
    }
    for name, unit, errors in (("force", "n", force_errors), ("location", "m", location_errors)):
        if len(errors):
            summary[f"{name}_median_error_{unit}"] = float(np.median(errors))
            summary[f"{name}_p90_error_{unit}"] = float(np.percentile(errors, 90))
    figure = _draw(seconds, matched, force_errors, location_errors)
    figure.suptitle(
        f"{whose}: estimate against truth, {len(matched)} estimates in {seconds[-1]:.1f} s",
        fontsize=13,
        color=_INK,
    )
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=110)
    return summary


def _instants(record: Path, sensor: str | None) -> tuple[str, dict[int, MatchedMessages]]:
    matchers: dict[str, TruthMatcher] = {}
    estimates: dict[str, int] = {}
    for item in read_record(record):
        topic, whose = item.address.topic, item.address.sensor
        if topic not in _MATCHED or sensor not in (None, whose):
            continue
        message = TOPICS[topic].codec.decode(item.payload)
        assert isinstance(message, FeatureEstimate | IndenterPoseFrame | WrenchFrame)
        matchers.setdefault(whose, TruthMatcher(remember=None)).add(message)
        if isinstance(message, FeatureEstimate):
            estimates[whose] = estimates.get(whose, 0) + 1
    if not estimates:
        of_whom = "" if sensor is None else f" of the sensor {sensor!r}"
        raise RecordingError(
            f"{record} holds no estimates{of_whom}", remedy="record while the features service runs"
        )
    name = max(estimates, key=lambda key: estimates[key])
    return name, dict(matchers[name].instants())


def _errors(differences: Any) -> Points:
    found = [float(np.linalg.norm(value)) for value in differences if value is not None]
    return np.array(found, np.float64)


def _draw(seconds: Points, matched: list[MatchedMessages], force: Points, location: Points) -> Any:
    figures = require("matplotlib.figure", extra="services")
    figure = figures.Figure(figsize=(14, 9), layout="constrained", facecolor="white")
    grid = figure.add_gridspec(4, 2)
    columns = (
        ("force {} [N]", _force_rows(matched)),
        ("contact {} [mm]", _location_rows(matched)),
    )
    for column, (label, (truth, estimate)) in enumerate(columns):
        first = None
        for row, axis in enumerate(_AXES):
            axes = figure.add_subplot(grid[row, column], sharex=first)
            first = first or axes
            axes.plot(seconds, estimate[:, row], color=_COLOURS[row], lw=1.6, label="estimate")
            axes.plot(seconds, truth[:, row], color=_INK, lw=0.9, label="truth")
            axes.set_ylabel(label.format(axis), color=_INK)
            _tidy(axes)
            axes.tick_params(labelbottom=row == len(_AXES) - 1)
            if row == 0:
                axes.legend(
                    loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False, ncols=2
                )
        axes.set_xlabel("time [s]", color=_INK)
    _histogram(figure.add_subplot(grid[3, 0]), force, "force error", "N", "#6b4fa0")
    location_mm = _MM_PER_M * location
    _histogram(
        figure.add_subplot(grid[3, 1]), location_mm, "contact location error", "mm", "#b5762f"
    )
    return figure


def _force_rows(matched: list[MatchedMessages]) -> tuple[Points, Points]:
    truth = [_or_nan(item.wrench and item.wrench.force) for item in matched]
    estimate = [_or_nan(item.estimate and item.estimate.force) for item in matched]
    return np.stack(truth), np.stack(estimate)


def _location_rows(matched: list[MatchedMessages]) -> tuple[Points, Points]:
    truth = [
        _or_nan(item.pose.position if item.pose is not None and item.pose.in_contact else None)
        for item in matched
    ]
    estimate = [_or_nan(item.estimate and item.estimate.contact_location) for item in matched]
    return _MM_PER_M * np.stack(truth), _MM_PER_M * np.stack(estimate)


def _or_nan(values: Any) -> Points:
    """Three numbers, or three gaps in the line."""
    return np.full(3, np.nan) if values is None else np.asarray(values, np.float64)


def _histogram(axes: Any, errors: Points, name: str, unit: str, colour: str) -> None:
    axes.set_xlabel(f"{name} [{unit}]", color=_INK)
    axes.set_ylabel("estimates", color=_INK)
    _tidy(axes)
    if not len(errors):
        axes.text(0.5, 0.5, "no truth recorded", ha="center", transform=axes.transAxes, color=_INK)
        return
    # The longest tail would squeeze everything else into the first bars.
    reach = float(np.percentile(errors, 99)) or 1.0
    axes.hist(errors, bins=60, range=(0.0, reach), color=colour, alpha=0.85)
    median = float(np.median(errors))
    axes.axvline(median, color=_INK, lw=1.2)
    axes.annotate(
        f"median {median:.3g} {unit}, 90 % below {np.percentile(errors, 90):.3g} {unit}",
        (0.98, 0.9),
        xycoords="axes fraction",
        ha="right",
        fontsize=9,
        color=_INK,
    )


def _tidy(axes: Any) -> None:
    axes.set_axisbelow(True)
    axes.grid(visible=True, color="#e4e4e8", lw=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=_INK, labelsize=8)
