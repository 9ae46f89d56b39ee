"""The finite elements as the experiment of the training room uses them.

Training states in `palpate_training.experiment.generate.simulator` what it needs; this module is
the implementation, and the only place where the two rooms meet.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from palpate.cluster import RayCluster
from palpate.errors import ConfigError, DatasetError, SimulationError
from palpate_fem.calibration.runs import PlannedPath
from palpate_fem.config import FingertipParameters
from palpate_fem.electrodes.electronics import (
    ElectrodeSignals,
    core_temperature_c,
    log_sigma,
    skewed,
)
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.indenter.catalogue import BETWEEN, indenter_names, make_indenter
from palpate_fem.indenter.path import parse_segments
from palpate_fem.population.members import Member, read_population
from palpate_fem.population.responses import Population, clear_steps
from palpate_fem.random_presses import RandomPress, random_presses
from palpate_fem.result import IndentationResult
from palpate_fem.service.batch import (
    BatchReport,
    SimulationBatch,
    TrajectoryPlan,
    sweep_into_store,
)
from palpate_fem.service.biotac import BiotacTip, biotac
from palpate_fem.service.config import DEFAULT_FACTORY
from palpate_fem.service.device_batch import SLOTS, DeviceBatch, threads_and_packers
from palpate_fem.service.device_process import check_devices
from palpate_fem.service.fingertips import skin_of
from palpate_fem.service.jobs import WorkerSetup
from palpate_fem.service.ray_batch import RayBatch, cluster_packers
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.read import SimulationStore
from palpate_fem.trajectory import (
    CLEARANCE_M,
    Campaign,
    PlannedIndentation,
    angled_direction,
    points_first,
    segment_path,
)
from palpate_training.experiment.generate.simulator import (
    SKIN,
    ElectrodeStream,
    ExperimentSpec,
    OnProgress,
    PressedSpecimens,
    SimulatedFingertip,
    SimulatedTrajectory,
    Specimen,
)
from palpate_training.experiment.plan import (
    INCREMENT_M,
    PlannedManipulation,
    PlannedTrajectory,
    assign_arm,
)

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
    given = {name: getattr(spec, name) for name in SKIN if getattr(spec, name) is not None}
    return FingertipParameters(fluid_volume_m3=spec.fluid_volume_m3, **given)


def fingertip_settings(parameters: FingertipParameters) -> dict[str, float]:
    """A drawn fingertip as settings of an experiment, without what is not drawn."""
    values = {name: getattr(parameters, name) for name in (*SKIN, "fluid_volume_m3")}
    return {name: value for name, value in values.items() if value is not None}


def _mesh_options(spec: ExperimentSpec) -> dict[str, object]:
    return {"layers": spec.layers, "edge_m": spec.edge_m, "solver": dict(SOLVER)}


def specimens_of(members: Iterable[Member]) -> tuple[Specimen, ...]:
    """Members of a population as specimens."""
    return tuple(
        Specimen(
            name=member.specimen.name,
            overtravel_m=member.overtravel_m,
            temperature_coefficient=member.specimen.temperature_coefficient,
            parameters=member.specimen,
            parameters_json=member.specimen.to_json(),
            content=member.to_dict(),
            pressed_with=member.pressed_with,
            stream=partial(_stream, member.specimen),
            warming=partial(_warming, member.specimen),
        )
        for member in members
    )


def _stream(unit: SpecimenParameters, rest: Floats, seed: int) -> ElectrodeStream:
    signals = ElectrodeSignals(unit, rest, seed)
    return lambda ideal, time_s, elapsed_s, warmth: signals.stream(
        skewed(ideal, time_s), elapsed_s, log_sigma=warmth
    )


def _warming(unit: SpecimenParameters, age_s: Floats) -> Floats:
    core = [core_temperature_c(float(age), AMBIENT_C, unit) for age in age_s]
    return np.array([log_sigma(temperature_c, unit) for temperature_c in core])


def read_specimens(population: Path | None) -> tuple[Specimen, ...]:
    """Specimens of a population's file; None = the three that come with palpate.

    Raises:
        ConfigError: No such file, or it is no population.
    """
    return specimens_of(read_population(population))


@dataclass(frozen=True, slots=True)
class FilmFactory:
    """Makes the electrodes of specimens in a worker, which keeps them; equal by what it makes."""

    key: str
    units: tuple[SpecimenParameters, ...]
    fingertip: StoredFingertip = field(compare=False)

    def __call__(self) -> PressedSpecimens:
        """Prepare the films; takes seconds."""
        return cast("PressedSpecimens", Population(self.fingertip, self.units))


def _build(spec: ExperimentSpec) -> BiotacTip:
    build: Callable[..., Any] = biotac(**_mesh_options(spec))  # type: ignore[arg-type]
    tip: BiotacTip = build(parameters_of(spec), lambda _: None)
    return tip


def _indenters(spec: ExperimentSpec) -> tuple[str, ...]:
    """Names of an experiment's indenters."""
    named = tuple(make_indenter(name).name for name in spec.indenters)
    return named or indenter_names() + (BETWEEN if spec.presses else ())


