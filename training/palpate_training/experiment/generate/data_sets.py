"""Stage three: the paper's data sets, purely experimental and mixed, of all that was executed.

Fields of thousands of trajectories do not fit in memory, and reading them takes most of the time.
So the bases are fitted on some of them, on disk, and worker processes encode all, one at a time.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.datasets.assembly import (
    EncodedTrial,
    TrialEncoder,
    assemble_encoded,
    assemble_experiment,
    assemble_mixed,
    mix,
)
from palpate_training.datasets.basis import (
    Blocks,
    FieldFile,
    FieldLoss,
    fit_basis,
    mean_and_largest,
)
from palpate_training.datasets.container import Provenance, read_archive
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    FieldBasis,
    MixedDataset,
    SkinMesh,
)
from palpate_training.datasets.trials import (
    MixedRows,
    SimulatedTrial,
    TrialRows,
    reason_of,
    trial_name,
)
from palpate_training.experiment.generate.simulator import (
    IndentationStore,
    OnProgress,
    SimulatedFingertip,
    SimulatedTrajectory,
    travelled,
)
from palpate_training.experiment.generate.trials import file_of, read_trials
from palpate_training.experiment.generate.workers import Answer, Task, TaskRunner

Floats = npt.NDArray[np.float64]

SUBSET = 128
"""Nodes of the paper's fields."""

FORCE_MODES = 160
"""Modes of the contact forces. Their patches are small and many, so no number of modes holds them
as a few hundred hold the displacement; the data set says what is lost."""


FIT_TRAJECTORIES = 400
"""Trajectories at most that the bases are fitted on: a gigabyte of fields on the disk."""

OpenStore = Callable[[Path], IndentationStore]
"""Opens a store in a worker; can be pickled."""


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
    open_store: OpenStore | None = None,
    runner: TaskRunner | None = None,
) -> AssembledSets:
    """Make both data sets.

    The bases are fitted on ``FIT_TRAJECTORIES`` at most, spread evenly over all by name; what they
    lose is measured on every step of every trajectory.

    Args:
        store: The simulations.
        folder: The trials; takes the fields of the fit and the bases until the data sets are made.
        unit_names: Of all specimens, in order.
        provenance: Where the data sets come from.
        clearance_m: How far from the skin simulated paths start [m].
        on_progress: Called with the progress of each part of the work.
        open_store: Opens the store in the processes of ``runner``.
        runner: Its processes read and encode, if they see the files of this one; without both all
            is done in this process.

    Raises:
        DatasetError: A file is damaged, nothing was executed, or the disk refuses.
        WorkerLostError: A worker died.
    """
    fingertip = store.fingertip()
    names = sorted(name for name in store.ids() if file_of(folder, name).exists())
    if not names:
        raise DatasetError(f"{folder} holds no trial", remedy="run the stages before")
    if open_store is None or (runner is not None and not runner.sees_files):
        runner = None
    found: dict[str, ExecutedTrajectory] = {}
    for name, executed in _answers(runner, partial(_executed, folder), names):
        found[name] = executed
        on_progress(len(found), len(names), "read")
    held = [found[name] for name in names]
    dropped = [lost for one in held for lost in one.dropped]
    tasks = [one for one in held if one.rows]
    experiment = assemble_experiment(
        (rows for one in tasks for rows in one.rows), provenance, unit_names=unit_names
    )
    mesh = skin_mesh(fingertip)
    bases = _fitted(store, folder, _spread(tasks), mesh, clearance_m, on_progress)
    encoded: dict[str, EncodedTrajectory] = {}
    with tempfile.TemporaryDirectory(prefix=".bases-", dir=folder) as shared:
        encode: Callable[[ExecutedTrajectory], EncodedTrajectory]
        if runner is None or open_store is None:
            encode = TrajectoryEncoder(store, mesh, bases, clearance_m)
        else:
            path = Path(shared) / "bases.npz"
            bases.write(path)
            encode = partial(_encode, EncoderPlace(store.path, path, clearance_m, open_store))
        for task, answer in _answers(runner, encode, tasks):
            encoded[task.name] = answer
            on_progress(len(encoded), len(tasks), "mixed data set")
    answers = [encoded.pop(task.name) for task in tasks]
    dropped += [lost for answer in answers for lost in answer.dropped]
    bases = bases.measured(answers)
    mixed = assemble_encoded(
        (trial for answer in answers for trial in answer.trials),
        bases.displacement,
        mesh,
        provenance,
        contact_basis=bases.contact_force,
        unit_names=unit_names,
    )
    return AssembledSets(experiment, mixed, sorted(dropped))


