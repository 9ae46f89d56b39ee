"""Tables of the twin beside the paper's numbers: Markdown for people, JSON with every metric.

What the paper measured on real BioTacs, to stand beside results on the twin.

Narang et al., unseen trajectories: contact location and force of the best network for each (MLP;
voxel network for the magnitude, MLP for the angle), field and electrodes of PointNet++. The field
is counted on 128 ventral nodes, the electrodes over full scale and in counts.


One figure for each task: error by force, and a typical held-out row, truth beside estimate.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.process import require
from palpate_training.datasets.experiment import SkinMesh
from palpate_training.datasets.features import ELECTRODES
from palpate_training.tasks.results import ModelResult, Picture, TaskReport, write_json

TWIN_LABEL, PAPER_LABEL = "twin", "paper (real)"


@dataclass(frozen=True, slots=True)
class Column:
    """Heading with the unit, metric, factor from SI to that unit, digits, and its interval."""

    heading: str
    metric: str
    factor: float
    digits: int
    interval: str = ""


_NORM = "electrode_l2_median_counts"
_SUBSET = Column("128 nodes [mm]", "nodal_subset_m", 1e3, 3, "nodal_subset_m")
_RMSE = Column("RMSE [counts]", "electrode_rmse_counts", 1, 0, "electrode_rmse_counts")
_LOCATION = Column("median [mm]", "location_distance_median_m", 1e3, 2, "distance_m")
_MAGNITUDE = Column("magnitude median [N]", "force_magnitude_median_n", 1, 2, "magnitude_n")

COLUMNS: dict[str, tuple[Column, ...]] = {
    "field": (
        _SUBSET,
        Column("all nodes [mm]", "nodal_all_m", 1e3, 3, "nodal_all_m"),
        Column("moving nodes [mm]", "nodal_moving_m", 1e3, 3),
        Column("worst node [mm]", "nodal_max_m", 1e3, 2),
        Column("skill, 128 nodes", "skill_subset", 1, 3),
        Column("skill, all nodes", "skill_all", 1, 3),
    ),
    "synthesis": (
        Column("RMSE [-]", "electrode_rmse", 1, 4),
        _RMSE,
        Column("l2 median [counts]", _NORM, 1, 0, _NORM),
        Column("skill", "skill_rmse", 1, 3),
    ),
    "force": (
        _MAGNITUDE,
        Column("mean [N]", "force_magnitude_mean_n", 1, 2),
        Column("/ std", "force_magnitude_over_std_median", 1, 2),
        Column("angle median [rad]", "force_angle_median_rad", 1, 3, "angle_rad"),
        Column("1 - cos median", "force_one_minus_cos_median", 1, 4),
    ),
    "location": (
        _LOCATION,
        Column("mean [mm]", "location_distance_mean_m", 1e3, 2),
        Column("IQR [mm]", "location_distance_iqr_m", 1e3, 2),
    ),
}
"""What each task's table shows; the JSON holds every metric."""

_HEADLINES = {
    "field": ("field, 128 nodes [mm]", _SUBSET),
    "synthesis": ("electrode RMSE [counts]", _RMSE),
    "location": ("location median [mm]", _LOCATION),
    "force": ("force magnitude median [N]", _MAGNITUDE),
}

_PREFACE = """\
Held out are whole unique trajectories: 70 % of them train, 10 % stop the training and choose
settings, 20 % are tested, and every execution of a trajectory, on whatever unit, is on one side.
"{twin}" rows are simulated fingers and say nothing about a real one; "{paper}" rows are what
Narang et al. measured with their networks on their BioTacs. "network" is trained on the unit that
is tested, "network, all units" on all. Numbers of a network are means over {seeds} seeds; in
brackets the 95 % interval, whole trajectories drawn with replacement. "moving nodes" truly move by
more than 0.1 mm. A skill is one minus the error over that of predicting zero.
"""


def table(report: TaskReport) -> str:
    """One task as a Markdown table, the paper's row below the twin's rows of each unit."""
    columns = COLUMNS[report.task]
    lines = _head(["held out", "data", "model", *(column.heading for column in columns)], 3)
    for test in dict.fromkeys(result.test for result in report.results):
        for result in report.results:
            if result.test == test:
                cells = [_cell(result, column) for column in columns]
                lines.append(_line([test, TWIN_LABEL, result.model, *cells]))
        known = PAPER[report.task].get(test)
        if known is not None:
            cells = [_known(known.get(column.metric), column) for column in columns]
            lines.append(_line([test, PAPER_LABEL, "best published", *cells]))
    return "\n".join(lines) + "\n"


