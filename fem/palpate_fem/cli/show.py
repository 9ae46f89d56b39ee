"""Tables, progress and JSON of the finite-element commands."""

from __future__ import annotations

import json
import math
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.service.batch import FAILED, BatchReport
from palpate_fem.store.content import StoredFingertip, TrajectorySummary

console = Console(stderr=True)
"""Progress and remarks; results go to stdout."""

_COLUMNS = ("pose", "force", "torque", "centre_of_pressure")
_SHOWN_EARLY = 40


class _Info(ProgressColumn):
    """The ``info`` of a task, if it has one."""

    def render(self, task: Task) -> Text:
        return Text(str(task.fields.get("info", "")))


def progress_bar() -> Progress:
    """A bar on stderr; tasks may carry ``info``, a text behind the bar."""
    return Progress(
        TextColumn("{task.description:10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        _Info(),
        console=console,
        transient=True,
    )


def show_trajectory(fingertip: StoredFingertip, trajectory: IndentationResult) -> None:
    """Its steps, one a row."""
    ending = trajectory.outcome.value + (f": {trajectory.reason}" if trajectory.reason else "")
    table = Table(
        title=f"{trajectory.indenter}: {ending}",
        caption=f"{len(fingertip.mesh.nodes):,} nodes, "
        f"fluid {fingertip.fluid_pressure_pa / 1e3:.1f} kPa, "
        f"{fingertip.total_thickness_m * 1e3:.2f} mm; {trajectory.seconds:.1f} s",
    )
    for heading in ("step", "travel mm", "|F| N", "Fx", "Fy", "Fz", "p kPa", "area mm²", "Newton"):
        table.add_column(heading, justify="right")
    places = np.array([trajectory.path[0], *(step.pose for step in trajectory.steps)])[:, :3]
    travel = np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)) * 1e3
    for number, step in enumerate(trajectory.steps):
        table.add_row(
            str(number + 1),
            f"{travel[number]:.3f}",
            f"{np.linalg.norm(step.force):.3f}",
            *(f"{component:.3f}" for component in step.force),
            f"{step.fluid_pressure_pa / 1e3:.2f}",
            f"{step.contact_area_m2 * 1e6:.2f}",
            str(step.convergence.iterations),
        )
    Console().print(table)


def show_summaries(store: Path, names: Sequence[str]) -> None:
    """What a store holds of these trajectories, one row for each indenter."""
    from palpate_fem.store.read import SimulationStore

    opened = SimulationStore.open(store)
    there = set(opened.ids())
    rows: dict[str, list[TrajectorySummary]] = defaultdict(list)
    for name in names:
        if name in there:
            summary = opened.summary(name)
            rows[summary.indenter].append(summary)
    table = Table(title=str(store))
    for heading in ("indenter", "run", "complete", "force limit", "other", "peak |F| N", "s each"):
        table.add_column(heading, justify="left" if heading == "indenter" else "right")
    for indenter, found in rows.items():
        complete, limit = (
            sum(summary.outcome is how for summary in found)
            for how in (IndentationOutcome.COMPLETE, IndentationOutcome.FORCE_LIMIT)
        )
        peaks = [np.linalg.norm(s.force, axis=1).max() for s in found if len(s.force)]
        table.add_row(
            indenter,
            str(len(found)),
            str(complete),
            str(limit),
            str(len(found) - complete - limit),
            f"{min(peaks):.2f} - {max(peaks):.2f}" if peaks else "",
            f"{statistics.median(summary.seconds for summary in found):.1f}",
        )
    Console().print(table)


def show_report(report: BatchReport, present: int, store: Path | None) -> None:
    """Every early end, and the sum of it all."""
    if report.early:
        table = Table(title="did not complete")
        for heading in ("trajectory", "how", "steps", "why"):
            table.add_column(heading, overflow="fold")
        for early in report.early[:_SHOWN_EARLY]:
            table.add_row(
                early.name, early.how, f"{early.steps} of {early.steps_total}", early.reason
            )
        if len(report.early) > _SHOWN_EARLY:
            table.caption = f"and {len(report.early) - _SHOWN_EARLY} more"
        Console().print(table)
    counts = ", ".join(f"{count} {how}" for how, count in sorted(report.outcomes.items()))
    parts = [f"{report.done} of {report.total} run" + (f": {counts}" if counts else "")]
    if present:
        parts.append(f"{present} were there already")
    if report.stopped:
        parts.append("stopped early; the same command goes on" if store else "stopped early")
    if report.failed and store:
        parts.append(f"{report.failed} {FAILED}: the same command tries them again")
    Console().print("; ".join(parts), soft_wrap=True, markup=False, highlight=False)


def write_json(
    fingertip: StoredFingertip,
    trajectories: Sequence[IndentationResult],
    report: BatchReport,
    present: int,
) -> None:
    """All of it but the fields, on stdout."""
    content = {
        "fingertip": {
            "mesh": fingertip.mesh.name,
            "mesh_sha256": fingertip.mesh.sha256.hex(),
            "nodes": len(fingertip.mesh.nodes),
            "parameters": asdict(fingertip.parameters),
            "fluid_pressure_pa": fingertip.fluid_pressure_pa,
            "fluid_volume_m3": fingertip.fluid_volume_m3,
            "total_thickness_m": fingertip.total_thickness_m,
        },
        "outcomes": dict(report.outcomes),
        "present": present,
        "stopped": report.stopped,
        "early": [asdict(early) for early in report.early],
        "trajectories": [
            {
                "indenter": trajectory.indenter,
                "outcome": trajectory.outcome.value,
                "reason": trajectory.reason,
                "travel_m": trajectory.travel_m,
                "seconds": trajectory.seconds,
                "steps": [_plain(step) for step in trajectory.steps],
            }
            for trajectory in trajectories
        ],
    }
    typer.echo(json.dumps(content, indent=1, allow_nan=False))


def _plain(step: IndentationStep) -> dict[str, object]:
    """A step without its fields; NaN, which JSON has not, as None."""
    return {
        **{
            name: [
                value if math.isfinite(value) else None for value in getattr(step, name).tolist()
            ]
            for name in _COLUMNS
        },
        "fluid_pressure_pa": step.fluid_pressure_pa,
        "contact_area_m2": step.contact_area_m2,
        "convergence": asdict(step.convergence),
    }