@dataclass(frozen=True, slots=True)
class ExecutedTrajectory:
    """What was executed of a trajectory.

    Attributes:
        name: Its id.
        believed: Steps of the simulation that are used.
        rows: Of each trial that gave some.
        dropped: Trial and reason of each that gave none.
    """

    name: str
    believed: int
    rows: tuple[TrialRows, ...]
    dropped: tuple[tuple[str, str], ...]


def _executed(folder: Path, name: str) -> ExecutedTrajectory:
    done = read_trials(folder, name)
    dropped = tuple((f"{unit} {name}", why) for unit, why in done.dropped)
    return ExecutedTrajectory(name, done.believed, done.rows, dropped)


@dataclass(frozen=True, slots=True)
class EncodedTrajectory:
    """What the mixed data set holds of a trajectory; small.

    Attributes:
        trials: Its trials that could be mixed.
        dropped: Trial and reason of each other.
        displacement: What the displacement of its steps loses [m].
        contact_force: What their contact forces lose [N].
    """

    trials: tuple[EncodedTrial, ...]
    dropped: tuple[tuple[str, str], ...]
    displacement: FieldLoss
    contact_force: FieldLoss


@dataclass(frozen=True, slots=True)
class FieldBases:
    """Bases of both fields.

    Attributes:
        displacement: Of the displacement [m].
        contact_force: Of the contact forces [N].
    """

    displacement: FieldBasis
    contact_force: FieldBasis

    def measured(self, answers: Sequence[EncodedTrajectory]) -> FieldBases:
        """With the losses of these trajectories."""
        moved = mean_and_largest(answer.displacement for answer in answers)
        pressed = mean_and_largest(answer.contact_force for answer in answers)
        return FieldBases(
            replace(self.displacement, loss_mean=moved[0], loss_max=moved[1]),
            replace(self.contact_force, loss_mean=pressed[0], loss_max=pressed[1]),
        )

    def write(self, path: Path) -> None:
        """Write them for workers to read.

        Raises:
            DatasetError: The disk refuses.
        """
        arrays = {
            f"{name}/{key}": np.asarray(getattr(getattr(self, name), key))
            for name in ("displacement", "contact_force")
            for key in _BASIS_PARTS
        }
        try:
            with path.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
        except OSError as error:
            raise DatasetError(
                f"cannot write {path}: {error}", remedy="check the folder's rights and free space"
            ) from error

    @classmethod
    def read(cls, path: Path) -> FieldBases:
        """Read what ``write`` wrote.

        Raises:
            DatasetError: It is not there.
        """
        arrays = read_archive(path, lambda names: names, remedy="run the command again")

        def basis(name: str) -> FieldBasis:
            mean, modes, *numbers = (arrays[f"{name}/{key}"] for key in _BASIS_PARTS)
            return FieldBasis(mean, modes, *(float(number) for number in numbers))

        return cls(basis("displacement"), basis("contact_force"))


_BASIS_PARTS = ("mean", "modes", "loss_mean", "loss_max", "step")


class TrajectoryEncoder:
    """Reads trajectories from a store, mixes and encodes their trials."""

    def __init__(
        self, store: IndentationStore, mesh: SkinMesh, bases: FieldBases, clearance_m: float
    ) -> None:
        self._store = store
        self._outer = mesh.outer_nodes
        self._clearance_m = clearance_m
        self._encode = TrialEncoder(mesh, bases.displacement, bases.contact_force)

    def __call__(self, task: ExecutedTrajectory) -> EncodedTrajectory:
        """Encode the trials of a trajectory.

        Raises:
            DatasetError: It is damaged, or its fields are of another mesh.
        """
        simulated = simulated_trial(
            task.name,
            self._store.trajectory(task.name),
            task.believed,
            self._clearance_m,
            self._outer,
        )
        dropped: list[tuple[str, str]] = []
        encode = self._encode
        steps = encode.steps(simulated)
        trials = tuple(
            encode(one, steps) for one in _mixed(task.rows, {task.name: simulated}, dropped)
        )
        assert encode.contact_force is not None
        assert simulated.contact_force is not None
        return EncodedTrajectory(
            trials,
            tuple(dropped),
            encode.displacement.lost(simulated.displacement, steps.displacement),
            encode.contact_force.lost(simulated.contact_force, steps.contact_force),
        )


