"""The page of the twin's results: tables beside the paper's numbers, a figure and JSON each.

The paper's numbers (Narang et al., real BioTacs, unseen trajectories): contact location and force
of the best network for each (MLP; voxel network for the magnitude, MLP for the angle), field and
electrodes of PointNet++. The field is counted on 128 ventral nodes, the electrodes over full scale
and in counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.files.atomic import written_whole
from palpate_training.datasets.experiment import SkinMesh
from palpate_training.datasets.features import ELECTRODES
from palpate_training.figures.style import markdown_table, new_figure, save
from palpate_training.tasks.results import (
    MetricColumn,
    ResultPicture,
    TaskReport,
    write_json,
)

TWIN_LABEL, PAPER_LABEL = "twin", "paper (real)"


_NORM = "electrode_l2_median_counts"
_SUBSET = MetricColumn("128 nodes [mm]", "nodal_subset_m", 3, "nodal_subset_m", factor=1e3)
_RMSE = MetricColumn("RMSE [counts]", "electrode_rmse_counts", 0, "electrode_rmse_counts")
_LOCATION = MetricColumn("median [mm]", "location_distance_median_m", 2, "distance_m", factor=1e3)
_MAGNITUDE = MetricColumn("magnitude median [N]", "force_magnitude_median_n", 2, "magnitude_n")

COLUMNS: dict[str, tuple[MetricColumn, ...]] = {
    "field": (
        _SUBSET,
        MetricColumn("all nodes [mm]", "nodal_all_m", 3, "nodal_all_m", factor=1e3),
        MetricColumn("moving nodes [mm]", "nodal_moving_m", 3, factor=1e3),
        MetricColumn("worst node [mm]", "nodal_max_m", 2, factor=1e3),
        MetricColumn("skill, 128 nodes", "skill_subset", 3),
        MetricColumn("skill, all nodes", "skill_all", 3),
    ),
    "synthesis": (
        MetricColumn("RMSE [-]", "electrode_rmse", 4),
        _RMSE,
        MetricColumn("l2 median [counts]", _NORM, 0, _NORM),
        MetricColumn("skill", "skill_rmse", 3),
    ),
    "force": (
        _MAGNITUDE,
        MetricColumn("mean [N]", "force_magnitude_mean_n", 2),
        MetricColumn("/ std", "force_magnitude_over_std_median", 2),
        MetricColumn("angle median [rad]", "force_angle_median_rad", 3, "angle_rad"),
        MetricColumn("1 - cos median", "force_one_minus_cos_median", 4),
    ),
    "location": (
        _LOCATION,
        MetricColumn("mean [mm]", "location_distance_mean_m", 2, factor=1e3),
        MetricColumn("IQR [mm]", "location_distance_iqr_m", 2, factor=1e3),
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
    """One task as a Markdown table, the paper's row below the twin's rows of each specimen."""
    columns = COLUMNS[report.task]
    rows = []
    for test in dict.fromkeys(result.test for result in report.results):
        for result in report.results:
            if result.test == test:
                cells = [column.cell(result) for column in columns]
                rows.append([test, TWIN_LABEL, result.model, *cells])
        known = PAPER[report.task].get(test)
        if known is not None:
            cells = [column.show(known.get(column.metric)) for column in columns]
            rows.append([test, PAPER_LABEL, "best published", *cells])
    headings = ["held out", "data", "model", *(column.heading for column in columns)]
    return markdown_table(headings, rows, words=3)


def headline_table(reports: Sequence[TaskReport]) -> str:
    """All tasks in one table: specimen by specimen the models, then the paper."""
    shown = {report.task: report for report in reports}
    columns = {task: column for task, (_, column) in _HEADLINES.items() if task in shown}
    rows = []
    each = [result for report in reports for result in report.results]
    for test in dict.fromkeys(result.test for result in each):
        for model in dict.fromkeys(result.model for result in each if result.test == test):
            cells = []
            for task, column in columns.items():
                found = [r for r in shown[task].results if (r.test, r.model) == (test, model)]
                cells.append(column.cell(found[0]) if found else "-")
            rows.append([test, TWIN_LABEL, model, *cells])
        known = {task: PAPER[task].get(test, {}) for task in columns}
        if any(known.values()):
            cells = [
                columns[task].show(one.get(columns[task].metric)) for task, one in known.items()
            ]
            rows.append([test, PAPER_LABEL, "best published", *cells])
    headings = ["held out", "data", "model", *(_HEADLINES[task][0] for task in columns)]
    return markdown_table(headings, rows, words=3)


def write_report(
    folder: Path, reports: Sequence[TaskReport], mesh: SkinMesh, *, command: str, seeds: int
) -> list[Path]:
    """Write ``twin.md``, a JSON for each task, PNGs for field and synthesis; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    text = ["# Learning on the twin", f"Made by `{command}`."]
    text += [_PREFACE.format(twin=TWIN_LABEL, paper=PAPER_LABEL, seeds=seeds).rstrip()]
    text += ["## In short", headline_table(reports).rstrip()]
    for report in reports:
        text += [f"## {report.task.capitalize()}", table(report).rstrip()]
        if report.picture is not None:
            path = folder / f"twin-{report.task}.png"
            if report.task == "field":
                draw_field(path, report.picture, mesh)
            else:
                draw_synthesis(path, report.picture)
            written.append(path)
            text.append(f"![{report.task}: {report.picture.example}]({path.name})")
        path = folder / f"twin-{report.task}.json"
        write_json(path, report.results, {"command": command, **report.facts})
        written.append(path)
    path = folder / "twin.md"
    with written_whole(path) as part:
        part.write_text("\n\n".join(text) + "\n", encoding="utf-8")
    return [*written, path]


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


def draw_field(path: Path, picture: ResultPicture, mesh: SkinMesh) -> None:
    """Error by force bin and the example on the skin, fields (V, 3) [m], seen from below."""
    figure = new_figure(13.0, 4.2)
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
    save(figure, path)


def draw_synthesis(path: Path, picture: ResultPicture) -> None:
    """Error by force bin and the example, tared counts of 19 electrodes."""
    figure = new_figure(11.0, 4.2)
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
    save(figure, path)


def ventral_faces(mesh: SkinMesh) -> npt.NDArray[np.int32]:
    """Outer triangles that look down, to the pad's side: what one sees from below, shape (F, 3)."""
    a, b, c = (mesh.nodes[mesh.outer_faces[:, i]] for i in range(3))
    return np.asarray(mesh.outer_faces[np.cross(b - a, c - a)[:, 2] < 0])


def by_force(
    force_n: npt.NDArray[np.floating], error: npt.NDArray[np.float64]
) -> list[npt.NDArray[np.float64]]:
    """Errors (N,) of the rows of each force bin, by their true force magnitude [N], (N,)."""
    return [error[(force_n >= low) & (force_n < high)] for low, high in pairwise(FORCE_BINS_N)]


def _boxes(axis: Any, picture: ResultPicture, factor: float, label: str) -> None:
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
