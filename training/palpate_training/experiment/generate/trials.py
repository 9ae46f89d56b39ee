"""Stage two, the testbed: every simulated trajectory is executed on the specimens that met it.

The work is spread over processes or machines: plain values in, plain values out. A process keeps
what is expensive to make (the specimens' electrodes) between tasks.
"""

from __future__ import annotations

import io
import logging
import pickle
import tempfile
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate_training.datasets.container import read_archive
from palpate_training.datasets.processing import from_half_newton, tare
from palpate_training.datasets.trials import TrialHeader, TrialRows, reason_of
from palpate_training.experiment.clearance import pad_poses, simulate_registrations
from palpate_training.experiment.generate.simulator import (
    ExperimentSpec,
    IndentationStore,
    MakeSpecimens,
    OnProgress,
    PressedSpecimens,
    SimulatedFingertip,
    SimulatedStep,
    SimulatedTrajectory,
    Specimen,
    TwinSimulator,
    travelled,
)
from palpate_training.experiment.generate.workers import TaskRunner
from palpate_training.experiment.plan import (
    APPROACH_M,
    ARMS,
    PlannedManipulation,
    PlannedTrajectory,
)
from palpate_training.experiment.stand_in_arm import sensor_robot, stand_in_arm
from palpate_training.experiment.virtual_testbed import contact_travel, perform

_log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

WARM_S = 1800.0
"""Age of sensors when the experiment starts [s]; paper: left untouched for about 30 min."""

TEMPERATURE_WALK_K = 0.03
"""Random walk of the core's temperature: standard deviation of what it gains in one minute [K]."""

SUFFIX = ".npz"
FINGERTIP = "fingertip.txt"
"""Digest of the fingertip whose simulation the trials of a folder are of."""

ROW_ARRAYS = ("rest", "travel_m", "tared", "force", "location")


def make_trials(
    spec: ExperimentSpec,
    store: IndentationStore,
    specimens: Sequence[Specimen],
    simulator: TwinSimulator,
    folder: Path,
    runner: TaskRunner,
    *,
    on_progress: OnProgress,
    stop: threading.Event,
) -> bool:
    """Execute what the store holds; trials that the folder holds already are not made again.

    Trajectories of indenters that no specimen was pressed with are left out.

    Returns:
        Whether all are there; False = stopped.

    Raises:
        DatasetError: The store is damaged, the folder holds trials of another fingertip, or the
            disk refuses.
    """
    fingertip = store.fingertip()
    there = set(store.ids())
    every: list[PlannedTrajectory | PlannedManipulation] = [
        *simulator.plans(spec, fingertip),
        *simulator.manipulations(spec, fingertip),
    ]
    plans = [
        (plan, who)
        for plan in every
        if plan.trajectory in there and (who := _executed_by(spec, specimens, plan))
    ]
    left = [(plan, who) for plan, who in plans if not file_of(folder, plan.trajectory).exists()]
    done = len(plans) - len(left)
    _keep_fingertip(folder, fingertip.key, store.path, done=done, more=bool(left))
    on_progress(done, len(plans), "")
    if not left:
        return True
    make = simulator.make_specimens(fingertip, specimens)
    tasks = _tasks(spec, store, specimens, left, simulator, in_worker=runner.sees_files)
    with tempfile.NamedTemporaryFile(prefix="palpate-specimens-") as shared:
        work: Callable[[TrialTask], bytes] = partial(_work, make)
        if runner.sees_files:  # the skin and a thousand specimens are more than a task
            shared.write(pickle.dumps(make))
            shared.flush()
            work = partial(_work_shared, Path(shared.name))
        for task, data in runner.run(work, tasks):
            with written_whole(file_of(folder, task.name)) as part:
                part.write_bytes(data)
            done += 1
            on_progress(done, len(plans), task.name)
            if stop.is_set():
                break
    return done == len(plans)


