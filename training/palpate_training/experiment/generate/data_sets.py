"""Stage three: the paper's data sets, purely experimental and mixed, of all that was executed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.datasets.assembly import assemble_experiment, assemble_mixed, mix
from palpate_training.datasets.basis import fit_basis
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    SkinMesh,
)
from palpate_training.datasets.trials import MixedRows, SimulatedTrial, TrialRows
from palpate_training.experiment.generate.simulator import (
    IndentationStore,
    OnProgress,
    SimulatedFingertip,
    SimulatedTrajectory,
    travelled,
)
from palpate_training.experiment.generate.trials import file_of, read_trials

Floats = npt.NDArray[np.float64]

SUBSET = 128
"""Nodes of the paper's fields."""

FORCE_MODES = 160
"""Modes of the contact forces. Their patches are small and many, so no number of modes holds them
as a few hundred hold the displacement; the data set says what is lost."""


@dataclass(frozen=True, slots=True)
class AssembledSets:
    """Both data sets, and what is in neither.

    Attributes:
        experiment: Purely experimental.
        mixed: With simulated fields.
        dropped: Trial and reason of each that was left out of one or both.
    """

    experiment: ExperimentDataset
    mixed: MixedDataset
    dropped: list[tuple[str, str]]


def assemble(
    store: IndentationStore,
    folder: Path,
    unit_names: tuple[str, ...],
    provenance: Provenance,
    *,
    clearance_m: float,
    on_progress: OnProgress,
) -> AssembledSets:
    """Make both data sets.

    Raises:
        DatasetError: A file is damaged, or nothing was executed.
    """
    fingertip = store.fingertip()
    names = [name for name in store.ids() if file_of(folder, name).exists()]
    if not names:
        raise DatasetError(f"{folder} holds no trial", remedy="run the stages before")
    outer = np.unique(fingertip.mesh.outer_faces)
    rows: dict[str, tuple[TrialRows, ...]] = {}
    simulated: dict[str, SimulatedTrial] = {}
    dropped: list[tuple[str, str]] = []
    for k, name in enumerate(names):
        done = read_trials(folder, name)
        dropped += [(f"{unit} {name}", why) for unit, why in done.dropped]
        if done.rows:
            rows[name] = done.rows
            simulated[name] = simulated_trial(
                name, store.trajectory(name), done.believed, clearance_m, outer
            )
        on_progress(k + 1, len(names), "read")
    every = [one for some in rows.values() for one in some]
    experiment = assemble_experiment(every, provenance, unit_names=unit_names)
    mixed = join(
        every,
        simulated,
        dropped,
        fingertip,
        provenance,
        unit_names=unit_names,
        on_progress=on_progress,
    )
    return AssembledSets(experiment, mixed, sorted(dropped))


def join(
    rows: Sequence[TrialRows],
    simulated: dict[str, SimulatedTrial],
    dropped: list[tuple[str, str]],
    fingertip: SimulatedFingertip,
    provenance: Provenance,
    *,
    unit_names: tuple[str, ...],
    on_progress: OnProgress,
) -> MixedDataset:
    """Make the mixed data set of trials, real ones or the twin's, and their simulations.

    Raises:
        DatasetError: Nothing is left.
    """
    mesh = skin_mesh(fingertip)
    on_progress(0, 1, "basis of the fields")
    basis = fit_basis(lambda: (trial.displacement for trial in simulated.values()))
    on_progress(0, 1, "basis of the contact forces")
    contact_basis = fit_basis(
        lambda: (
            trial.contact_force for trial in simulated.values() if trial.contact_force is not None
        ),
        count=FORCE_MODES,
    )
    on_progress(0, 1, "mixed data set")
    mixed = assemble_mixed(
        _mixed(rows, simulated, dropped),
        basis,
        mesh,
        provenance,
        contact_basis=contact_basis,
        unit_names=unit_names,
    )
    on_progress(1, 1, "mixed data set")
    return mixed


def simulated_trial(
    name: str,
    trajectory: SimulatedTrajectory,
    believed: int,
    clearance_m: float,
    outer: npt.NDArray[np.int32],
) -> SimulatedTrial:
    """A simulated trajectory from first contact on, as it is mixed with trials.

    Args:
        name: Its id.
        trajectory: As simulated.
        believed: How many of its steps to take, one or more.
        clearance_m: How far from the skin its path starts [m].
        outer: Nodes of the outer surface, ascending.
    """
    steps = trajectory.steps[:believed]
    travel = travelled(trajectory, steps) - clearance_m
    fields = np.array([step.displacement for step in steps], np.float32)
    contact = np.array([step.indenter_force[outer] for step in steps], np.float32)
    return SimulatedTrial(
        trajectory=name,
        travel_m=np.concatenate([[0.0], travel]),
        force=np.concatenate([np.zeros((1, 3)), [step.force for step in steps]]),
        displacement=np.concatenate([np.zeros_like(fields[:1]), fields]),
        converged=len(steps) + 1,
        contact_force=np.concatenate([np.zeros_like(contact[:1]), contact]),
    )


def _mixed(
    rows: Sequence[TrialRows],
    simulated: dict[str, SimulatedTrial],
    dropped: list[tuple[str, str]],
) -> Iterator[MixedRows]:
    for one in rows:
        try:
            yield mix(one, simulated[one.header.trajectory])
        except DatasetError as error:
            dropped.append((f"{one.header.unit} {one.header.trajectory}", str(error)))


def skin_mesh(fingertip: SimulatedFingertip) -> SkinMesh:
    """The pressurised skin with its surfaces in triangles, and the nodes that errors count on."""
    nodes = fingertip.pressurised_nodes
    return SkinMesh(
        nodes=nodes,
        outer_faces=_triangles(fingertip.mesh.outer_faces),
        inner_faces=_triangles(fingertip.mesh.inner_faces),
        subset=ventral_subset(nodes, fingertip.mesh.outer_nodes),
        sha256=fingertip.mesh.sha256.hex(),
    )


def ventral_subset(nodes: Floats, outer: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """128 nodes of the ventral outer surface, each as far as can be from those before.

    The paper takes 128 nodes of its mesh without stating which.

    Args:
        nodes: [m], shape (V, 3).
        outer: Ids of the nodes of the outer surface.
    """
    ventral = outer[nodes[outer, 2] < 0.0]
    points = nodes[ventral]
    chosen = [int(points[:, 2].argmin())]
    away = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(SUBSET, len(points)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.sort(ventral[chosen]).astype(np.int32)


def _triangles(faces: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    if faces.shape[1] == 3:
        return faces
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]).astype(np.int32)
