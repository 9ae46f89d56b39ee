"""Results of models on held-out rows, beside their baselines: what every task shares."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.table import Table

from palpate.files.atomic import written_whole
from palpate_training.datasets.experiment import ExperimentDataset, MixedDataset
from palpate_training.figures.style import markdown_table
from palpate_training.learning.fit import FitConfig
from palpate_training.learning.metrics import (
    Rows64,
    cluster_bootstrap,
    force_errors,
    force_metrics,
    root_mean,
)
from palpate_training.learning.splits import Rows, unit_sets

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


FloatArray = npt.NDArray[np.float32]
Errors = dict[str, Rows64]
OnNetwork = Callable[[], None]

ZERO, MEAN, RIDGE, OWN, ALL = "zero", "training mean", "ridge", "network", "network, all units"


@dataclass(frozen=True, slots=True)
class ResultPicture:
    """What the figure of a task shows.

    Attributes:
        force_n: True force magnitude of the held-out rows [N], by unit.
        error: Their error by unit: mean over all nodes [m], or norm in R^19 [counts].
        example: What the example is, for its title.
        truth: Field (V, 3) [m] or tared counts (19,) of the example.
        estimate: The same, estimated.
    """

    force_n: dict[str, Rows64]
    error: dict[str, Rows64]
    example: str
    truth: FloatArray
    estimate: FloatArray


@dataclass(frozen=True, slots=True)
class TaskReport:
    """Results of one task.

    Attributes:
        task: ``field``, ``synthesis``, ``force`` or ``location``.
        results: One for each model and unit.
        facts: What produced them.
        picture: For the figure, if the task has one.
    """

    task: str
    results: list[ModelResult]
    facts: dict[str, object] = field(default_factory=dict)
    picture: ResultPicture | None = None


def networks(data: ExperimentDataset, seeds: int) -> int:
    """How many networks ``evaluate_field`` and ``evaluate_synthesis`` train together."""
    sets = unit_sets(data)
    return seeds * (len(sets) + sum(len(units) == 1 for units in sets))


def typical(error: Rows64, force: FloatArray) -> int:
    """The row whose error (N,) is the median among the half with the larger force (N, 3) [N]."""
    magnitude = np.linalg.norm(force, axis=1)
    hard = np.flatnonzero(magnitude >= np.median(magnitude))
    return int(hard[np.argsort(error[hard], kind="stable")[len(hard) // 2]])


def stack_seeds(errors: Sequence[Errors], names: Sequence[str]) -> dict[str, Rows64]:
    """Errors of every row and seed by name, each of shape ``(N, S)``."""
    return {name: np.stack([one[name] for one in errors], axis=1) for name in names}


def interval_of(errors: Sequence[Errors], cluster: Labels, draws: int) -> dict[str, Interval]:
    """95 % intervals of the headline numbers, whole trajectories drawn with replacement."""
    if "subset_m" in errors[0]:
        stacked = stack_seeds(errors, ("subset_m", "all_m"))
        wanted = {f"nodal_{name}": values for name, values in stacked.items()}
        return cluster_bootstrap(
            wanted, cluster, statistic=lambda values: float(np.nanmean(values)), draws=draws
        )
    stacked = stack_seeds(errors, ("mean_square", "l2_counts"))
    squares = {"electrode_rmse_counts": stacked["mean_square"]}
    rmse = cluster_bootstrap(squares, cluster, statistic=root_mean, draws=draws)
    norm = {"electrode_l2_median_counts": stacked["l2_counts"]}
    return rmse | cluster_bootstrap(norm, cluster, draws=draws)


def result_of(
    test: str,
    model: str,
    errors: Sequence[Errors],
    zero: Errors,
    data: MixedDataset,
    rows: Rows,
    draws: int,
    summary: Callable[[Errors, Errors], dict[str, float]],
) -> ModelResult:
    """One row of the table, averaged over seeds."""
    interval = interval_of(errors, data.experiment.row_trajectory[rows], draws)
    return averaged(test, model, [summary(one, zero) for one in errors], interval)


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


def label_of(units: Sequence[str]) -> str:
    """How a set of units is called in tables."""
    return units[0] if len(units) == 1 else "all units"


def name_of(data: MixedDataset, row: int) -> str:
    """Trial and force of a row, for the title of a picture."""
    trial = int(data.experiment.trial[row])
    force = float(np.linalg.norm(data.experiment.force[row]))
    return f"{data.experiment.trial_name(trial)}, {force:.1f} N"


def facts_of(data: MixedDataset, seeds: int, config: FitConfig) -> dict[str, object]:
    """What produced the results of a task."""
    return {
        "source": data.experiment.provenance.source,
        "rows": len(data),
        "trajectories": len(np.unique(data.experiment.row_trajectory)),
        "seeds": seeds,
        "nodes": len(data.mesh.nodes),
        "basis_loss_mean_m": data.basis.loss_mean,
        "config": asdict(config),
    }
