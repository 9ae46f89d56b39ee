"""The finite elements as the experiment of the training room uses them.

Training states in `palpate_training.experiment.generate.simulator` what it needs; this module is
the implementation, and the only place where the two rooms meet.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from palpate_fem.config import FingertipParameters
from palpate_fem.electrodes.electronics import (
    ElectrodeSignals,
    core_temperature_c,
    log_sigma,
    skewed,
)
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.outline import outline_of
from palpate_fem.population.members import Member, read_population
from palpate_fem.population.responses import Population, clear_steps
from palpate_fem.result import IndentationResult, IndentationStep
from palpate_fem.service.batch import BatchReport, SimulationBatch, sweep_into_store
from palpate_fem.service.biotac import BiotacTip, biotac
from palpate_fem.service.config import DEFAULT_FACTORY
from palpate_fem.service.fingertips import skin_of
from palpate_fem.service.jobs import WorkerSetup
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.files import StoreTakenError
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter, TrajectoryClaim
from palpate_fem.trajectory import CLEARANCE_M, Campaign, PlannedIndentation
from palpate_training.experiment.generate.simulator import (
    ExperimentSpec,
    OnProgress,
    SimulatedFingertip,
    SimulatedStep,
    SimulatedTrajectory,
    Specimen,
)
from palpate_training.experiment.generate.workers import RayCluster
from palpate_training.experiment.plan import INCREMENT_M

Floats = NDArray[np.float64]

COMMAND = "palpate data generate"

LIMIT_S = 600.0
"""Longest time for one trajectory [s]; none has needed a third of it."""

SOLVER: dict[str, bool | int | float | str] = {"smallest_increment": 0.125}
"""A pinched skin that needs finer increments than an eighth seldom converges at all."""

AMBIENT_C = 25.0
"""Temperature around a sensor that warms up [degrees C]."""


def parameters_of(spec: ExperimentSpec) -> FingertipParameters:
    """Parameters of an experiment's fingertip."""
    return FingertipParameters(fluid_volume_m3=spec.fluid_volume_m3)


def _mesh_options(spec: ExperimentSpec) -> dict[str, object]:
    return {"layers": 2, "edge_m": spec.edge_m, "solver": dict(SOLVER)}


@dataclass(frozen=True, slots=True)
class FemSpecimen:
    """A member of a population, as the experiment presses it."""

    member: Member

    @property
    def name(self) -> str:
        """E.g. ``biotac-1``."""
        return self.member.specimen.name

    @property
    def overtravel_m(self) -> float:
        """How much deeper it is pressed than planned [m]."""
        return self.member.overtravel_m

    @property
    def temperature_coefficient(self) -> float:
        """Change of ln conductivity with temperature [1/K]."""
        return self.member.specimen.temperature_coefficient

    def pressed_with(self, indenter: str) -> bool:
        """Whether it meets an indenter."""
        return self.member.published.pressed_with(indenter)

    def content(self) -> dict[str, Any]:
        """All that decides its rows, as plain values."""
        return self.member.to_dict()

    def to_json(self) -> str:
        """Its electrical parameters."""
        return self.member.specimen.to_json()

    def stream(self, rest: Floats, seed: int) -> FemElectrodeStream:
        """Its electrodes over time, from the untouched state."""
        return FemElectrodeStream(ElectrodeSignals(self.member.specimen, rest, seed))

    def warming(self, age_s: Floats) -> Floats:
        """Return ln of the conductivity at ages since power-on [s], shape (T,)."""
        unit = self.member.specimen
        core = [core_temperature_c(float(age), AMBIENT_C, unit) for age in age_s]
        return np.array([log_sigma(temperature_c, unit) for temperature_c in core])


def specimens_of(members: Iterable[Member]) -> tuple[FemSpecimen, ...]:
    """Members of a population as specimens."""
    return tuple(FemSpecimen(member) for member in members)


