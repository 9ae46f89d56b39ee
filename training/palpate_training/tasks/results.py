"""Results of models on held-out rows, beside their baselines: what every task shares."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.table import Table

from palpate.files.atomic import written_whole
from palpate_training.figures.style import markdown_table
from palpate_training.learning.metrics import (
    Rows64,
    cluster_bootstrap,
    force_errors,
    force_metrics,
)

Labels = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float32] | npt.NDArray[np.float64]
Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class ModelResult:
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
) -> ModelResult:
    """Metrics of one model, from the force (N, 3) [N] that each of its seeds estimates."""
    errors = [force_errors(estimate, truth) for estimate in estimates]
    stacked = stack_seeds(errors, ("magnitude_n", "angle_rad", "vector_n"))
    seeds = [force_metrics(estimate, truth) for estimate in estimates]
    return averaged(test, model, seeds, cluster_bootstrap(stacked, cluster, draws=draws))


@dataclass(frozen=True, slots=True)
class MetricColumn:
    """A column of a table.

    Attributes:
        heading: With the unit that is shown.
        metric: Name of the metric.
        digits: Behind the point.
        interval: Name of the interval to put behind the value.
        factor: From the metric's unit to the one that is shown.
    """

    heading: str
    metric: str
    digits: int
    interval: str = ""
    factor: float = 1.0

    def show(self, value: float | None) -> str:
        """A value of the metric as text."""
        return "-" if value is None else f"{value * self.factor:.{self.digits}f}"

    def cell(self, result: ModelResult) -> str:
        """The metric of a result, with its interval where there is one."""
        text = self.show(result.metrics[self.metric])
        if self.interval in result.interval:
            low, high = (self.show(end) for end in result.interval[self.interval])
            text += f" ({low}-{high})"
        return text


FORCE_COLUMNS = (
    MetricColumn("magnitude median [N]", "force_magnitude_median_n", 3, "magnitude_n"),
    MetricColumn("mean [N]", "force_magnitude_mean_n", 3),
    MetricColumn("IQR [N]", "force_magnitude_iqr_n", 3),
    MetricColumn("/ std", "force_magnitude_over_std_median", 2),
    MetricColumn("/ norm", "force_magnitude_over_norm_median", 3),
    MetricColumn("angle median [rad]", "force_angle_median_rad", 3, "angle_rad"),
    MetricColumn("1 - cos", "force_one_minus_cos_median", 4),
    MetricColumn("vector median [N]", "force_vector_median_n", 3, "vector_n"),
    MetricColumn("RMSE x [N]", "force_rmse_x_n", 3),
    MetricColumn("RMSE y [N]", "force_rmse_y_n", 3),
    MetricColumn("RMSE z [N]", "force_rmse_z_n", 3),
)


def rich_table(results: Sequence[ModelResult], title: str) -> Table:
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
        table.add_row(result.test, result.model, *(column.cell(result) for column in columns))
    return table


def force_table(results: Sequence[ModelResult]) -> str:
    """All columns as a Markdown table."""
    headings = ["held out", "model", *(column.heading for column in FORCE_COLUMNS)]
    rows = [
        [result.test, result.model, *(column.cell(result) for column in FORCE_COLUMNS)]
        for result in results
    ]
    return markdown_table(headings, rows, words=2)


def write_json(path: Path, results: Sequence[ModelResult], facts: dict[str, object]) -> None:
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
    text = json.dumps({**facts, "results": rows}, indent=1) + "\n"
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


def _short(value: float) -> float:
    return float(f"{value:.6g}")


Errors = dict[str, Rows64]
OnNetwork = Callable[[], None]


def stack_seeds(errors: Sequence[Errors], names: Sequence[str]) -> dict[str, Rows64]:
    """Errors of every row and seed by name, each of shape ``(N, S)``."""
    return {name: np.stack([one[name] for one in errors], axis=1) for name in names}


def averaged(
    test: str,
    model: str,
    seeds: Sequence[dict[str, float]],
    interval: dict[str, Interval],
) -> ModelResult:
    """Metrics averaged over seeds, with their standard deviation where there are several."""
    values = {name: [one[name] for one in seeds] for name in seeds[0]}
    means = {name: float(np.mean(each)) for name, each in values.items()}
    sd = {name: float(np.std(each, ddof=1)) for name, each in values.items() if len(seeds) > 1}
    return ModelResult(test, model, means, sd, interval)


def tick(on_network: OnNetwork | None) -> None:
    """One more network is trained."""
    if on_network is not None:
        on_network()
