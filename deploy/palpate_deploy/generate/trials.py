"""Stage two: the testbed. Every simulated trajectory is executed on the units that met it."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate_deploy.generate.mechanics import OnProgress, plans_of
from palpate_deploy.generate.registration import registration_errors
from palpate_deploy.generate.spec import ExperimentSpec
from palpate_deploy.generate.spread import Spread
from palpate_deploy.generate.tasks import TrialMaker, TrialsDone, TrialTask, pack, unpack
from palpate_fem.population.member import Member
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.read import SimulationStore
from palpate_fem.trajectory import PlannedIndentation
from palpate_training.experiment.plan import assign_arm

FOLDER = "trials"
SUFFIX = ".npz"


def make_trials(
    spec: ExperimentSpec,
    store: SimulationStore,
    members: Sequence[Member],
    folder: Path,
    spread: Spread,
    *,
    on_progress: OnProgress,
) -> None:
    """Execute what the store holds; what the folder holds already is not made again.

    Args:
        spec: The experiment.
        store: Its mechanics; trajectories that are not there yet are passed over.
        members: Units.
        folder: Takes a file for each trajectory, whole or not at all.
        spread: Where the work is done.
        on_progress: Called after each trajectory.

    Raises:
        DatasetError: The store is damaged, or the disk refuses.
    """
    fingertip = store.fingertip()
    there = set(store.ids())
    plans = [plan for plan in plans_of(spec, fingertip) if plan.name in there]
    left = [plan for plan in plans if not file_of(folder, plan.name).exists()]
    done = len(plans) - len(left)
    on_progress(done, len(plans), "")
    if not left:
        return
    units = tuple(member.unit for member in members)
    work: Callable[[TrialTask], bytes] = partial(_work, _Films(fingertip, units))
    for task, data in spread.run(work, _tasks(spec, store, members, left)):
        with written_whole(file_of(folder, task.name)) as part:
            part.write_bytes(data)
        done += 1
        on_progress(done, len(plans), task.name)


def read_trials(folder: Path, name: str) -> TrialsDone:
    """What came of a trajectory.

    Raises:
        DatasetError: The file is damaged; names it.
    """
    path = file_of(folder, name)
    try:
        return unpack(path.read_bytes())
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise DatasetError(
            f"{path} is damaged: {error}", remedy="remove it and run the command again"
        ) from error


def file_of(folder: Path, name: str) -> Path:
    """File of a trajectory's trials."""
    return folder / (name.replace("/", "__") + SUFFIX)


def _tasks(
    spec: ExperimentSpec,
    store: SimulationStore,
    members: Sequence[Member],
    plans: Sequence[PlannedIndentation],
) -> Iterator[TrialTask]:
    errors = registration_errors(members, spec.seed)
    for plan in plans:
        who = [i for i, member in enumerate(members) if member.wanted.pressed_with(plan.indenter)]
        if not who:
            continue
        arm = assign_arm(plan.target)
        yield TrialTask(
            name=plan.name,
            arm=arm,
            direction=plan.direction,
            planned_m=plan.depth_m - spec.overtravel_m,
            trajectory=store.trajectory(plan.name),
            members=tuple(members[i] for i in who),
            errors_m=errors[arm][np.array(who)],
            seed=spec.seed,
        )


class _Films:
    """Fingertip and units, hashed by what they are, so that a process makes their films once."""

    def __init__(self, fingertip: StoredFingertip, units: tuple[object, ...]) -> None:
        self.fingertip, self.units = fingertip, units
        self._key = (fingertip.key, units)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Films) and self._key == other._key


@lru_cache(maxsize=1)
def _maker(films: _Films) -> TrialMaker:
    return TrialMaker(films.fingertip, films.units)  # type: ignore[arg-type]


def _work(films: _Films, task: TrialTask) -> bytes:
    return pack(_maker(films)(task))