def read_specimens(population: Path | None) -> tuple[FemSpecimen, ...]:
    """Specimens of a population's file; None = the three that come with palpate.

    Raises:
        ConfigError: No such file, or it is no population.
    """
    return specimens_of(read_population(population))


@dataclass(frozen=True, slots=True)
class FemElectrodeStream:
    """The electrodes of one specimen over time."""

    signals: ElectrodeSignals

    def read(
        self, ideal: Floats, time_s: Floats, elapsed_s: Floats, log_sigma: Floats
    ) -> NDArray[np.uint16]:
        """Counts of ideal counts, each electrode at its own instant of the frame."""
        return self.signals.stream(skewed(ideal, time_s), elapsed_s, log_sigma=log_sigma)


class FemSpecimens:
    """Electrodes of specimens on one fingertip."""

    def __init__(self, fingertip: StoredFingertip, units: Sequence[SpecimenParameters]) -> None:
        self._population = Population(fingertip, units)
        self._held = fingertip.mesh.fixed

    @property
    def rest_counts(self) -> Mapping[str, Floats]:
        """Ideal counts of each untouched specimen."""
        return self._population.rest_counts

    def clear_steps(self, indentation: SimulatedTrajectory) -> int:
        """How many steps there are before the indenter bears on what holds the finger."""
        return clear_steps(cast("IndentationResult", indentation), self._held)

    def counts(self, steps: Sequence[SimulatedStep]) -> Mapping[str, Floats]:
        """Ideal counts of each specimen at each step."""
        return self._population.counts(cast("Sequence[IndentationStep]", steps))


class FemSpecimensOf:
    """Makes `FemSpecimens` in a worker, which keeps them: equal factories make equal ones."""

    def __init__(self, fingertip: StoredFingertip, units: tuple[SpecimenParameters, ...]) -> None:
        self._fingertip, self._units = fingertip, units
        self._key = (fingertip.key, units)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FemSpecimensOf) and self._key == other._key

    def __call__(self) -> FemSpecimens:
        """Prepare the films; takes seconds."""
        return FemSpecimens(self._fingertip, self._units)


class FemStore:
    """A simulation store, as the experiment reads it."""

    def __init__(self, path: Path) -> None:
        self._store = SimulationStore.open(path)
        self.path = path

    def ids(self) -> Sequence[str]:
        """Ids of the trajectories that are there."""
        return self._store.ids()

    def fingertip(self) -> StoredFingertip:
        """What was pressed."""
        return self._store.fingertip()

    def indentation(self, name: str) -> IndentationResult:
        """A trajectory with its fields."""
        return self._store.trajectory(name)

    def start_pose(self, name: str) -> Floats:
        """First pose of a trajectory's path."""
        return np.asarray(self._store.summary(name).path[0])


@dataclass(frozen=True, slots=True)
class _MechanicsTask:
    """A trajectory for a machine of a cluster to simulate."""

    spec: ExperimentSpec
    name: str
    indenter: str
    path: Floats


def _simulate(task: _MechanicsTask) -> IndentationResult:
    """Run a trajectory on this process's fingertip."""
    friction = parameters_of(task.spec).friction_coefficient
    return _fingertip(task.spec).indent(task.indenter, task.path, friction_coefficient=friction)


@lru_cache(maxsize=1)
def _fingertip(spec: ExperimentSpec) -> BiotacTip:
    build: Callable[..., Any] = biotac(**_mesh_options(spec))  # type: ignore[arg-type]
    tip: BiotacTip = build(parameters_of(spec), lambda _: None)
    return tip


