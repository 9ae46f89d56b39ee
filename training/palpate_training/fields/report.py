"""Tables of the twin beside the paper's numbers: Markdown for people, JSON with every metric."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from palpate_training.evaluate import Result, write_json
from palpate_training.fields.evaluate import TaskReport
from palpate_training.fields.paper import PAPER
from palpate_training.fields.pictures import draw_field, draw_synthesis
from palpate_training.twin.content import SkinMesh

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


def _cell(result: Result, column: Column) -> str:
    text = _known(result.metrics[column.metric], column)
    if column.interval in result.interval:
        low, high = (_known(end, column) for end in result.interval[column.interval])
        text += f" ({low}-{high})"
    return text


def _known(value: float | None, column: Column) -> str:
    return "-" if value is None else f"{value * column.factor:.{column.digits}f}"
