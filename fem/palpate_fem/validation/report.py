"""A validation as tables, CSV and JSON, with the paper's numbers beside ours."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from palpate.errors import DatasetError
from palpate_fem.calibration.result import write_json
from palpate_fem.validation.validate import (
    PAPER_INDENTER_N,
    PAPER_MEDIAN_N,
    PAPER_RANGE_N,
    PAPER_RELATIVE,
    Validation,
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
    """What must be said beside the table: kind, outcomes, what was left out and why."""
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
        folder: Made if it is not there.
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
    """All numbers [SI], the paper's beside ours, without the curves."""
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
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows(rows)
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text.getvalue(), "utf-8")
        os.replace(partial, path)
    except OSError as error:
        raise DatasetError(
            f"cannot write {path}: {error}", remedy="check the folder's rights and free space"
        ) from error
