"""Results beside their baselines: one row for each model, as a rich table, Markdown and JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.table import Table

from palpate_training.metrics import cluster_bootstrap, force_errors, force_metrics

Labels = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float32] | npt.NDArray[np.float64]
Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Result:
    """One model on one test.

    Attributes:
        test: What was held out.
        model: Name of the model.
        metrics: By name, averaged over the seeds.
        seed_sd: Standard deviation over the seeds, by name; empty for one.
        interval: 95 % confidence interval by name of the error (median), from whole blocks.
    """

    test: str
    model: str
    metrics: dict[str, float]
    seed_sd: dict[str, float] = field(default_factory=dict)
    interval: dict[str, Interval] = field(default_factory=dict)


def force_result(
    test: str,
    model: str,
    estimates: Sequence[Floats],
    truth: Floats,
    cluster: Labels,
    *,
    draws: int = 2000,
) -> Result:
    """Metrics of one model, from the estimates of each of its seeds.

    Args:
        test: What was held out.
        model: Name of the model.
        estimates: Estimated force [N], shape ``(N, 3)``, one array for each seed.
        truth: True force [N], shape ``(N, 3)``.
        cluster: Block of every row, shape ``(N,)``.
        draws: Draws of the bootstrap.
    """
    each = [force_metrics(estimate, truth) for estimate in estimates]
    errors = [force_errors(estimate, truth) for estimate in estimates]
    stacked = {
        name: np.stack([one[name] for one in errors], axis=1)
        for name in ("magnitude_n", "angle_rad", "vector_n")
    }
    return Result(
        test=test,
        model=model,
        metrics={name: float(np.mean([one[name] for one in each])) for name in each[0]},
        seed_sd={name: float(np.std([one[name] for one in each], ddof=1)) for name in each[0]}
        if len(each) > 1
        else {},
        interval=cluster_bootstrap(stacked, cluster, draws=draws),
    )


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the table: heading, metric, digits, and the interval to put behind it."""

    heading: str
    metric: str
    digits: int
    interval: str = ""


FORCE_COLUMNS = (
    Column("magnitude median [N]", "force_magnitude_median_n", 3, "magnitude_n"),
    Column("mean [N]", "force_magnitude_mean_n", 3),
    Column("IQR [N]", "force_magnitude_iqr_n", 3),
    Column("/ std", "force_magnitude_over_std_median", 2),
    Column("/ norm", "force_magnitude_over_norm_median", 3),
    Column("angle median [rad]", "force_angle_median_rad", 3, "angle_rad"),
    Column("1 - cos", "force_one_minus_cos_median", 4),
    Column("vector median [N]", "force_vector_median_n", 3, "vector_n"),
    Column("RMSE x [N]", "force_rmse_x_n", 3),
    Column("RMSE y [N]", "force_rmse_y_n", 3),
    Column("RMSE z [N]", "force_rmse_z_n", 3),
)


def _cells(result: Result, columns: Sequence[Column]) -> list[str]:
    cells = []
    for column in columns:
        text = f"{result.metrics[column.metric]:.{column.digits}f}"
        if column.interval in result.interval:
            low, high = result.interval[column.interval]
            text += f" ({low:.{column.digits}f}-{high:.{column.digits}f})"
        cells.append(text)
    return cells


def rich_table(results: Sequence[Result], title: str) -> Table:
    """The main columns for a terminal; the Markdown and the JSON hold them all."""
    columns = [column for column in FORCE_COLUMNS if column.interval or column.digits == 4]
    table = Table(title=title)
    for heading in ("held out", "model"):
        table.add_column(heading)
    for column in columns:
        table.add_column(column.heading, justify="right")
    for before, result in zip((None, *results), results, strict=False):
        if before is not None and before.test != result.test:
            table.add_section()
        table.add_row(result.test, result.model, *_cells(result, columns))
    return table


def markdown_table(results: Sequence[Result]) -> str:
    """All columns as a Markdown table."""
    headings = ["held out", "model", *(column.heading for column in FORCE_COLUMNS)]
    lines = ["| " + " | ".join(headings) + " |", "|---|---|" + "---:|" * len(FORCE_COLUMNS)]
    lines += [
        "| " + " | ".join([result.test, result.model, *_cells(result, FORCE_COLUMNS)]) + " |"
        for result in results
    ]
    return "\n".join(lines) + "\n"


def write_json(path: Path, results: Sequence[Result], facts: dict[str, object]) -> None:
    """Write every metric with six digits, and what produced it."""
    rows = [
        {
            "held_out": result.test,
            "model": result.model,
            "metrics": {name: _short(value) for name, value in result.metrics.items()},
            "seed_sd": {name: _short(value) for name, value in result.seed_sd.items()},
            "interval_95": {
                name: [_short(v) for v in ends] for name, ends in result.interval.items()
            },
        }
        for result in results
    ]
    path.write_text(json.dumps({**facts, "results": rows}, indent=1) + "\n", encoding="utf-8")


def _short(value: float) -> float:
    return float(f"{value:.6g}")