def _keep_fingertip(folder: Path, key: str, store: Path, *, done: int, more: bool) -> None:
    """Write of which fingertip the trials are, if ``more`` come, or compare it with what is there.

    ``done`` trajectories have trials already.
    """
    path = folder / FINGERTIP
    try:
        found = path.read_bytes()
    except FileNotFoundError:
        if not more:
            return
        if done:
            _log.warning("%s does not say of which fingertip its %d trials are", folder, done)
        with written_whole(path) as part:
            part.write_text(key, encoding="utf-8")
        return
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="check the folder's rights, or name another",
        ) from error
    if found != key.encode():
        raise DatasetError(
            f"{folder} holds trials of another fingertip than {store} simulates",
            remedy=f"remove {folder} and run the command again: they are made again",
        )


def read_trials(folder: Path, name: str) -> TrialsDone:
    """What came of a trajectory.

    Raises:
        DatasetError: The file is damaged; names it.
    """
    path = file_of(folder, name)
    remedy = "remove it and run the command again"
    arrays = read_archive(path, list, remedy=remedy)
    try:
        return unpack(arrays)
    except (ValueError, KeyError) as error:
        raise DatasetError(f"{path} is damaged: {error}", remedy=remedy) from error


def file_of(folder: Path, name: str) -> Path:
    """File of a trajectory's trials."""
    return folder / (name.replace("/", "__") + SUFFIX)


def registration_errors(specimens: Sequence[Specimen], seed: int) -> dict[str, Floats]:
    """Tip by kinematics and registration minus true tip [m], for each arm (U, 3), sensor frame.

    Sideways it is what the registration procedure leaves, drawn by its own error model. Along the
    dorsal axis it is what each specimen was fitted to: published forces show how deep they were
    pressed.
    """
    errors = {}
    for number, side in enumerate(ARMS):
        poses = pad_poses(1.0 if side == "left" else -1.0)
        found = simulate_registrations(
            stand_in_arm(side), sensor_robot(side), poses, draws=len(specimens), seed=seed + number
        )
        drawn = found.constant.copy()
        drawn[:, 2] = [-specimen.overtravel_m for specimen in specimens]
        errors[side] = drawn
    return errors


@dataclass(frozen=True, slots=True)
class ClearTrajectory:
    """A simulated trajectory.

    Attributes:
        trajectory: The simulation.
        clear_steps: Its steps before the indenter bears on what holds the finger.
    """

    trajectory: SimulatedTrajectory
    clear_steps: int


@lru_cache(maxsize=1)
def _opened(simulator: TwinSimulator, path: Path) -> tuple[IndentationStore, SimulatedFingertip]:
    store = simulator.open_store(path)
    return store, store.fingertip()


def read_clear(simulator: TwinSimulator, path: Path, name: str) -> ClearTrajectory:
    """Read a trajectory from a store, which stays open for the next one.

    Raises:
        DatasetError: It is damaged.
    """
    return _clear(simulator, *_opened(simulator, path), name)


def _clear(
    simulator: TwinSimulator, store: IndentationStore, fingertip: SimulatedFingertip, name: str
) -> ClearTrajectory:
    trajectory = store.trajectory(name)
    return ClearTrajectory(trajectory, simulator.clear_steps(trajectory, fingertip))


def _given(trajectory: ClearTrajectory) -> ClearTrajectory:
    """For a worker on a machine that does not see the store."""
    return trajectory


@dataclass(frozen=True, slots=True)
class TrialTask:
    """A simulated trajectory to be executed on the specimens.

    Attributes:
        name: Its id.
        arm: Which arm executes it.
        direction: Where it moves, shape (3,).
        planned_m: Planned travel past first contact [m]; None = all of a path that is no press.
            Such a path is felt its way to the skin, so that a registration error does not change
            how deep it is.
        simulated: Gives the simulation.
        specimens: Those that execute it.
        measured: Names of those whose ideal counts are kept.
        errors_m: Registration error of that arm for each of them [m], shape (U, 3).
        exact_labels: Contact locations are without it.
        clearance_m: How far from the skin its path starts [m].
        seed: Of the experiment.
    """

    name: str
    arm: str
    direction: Floats
    planned_m: float | None
    simulated: Callable[[], ClearTrajectory]
    specimens: tuple[Specimen, ...]
    measured: tuple[str, ...]
    errors_m: Floats
    exact_labels: bool
    clearance_m: float
    seed: int