def headline_table(reports: Sequence[TaskReport]) -> str:
    """All tasks in one table: unit by unit the models, then the paper."""
    shown = {report.task: report for report in reports}
    tasks = [task for task in _HEADLINES if task in shown]
    lines = _head(["held out", "data", "model", *(_HEADLINES[task][0] for task in tasks)], 3)
    each = [result for report in reports for result in report.results]
    for test in dict.fromkeys(result.test for result in each):
        for model in dict.fromkeys(result.model for result in each if result.test == test):
            cells = []
            for task in tasks:
                found = [r for r in shown[task].results if (r.test, r.model) == (test, model)]
                cells.append(_cell(found[0], _HEADLINES[task][1]) if found else "-")
            lines.append(_line([test, TWIN_LABEL, model, *cells]))
        known = [PAPER[task].get(test, {}) for task in tasks]
        if any(known):
            cells = [
                _known(one.get(_HEADLINES[task][1].metric), _HEADLINES[task][1])
                for task, one in zip(tasks, known, strict=True)
            ]
            lines.append(_line([test, PAPER_LABEL, "best published", *cells]))
    return "\n".join(lines) + "\n"


def write_report(
    folder: Path, reports: Sequence[TaskReport], mesh: SkinMesh, *, command: str, seeds: int
) -> list[Path]:
    """Write ``twin.md``, a JSON for each task and a PNG for field and synthesis.

    Args:
        folder: Where to; made if it is missing.
        reports: Results of the tasks.
        mesh: The skin that fields are drawn on.
        command: The command line that made them.
        seeds: Networks of each kind.

    Returns:
        What was written; every file appears whole or not at all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    text = ["# Learning on the twin", f"Made by `{command}`."]
    text += [_PREFACE.format(twin=TWIN_LABEL, paper=PAPER_LABEL, seeds=seeds).rstrip()]
    text += ["## In short", headline_table(reports).rstrip()]
    for report in reports:
        text += [f"## {report.task.capitalize()}", table(report).rstrip()]
        if report.picture is not None:
            path = folder / f"twin-{report.task}.png"
            part = path.with_suffix(".part.png")
            if report.task == "field":
                draw_field(part, report.picture, mesh)
            else:
                draw_synthesis(part, report.picture)
            os.replace(part, path)
            written.append(path)
            text.append(f"![{report.task}: {report.picture.example}]({path.name})")
        path = folder / f"twin-{report.task}.json"
        part = path.with_suffix(".part")
        write_json(part, report.results, {"command": command, **report.facts})
        os.replace(part, path)
        written.append(path)
    path = folder / "twin.md"
    part = path.with_suffix(".part")
    part.write_text("\n\n".join(text) + "\n", encoding="utf-8")
    os.replace(part, path)
    return [*written, path]


def _head(headings: Sequence[str], words: int) -> list[str]:
    return [_line(headings), "|" + "---|" * words + "---:|" * (len(headings) - words)]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _cell(result: ModelResult, column: Column) -> str:
    text = _known(result.metrics[column.metric], column)
    if column.interval in result.interval:
        low, high = (_known(end, column) for end in result.interval[column.interval])
        text += f" ({low}-{high})"
    return text


def _known(value: float | None, column: Column) -> str:
    return "-" if value is None else f"{value * column.factor:.{column.digits}f}"


ALL_UNITS = "all units"

PAPER: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "field": {
        "biotac-1": {"nodal_subset_m": 0.21e-3},
        "biotac-2": {"nodal_subset_m": 0.20e-3},
        "biotac-3": {"nodal_subset_m": 0.25e-3},
        ALL_UNITS: {"nodal_subset_m": 0.22e-3},
    },
    "synthesis": {
        "biotac-1": {
            "electrode_rmse": 0.019,
            "electrode_rmse_counts": 80,
            "electrode_l2_median_counts": 225,
        },
        "biotac-2": {
            "electrode_rmse": 0.017,
            "electrode_rmse_counts": 73,
            "electrode_l2_median_counts": 166,
        },
        "biotac-3": {
            "electrode_rmse": 0.016,
            "electrode_rmse_counts": 66,
            "electrode_l2_median_counts": 187,
        },
    },
    "force": {
        "biotac-1": {"force_magnitude_median_n": 0.96, "force_angle_median_rad": 0.14},
        "biotac-2": {"force_magnitude_median_n": 0.78, "force_angle_median_rad": 0.15},
        "biotac-3": {"force_magnitude_median_n": 0.73, "force_angle_median_rad": 0.12},
        ALL_UNITS: {"force_magnitude_median_n": 0.64, "force_angle_median_rad": 0.15},
    },
    "location": {
        "biotac-1": {"location_distance_median_m": 1.5e-3, "location_distance_mean_m": 1.8e-3},
        "biotac-2": {"location_distance_median_m": 2.0e-3, "location_distance_mean_m": 2.1e-3},
        "biotac-3": {"location_distance_median_m": 2.4e-3, "location_distance_mean_m": 2.6e-3},
        ALL_UNITS: {"location_distance_median_m": 2.0e-3, "location_distance_mean_m": 2.2e-3},
    },
}
"""Task -> unit -> metric of ``palpate_training.tasks.results.ModelResult``, SI and counts."""


FORCE_BINS_N = (0.0, 2.0, 8.0, np.inf)
"""Below 2 N, 2 to 8 N, above 8 N [N] (learning notes, 6.1); rows start at 0.5 N."""

_BIN_NAMES = ("< 2 N", "2-8 N", "> 8 N")


def draw_field(path: Path, picture: Picture, mesh: SkinMesh) -> None:
    """Error by force bin and the example on the skin, seen from below.

    Args:
        path: PNG to write.
        picture: What to draw; fields (V, 3) [m].
        mesh: The skin.
    """
    figure = _figure(13.0)
    left, *right = figure.subplots(1, 4, width_ratios=[1.5, 1, 1, 1])
    _boxes(left, picture, 1e3, "mean nodal error, all nodes [mm]")
    truth, estimate = (
        1e3 * np.linalg.norm(field, axis=1) for field in (picture.truth, picture.estimate)
    )
    wrong = 1e3 * np.linalg.norm(picture.estimate - picture.truth, axis=1)
    top = float(max(truth.max(), estimate.max(), 1e-3))
    faces = ventral_faces(mesh)
    for axis, values, title in zip(
        right, (truth, estimate, wrong), ("truth", "estimate", "error"), strict=True
    ):
        drawn = axis.tripcolor(
            1e3 * mesh.nodes[:, 1],
            1e3 * mesh.nodes[:, 0],
            faces,
            values,
            shading="gouraud",
            cmap="viridis",
            vmin=0.0,
            vmax=top,
        )
        axis.set(aspect="equal", title=title, xlabel="y [mm]")
        axis.spines[["top", "right"]].set_visible(False)
    right[0].set_ylabel("x [mm]")
    figure.colorbar(drawn, ax=right, label="displacement [mm]", shrink=0.8)
    figure.suptitle(f"Held-out trajectory of typical error: {picture.example}", fontsize=10)
    _save(figure, path)


def draw_synthesis(path: Path, picture: Picture) -> None:
    """Error by force bin and the 19 electrodes of the example.

    Args:
        path: PNG to write.
        picture: What to draw; tared counts (19,).
    """
    figure = _figure(11.0)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.6])
    _boxes(left, picture, 1.0, "norm of the error in R^19 [counts]")
    at = np.arange(ELECTRODES)
    right.bar(at - 0.2, picture.truth, 0.4, label="truth", color="#222222")
    right.bar(at + 0.2, picture.estimate, 0.4, label="estimate", color="#d1672a")
    right.set_xticks(at, [f"E{i + 1}" for i in at], fontsize=7)
    right.set_ylabel("tared counts")
    right.legend(frameon=False)
    right.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"Held-out trajectory of typical error: {picture.example}", fontsize=10)
    _save(figure, path)


def ventral_faces(mesh: SkinMesh) -> npt.NDArray[np.int32]:
    """Outer triangles that look down, to the pad's side: what one sees from below, shape (F, 3)."""
    a, b, c = (mesh.nodes[mesh.outer_faces[:, i]] for i in range(3))
    return np.asarray(mesh.outer_faces[np.cross(b - a, c - a)[:, 2] < 0])