class FemSimulator:
    """Skin by finite elements, electrodes by the film's conduction."""

    clearance_m = CLEARANCE_M

    def fingertip(self, spec: ExperimentSpec) -> StoredFingertip:
        """Pressurise the fingertip of an experiment, in this process."""
        build: Callable[..., Any] = biotac(**_mesh_options(spec))  # type: ignore[arg-type]
        described: StoredFingertip = build(parameters_of(spec), lambda _: None).describe()
        return described

    def plans(
        self, spec: ExperimentSpec, fingertip: SimulatedFingertip
    ) -> Sequence[PlannedIndentation]:
        """All planned trajectories, first points first: what is there early is a fair sample."""
        names = tuple(make_indenter(name).name for name in spec.indenters) or indenter_names()
        plans = Campaign(
            skin_of(cast("StoredFingertip", fingertip)),
            names,
            points=spec.points,
            seed=spec.seed,
            angled=spec.angled,
            increment_m=INCREMENT_M,
            overtravel_m=spec.overtravel_m,
        )
        return sorted(plans, key=lambda plan: (*plan.name.split("/")[1:], plan.name))

    def simulate(
        self,
        spec: ExperimentSpec,
        store: Path,
        *,
        workers: int,
        threads: int,
        stop: threading.Event,
        on_progress: OnProgress,
    ) -> bool:
        """Fill the store on this host; what it holds is not run again.

        Raises:
            DatasetError: The store is another fingertip's or damaged, or the disk refuses.
            RemoteError: The solver does not start.
        """
        setup = WorkerSetup(DEFAULT_FACTORY, _mesh_options(spec), parameters_of(spec), 1)
        batch = SimulationBatch(setup, workers=workers, threads=threads, limit_s=LIMIT_S)
        try:
            fingertip = batch.fingertip(stop)
            if fingertip is None:
                return False
            plans = self.plans(spec, fingertip)

            def on_report(report: BatchReport) -> None:
                present = len(plans) - report.total
                on_progress(report.done + present, len(plans), _outcomes(report))

            report, _ = sweep_into_store(
                batch, plans, store, stop=stop, on_report=on_report, command=COMMAND
            )
            return not report.stopped
        finally:
            batch.close()

    def simulate_on_cluster(
        self, spec: ExperimentSpec, store: Path, cluster: RayCluster, *, on_progress: OnProgress
    ) -> bool:
        """Fill the store with what the machines of a cluster simulate; this host only writes.

        Raises:
            DatasetError: The store is another fingertip's or damaged, or the disk refuses.
            WorkerLostError: The cluster lost machines again and again.
        """
        fingertip = self.fingertip(spec)
        plans = self.plans(spec, fingertip)
        with StoreWriter(
            store, fingertip, shared=True, outline=outline_of, command=COMMAND
        ) as writer:
            done = writer.done()
            places: dict[str, TrajectoryClaim] = {}

            def claimed() -> Iterator[_MechanicsTask]:
                for plan in plans:
                    if plan.name in done:
                        continue
                    # another command may be simulating it
                    with contextlib.suppress(StoreTakenError):
                        places[plan.name] = writer.claim(plan.name)
                        yield _MechanicsTask(spec, plan.name, plan.indenter, plan.path)

            count = len(done)
            try:
                for task, trajectory in cluster.run(_simulate, claimed()):
                    with places.pop(task.name) as place:
                        place.write(trajectory)
                    count += 1
                    on_progress(count, len(plans), trajectory.outcome.value)
            finally:
                for place in places.values():
                    place.close()
        return True

    def open_store(self, path: Path) -> FemStore:
        """Open a simulation store."""
        return FemStore(path)

    def make_specimens(
        self, fingertip: SimulatedFingertip, specimens: Iterable[Specimen]
    ) -> FemSpecimensOf:
        """What makes the specimens' electrodes in a worker process."""
        units = tuple(cast("FemSpecimen", specimen).member.specimen for specimen in specimens)
        return FemSpecimensOf(cast("StoredFingertip", fingertip), units)

    def clear_steps(self, indentation: SimulatedTrajectory, fingertip: SimulatedFingertip) -> int:
        """How many steps there are before the indenter bears on what holds the finger."""
        held = cast("StoredFingertip", fingertip).mesh.fixed
        return clear_steps(cast("IndentationResult", indentation), held)


def _outcomes(report: BatchReport) -> str:
    return "  ".join(f"{how} {count}" for how, count in sorted(report.outcomes.items()))
