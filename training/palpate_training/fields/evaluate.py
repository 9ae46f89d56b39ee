"""Results of networks and their rivals on held-out trajectories: what every task shares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from palpate_training.evaluate import Result
from palpate_training.fields.fit import FitConfig
from palpate_training.fields.metrics import Rows64, root_mean
from palpate_training.fields.split import unit_sets
from palpate_training.metrics import cluster_bootstrap
from palpate_training.splits import Rows
from palpate_training.twin.content import ExperimentDataset, MixedDataset

FloatArray = npt.NDArray[np.float32]
Errors = dict[str, Rows64]
OnNetwork = Callable[[], None]

ZERO, MEAN, RIDGE, OWN, ALL = "zero", "training mean", "ridge", "network", "network, all units"


@dataclass(frozen=True, slots=True)
class Picture:
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
    results: list[Result]
    facts: dict[str, object] = field(default_factory=dict)
    picture: Picture | None = None


def networks(data: ExperimentDataset, seeds: int) -> int:
    """How many networks ``evaluate_field`` and ``evaluate_synthesis`` train together."""
    sets = unit_sets(data)
    return seeds * (len(sets) + sum(len(units) == 1 for units in sets))


def typical(error: Rows64, force: FloatArray) -> int:
    """The row whose error is the median among the harder half of the presses.

    Args:
        error: Error of every row, shape (N,).
        force: True force [N], shape (N, 3).
    """
    magnitude = np.linalg.norm(force, axis=1)
    hard = np.flatnonzero(magnitude >= np.median(magnitude))
    return int(hard[np.argsort(error[hard], kind="stable")[len(hard) // 2]])


def interval_of(
    errors: Sequence[Errors], cluster: npt.NDArray[np.int32], draws: int
) -> dict[str, tuple[float, float]]:
    """95 % intervals of the headline numbers, whole trajectories drawn with replacement."""

    def stack(name: str) -> Rows64:
        return np.stack([one[name] for one in errors], axis=1)

    if "subset_m" in errors[0]:
        wanted = {f"nodal_{name}": stack(name) for name in ("subset_m", "all_m")}
        return cluster_bootstrap(
            wanted, cluster, statistic=lambda values: float(np.nanmean(values)), draws=draws
        )
    rmse = cluster_bootstrap(
        {"electrode_rmse_counts": stack("mean_square")}, cluster, statistic=root_mean, draws=draws
    )
    norm = {"electrode_l2_median_counts": stack("l2_counts")}
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
) -> Result:
    """One row of the table, averaged over seeds.

    Args:
        test: What was held out.
        model: Name of the model.
        errors: Errors of every row, one for each seed.
        zero: Those of predicting zero.
        data: Rows with their trajectories.
        rows: The held-out rows.
        draws: Draws of the bootstrap.
        summary: Metrics of one seed, from its errors and those of predicting zero.
    """
    interval = interval_of(errors, data.experiment.row_trajectory[rows], draws)
    return averaged(test, model, [summary(one, zero) for one in errors], interval)


def averaged(
    test: str,
    model: str,
    seeds: Sequence[dict[str, float]],
    interval: dict[str, tuple[float, float]],
) -> Result:
    """Metrics averaged over seeds, with their standard deviation where there are several.

    Args:
        test: What was held out.
        model: Name of the model.
        seeds: Metrics of each seed.
        interval: 95 % intervals by name.
    """
    values = {name: [one[name] for one in seeds] for name in seeds[0]}
    return Result(
        test,
        model,
        {name: float(np.mean(each)) for name, each in values.items()},
        {name: float(np.std(each, ddof=1)) for name, each in values.items()}
        if len(seeds) > 1
        else {},
        interval,
    )


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


def facts_of(data: MixedDataset, seeds: int, config: FitConfig | None) -> dict[str, object]:
    """What produced the results of a task."""
    config = config or FitConfig()
    return {
        "source": data.experiment.provenance.source,
        "rows": len(data),
        "trajectories": len(np.unique(data.experiment.row_trajectory)),
        "seeds": seeds,
        "nodes": len(data.mesh.nodes),
        "basis_loss_mean_m": data.basis.loss_mean_m,
        "config": {key: getattr(config, key) for key in FitConfig.__slots__},
    }