def by_force(
    force_n: npt.NDArray[np.floating], error: npt.NDArray[np.float64]
) -> list[npt.NDArray[np.float64]]:
    """Errors of the rows of each force bin.

    Args:
        force_n: True force magnitude [N], shape (N,).
        error: Error of the same rows, shape (N,).
    """
    return [error[(force_n >= low) & (force_n < high)] for low, high in pairwise(FORCE_BINS_N)]


def _boxes(axis: Any, picture: Picture, factor: float, label: str) -> None:
    units = list(picture.error)
    width = 0.8 / len(units)
    for i, unit in enumerate(units):
        bins = by_force(picture.force_n[unit], picture.error[unit])
        filled = [k for k, values in enumerate(bins) if values.size]
        axis.boxplot(
            [factor * bins[k] for k in filled],
            positions=[k + (i - (len(units) - 1) / 2) * width for k in filled],
            widths=0.8 * width,
            showfliers=False,
            medianprops={"color": f"C{i}"},
            boxprops={"color": f"C{i}"},
        )
        axis.plot([], [], color=f"C{i}", label=unit)
    axis.set_xticks(range(len(_BIN_NAMES)), _BIN_NAMES)
    axis.set(xlabel="true force", ylabel=label, ylim=(0, None))
    axis.legend(frameon=False, fontsize=8)
    axis.spines[["top", "right"]].set_visible(False)


def _figure(width: float) -> Any:
    matplotlib = require("matplotlib", extra="training")
    matplotlib.use("agg")
    pyplot = require("matplotlib.pyplot", extra="training")
    return pyplot.figure(figsize=(width, 4.2), layout="constrained")


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=110, metadata={"Software": None})
    require("matplotlib.pyplot", extra="training").close(figure)
