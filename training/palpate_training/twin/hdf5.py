"""The experiment's data sets on disk: schemas ``palpate.experiment`` and ``palpate.mixed``, v1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from palpate.errors import DatasetError
from palpate_training.twin.container import Column, Tables, read_tables, write_tables
from palpate_training.twin.content import (
    EXPERIMENT_ARRAYS,
    ExperimentDataset,
    FieldBasis,
    MixedDataset,
    SkinMesh,
)

EXPERIMENT_SCHEMA = "palpate.experiment"
MIXED_SCHEMA = "palpate.mixed"
VERSION = 1

UNITS = {"trial_rest": "counts", "travel_m": "m", "force": "N", "location": "m"}
"""Units of the arrays of a trial or row; all others are numbers."""

EXPERIMENT_COLUMNS: dict[str, Column] = {
    **{name: Column("1", str) for name in ("unit_names", "trajectories", "indenters")},
    **{
        name: Column(UNITS.get(name, "1"), dtype)
        for name, (_, _, dtype) in EXPERIMENT_ARRAYS.items()
    },
}

MIXED_COLUMNS: dict[str, Column] = {
    **EXPERIMENT_COLUMNS,
    "simulated_force": Column("N", np.float32),
    "coefficients": Column("m", np.float32),
    "basis/mean": Column("m", np.float32),
    "basis/modes": Column("1", np.float32),
    "mesh/nodes": Column("m", np.float64),
    "mesh/outer_faces": Column("1", np.int32),
    "mesh/inner_faces": Column("1", np.int32),
    "mesh/subset": Column("1", np.int32),
}

_MIXED_NUMBERS = ("loss_mean_m", "loss_max_m", "mesh_sha256")


def write_experiment(path: Path, data: ExperimentDataset) -> str:
    """Write a purely experimental data set; the file appears complete or not at all.

    Returns:
        The content's SHA-256, hex.

    Raises:
        DatasetError: The disk refused.
    """
    tables = _experiment_tables(data)
    return write_tables(path, EXPERIMENT_SCHEMA, VERSION, EXPERIMENT_COLUMNS, tables)


def write_mixed(path: Path, data: MixedDataset) -> str:
    """Write a mixed data set, its basis and its mesh; complete or not at all.

    Returns:
        The content's SHA-256, hex.

    Raises:
        DatasetError: The disk refused.
    """
    return write_tables(path, MIXED_SCHEMA, VERSION, MIXED_COLUMNS, _mixed_tables(data))


def read_experiment(path: Path) -> ExperimentDataset:
    """Read a purely experimental data set and check everything about it.

    Raises:
        DatasetError: The file is missing, damaged, of another schema or version, was changed after
            writing, or its content breaks the schema; names the file and the dataset inside.
    """
    tables = read_tables(path, EXPERIMENT_SCHEMA, VERSION, EXPERIMENT_COLUMNS)
    return _named(path, lambda: _experiment(tables))


def read_mixed(path: Path) -> MixedDataset:
    """Read a mixed data set and check everything about it.

    Raises:
        DatasetError: As for ``read_experiment``.
    """
    tables = read_tables(path, MIXED_SCHEMA, VERSION, MIXED_COLUMNS, _MIXED_NUMBERS)
    arrays, numbers = tables.arrays, tables.numbers

    def build() -> MixedDataset:
        return MixedDataset(
            experiment=_experiment(tables),
            simulated_force=arrays["simulated_force"],
            coefficients=arrays["coefficients"],
            basis=FieldBasis(
                arrays["basis/mean"],
                arrays["basis/modes"],
                float(numbers["loss_mean_m"]),
                float(numbers["loss_max_m"]),
            ),
            mesh=SkinMesh(
                arrays["mesh/nodes"],
                arrays["mesh/outer_faces"],
                arrays["mesh/inner_faces"],
                arrays["mesh/subset"],
                str(numbers["mesh_sha256"]),
            ),
        )

    return _named(path, build)


def content_sha256(data: ExperimentDataset | MixedDataset) -> str:
    """SHA-256 of names, shapes and values, hex: the same as in the file."""
    tables = _mixed_tables(data) if isinstance(data, MixedDataset) else _experiment_tables(data)
    return tables.content_sha256()


Data = TypeVar("Data")


def _named(path: Path, build: Callable[[], Data]) -> Data:
    """Build a data set; what its own checks say is said of the file."""
    try:
        return build()
    except DatasetError as error:
        raise DatasetError(f"{path}: {error.problem}", remedy=error.remedy) from error


def _experiment_tables(data: ExperimentDataset) -> Tables:
    return Tables(
        {
            name: np.array(getattr(data, name), dtype=object)
            if column.dtype is str
            else getattr(data, name)
            for name, column in EXPERIMENT_COLUMNS.items()
        },
        {},
        data.provenance,
    )


def _mixed_tables(data: MixedDataset) -> Tables:
    experiment = _experiment_tables(data.experiment)
    return Tables(
        {
            **experiment.arrays,
            "simulated_force": data.simulated_force,
            "coefficients": data.coefficients,
            "basis/mean": data.basis.mean,
            "basis/modes": data.basis.modes,
            "mesh/nodes": data.mesh.nodes,
            "mesh/outer_faces": data.mesh.outer_faces,
            "mesh/inner_faces": data.mesh.inner_faces,
            "mesh/subset": data.mesh.subset,
        },
        {
            "loss_mean_m": data.basis.loss_mean_m,
            "loss_max_m": data.basis.loss_max_m,
            "mesh_sha256": data.mesh.sha256,
        },
        experiment.provenance,
    )


def _experiment(tables: Tables) -> ExperimentDataset:
    arrays = tables.arrays
    return ExperimentDataset(
        unit_names=tuple(arrays["unit_names"]),
        trajectories=tuple(arrays["trajectories"]),
        indenters=tuple(arrays["indenters"]),
        **{name: arrays[name] for name in EXPERIMENT_ARRAYS},
        provenance=tables.provenance,
    )
