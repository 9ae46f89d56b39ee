"""Many trajectories over processes: into a store, or as the simulator of a calibration.

What has converged is kept, and every early end is reported.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import queue
import resource
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from palpate.errors import (
    ConfigError,
    DatasetError,
    PalpateError,
    RemoteError,
    SimulationError,
)
from palpate.process import Closing
from palpate_fem.arrays import Floats
from palpate_fem.calibration.runs import PlannedPath, SimulatedRun
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.outline import outline_of
from palpate_fem.indenter.path import check_path
from palpate_fem.random_presses import RandomPress
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.service.jobs import (
    JobEnded,
    JobEvent,
    JobFailed,
    JobStarted,
    SimulationJob,
    StepConverged,
    WorkerSetup,
)
from palpate_fem.service.packing import PackingProcesses
from palpate_fem.service.pool import WorkerPool
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.files import StoreTakenError
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter, TrajectoryClaim
from palpate_fem.trajectory import PlannedIndentation

_POLL_S = 0.1
_OWN_FILES = 256  # of libraries, processes and results on their way
_SAME_PATH = 1e-6  # [m, 1]; stores of other processors differ by rounding
FAILED = "failed"
"""Outcome, in a report, of a trajectory that could not be run or whose worker died."""


TrajectoryPlan = PlannedPath | PlannedIndentation | RandomPress
"""One trajectory to run."""


@dataclass(frozen=True, slots=True)
class EarlyEnd:
    """A trajectory that did not complete.

    Attributes:
        name: Its id.
        how: Its outcome, or ``failed``.
        reason: Why it ended.
        steps: Number of steps that converged.
        steps_total: Number of steps of its path.
    """

    name: str
    how: str
    reason: str
    steps: int
    steps_total: int


@dataclass(slots=True)
class BatchReport:
    """How a batch went, or how it is going.

    Attributes:
        total: Trajectories to run.
        outcomes: Number of trajectories by outcome, ``failed`` included.
        early: Every trajectory that did not complete.
        running: Converged steps of the trajectories that run now.
        seconds: Computing time of each trajectory that ended [s].
        on_cpu: Trajectories that a device did not solve and the CPU did.
        stopped: Whether it was stopped before all were run.
        wall_s: Time from the first to the last of them [s].
    """

    total: int
    outcomes: Counter[str] = field(default_factory=Counter)
    early: list[EarlyEnd] = field(default_factory=list)
    running: dict[str, int] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)
    on_cpu: int = 0
    stopped: bool = False
    wall_s: float = 0.0

    @property
    def done(self) -> int:
        """Trajectories that ended, with any outcome."""
        return self.outcomes.total()

    @property
    def failed(self) -> int:
        """Trajectories without a result."""
        return self.outcomes[FAILED]


OnTrajectory = Callable[[TrajectoryPlan, IndentationResult], None]
OnReport = Callable[[BatchReport], None]


class TrajectoryBatch(Protocol):
    """Runs many trajectories on fingertips with one set of parameters."""

    @property
    def ahead(self) -> int:
        """Most trajectories that are taken and have not ended."""
        ...

    def fingertip(self, stop: threading.Event) -> StoredFingertip | None:
        """Wait for the first pressurised fingertip; None if ``stop`` is set before.

        Raises:
            RemoteError: No process starts; says why.
        """
        ...

    def run(
        self,
        plans: Iterable[TrajectoryPlan],
        total: int,
        *,
        stop: threading.Event,
        on_trajectory: OnTrajectory,
        on_report: OnReport | None = None,
    ) -> BatchReport:
        """Run trajectories, as many at once as there is room for.

        Args:
            plans: What to run, with unique names. The next one is taken when there is room.
            total: Number of plans, for the report.
            stop: Set it to end early: what runs then is cancelled and dropped.
            on_trajectory: Called in this thread with every trajectory that was not cancelled,
                complete or not. An exception from it ends the batch.
            on_report: Called in this thread after every event.

        Raises:
            RemoteError: The processes cannot run any more; says why.
        """
        ...


class SimulationBatch(Closing):
    """Runs trajectories on fingertips with one set of parameters, in worker processes.

    Args:
        setup: How workers make fingertips; all trajectories use its ``warm`` parameters.
        workers: Number of worker processes.
        threads: Threads that each may use.
        limit_s: Longest time for one trajectory [s].
        grace_s: Time after that at which a solver that still runs is killed [s].
    """

    def __init__(
        self,
        setup: WorkerSetup,
        *,
        workers: int,
        threads: int,
        limit_s: float = math.inf,
        grace_s: float = 10.0,
    ) -> None:
        self._setup = setup
        self._limit_s = limit_s
        self._first: StoredFingertip | None = None
        self._has_first = threading.Event()
        self._events: queue.SimpleQueue[tuple[TrajectoryPlan, JobEvent]] = queue.SimpleQueue()
        self._pool = WorkerPool(
            setup,
            workers=workers,
            threads=threads,
            waiting=workers,
            grace_s=grace_s,
            on_fingertip=self._keep_first,
        )
        self.ahead = workers + 1

    def fingertip(self, stop: threading.Event) -> StoredFingertip | None:
        """See ``TrajectoryBatch.fingertip``."""
        while not (self._has_first.wait(_POLL_S) or stop.is_set()):
            if self._pool.broken is not None:
                raise self._pool.broken
        return self._first

    def run(
        self,
        plans: Iterable[TrajectoryPlan],
        total: int,
        *,
        stop: threading.Event,
        on_trajectory: OnTrajectory,
        on_report: OnReport | None = None,
    ) -> BatchReport:
        """See ``TrajectoryBatch.run``; as many at once as there are workers."""
        pending: Iterator[TrajectoryPlan] = iter(plans)
        ahead = next(pending, None)
        report, began = BatchReport(total), time.monotonic()
        steps: dict[str, list[IndentationStep]] = {}
        while True:
            # Cancelled jobs still end with an event; the loop goes on until all of them have.
            if stop.is_set() and not report.stopped:
                report.stopped = True
                ahead = None
                for name in steps:
                    self._pool.cancel(name)
            # A trajectory's time runs from its submission, so it must not wait in the queue.
            while ahead is not None and len(steps) < self._pool.ready:
                self._submit(ahead, steps)
                ahead = next(pending, None)
            if ahead is None and not steps:
                report.wall_s = time.monotonic() - began
                return report
            if self._pool.broken is not None:
                raise self._pool.broken
            try:
                plan, event = self._events.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            if isinstance(event, StepConverged):
                steps[plan.name].append(event.step)
                report.running[plan.name] = len(steps[plan.name])
            elif isinstance(event, JobEnded | JobFailed):
                report.running.pop(plan.name, None)
                account_for(report, plan, event, steps.pop(plan.name), on_trajectory)
            if on_report is not None:
                on_report(report)

    def close(self) -> None:
        """End the workers."""
        self._pool.close()

    def _keep_first(self, fingertip: StoredFingertip) -> None:
        # Workers report it with every trajectory, and each copy has a megabyte.
        if not self._has_first.is_set():
            self._first = fingertip
            self._has_first.set()

    def _submit(self, plan: TrajectoryPlan, steps: dict[str, list[IndentationStep]]) -> None:
        job = SimulationJob(plan.name, self._setup.warm, plan.indenter, plan.path, self._limit_s)
        steps[plan.name] = []
        try:
            self._pool.submit(job, lambda event: self._events.put((plan, event)))
        except RemoteError as error:
            self._events.put((plan, JobFailed.of(error)))


def account_for(
    report: BatchReport,
    plan: TrajectoryPlan,
    event: JobEnded | JobFailed,
    steps: Sequence[IndentationStep],
    on_trajectory: OnTrajectory,
) -> None:
    """Count the end of a trajectory, and pass it on unless the batch was stopped.

    Args:
        report: Where it counts.
        plan: The trajectory.
        event: Its end.
        steps: What converged of it.
        on_trajectory: Called with its result if it has one.
    """
    total = len(plan.path) - 1
    if isinstance(event, JobFailed):
        report.outcomes[FAILED] += 1
        report.early.append(EarlyEnd(plan.name, FAILED, event.problem, len(steps), total))
        return
    if event.outcome is IndentationOutcome.CANCELLED:
        return
    report.outcomes[event.outcome.value] += 1
    report.seconds.append(event.seconds)
    if event.outcome is not IndentationOutcome.COMPLETE:
        report.early.append(
            EarlyEnd(plan.name, event.outcome.value, event.reason, len(steps), total)
        )
    on_trajectory(
        plan,
        event.trajectory(plan.indenter, plan.path, steps),
    )


def sweep_into_store(
    batch: TrajectoryBatch,
    plans: Sequence[TrajectoryPlan],
    path: Path,
    *,
    stop: threading.Event,
    on_report: OnReport | None = None,
    stress: bool = False,
    command: str = "",
    packers: int = 0,
) -> tuple[BatchReport, int]:
    """Run the trajectories that a store does not hold yet; each is on the disk when it has ended.

    Several processes may fill one store at the same time. Each trajectory is stored with the
    outline of its indenter, for pictures. One whose path cannot be made counts as failed.

    Args:
        batch: Runs them; the caller closes it.
        plans: All trajectories that the store shall hold.
        path: The store, ``NAME.sim``; created if it does not exist.
        stop: Set it to end early; what runs then is dropped.
        on_report: Called after every event.
        stress: Whether to keep stress.
        command: Command line that runs it, for provenance.
        packers: Processes that make the files, for a batch which is quicker than one core packs;
            a trajectory is then on the disk soon after it was reported. 0 = this process does.

    Returns:
        The report, and the number of trajectories that the store held before. What another process
        had claimed is in neither: it runs there, or was lost with it.

    Raises:
        DatasetError: The store belongs to another fingertip, is damaged or in use, keeps stress
            otherwise than wanted, or the disk refuses.
        RemoteError: The solver does not start.
        ConfigError: The batch takes more trajectories at once than this process may open files.
    """
    allow_open_files(batch.ahead)  # each claim is one
    fingertip = batch.fingertip(stop)
    if fingertip is None:
        return BatchReport(len(plans), stopped=True), 0
    with contextlib.ExitStack() as stack:
        store = stack.enter_context(
            StoreWriter(
                path, fingertip, shared=True, outline=outline_of, stress=stress, command=command
            )
        )
        packing = (
            stack.enter_context(PackingProcesses(store.images, packers)) if packers > 0 else None
        )
        done = store.done()
        left = [plan for plan in plans if plan.name not in done]
        _check_paths(path, [plan for plan in plans if plan.name in done])
        if stress or left:
            _check_stress(store, sorted(done), stress=stress)
            # What has no end there stays beside these, unless they are to end it.
            beside = set(store.ids()) - done - {plan.name for plan in plans}
            _check_stress(store, sorted(beside), stress=stress)
        claims: dict[str, TrajectoryClaim] = {}
        unmade: list[EarlyEnd] = []

        def claimed() -> Iterator[TrajectoryPlan]:
            for plan in left:
                try:
                    plan.path  # noqa: B018 - it may be made only now, which may fail
                except PalpateError as error:
                    unmade.append(EarlyEnd(plan.name, FAILED, error.problem, 0, 0))
                    continue
                with contextlib.suppress(StoreTakenError):  # another process runs it, or has run it
                    claims[plan.name] = store.claim(plan.name)
                    yield plan

        def keep(plan: TrajectoryPlan, trajectory: IndentationResult) -> None:
            claim = claims.pop(plan.name)
            if packing is not None:
                packing.put(claim, trajectory)
                return
            with claim:
                claim.write(trajectory)

        try:
            report = batch.run(
                claimed(), len(left), stop=stop, on_trajectory=keep, on_report=on_report
            )
            if packing is not None:
                packing.finish()
        finally:
            for claim in claims.values():
                claim.close()  # releases what was not written
    if unmade:
        report.outcomes[FAILED] += len(unmade)
        report.early += unmade
    return report, len(plans) - len(left)


def _check_paths(store: Path, known: Sequence[TrajectoryPlan]) -> None:
    """Check that trajectories that are there, three of them, have the paths that are planned.

    Other points, steps or depths change the path of all.

    Raises:
        DatasetError: One has another path.
    """
    if not known:
        return
    held = SimulationStore.open(store)
    for number in sorted({0, len(known) // 2, len(known) - 1}):
        plan, path = known[number], held.summary(known[number].name).path
        if path.shape != plan.path.shape or not np.allclose(path, plan.path, atol=_SAME_PATH):
            raise DatasetError(
                f"{store}: {plan.name} has another path there than is planned now",
                remedy="give the points, seed, steps and depths that it was made with, or another "
                "file",
            )


def _check_stress(store: SimulationStore, names: Sequence[str], *, stress: bool) -> None:
    """Check that trajectories that are there, three of them, have stress as others will.

    Raises:
        DatasetError: One differs.
    """
    for name in {names[0], names[len(names) // 2], names[-1]} if names else ():
        with store.group(name) as group:
            differs = len(group["pose"]) > 0 and ("stress" in group) is not stress
        if differs:
            raise DatasetError(
                f"{store.path}: {name} was stored {'without' if stress else 'with'} stress",
                remedy=f"{'leave out' if stress else 'give'} --stress, or name another store",
            )


def allow_open_files(count: int) -> None:
    """Let this process open so many files beside its own, if the system does.

    Raises:
        ConfigError: It does not.
    """
    wanted = count + _OWN_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return
    if hard != resource.RLIM_INFINITY and hard < wanted:
        raise ConfigError(
            f"{count} trajectories at once need as many open files; {hard} are allowed",
            remedy="give fewer --slots, or raise the limit: ulimit -Hn",
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


class PoolSimulator(Closing):
    """Runs indentations in worker processes, as a ``Simulator`` that many threads may call.

    Each call waits for its own result, so it takes as many threads as there are workers: run it in
    a ``ThreadPoolExecutor``. If a worker dies, only its own run fails.

    Args:
        setup: How workers make fingertips.
        workers: Number of worker processes.
        threads: Threads that each may use.
        limit_s: Longest time for one run [s].
    """

    def __init__(
        self, setup: WorkerSetup, *, workers: int, threads: int, limit_s: float = math.inf
    ) -> None:
        self._limit_s = limit_s
        self._numbers = itertools.count()
        self._pool = WorkerPool(setup, workers=workers, threads=threads, waiting=10_000)

    def simulate(
        self, parameters: FingertipParameters, indenter: str, path: Floats
    ) -> SimulatedRun:
        """Indent a finger of these parameters along a path, shape (K, 7).

        Raises:
            SimulationError: It cannot be run; says why.
        """
        events: queue.SimpleQueue[JobEvent] = queue.SimpleQueue()
        poses = check_path(path)
        job = SimulationJob(str(next(self._numbers)), parameters, indenter, poses, self._limit_s)
        self._pool.submit(job, events.put)
        steps: list[IndentationStep] = []
        thickness_m = fluid_m3 = math.nan
        while True:
            event = events.get()
            if isinstance(event, JobStarted):
                thickness_m = event.fingertip.total_thickness_m
                fluid_m3 = event.fingertip.fluid_volume_m3
            elif isinstance(event, StepConverged):
                steps.append(event.step)
            elif isinstance(event, JobFailed):
                raise SimulationError(event.problem, remedy=event.remedy)
            elif isinstance(event, JobEnded):
                done = event.trajectory(indenter, poses, steps)
                return SimulatedRun.of(done, thickness_m=thickness_m, fluid_volume_m3=fluid_m3)

    def close(self) -> None:
        """End the workers."""
        self._pool.close()