@dataclass(frozen=True, slots=True)
class EncoderPlace:
    """What a worker makes its ``TrajectoryEncoder`` of; equal by the files that it names.

    Attributes:
        store: The simulations.
        bases: File of the bases.
        clearance_m: How far from the skin simulated paths start [m].
        open_store: Opens the store.
    """

    store: Path
    bases: Path
    clearance_m: float
    open_store: OpenStore = field(compare=False)


@lru_cache(maxsize=1)
def _encoder(place: EncoderPlace) -> TrajectoryEncoder:
    store = place.open_store(place.store)
    mesh = skin_mesh(store.fingertip())
    return TrajectoryEncoder(store, mesh, FieldBases.read(place.bases), place.clearance_m)


def _encode(place: EncoderPlace, task: ExecutedTrajectory) -> EncodedTrajectory:
    return _encoder(place)(task)


def _answers(
    runner: TaskRunner | None, function: Callable[[Task], Answer], tasks: Iterable[Task]
) -> Iterator[tuple[Task, Answer]]:
    """Tasks and answers, in any order; in this process, one by one, without a runner.

    Raises:
        DatasetError: As the function does.
    """
    if runner is None:
        yield from ((task, function(task)) for task in tasks)
        return
    yield from runner.run(function, tasks)


Item = TypeVar("Item")


def _spread(items: Sequence[Item]) -> list[Item]:
    """Some of them, evenly: ``FIT_TRAJECTORIES``, or all where they are not more."""
    count = min(FIT_TRAJECTORIES, len(items))
    return [items[k] for k in np.linspace(0, len(items) - 1, count).round().astype(int)]


def _fitted(
    store: IndentationStore,
    folder: Path,
    some: Sequence[ExecutedTrajectory],
    mesh: SkinMesh,
    clearance_m: float,
    on_progress: OnProgress,
) -> FieldBases:
    """Fit the bases on the fields of some trajectories, which are put on the disk of a folder."""
    outer = mesh.outer_nodes
    with FieldFile(folder) as displacement, FieldFile(folder) as contact_force:
        for k, task in enumerate(some):
            simulated = simulated_trial(
                task.name, store.trajectory(task.name), task.believed, clearance_m, outer
            )
            displacement.add(simulated.displacement)
            if simulated.contact_force is not None:
                contact_force.add(simulated.contact_force)
            on_progress(k + 1, len(some), "fields to fit")
        return _fit(displacement, contact_force, on_progress)


def _fit(displacement: Blocks, contact_force: Blocks, on_progress: OnProgress) -> FieldBases:
    on_progress(0, 1, "basis of the fields")
    basis = fit_basis(displacement)
    on_progress(0, 1, "basis of the contact forces")
    return FieldBases(basis, fit_basis(contact_force, count=FORCE_MODES))


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
    bases = _fit(
        lambda: (trial.displacement for trial in simulated.values()),
        lambda: (
            trial.contact_force for trial in simulated.values() if trial.contact_force is not None
        ),
        on_progress,
    )
    on_progress(0, 1, "mixed data set")
    mixed = assemble_mixed(
        _mixed(rows, simulated, dropped),
        bases.displacement,
        mesh,
        provenance,
        contact_basis=bases.contact_force,
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
    simulated: Mapping[str, SimulatedTrial],
    dropped: list[tuple[str, str]],
) -> Iterator[MixedRows]:
    for one in rows:
        try:
            yield mix(one, simulated[one.header.trajectory])
        except DatasetError as error:
            name = trial_name(one.header)
            dropped.append((name, reason_of(name, error)))


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
