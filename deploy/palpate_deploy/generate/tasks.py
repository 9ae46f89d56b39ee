"""The work that is spread over processes or machines: plain values in, plain values out.

A process keeps what is expensive to make (the pressurised fingertip, the films) between tasks.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import DatasetError
from palpate_deploy.generate.spec import ExperimentSpec
from palpate_fem.electrodes.signals import ElectrodeSignals, skewed
from palpate_fem.electrodes.unit import UnitParameters
from palpate_fem.population.answers import Population
from palpate_fem.population.member import Member
from palpate_fem.population.mount import clear_steps
from palpate_fem.result import IndentationResult
from palpate_fem.service.biotac import BiotacTip, biotac
from palpate_fem.store.content import StoredFingertip
from palpate_fem.trajectory import CLEARANCE_M
from palpate_training.datasets.processing import process
from palpate_training.datasets.trials import TrialHeader, TrialRows
from palpate_training.experiment.plan import APPROACH_M
from palpate_training.experiment.virtual_testbed import contact_travel, perform

Floats = NDArray[np.float64]

WARM_S = 1800.0
"""Age of sensors when the experiment starts [s]; paper: left untouched for about 30 min."""

TEMPERATURE_WALK_K = 0.03
"""Random walk of the core's temperature: standard deviation of what it gains in one minute [K]."""


@dataclass(frozen=True, slots=True)
class MechanicsTask:
    """A trajectory to simulate."""

    spec: ExperimentSpec
    name: str
    indenter: str
    path: Floats


def simulate(task: MechanicsTask) -> IndentationResult:
    """Run a trajectory on this process's fingertip."""
    tip = _fingertip(task.spec)
    friction = task.spec.parameters.friction_coefficient
    return tip.indent(task.indenter, task.path, friction_coefficient=friction)


@lru_cache(maxsize=1)
def _fingertip(spec: ExperimentSpec) -> BiotacTip:
    build: Callable[..., Any] = biotac(**spec.mesh_options)  # type: ignore[arg-type]
    tip: BiotacTip = build(spec.parameters, lambda _: None)
    return tip


@dataclass(frozen=True, slots=True)
class TrialTask:
    """A simulated trajectory to be executed on the units.

    Attributes:
        name: Its id.
        arm: Which arm executes it.
        direction: Where it moves, shape (3,).
        planned_m: Planned travel past first contact [m].
        trajectory: The simulation.
        members: Units that execute it.
        errors_m: Registration error of that arm for each of these units [m], shape (U, 3).
        seed: Of the experiment.
    """

    name: str
    arm: str
    direction: Floats
    planned_m: float
    trajectory: IndentationResult
    members: tuple[Member, ...]
    errors_m: Floats
    seed: int


@dataclass(frozen=True, slots=True)
class TrialsDone:
    """What came of a task.

    Attributes:
        name: Id of the trajectory.
        rows: Of each unit that gave some.
        dropped: Unit and reason of each that gave none.
        counts: Ideal counts of each unit's electrodes along the simulation, untouched first, shape
            (S + 1, 19) each, whether it executed the trajectory or not: what a virtual finger
            plays.
        believed: Steps S of the simulation that were used.
    """

    name: str
    rows: tuple[TrialRows, ...]
    dropped: tuple[tuple[str, str], ...]
    counts: dict[str, Floats]
    believed: int


class TrialMaker:
    """Executes trajectories on the units of one fingertip; one in each process."""

    def __init__(self, fingertip: StoredFingertip, units: Sequence[UnitParameters]) -> None:
        self._population = Population(fingertip, units)
        self._held = fingertip.mesh.fixed

    def __call__(self, task: TrialTask) -> TrialsDone:
        """Perform and process the trials of one trajectory."""
        steps = task.trajectory.steps[: clear_steps(task.trajectory, self._held)]
        answers = self._population.answer(steps)
        counts = {
            name: np.concatenate([rest[None], answers[name]])
            for name, rest in self._population.rest_counts.items()
        }
        kept, dropped = [], []
        for member, error in zip(task.members, task.errors_m, strict=True):
            name = member.unit.name
            try:
                kept.append(_perform(task, steps, member, error, counts[name]))
            except DatasetError as failure:
                dropped.append((name, str(failure)))
        return TrialsDone(task.name, tuple(kept), tuple(dropped), counts, len(steps))