def with_indenters_met(spec: ExperimentSpec, specimens: Sequence[Specimen]) -> ExperimentSpec:
    """An experiment with those of its indenters that some specimen was pressed with.

    Raises:
        ConfigError: There is none.
    """
    names = _indenters(spec)
    met = tuple(name for name in names if any(one.pressed_with(name) for one in specimens))
    if not met:
        who = ", ".join(one.name for one in specimens)
        raise ConfigError(
            f"no specimen of {who} was pressed with {', '.join(names)}",
            remedy="name other indenters, or other specimens with --units",
        )
    return spec if met == names else replace(spec, indenters=met)


def _presses(spec: ExperimentSpec, fingertip: SimulatedFingertip) -> Sequence[PlannedIndentation]:
    """All planned presses, first points first."""
    plans = Campaign(
        skin_of(cast("StoredFingertip", fingertip)),
        _indenters(spec),
        points=spec.points,
        seed=spec.seed,
        angled=spec.angled,
        increment_m=INCREMENT_M,
        overtravel_m=spec.overtravel_m,
    )
    return points_first(plans)


def _paths(
    spec: ExperimentSpec, fingertip: SimulatedFingertip
) -> Iterator[tuple[PlannedManipulation, Floats]]:
    """The experiment's other paths at the targets of its presses, with their poses."""
    skin = skin_of(cast("StoredFingertip", fingertip))
    for press in _presses(replace(spec, angled=0), fingertip) if spec.paths else ():
        place = press.name.removesuffix("/normal")
        for number, words in enumerate(spec.paths):
            segments = parse_segments(words)
            first = angled_direction(press.normal, segments[0].angle_rad, segments[0].azimuth_rad)
            poses = segment_path(
                make_indenter(press.indenter),
                press.target,
                press.normal,
                segments,
                skin,
                step_m=INCREMENT_M,
            )
            name, arm = f"{place}/path-{number}", assign_arm(press.target)
            yield PlannedManipulation(name, press.indenter, arm, first), poses


def _random(spec: ExperimentSpec, fingertip: SimulatedFingertip) -> Iterator[RandomPress]:
    skin = skin_of(cast("StoredFingertip", fingertip))
    return random_presses(skin, spec.presses, seed=spec.seed, indenters=_indenters(spec))


def _campaign(spec: ExperimentSpec, fingertip: SimulatedFingertip) -> Sequence[TrajectoryPlan]:
    """All trajectories to simulate."""
    if spec.presses:
        return [*_random(spec, fingertip)]
    others = [
        PlannedPath(plan.trajectory, plan.indenter, poses)
        for plan, poses in _paths(spec, fingertip)
    ]
    return [*_presses(spec, fingertip), *others]


