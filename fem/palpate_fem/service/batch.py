"""Many trajectories over worker processes; what has converged is kept, every early end is told."""

from __future__ import annotations

import contextlib
import math
import queue
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from palpate.errors import RemoteError
from palpate_fem.config import FingertipParameters
from palpate_fem.result import Floats, IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.service.jobs import Ended, Event, Failed, Job, Setup, Stepped
from palpate_fem.service.pool import Pool
from palpate_fem.store.content import StoredFingertip

_LOOK_S = 0.1
FAILED = "failed"
"""What a report calls a trajectory that could not be run, or whose worker died."""


class Plan(Protocol):
    """One trajectory to run, e.g. ``palpate_fem.trajectory.Indentation``."""

    @property
    def name(self) -> str:
        """Its id in a store, unique."""
        ...

    @property
    def indenter(self) -> str:
        """Name of the indenter."""
        ...

    @property
    def path(self) -> Floats:
        """Poses, shape (K, 7); the first does not touch the skin."""
        ...


@dataclass(frozen=True, slots=True)
class Press:
    """A plan of one's own."""

    name: str
    indenter: str
    path: Floats


@dataclass(frozen=True, slots=True)
class Early:
    """A trajectory that did not complete.

    Attributes:
        name: Which.
        how: Its outcome, or ``failed``.
        reason: Why.
        steps: Steps that converged.
        steps_total: Steps of its path.
    """

    name: str
    how: str
    reason: str
    steps: int
    steps_total: int


@dataclass(slots=True)
class BatchReport:
    """How a batch went; also how it goes, while it does.

    Attributes:
        total: Trajectories to run.
        outcomes: How many ended how; ``failed`` among them.
        early: Every trajectory that did not complete.
        running: Steps done by the trajectories that run now.
        seconds: Time that each one took that ended [s].
        stopped: Whether it was stopped before all were run.
    """

    total: int
    outcomes: Counter[str] = field(default_factory=Counter)
    early: list[Early] = field(default_factory=list)
    running: dict[str, int] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)
    stopped: bool = False

    @property
    def done(self) -> int:
        """Trajectories that ended, whatever the outcome."""
        return self.outcomes.total()

    @property
    def failed(self) -> int:
        """Trajectories of which nothing is known."""
        return self.outcomes[FAILED]


OnTrajectory = Callable[[Plan, IndentationResult], None]
OnReport = Callable[[BatchReport], None]


class Batch:
    """Runs trajectories on fingertips of one set of parameters.

    Args:
        setup: How workers make fingertips; all trajectories run with its ``warm`` parameters.
        workers: Worker processes.
        threads: Threads that each may use.
        limit_s: Longest time that one trajectory may take [s].
        grace_s: How long a solver may go on after that before it is killed [s].
    """

    def __init__(
        self,
        setup: Setup,
        *,
        workers: int,
        threads: int,
        limit_s: float = math.inf,
        grace_s: float = 10.0,
    ) -> None:
        self._setup = setup
        self._limit_s = limit_s
        self._fingertip: queue.SimpleQueue[StoredFingertip] = queue.SimpleQueue()
        self._first: StoredFingertip | None = None
        self._events: queue.SimpleQueue[tuple[Plan, Event]] = queue.SimpleQueue()
        self._pool = Pool(
            setup,
            workers=workers,
            threads=threads,
            waiting=workers,
            grace_s=grace_s,
            on_fingertip=self._fingertip.put,
        )

    def fingertip(self, stop: threading.Event) -> StoredFingertip | None:
        """Wait for the first pressurised fingertip; None = told to stop.

        Raises:
            RemoteError: None will ever come; says why.
        """
        while self._first is None and not stop.is_set():
            if self._pool.broken is not None:
                raise self._pool.broken
            with contextlib.suppress(queue.Empty):
                self._first = self._fingertip.get(timeout=_LOOK_S)
        return self._first

    def run(
        self,
        plans: Iterable[Plan],
        total: int,
        *,
        stop: threading.Event,
        on_trajectory: OnTrajectory,
        on_report: OnReport | None = None,
    ) -> BatchReport:
        """Run them all, as many at once as there are workers.

        Args:
            plans: What to run; names unique. The next one is taken when a worker is free.
            total: How many they are, for the report.
            stop: Set it to end early: what runs is cancelled and not kept.
            on_trajectory: Called in this thread with everything that ended by itself, complete or
                not. What it raises ends the batch.
            on_report: Called in this thread whenever something has happened.

        Raises:
            RemoteError: The workers cannot run any more; says why.
        """
        pending: Iterator[Plan] = iter(plans)
        ahead = next(pending, None)
        report = BatchReport(total)
        steps: dict[str, list[IndentationStep]] = {}
        while True:
            if stop.is_set() and not report.stopped:
                report.stopped = True
                ahead = None
                for name in steps:
                    self._pool.cancel(name)
            # Not before a worker can take it: its time runs from here.
            while ahead is not None and len(steps) < self._pool.ready:
                self._submit(ahead, steps)
                ahead = next(pending, None)
            if ahead is None and not steps:
                return report
            if self._pool.broken is not None:
                raise self._pool.broken
            try:
                plan, event = self._events.get(timeout=_LOOK_S)
            except queue.Empty:
                continue
            if isinstance(event, Stepped):
                steps[plan.name].append(event.step)
                report.running[plan.name] = len(steps[plan.name])
            elif isinstance(event, Ended | Failed):
                report.running.pop(plan.name, None)
                _account(report, plan, event, steps.pop(plan.name), on_trajectory)
            if on_report is not None:
                on_report(report)

    def close(self) -> None:
        """End the workers."""
        self._pool.close()

    def _submit(self, plan: Plan, steps: dict[str, list[IndentationStep]]) -> None:
        job = Job(plan.name, self._parameters, plan.indenter, plan.path, self._limit_s)
        steps[plan.name] = []
        try:
            self._pool.submit(job, lambda event: self._events.put((plan, event)))
        except RemoteError as error:
            self._events.put((plan, Failed.of(error)))

    @property
    def _parameters(self) -> FingertipParameters:
        return self._setup.warm


def _account(
    report: BatchReport,
    plan: Plan,
    event: Ended | Failed,
    steps: Sequence[IndentationStep],
    on_trajectory: OnTrajectory,
) -> None:
    """Count how one ended, and hand it on unless it was stopped by whoever stops the batch."""
    total = len(plan.path) - 1
    if isinstance(event, Failed):
        report.outcomes[FAILED] += 1
        report.early.append(Early(plan.name, FAILED, event.problem, len(steps), total))
        return
    if event.outcome is IndentationOutcome.CANCELLED:
        return
    report.outcomes[event.outcome.value] += 1
    report.seconds.append(event.seconds)
    if event.outcome is not IndentationOutcome.COMPLETE:
        report.early.append(Early(plan.name, event.outcome.value, event.reason, len(steps), total))
    on_trajectory(
        plan,
        IndentationResult(
            plan.indenter,
            plan.path,
            tuple(steps),
            event.outcome,
            event.reason,
            event.travel_m,
            event.seconds,
        ),
    )
