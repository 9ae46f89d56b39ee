"""What a data set of the experiment holds, in numbers: of either schema, or the published files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from palpate.errors import DatasetError
from palpate.files.hdf5 import schema_of
from palpate_training.datasets.experiment import (
    EXPERIMENT_SCHEMA,
    MIXED_SCHEMA,
    ExperimentDataset,
    MixedDataset,
    content_sha256,
    read_experiment,
    read_mixed,
)
from palpate_training.datasets.published import published_unit, read_published

PUBLISHED = "published layout"


@dataclass(frozen=True, slots=True)
class SpecimenContents:
    """What a data set holds of one BioTac.

    Attributes:
        unit: Its name.
        trials: Trials.
        indenters: Different indenters.
        rows: Rows.
        tared_min: Smallest tared value over all electrodes, over full scale [1].
        tared_max: Largest.
        force_max_n: Largest magnitude [N].
        electrode_sd: Standard deviation of each electrode's tared values [1], E1 to E19.
    """

    unit: str
    trials: int
    indenters: int
    rows: int
    tared_min: float
    tared_max: float
    force_max_n: float
    electrode_sd: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ExperimentContents:
    """What a data set holds.

    Attributes:
        kind: Its schema, or ``published layout``.
        trajectories: Unique trajectories.
        trials: Their executions.
        rows: Time steps.
        units: Of each BioTac.
        content_sha256: Hash over names, shapes and values, hex.
        provenance: Where it comes from, by key.
        modes: Modes of the displacement field; 0 where there is none.
        nodes: Nodes of the field; 0 where there is none.
        field_loss_mean_m: What the fields lost on average when compressed [m].
        field_loss_max_m: What they lost at most [m].
        force_rms_n: Root mean square of simulated minus measured force, over components [N].
    """

    kind: str
    trajectories: int
    trials: int
    rows: int
    units: tuple[SpecimenContents, ...]
    content_sha256: str
    provenance: dict[str, str]
    modes: int = 0
    nodes: int = 0
    field_loss_mean_m: float = 0.0
    field_loss_max_m: float = 0.0
    force_rms_n: float = 0.0


def load(
    path: Path,
    *,
    axes: Sequence[str] = ("x", "y", "z"),
    force_on_indenter: bool = False,
    others: Sequence[str] = (),
) -> tuple[str, ExperimentDataset | MixedDataset]:
    """Read whatever lies there, and say what it is: either schema, or a folder of published files.

    Args:
        path: A file, a folder with published files, or one of these files; of a folder the BioTacs
            that are there are read.
        axes: Of published files, as in ``read_published``.
        force_on_indenter: Likewise.
        others: Schemas that the caller takes, too, for the error.

    Raises:
        DatasetError: It is none of these, or damaged.
    """
    if path.is_dir():
        return PUBLISHED, read_published(path, axes=axes, force_on_indenter=force_on_indenter)
    unit = published_unit(path)
    if unit is not None:
        return PUBLISHED, read_published(
            path.parent, units=[unit], axes=axes, force_on_indenter=force_on_indenter
        )
    schema = schema_of(path, extra="training")
    if schema == EXPERIMENT_SCHEMA.name:
        return schema, read_experiment(path)
    if schema == MIXED_SCHEMA.name:
        return schema, read_mixed(path)
    *first, last = map(repr, (*others, EXPERIMENT_SCHEMA.name, MIXED_SCHEMA.name))
    raise DatasetError(
        f"{path}: schema is {schema or 'not stated'!r}, expected {', '.join(first)} or {last}",
        remedy="give a file that palpate wrote, or the folder with biotac1.hdf5 and so on",
    )


def contents(kind: str, data: ExperimentDataset | MixedDataset) -> ExperimentContents:
    """Count and measure a data set."""
    rows = data.experiment if isinstance(data, MixedDataset) else data
    plain = ExperimentContents(
        kind=kind,
        trajectories=len(rows.trajectories),
        trials=rows.trials,
        rows=len(rows),
        units=tuple(_unit(rows, unit) for unit in np.unique(rows.trial_unit)),
        content_sha256=content_sha256(data),
        provenance=asdict(rows.provenance),
    )
    if not isinstance(data, MixedDataset):
        return plain
    return replace(
        plain,
        modes=len(data.basis.modes),
        nodes=len(data.mesh.nodes),
        field_loss_mean_m=data.basis.loss_mean,
        field_loss_max_m=data.basis.loss_max,
        force_rms_n=float(np.sqrt(np.mean((data.simulated_force - rows.force) ** 2))),
    )


def _unit(data: ExperimentDataset, unit: int) -> SpecimenContents:
    mine = data.row_unit == unit
    trials = data.trial_unit == unit
    tared = data.tared[mine].astype(np.float64)
    trajectories = data.trial_trajectory[trials]
    return SpecimenContents(
        unit=data.unit_names[unit],
        trials=int(trials.sum()),
        indenters=len({data.indenters[i] for i in trajectories}),
        rows=int(mine.sum()),
        tared_min=float(tared.min()),
        tared_max=float(tared.max()),
        force_max_n=float(np.linalg.norm(data.force[mine], axis=1).max()),
        electrode_sd=tuple(float(sd) for sd in tared.std(axis=0)),
    )
