"""The two data sets of the paper, in memory and on disk: experimental, mixed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.files.hdf5 import Hdf5Schema
from palpate_training.datasets.container import (
    Provenance,
    StoredColumn,
    StoredTables,
    read_tables,
    write_tables,
)
from palpate_training.datasets.features import ELECTRODES

FloatArray = npt.NDArray[np.float32]
IndexArray = npt.NDArray[np.int32]

EXPERIMENT_ARRAYS: dict[str, tuple[bool, tuple[int, ...], type[np.generic]]] = {
    "trial_unit": (True, (), np.int32),
    "trial_trajectory": (True, (), np.int32),
    "trial_rest": (True, (ELECTRODES,), np.float32),
    "trial": (False, (), np.int32),
    "travel_m": (False, (), np.float32),
    "tared": (False, (ELECTRODES,), np.float32),
    "force": (False, (3,), np.float32),
    "location": (False, (3,), np.float32),
}
"""Whether there is one for each trial (else for each row), shape of one, type."""


@dataclass(frozen=True, slots=True)
class ExperimentDataset:
    """Rows of all trials, trial after trial; sensor frame, SI.

    Attributes:
        unit_names: Names of the BioTacs.
        trajectories: Id of each unique trajectory.
        indenters: Indenter of each unique trajectory, by name, aligned with ``trajectories``.
        trial_unit: Index into ``unit_names`` of each trial, shape (M,).
        trial_trajectory: Index into ``trajectories`` of each trial, shape (M,).
        trial_rest: Untouched counts of each trial [counts], shape (M, 19); NaN where the source,
            such as the published files, does not hold them.
        trial: Index of the trial of each row, shape (N,), never decreasing.
        travel_m: Travel since 0.5 N [m], shape (N,).
        tared: Tared electrodes over full scale [1], shape (N, 19).
        force: Force on the BioTac [N], shape (N, 3).
        location: Contact location [m], shape (N, 3).
        provenance: Where it comes from.
    """

    unit_names: tuple[str, ...]
    trajectories: tuple[str, ...]
    indenters: tuple[str, ...]
    trial_unit: IndexArray
    trial_trajectory: IndexArray
    trial_rest: FloatArray
    trial: IndexArray
    travel_m: FloatArray
    tared: FloatArray
    force: FloatArray
    location: FloatArray
    provenance: Provenance

    def __post_init__(self) -> None:
        _check_arrays(self)
        _check_trials(self)

    def __len__(self) -> int:
        return len(self.trial)

    @property
    def trials(self) -> int:
        """How many trials there are, M."""
        return len(self.trial_unit)

    def trial_name(self, trial: int) -> str:
        """Unit and trajectory of a trial, as messages name it."""
        unit = self.unit_names[self.trial_unit[trial]]
        return f"{unit} {self.trajectories[self.trial_trajectory[trial]]}"

    def rows_of(self, trial: int) -> slice:
        """The rows of a trial, which are contiguous."""
        first, last = np.searchsorted(self.trial, [trial, trial + 1])
        return slice(int(first), int(last))

    @property
    def row_unit(self) -> IndexArray:
        """Unit of each row, shape (N,)."""
        return self.trial_unit[self.trial]

    @property
    def row_trajectory(self) -> IndexArray:
        """Unique trajectory of each row, shape (N,): what is held out together."""
        return self.trial_trajectory[self.trial]


@dataclass(frozen=True, slots=True)
class SkinMesh:
    """The skin whose nodes a field belongs to.

    Attributes:
        nodes: Pressurised positions [m], shape (V, 3).
        outer_faces: Triangles of the outer surface, outward, shape (F, 3).
        inner_faces: Triangles of the inner surface, shape (G, 3).
        subset: The 128 ventral nodes that errors are counted on as in the paper, shape (128,).
        sha256: Content hash of the mesh, hex.
    """

    nodes: npt.NDArray[np.float64]
    outer_faces: IndexArray
    inner_faces: IndexArray
    subset: IndexArray
    sha256: str

    @property
    def outer_nodes(self) -> IndexArray:
        """Nodes of the outer surface, ascending, shape (O,)."""
        return np.unique(self.outer_faces)

    def areas(self, faces: IndexArray) -> npt.NDArray[np.float64]:
        """Each node's share of the area of some triangles [m2], shape (V,)."""
        corners = self.nodes[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        third = np.linalg.norm(cross, axis=1) / 6.0
        shares = np.bincount(faces.ravel(), np.repeat(third, 3), minlength=len(self.nodes))
        return np.asarray(shares, np.float64)


@dataclass(frozen=True, slots=True)
class FieldBasis:
    """Fields of three values a node as few numbers: field = mean + coefficients @ modes.

    All but the modes is in the unit of the fields: m of displacements, N of forces.

    Attributes:
        mean: Shape (V, 3).
        modes: Orthonormal over all 3 V values, shape (K, V, 3).
        loss_mean: Mean nodal distance between the fields and their compressed form.
        loss_max: Largest such distance of any node and row.
        step: Coefficients that are made with this basis are multiples of it; 0 = not rounded, or
            not known, as files do not hold it.
    """

    mean: FloatArray
    modes: FloatArray
    loss_mean: float
    loss_max: float
    step: float = 0.0

    def decode(self, coefficients: FloatArray) -> FloatArray:
        """Fields, shape (N, V, 3), of coefficients (N, K)."""
        flat = self.modes.reshape(len(self.modes), -1)
        field = coefficients @ flat
        field += self.mean.reshape(-1)
        return np.asarray(field.reshape(-1, *self.mean.shape), np.float32)


@dataclass(frozen=True, slots=True)
class SimulatedContact:
    """How the indenter bears on the skin in the simulation, row by row.

    Attributes:
        centre: Centre of pressure on the deformed skin [m], shape (N, 3).
        normal: Contact normal, out of the skin, of unit length, shape (N, 3).
        coefficients: Of the contact forces of each row [N], shape (N, K); rounded as those of the
            displacement are.
        basis: What they are coefficients of: forces on the nodes of the outer surface [N], shape
            (O, 3).
    """

    centre: FloatArray
    normal: FloatArray
    coefficients: FloatArray
    basis: FieldBasis


@dataclass(frozen=True, slots=True)
class MixedDataset:
    """Experiment and simulation row by row, 20 rows a trial.

    The field of a trajectory is stored once for each trial, as the rows' travel differs by trial.

    Attributes:
        experiment: The measured side.
        simulated_force: [N], shape (N, 3).
        coefficients: Of the field of each row [m], shape (N, K): multiples of a power of two that
            is fine beside the basis's loss, which is measured with them.
        basis: What they are coefficients of.
        mesh: Whose nodes move.
        contact: How the indenter bears on the skin; None where the source does not say.
    """

    experiment: ExperimentDataset
    simulated_force: FloatArray
    coefficients: FloatArray
    basis: FieldBasis
    mesh: SkinMesh
    contact: SimulatedContact | None = None

    def __post_init__(self) -> None:
        rows, modes = len(self.experiment), len(self.basis.modes)
        _check_array("simulated_force", self.simulated_force, (rows, 3), np.float32)
        _check_array("coefficients", self.coefficients, (rows, modes), np.float32)
        _check_array("basis modes", self.basis.modes, (modes, *self.mesh.nodes.shape), np.float32)
        _check_array("basis mean", self.basis.mean, self.mesh.nodes.shape, np.float32)
        for name in ("simulated_force", "coefficients"):
            _check_finite(self.experiment, name, getattr(self, name))
        if self.contact is not None:
            basis = self.contact.basis
            outer = (len(self.mesh.outer_nodes), 3)
            for name, array, shape in (
                ("contact centre", self.contact.centre, (rows, 3)),
                ("contact normal", self.contact.normal, (rows, 3)),
                ("contact coefficients", self.contact.coefficients, (rows, len(basis.modes))),
                ("contact basis modes", basis.modes, (len(basis.modes), *outer)),
                ("contact basis mean", basis.mean, outer),
            ):
                _check_array(name, array, shape, np.float32)
                if len(array) == rows:
                    _check_finite(self.experiment, name, array)

    def __len__(self) -> int:
        return len(self.experiment)

    def displacement(self, rows: slice | IndexArray | npt.NDArray[np.int64]) -> FloatArray:
        """Nodal displacement of some rows [m], shape (R, V, 3)."""
        return self.basis.decode(self.coefficients[rows])


def _check_array(
    name: str,
    array: npt.NDArray[np.generic],
    shape: tuple[int, ...],
    dtype: type[np.generic],
) -> None:
    if array.shape != shape or array.dtype != dtype:
        raise DatasetError(
            f"{name} is {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape}",
            remedy="use palpate_training.datasets.assembly, which makes all arrays alike",
        )


def _check_arrays(data: ExperimentDataset) -> None:
    if min(len(data.trial), data.trials) == 0:
        raise DatasetError("no rows", remedy="process or ingest at least one trial")
    for name, (of_trial, shape, dtype) in EXPERIMENT_ARRAYS.items():
        count = len(data.trial_unit) if of_trial else len(data.trial)
        _check_array(name, getattr(data, name), (count, *shape), dtype)


def _check_trials(data: ExperimentDataset) -> None:
    for what, names in (("unit", data.unit_names), ("trajectory", data.trajectories)):
        if len(set(names)) != len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise DatasetError(f"{what} {twice!r} is named twice", remedy="name each once")
    if len(data.indenters) != len(data.trajectories):
        raise DatasetError(
            f"{len(data.indenters)} indenters for {len(data.trajectories)} trajectories",
            remedy="name the indenter of each unique trajectory",
        )
    for name, index, count in (
        ("trial_unit", data.trial_unit, len(data.unit_names)),
        ("trial_trajectory", data.trial_trajectory, len(data.trajectories)),
    ):
        if index.min() < 0 or index.max() >= count:
            raise DatasetError(
                f"{name} holds {index.min()}..{index.max()}, but {count} are named",
                remedy=f"{name} is an index into the names, from 0",
            )
    if not np.array_equal(np.unique(data.trial), np.arange(data.trials)):
        raise DatasetError(
            f"trial must hold each of 0..{data.trials - 1}",
            remedy="give every trial at least one row, and every row the index of its trial",
        )
    if (np.diff(data.trial) < 0).any():
        row = int(np.flatnonzero(np.diff(data.trial) < 0)[0]) + 1
        raise DatasetError(
            f"row {row} belongs to an earlier trial than the row before it",
            remedy="write rows trial after trial",
        )
    pairs = np.stack([data.trial_unit, data.trial_trajectory], axis=1)
    _, first, counts = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        raise DatasetError(
            f"{data.trial_name(int(first[counts > 1][0]))} is there twice",
            remedy="a unit executes a trajectory once; remove one of the trials",
        )
    if np.isinf(data.trial_rest).any():
        raise DatasetError("trial_rest is infinite", remedy="write NaN where it is not known")
    for name in ("travel_m", "tared", "force", "location"):
        _check_finite(data, name, getattr(data, name))


def _check_finite(data: ExperimentDataset, name: str, values: FloatArray) -> None:
    bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    if bad.size:
        raise DatasetError(
            f"{name} is not finite in row {bad[0]}, trial"
            f" {data.trial_name(int(data.trial[bad[0]]))} ({bad.size} rows in all)",
            remedy="drop these rows where the data set is made",
        )


EXPERIMENT_SCHEMA = Hdf5Schema(
    "palpate.experiment", 1, "`palpate data inspect` shows what the file is"
)
MIXED_SCHEMA = Hdf5Schema("palpate.mixed", 1, "`palpate data inspect` shows what the file is")

UNITS = {"trial_rest": "counts", "travel_m": "m", "force": "N", "location": "m"}
"""Units of the arrays of a trial or row; all others are numbers."""

EXPERIMENT_COLUMNS: dict[str, StoredColumn] = {
    **{name: StoredColumn("1", str) for name in ("unit_names", "trajectories", "indenters")},
    **{
        name: StoredColumn(UNITS.get(name, "1"), dtype)
        for name, (_, _, dtype) in EXPERIMENT_ARRAYS.items()
    },
}

MIXED_COLUMNS: dict[str, StoredColumn] = {
    **EXPERIMENT_COLUMNS,
    "simulated_force": StoredColumn("N", np.float32),
    "coefficients": StoredColumn("m", np.float32),
    "basis/mean": StoredColumn("m", np.float32),
    "basis/modes": StoredColumn("1", np.float32),
    "mesh/nodes": StoredColumn("m", np.float64),
    "mesh/outer_faces": StoredColumn("1", np.int32),
    "mesh/inner_faces": StoredColumn("1", np.int32),
    "mesh/subset": StoredColumn("1", np.int32),
}

CONTACT_COLUMNS: dict[str, StoredColumn] = {
    "contact/centre": StoredColumn("m", np.float32),
    "contact/normal": StoredColumn("1", np.float32),
    "contact/coefficients": StoredColumn("N", np.float32),
    "contact/basis/mean": StoredColumn("N", np.float32),
    "contact/basis/modes": StoredColumn("1", np.float32),
}
"""Of mixed data sets that say how the indenter bears on the skin."""

_MIXED_NUMBERS = ("loss_mean_m", "loss_max_m", "mesh_sha256")
_CONTACT_NUMBERS = ("contact_loss_mean_n", "contact_loss_max_n")


def write_experiment(path: Path, data: ExperimentDataset) -> str:
    """Write a purely experimental data set, complete or not at all; returns its SHA-256, hex.

    Raises:
        DatasetError: The disk refused.
    """
    tables = _experiment_tables(data)
    return write_tables(path, EXPERIMENT_SCHEMA, EXPERIMENT_COLUMNS, tables)


def write_mixed(path: Path, data: MixedDataset) -> str:
    """Write a mixed data set with basis and mesh, complete or not at all; its SHA-256, hex.

    Raises:
        DatasetError: The disk refused.
    """
    return write_tables(path, MIXED_SCHEMA, _mixed_columns(data), _mixed_tables(data))


def read_experiment(path: str | Path) -> ExperimentDataset:
    """Read a purely experimental data set and check everything about it.

    Raises:
        DatasetError: The file is missing, damaged, of another schema or version, was changed after
            writing, or its content breaks the schema; names the file and the dataset inside.
    """
    path = Path(path)
    tables = read_tables(path, EXPERIMENT_SCHEMA, EXPERIMENT_COLUMNS)
    return _named(path, lambda: _experiment(tables))


def read_mixed(path: str | Path) -> MixedDataset:
    """Read a mixed data set and check everything about it.

    Raises:
        DatasetError: As for ``read_experiment``.
    """
    path = Path(path)
    tables = read_tables(
        path,
        MIXED_SCHEMA,
        MIXED_COLUMNS,
        _MIXED_NUMBERS,
        optional=CONTACT_COLUMNS,
        optional_numbers=_CONTACT_NUMBERS,
    )
    arrays, numbers = tables.arrays, tables.numbers

    def part(group: str) -> dict[str, Any]:
        """Arrays of a group, by their own names."""
        named = {k: v for k, v in arrays.items() if k.rpartition("/")[0] == group}
        return {name.rpartition("/")[2]: array for name, array in named.items()}

    def basis(group: str, loss_mean: str, loss_max: str) -> FieldBasis:
        losses = float(numbers[loss_mean]), float(numbers[loss_max])
        return FieldBasis(part(group)["mean"], part(group)["modes"], *losses)

    def build() -> MixedDataset:
        contact = None
        if "contact/basis/modes" in arrays:
            contact = SimulatedContact(
                **part("contact"), basis=basis("contact/basis", *_CONTACT_NUMBERS)
            )
        return MixedDataset(
            experiment=_experiment(tables),
            simulated_force=arrays["simulated_force"],
            coefficients=arrays["coefficients"],
            basis=basis("basis", "loss_mean_m", "loss_max_m"),
            mesh=SkinMesh(**part("mesh"), sha256=str(numbers["mesh_sha256"])),
            contact=contact,
        )

    return _named(path, build)


def content_sha256(data: ExperimentDataset | MixedDataset) -> str:
    """SHA-256 of names, shapes and values, hex: the same as in the file."""
    tables = _mixed_tables(data) if isinstance(data, MixedDataset) else _experiment_tables(data)
    return tables.content_sha256()


Data = TypeVar("Data")


def _named(path: Path, build: Callable[[], Data]) -> Data:
    """Build a data set; errors of its own checks name the file."""
    try:
        return build()
    except DatasetError as error:
        raise DatasetError(f"{path}: {error.problem}", remedy=error.remedy) from error


def _experiment_tables(data: ExperimentDataset) -> StoredTables:
    return StoredTables(
        {
            name: np.array(getattr(data, name), dtype=object)
            if column.dtype is str
            else getattr(data, name)
            for name, column in EXPERIMENT_COLUMNS.items()
        },
        {},
        data.provenance,
    )


def _mixed_columns(data: MixedDataset) -> dict[str, StoredColumn]:
    return MIXED_COLUMNS if data.contact is None else {**MIXED_COLUMNS, **CONTACT_COLUMNS}


def _mixed_tables(data: MixedDataset) -> StoredTables:
    experiment = _experiment_tables(data.experiment)
    numbers: dict[str, float | str] = {
        "loss_mean_m": data.basis.loss_mean,
        "loss_max_m": data.basis.loss_max,
        "mesh_sha256": data.mesh.sha256,
    }
    if data.contact is not None:
        basis = data.contact.basis
        numbers |= dict(zip(_CONTACT_NUMBERS, (basis.loss_mean, basis.loss_max), strict=True))
    return StoredTables(
        {
            **experiment.arrays,
            **{
                name: attrgetter(name.replace("/", "."))(data)
                for name in _mixed_columns(data).keys() - EXPERIMENT_COLUMNS.keys()
            },
        },
        numbers,
        experiment.provenance,
    )


def _experiment(tables: StoredTables) -> ExperimentDataset:
    arrays = tables.arrays
    return ExperimentDataset(
        unit_names=tuple(arrays["unit_names"]),
        trajectories=tuple(arrays["trajectories"]),
        indenters=tuple(arrays["indenters"]),
        **{name: arrays[name] for name in EXPERIMENT_ARRAYS},
        provenance=tables.provenance,
    )