@dataclass(frozen=True, slots=True)
class TrialsDone:
    """What came of a task.

    Attributes:
        name: Id of the trajectory.
        rows: Of each specimen that gave some.
        dropped: Specimen and reason of each that gave none.
        counts: Ideal counts of each specimen's electrodes along the simulation, untouched first,
            shape (S + 1, 19) each, whether it executed the trajectory or not: what a virtual finger
            plays. Where a few of many specimens execute it, of those.
        believed: Steps S of the simulation that were used.
    """

    name: str
    rows: tuple[TrialRows, ...]
    dropped: tuple[tuple[str, str], ...]
    counts: dict[str, Floats]
    believed: int


def execute(pressed: PressedSpecimens, task: TrialTask) -> TrialsDone:
    """Perform and process the trials of one trajectory."""
    found = task.simulated()
    trajectory, steps = found.trajectory, found.trajectory.steps[: found.clear_steps]
    answers = pressed.counts(steps, task.measured)
    counts = {
        name: np.concatenate([pressed.rest_counts[name][None], answers[name]])
        for name in task.measured
    }
    kept, dropped = [], []
    for specimen, error in zip(task.specimens, task.errors_m, strict=True):
        try:
            kept.append(_perform(task, trajectory, steps, specimen, error, counts[specimen.name]))
        except DatasetError as failure:
            dropped.append((specimen.name, reason_of(f"{specimen.name} {task.name}", failure)))
    return TrialsDone(task.name, tuple(kept), tuple(dropped), counts, len(steps))


def _perform(
    task: TrialTask,
    trajectory: SimulatedTrajectory,
    steps: Sequence[SimulatedStep],
    specimen: Specimen,
    error: Floats,
    counts: Floats,
) -> TrialRows:
    """One trial: streams as the testbed records them, then the paper's processing."""
    if not steps:
        raise DatasetError(
            f"{specimen.name} {task.name}: no step before it diverges or meets the mount",
            remedy="nothing to do: the trial is left out, as in the paper",
        )
    start = trajectory.path[0, :3]
    poses = np.array([step.pose[:3] for step in steps])
    travel = travelled(trajectory, steps) - task.clearance_m
    tip = np.concatenate([start[None] + task.clearance_m * task.direction, poses])
    force = np.concatenate([np.zeros((1, 3)), [step.force for step in steps]])
    if task.planned_m is None:
        contact_m = APPROACH_M
        length_m = contact_m + float(travel[-1])
    else:
        contact_m = contact_travel(error, task.direction)
        length_m = min(APPROACH_M + task.planned_m, contact_m + float(travel[-1]))
    label = f"{specimen.name}/{task.name}".encode()
    seed = zlib.crc32(label) ^ task.seed
    stream = specimen.stream(counts[0], seed)
    random = np.random.default_rng([seed, 1])

    def read(ideal: Floats, time_s: Floats) -> NDArray[np.uint16]:
        elapsed = np.diff(time_s, prepend=time_s[0])
        walk = np.cumsum(random.standard_normal(len(time_s)) * np.sqrt(elapsed / 60.0))
        drift = specimen.temperature_coefficient * TEMPERATURE_WALK_K * walk
        return stream(ideal, time_s, elapsed, drift)

    last = perform(
        TrialHeader(specimen.name, task.name, trajectory.indenter, task.arm),
        travel_m=np.concatenate([[0.0], travel]),
        force=force,
        counts=counts,
        tip=tip,
        read_electrodes=read,
        registration_error_m=np.zeros(3) if task.exact_labels else error,
        contact_m=contact_m,
        length_m=np.floor(length_m / 1e-4 + 1e-6) * 1e-4,
        since_power_on_s=WARM_S,
        seed=seed,
        last_only=True,
    )
    return from_half_newton(tare(last))


