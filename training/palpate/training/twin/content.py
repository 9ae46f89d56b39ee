"""The two data sets of the paper, in memory: purely experimental, and mixed with simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.training.dataset import Provenance

FloatArray = npt.NDArray[np.float32]
IndexArray = npt.NDArray[np.int32]


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
            such as the published files, does not tell.
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

    def __len__(self) -> int:
        return len(self.trial)

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


@dataclass(frozen=True, slots=True)
class FieldBasis:
    """Displacement fields as few numbers: field = mean + coefficients @ modes.

    Attributes:
        mean: [m], shape (V, 3).
        modes: Orthonormal over all 3 V values, shape (K, V, 3).
        loss_mean_m: Mean nodal distance between the fields and their compressed form [m].
        loss_max_m: Largest such distance of any node and row [m].
    """

    mean: FloatArray
    modes: FloatArray
    loss_mean_m: float
    loss_max_m: float

    def decode(self, coefficients: FloatArray) -> FloatArray:
        """Displacement [m], shape (N, V, 3), of coefficients (N, K)."""
        flat = self.modes.reshape(len(self.modes), -1)
        field = coefficients @ flat + self.mean.reshape(-1)
        return np.asarray(field.reshape(-1, *self.mean.shape), np.float32)


@dataclass(frozen=True, slots=True)
class MixedDataset:
    """Experiment and simulation row by row, 20 rows a trial.

    The field of a trajectory is stored once for each trial, as the rows' travel differs by trial.

    Attributes:
        experiment: The measured side.
        simulated_force: [N], shape (N, 3).
        coefficients: Of the field of each row, shape (N, K).
        basis: What they are coefficients of.
        mesh: Whose nodes move.
    """

    experiment: ExperimentDataset
    simulated_force: FloatArray
    coefficients: FloatArray
    basis: FieldBasis
    mesh: SkinMesh

    def __len__(self) -> int:
        return len(self.experiment)

    def displacement(self, rows: slice | IndexArray | npt.NDArray[np.int64]) -> FloatArray:
        """Nodal displacement of some rows [m], shape (R, V, 3)."""
        return self.basis.decode(self.coefficients[rows])