def _perform(
    task: TrialTask, steps: Sequence[Any], member: Member, error: Floats, counts: Floats
) -> TrialRows:
    """One trial: streams as the testbed records them, then the paper's processing."""
    if not steps:
        raise DatasetError(
            f"{member.unit.name} {task.name}: no step before it diverges or meets the mount",
            remedy="nothing to do: the trial is left out, as in the paper",
        )
    start = task.trajectory.path[0, :3]
    poses = np.array([step.pose[:3] for step in steps])
    travel = np.linalg.norm(poses - start, axis=1) - CLEARANCE_M
    tip = np.concatenate([start[None] + CLEARANCE_M * task.direction, poses])
    force = np.concatenate([np.zeros((1, 3)), [step.force for step in steps]])
    contact_m = contact_travel(error, task.direction)
    length_m = min(APPROACH_M + task.planned_m, contact_m + float(travel[-1]))
    unit = member.unit
    label = f"{unit.name}/{task.name}".encode()
    seed = zlib.crc32(label) ^ task.seed
    signals = ElectrodeSignals(unit, counts[0], seed)
    random = np.random.default_rng([seed, 1])

    def read(ideal: Floats, time_s: Floats) -> NDArray[np.uint16]:
        elapsed = np.diff(time_s, prepend=time_s[0])
        walk = np.cumsum(random.standard_normal(len(time_s)) * np.sqrt(elapsed / 60.0))
        drift = unit.temperature_coefficient * TEMPERATURE_WALK_K * walk
        return signals.stream(skewed(ideal, time_s), elapsed, log_sigma=drift)

    raw = perform(
        TrialHeader(unit.name, task.name, task.trajectory.indenter, task.arm),
        travel_m=np.concatenate([[0.0], travel]),
        force=force,
        counts=counts,
        tip=tip,
        read_electrodes=read,
        registration_error_m=error,
        contact_m=contact_m,
        length_m=np.floor(length_m / 1e-4 + 1e-6) * 1e-4,
        since_power_on_s=WARM_S,
        seed=seed,
    )
    return process(raw)


def pack(done: TrialsDone) -> bytes:
    """As the bytes of an .npz file, without pickles."""
    arrays: dict[str, Any] = {"name": np.array(done.name), "units": np.array(list(done.counts))}
    arrays["believed"] = np.array(done.believed)
    arrays["dropped"] = np.array(done.dropped, dtype=str).reshape(-1, 2)
    arrays["rows"] = np.array([list(_header(rows)) for rows in done.rows], dtype=str).reshape(-1, 4)
    for unit, counts in done.counts.items():
        arrays[f"counts/{unit}"] = counts
    for i, rows in enumerate(done.rows):
        for key in ("rest", "travel_m", "tared", "force", "location"):
            arrays[f"{i}/{key}"] = getattr(rows, key)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def unpack(data: bytes) -> TrialsDone:
    """Inverse of `pack`."""
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        rows = tuple(
            TrialRows(
                header=TrialHeader(*(str(word) for word in header)),
                rest=file[f"{i}/rest"],
                travel_m=file[f"{i}/travel_m"],
                tared=file[f"{i}/tared"],
                force=file[f"{i}/force"],
                location=file[f"{i}/location"],
            )
            for i, header in enumerate(file["rows"])
        )
        return TrialsDone(
            name=str(file["name"]),
            rows=rows,
            dropped=tuple((str(unit), str(why)) for unit, why in file["dropped"]),
            counts={str(unit): file[f"counts/{unit}"] for unit in file["units"]},
            believed=int(file["believed"]),
        )


def _header(rows: TrialRows) -> tuple[str, str, str, str]:
    header = rows.header
    return header.unit, header.trajectory, header.indenter, header.arm
