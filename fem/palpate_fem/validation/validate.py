"""Validation: simulated against measured forces, as in the paper's table and figures.

Paper, "Finite element model validation" (methods and results): RMS error of each trajectory by the
formula of the cost, averaged for each indenter, and relative to the greatest force. The alignment
at 0.5 N hides an offset in depth, so the offset is listed too.

If the "measurements" are simulations, this is a self-test of the program and no validation; every
table and figure says so.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean, median

import numpy as np

from palpate.files.atomic import written_whole
from palpate_fem.calibration.alignment import (
    INCREMENTS,
    THRESHOLD_N,
    AlignedCurves,
    AlignmentError,
    align,
    axis_rms_n,
    curve,
    peak_n,
    relative_rms,
    rms_n,
)
from palpate_fem.calibration.measured import SIMULATED, MeasuredIndentation
from palpate_fem.calibration.result import write_json
from palpate_fem.calibration.runs import SimulatedRun
from palpate_fem.result import IndentationOutcome

PAPER_RANGE_N = (0.226, 0.486)
"""Mean RMS force error of the best and the worst indenter (paper, "Finite element model
validation")."""
PAPER_MEDIAN_N = 0.260
"""Median of the indenters' means (same place)."""
PAPER_INDENTER_N = {"texture": 0.226, "ring": 0.486}
"""The indenters whose mean the paper names."""
PAPER_RELATIVE = {"cylinder_small": "least", "sphere_small": "greatest"}
"""Relative errors of which the paper gives the rank, not the value."""


@dataclass(frozen=True, slots=True)
class ComparedTrajectory:
    """One trajectory, compared with its simulation.

    Attributes:
        name: Of the trajectory, with its sensor if the file has several.
        indenter: Its indenter.
        sensor: Its sensor.
        rms_n: RMS force error, sum of the axes [N].
        axis_rms_n: The same for each axis [N].
        peak_n: Greatest measured force in the compared part [N].
        relative: RMS error over the greatest force.
        depth_offset_m: Depth at which the simulation reaches 0.5 N, minus the measured one [m].
        displacement_m: Compared displacement from there [m].
        coverage: Its part of the measured one.
        outcome: How the simulation ended.
        pair: The curves.
    """

    name: str
    indenter: str
    sensor: str
    rms_n: float
    axis_rms_n: tuple[float, ...]
    peak_n: float
    relative: float
    depth_offset_m: float
    displacement_m: float
    coverage: float
    outcome: IndentationOutcome
    pair: AlignedCurves

    @property
    def path_name(self) -> str:
        """Name without the sensor, common to all sensors that were pressed along this path."""
        return self.name.removesuffix(f"/{self.sensor}")


@dataclass(frozen=True, slots=True)
class IndenterErrors:
    """Means over the trajectories of one indenter."""

    indenter: str
    trajectories: int
    rms_n: float
    relative: float
    depth_offset_m: float
    depth_offset_sd_m: float
    coverage: float


@dataclass(frozen=True, slots=True)
class Validation:
    """Result of the comparison of all trajectories.

    Attributes:
        compared: One entry for each compared trajectory, in the order of the measurements.
        excluded: Name and reason of each that was not compared.
        outcomes: How many simulations ended how, those excluded too.
        self_test: Whether the "measurements" are simulations themselves.
        threshold_n: Force at which curves were aligned [N].
    """

    compared: tuple[ComparedTrajectory, ...]
    excluded: dict[str, str]
    outcomes: dict[str, int]
    self_test: bool
    threshold_n: float

    @property
    def by_indenter(self) -> tuple[IndenterErrors, ...]:
        """Means of each indenter, sorted by name."""
        found = []
        for indenter in sorted({item.indenter for item in self.compared}):
            items = [item for item in self.compared if item.indenter == indenter]
            offsets = [item.depth_offset_m for item in items]
            found.append(
                IndenterErrors(
                    indenter,
                    len(items),
                    mean(item.rms_n for item in items),
                    mean(item.relative for item in items),
                    mean(offsets),
                    float(np.std(offsets)),
                    mean(item.coverage for item in items),
                )
            )
        return tuple(found)

    @property
    def median_n(self) -> float:
        """Median of the indenters' mean RMS errors [N]; NaN without any."""
        means = [item.rms_n for item in self.by_indenter]
        return median(means) if means else float("nan")

    @property
    def title(self) -> str:
        """Title of every table and figure."""
        if self.self_test:
            return "SELF-TEST: simulation against simulations, no measurement is involved"
        return "simulation against measurement"


def validate(
    measured: Sequence[MeasuredIndentation],
    simulated: Mapping[str, SimulatedRun],
    refused: Mapping[str, str] | None = None,
    *,
    threshold_n: float = THRESHOLD_N,
    increments: int = INCREMENTS,
) -> Validation:
    """Compare each measured trajectory with its simulation.

    Args:
        measured: Measured trajectories; if they are simulations, this is a self-test.
        simulated: By the name of the measured trajectory, along the same path.
        refused: Why a simulation cannot be used, by the name of the measured trajectory.
        threshold_n: Force at which curves are aligned [N].
        increments: Samples of a curve.
    """
    compared, excluded = [], {}
    for item in measured:
        run = simulated.get(item.name)
        if run is None:
            excluded[item.name] = (refused or {}).get(item.name, "not simulated")
            continue
        try:
            compared.append(_compare(item, run, threshold_n, increments))
        except AlignmentError as error:
            why = f" ({run.outcome}: {run.reason})" if run.reason else ""
            excluded[item.name] = error.problem + (why if error.side == "simulation" else "")
    known = Counter(
        str(simulated[item.name].outcome) for item in measured if item.name in simulated
    )
    return Validation(
        tuple(compared),
        excluded,
        dict(sorted(known.items())),
        any(item.origin == SIMULATED for item in measured),
        threshold_n,
    )


def _compare(
    item: MeasuredIndentation, run: SimulatedRun, threshold_n: float, increments: int
) -> ComparedTrajectory:
    pair = align(
        run.curve, curve(item.pose, item.force), threshold_n=threshold_n, increments=increments
    )
    return ComparedTrajectory(
        item.name,
        item.indenter,
        item.sensor,
        rms_n(pair),
        tuple(axis_rms_n([pair]).tolist()),
        peak_n(pair),
        relative_rms(pair),
        pair.depth_offset_m,
        float(pair.displacement_m[-1]),
        pair.coverage,
        run.outcome,
        pair,
    )


INDENTER_HEADINGS = (
    "indenter",
    "trajectories",
    "RMS [N]",
    "paper [N]",
    "RMS / peak",
    "paper",
    "depth offset [mm]",
    "compared part",
)
TRAJECTORY_HEADINGS = (
    "trajectory",
    "indenter",
    "sensor",
    "rms_n",
    "rms_x_n",
    "rms_y_n",
    "rms_z_n",
    "peak_n",
    "relative",
    "depth_offset_m",
    "displacement_m",
    "coverage",
    "outcome",
    "excluded_because",
)


def indenter_rows(validation: Validation) -> list[tuple[str, ...]]:
    """Cells under ``INDENTER_HEADINGS``; the last row is the median over the indenters."""
    rows: list[tuple[str, ...]] = []
    for item in validation.by_indenter:
        paper = PAPER_INDENTER_N.get(item.indenter)
        offset, spread = item.depth_offset_m * 1e3, item.depth_offset_sd_m * 1e3
        rows.append(
            (
                item.indenter,
                str(item.trajectories),
                f"{item.rms_n:.3f}",
                "" if paper is None else f"{paper:.3f}",
                f"{item.relative:.1%}",
                PAPER_RELATIVE.get(item.indenter, ""),
                f"{offset:+.3f} ± {spread:.3f}",
                f"{item.coverage:.0%}",
            )
        )
    if rows:
        low, high = PAPER_RANGE_N
        paper_text = f"{PAPER_MEDIAN_N:.3f} ({low:.3f}-{high:.3f})"
        total = str(len(validation.compared))
        rows.append(
            ("median of indenters", total, f"{validation.median_n:.3f}", paper_text, "", "", "", "")
        )
    return rows


def summary_lines(validation: Validation) -> list[str]:
    """Lines below the table: kind of comparison, outcomes, what was left out and why."""
    lines = [validation.title]
    ends = ", ".join(f"{count} {name}" for name, count in validation.outcomes.items())
    lines.append(f"simulations: {ends or 'none'}")
    if validation.by_indenter:
        rows = sorted(validation.by_indenter, key=lambda row: row.relative)
        lines.append(
            f"relative error least for {rows[0].indenter} (paper: cylinder small),"
            f" greatest for {rows[-1].indenter} (paper: sphere small)"
        )
    lines.append(f"compared {len(validation.compared)}, left out {len(validation.excluded)}")
    lines += [f"  {name}: {why}" for name, why in validation.excluded.items()]
    return lines


def trajectory_rows(validation: Validation) -> list[tuple[str, ...]]:
    """Cells under ``TRAJECTORY_HEADINGS``, SI; excluded trajectories have their reason only."""
    rows: list[tuple[str, ...]] = []
    for item in validation.compared:
        numbers = (
            item.rms_n,
            *item.axis_rms_n,
            item.peak_n,
            item.relative,
            item.depth_offset_m,
            item.displacement_m,
            item.coverage,
        )
        cells = (f"{number:.6g}" for number in numbers)
        rows.append((item.name, item.indenter, item.sensor, *cells, str(item.outcome), ""))
    blank = ("",) * (len(TRAJECTORY_HEADINGS) - 2)
    return rows + [(name, *blank, why) for name, why in validation.excluded.items()]


def write_report(folder: Path, validation: Validation) -> tuple[Path, Path, Path]:
    """Write ``trajectories.csv``, ``indenters.csv`` and ``validation.json``.

    Args:
        folder: Created if it does not exist.
        validation: What to write.

    Returns:
        The three files.

    Raises:
        DatasetError: The disk refused.
    """
    trajectories, indenters = folder / "trajectories.csv", folder / "indenters.csv"
    _write_csv(trajectories, TRAJECTORY_HEADINGS, trajectory_rows(validation))
    _write_csv(indenters, INDENTER_HEADINGS, indenter_rows(validation))
    content = folder / "validation.json"
    write_json(content, as_json(validation))
    return trajectories, indenters, content


def as_json(validation: Validation) -> dict[str, object]:
    """All numbers [SI], the paper's next to ours, without the curves."""
    compared = []
    for item in validation.compared:
        record = asdict(item)
        del record["pair"]
        compared.append(record)
    return {
        "title": validation.title,
        "self_test": validation.self_test,
        "threshold_n": validation.threshold_n,
        "median_n": validation.median_n,
        "indenters": [asdict(item) for item in validation.by_indenter],
        "trajectories": compared,
        "excluded": validation.excluded,
        "outcomes": validation.outcomes,
        "paper": {
            "range_n": PAPER_RANGE_N,
            "median_n": PAPER_MEDIAN_N,
            "indenters_n": PAPER_INDENTER_N,
        },
    }


def _write_csv(path: Path, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    with written_whole(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([headings, *rows])