@dataclass(frozen=True)
class FemSimulator:
    """Skin by finite elements, electrodes by the film's conduction; one equals another."""

    clearance_m: float = CLEARANCE_M

    def fingertip(self, spec: ExperimentSpec) -> StoredFingertip:
        """Pressurise the fingertip of an experiment, in this process."""
        return _build(spec).describe()

    def plans(
        self, spec: ExperimentSpec, fingertip: SimulatedFingertip
    ) -> Sequence[PlannedTrajectory]:
        """All planned presses, each for the arm on its side of the finger."""
        return [
            PlannedTrajectory(
                trajectory=plan.name,
                indenter=plan.indenter,
                arm=assign_arm(plan.target),
                target=plan.target,
                direction=plan.direction,
                contact_m=plan.contact_m,
                depth_m=plan.depth_m,
            )
            for plan in ([] if spec.presses else _presses(spec, fingertip))
        ]

    def manipulations(
        self, spec: ExperimentSpec, fingertip: SimulatedFingertip
    ) -> Sequence[PlannedManipulation]:
        """The other paths at each point, or presses at random."""
        if spec.presses:
            return [
                PlannedManipulation(one.name, one.indenter, assign_arm(one.target), one.direction)
                for one in _random(spec, fingertip)
            ]
        return [plan for plan, _ in _paths(spec, fingertip)]

    def simulate(
        self,
        spec: ExperimentSpec,
        store: Path,
        *,
        workers: int,
        threads: int,
        stop: threading.Event,
        on_progress: OnProgress,
        devices: tuple[str, ...] = (),
        slots: int | None = None,
        cluster: RayCluster | None = None,
    ) -> bool:
        """Fill the store; what it holds is not run again, and only this host writes.

        Raises:
            DatasetError: The store is another fingertip's or damaged, or the disk refuses.
            RemoteError: The solver does not start.
            SimulationError: Trajectories failed or ran out of time; what ended otherwise is kept.
            ConfigError: There is no such device.
        """
        setup = WorkerSetup(DEFAULT_FACTORY, _mesh_options(spec), parameters_of(spec), 1)
        # Of very many presses at random a few may be shorter than they could be.
        gives_up = spec.presses > 0
        batch: SimulationBatch | DeviceBatch | RayBatch
        if cluster is not None:
            packers = cluster_packers()
            batch = RayBatch(
                cluster,
                setup,
                device=devices[0] if devices else None,
                slots=slots or SLOTS,
                limit_s=LIMIT_S,
                indenters=_indenters(spec),
                gives_up=gives_up,
            )
        elif devices:
            check_devices(devices)
            threads, packers = threads_and_packers(devices)
            batch = DeviceBatch(
                setup,
                devices,
                slots=slots or SLOTS,
                threads=threads,
                limit_s=LIMIT_S,
                indenters=_indenters(spec),
                gives_up=gives_up,
            )
        else:
            packers = 0
            batch = SimulationBatch(setup, workers=workers, threads=threads, limit_s=LIMIT_S)
        with batch:
            fingertip = batch.fingertip(stop)
            if fingertip is None:
                return False
            plans = _campaign(spec, fingertip)

            def on_report(report: BatchReport) -> None:
                present = len(plans) - report.total
                word = "  ".join(f"{how} {count}" for how, count in sorted(report.outcomes.items()))
                on_progress(report.done + present, len(plans), word)

            report, _ = sweep_into_store(
                batch,
                plans,
                store,
                stop=stop,
                on_report=on_report,
                command=COMMAND,
                packers=packers,
            )
            if report.stopped:
                return False
            missing = {plan.name for plan in plans} - SimulationStore.open(store).done()
            failed = [early for early in report.early if early.name in missing]
            if failed:
                first = failed[0]
                raise SimulationError(
                    f"{len(failed)} of {len(plans)} trajectories failed, the first is "
                    f"{first.name}: {first.reason or first.how}",
                    remedy="run this again: it goes on; with fewer --workers if memory or time "
                    "were short",
                )
            if missing:  # claimed by a process that runs it still, or that was lost
                raise DatasetError(
                    f"{len(missing)} of {len(plans)} trajectories are not in {store}: another "
                    "process has claimed them",
                    remedy="wait until it has ended, and run this again: it goes on",
                )
            return True

    def open_store(self, path: Path) -> SimulationStore:
        """Open a simulation store."""
        return SimulationStore.open(path)

    def make_specimens(
        self, fingertip: SimulatedFingertip, specimens: Iterable[Specimen]
    ) -> FilmFactory:
        """What makes the specimens' electrodes in a worker process."""
        tip = cast("StoredFingertip", fingertip)
        return FilmFactory(tip.key, tuple(one.parameters for one in specimens), tip)

    def clear_steps(self, indentation: SimulatedTrajectory, fingertip: SimulatedFingertip) -> int:
        """How many steps there are before the indenter bears on what holds the finger."""
        held = cast("StoredFingertip", fingertip).mesh.fixed
        return clear_steps(cast("IndentationResult", indentation), held)