def pack(done: TrialsDone) -> bytes:
    """As the bytes of an .npz file, without pickles."""
    arrays: dict[str, Any] = {"name": np.array(done.name), "units": np.array(list(done.counts))}
    arrays["believed"] = np.array(done.believed)
    arrays["dropped"] = np.array(done.dropped, dtype=str).reshape(-1, 2)
    arrays["rows"] = np.array(
        [list(astuple(rows.header)) for rows in done.rows], dtype=str
    ).reshape(-1, 4)
    for unit, counts in done.counts.items():
        arrays[f"counts/{unit}"] = counts
    for i, rows in enumerate(done.rows):
        for key in ROW_ARRAYS:
            arrays[f"{i}/{key}"] = getattr(rows, key)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def unpack(arrays: Mapping[str, NDArray[Any]]) -> TrialsDone:
    """Inverse of `pack`, of the arrays that it wrote."""
    rows = tuple(
        TrialRows(
            header=TrialHeader(*(str(word) for word in header)),
            **{key: arrays[f"{i}/{key}"] for key in ROW_ARRAYS},
        )
        for i, header in enumerate(arrays["rows"])
    )
    return TrialsDone(
        name=str(arrays["name"]),
        rows=rows,
        dropped=tuple((str(unit), str(why)) for unit, why in arrays["dropped"]),
        counts={str(unit): arrays[f"counts/{unit}"] for unit in arrays["units"]},
        believed=int(arrays["believed"]),
    )


def _executed_by(
    spec: ExperimentSpec,
    specimens: Sequence[Specimen],
    plan: PlannedTrajectory | PlannedManipulation,
) -> list[int]:
    """Which specimens execute a trajectory."""
    who = [i for i, one in enumerate(specimens) if one.pressed_with(plan.indenter)]
    if 0 < spec.units_each < len(who):
        draw = np.random.default_rng([spec.seed, zlib.crc32(plan.trajectory.encode())])
        return sorted(draw.choice(who, spec.units_each, replace=False).tolist())
    return who


def _tasks(
    spec: ExperimentSpec,
    store: IndentationStore,
    specimens: Sequence[Specimen],
    plans: Sequence[tuple[PlannedTrajectory | PlannedManipulation, list[int]]],
    simulator: TwinSimulator,
    *,
    in_worker: bool,
) -> Iterator[TrialTask]:
    seed = spec.seed if spec.registration_seed is None else spec.registration_seed
    errors, fingertip = registration_errors(specimens, seed), store.fingertip()
    for plan, who in plans:
        name = plan.trajectory
        yield TrialTask(
            name=name,
            arm=plan.arm,
            direction=plan.direction,
            planned_m=plan.depth_m - spec.overtravel_m
            if isinstance(plan, PlannedTrajectory)
            else None,
            simulated=partial(read_clear, simulator, store.path, name)
            if in_worker
            else partial(_given, _clear(simulator, store, fingertip, name)),
            specimens=tuple(specimens[i] for i in who),
            measured=tuple(
                specimens[i].name for i in (who if spec.units_each else range(len(specimens)))
            ),
            errors_m=errors[plan.arm][np.array(who)],
            exact_labels=spec.exact_labels,
            clearance_m=simulator.clearance_m,
            seed=spec.seed,
        )


@lru_cache(maxsize=1)
def _pressed(make: MakeSpecimens) -> PressedSpecimens:
    return make()


def _work(make: MakeSpecimens, task: TrialTask) -> bytes:
    return pack(execute(_pressed(make), task))


@lru_cache(maxsize=1)
def _shared(path: Path) -> PressedSpecimens:
    make: MakeSpecimens = pickle.loads(path.read_bytes())
    return make()


def _work_shared(path: Path, task: TrialTask) -> bytes:
    return pack(execute(_shared(path), task))
