"""Which worker a job gets; with processes that are only remembered."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate_fem.config import FingertipParameters
from palpate_fem.result import IndentationOutcome
from palpate_fem.service import pool
from palpate_fem.service.jobs import (
    JobEnded,
    JobEvent,
    JobStarted,
    JobWaiting,
    SimulationJob,
    WorkerSetup,
)
from palpate_fem.service.pool import WorkerPool, WorkerState
from palpate_fem.store.content import StoredFingertip

sample: Any = importlib.import_module("stored_sample")
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip

PATIENCE_S = 30.0
WARM, THIN, THICK = (FingertipParameters(skin_thickness_m=m) for m in (1.57e-3, 1.2e-3, 1.9e-3))
TIP = sample_fingertip(divisions=2)


class FakeProcess:
    """A worker that starts at once and runs a job until it is told to end it."""

    def __init__(
        self,
        setup: WorkerSetup,
        threads: int,
        on_event: Callable[[Any, JobEvent], None],
        on_gone: Callable[[Any], None],
    ) -> None:
        self.state = WorkerState.STARTING
        self.pid = 0
        self.jobs: list[SimulationJob] = []
        self.cancelled: set[str] = set()
        self.hears_late = False
        self.report = on_event

    def built(self, parameters: FingertipParameters) -> None:
        self.report(self, JobStarted(replace(TIP, parameters=parameters)))

    def start(self, job: SimulationJob) -> None:
        self.state = WorkerState.BUSY
        self.jobs.append(job)

    def end(self) -> None:
        self.built(self.jobs[-1].parameters)
        stopped = self.jobs[-1].id in self.cancelled
        outcome = IndentationOutcome.CANCELLED if stopped else IndentationOutcome.COMPLETE
        self.report(self, JobEnded(outcome, seconds=1.0))

    def cancel(self, job_id: str) -> None:
        if self.hears_late:
            self.end()
        self.cancelled.add(job_id)

    def end_if_stuck(self) -> None:
        return

    def kill(self) -> None:
        return

    def join(self) -> None:
        return


class Bench:
    """A pool of two warm workers, each of which keeps two fingertips."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.workers: list[FakeProcess] = []

        def start(*args: Any) -> FakeProcess:
            self.workers.append(FakeProcess(*args))
            return self.workers[-1]

        monkeypatch.setattr(pool, "WorkerProcess", start)
        self.pool = WorkerPool(WorkerSetup("", {}, WARM, keep=2), workers=2, threads=1, waiting=4)
        deadline = time.monotonic() + PATIENCE_S
        while len(self.workers) < 2:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        for worker in self.workers:
            worker.built(WARM)
        self.events: list[JobEvent] = []
        self.count = 0

    def run(self, parameters: FingertipParameters) -> int:
        """Submit a job; the number of the worker that got it."""
        before = [len(worker.jobs) for worker in self.workers]
        self.count += 1
        # Friction does not change the fingertip, so it must not matter.
        other = replace(parameters, friction_coefficient=0.01 * self.count)
        job = SimulationJob(str(self.count), other, "cube", np.zeros((2, 7)), PATIENCE_S)
        self.pool.submit(job, self.events.append)
        after = [len(worker.jobs) for worker in self.workers]
        return next(i for i in range(2) if after[i] > before[i])

    def end(self, number: int) -> None:
        self.workers[number].end()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    made = Bench(monkeypatch)
    yield made
    made.pool.close()


def test_a_job_goes_to_the_worker_that_keeps_its_fingertip(bench: Bench) -> None:
    """Whichever of two idle workers stands first in the pool."""
    first = bench.run(WARM)
    other = bench.run(THIN)
    assert {first, other} == {0, 1}
    bench.end(first)
    bench.end(other)
    for _ in range(3):
        assert bench.run(THIN) == other
        bench.end(other)
    # The one that ran WARM only is as good as any for it, but THICK drops WARM from `other`.
    taken = bench.run(THIN)
    assert bench.run(THICK) == first
    bench.end(first)
    bench.end(taken)
    assert bench.run(THICK) == first
    bench.end(first)
    assert bench.run(THIN) == other


def test_an_earlier_fingertip_that_is_still_kept_counts(bench: Bench) -> None:
    first = bench.run(WARM)
    other = bench.run(THIN)
    bench.end(other)
    assert bench.run(WARM) == other, "the first one is busy"
    bench.end(first)
    bench.end(other)  # WARM was its last, THIN is still kept
    assert bench.run(THIN) == other


def test_a_fingertip_that_is_no_longer_kept_does_not_count(bench: Bench) -> None:
    first = bench.run(WARM)
    other = bench.run(THIN)
    bench.end(other)
    assert bench.run(THICK) == other
    bench.end(other)  # keeps THIN and THICK: WARM was the oldest
    bench.end(first)
    assert bench.run(THIN) == other
    assert bench.run(WARM) == first
    bench.end(other)
    bench.end(first)


def test_any_idle_worker_is_better_than_waiting(bench: Bench) -> None:
    first = bench.run(THIN)
    second = bench.run(THIN)
    assert first != second
    with pytest.raises(StopIteration):
        bench.run(THIN)
    assert bench.events[-1] == JobWaiting(0)
    bench.end(second)
    assert len(bench.workers[second].jobs) == 2, "what waited is started when a worker is free"


def test_a_cancel_that_comes_too_late_does_not_stop_the_next_job_of_that_id(bench: Bench) -> None:
    job = SimulationJob("again", WARM, "cube", np.zeros((2, 7)), PATIENCE_S)
    bench.pool.submit(job, bench.events.append)
    (worker,) = (one for one in bench.workers if one.state is WorkerState.BUSY)
    worker.hears_late = True
    assert bench.pool.cancel("again")
    bench.pool.submit(job, bench.events.append)
    assert worker.state is WorkerState.BUSY
    worker.end()
    ends = [event.outcome for event in bench.events if isinstance(event, JobEnded)]
    assert ends == [IndentationOutcome.COMPLETE] * 2


def test_a_cancel_in_time_stops_its_job(bench: Bench) -> None:
    number = bench.run(WARM)
    assert bench.pool.cancel("1")
    bench.end(number)
    assert isinstance(bench.events[-1], JobEnded)
    assert bench.events[-1].outcome is IndentationOutcome.CANCELLED


def test_an_upkeep_that_hangs_is_noticed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The service's own loop goes on all the while."""
    monkeypatch.setattr(pool, "_TURN_S", 0.2)
    deadline = time.monotonic() + PATIENCE_S
    with bench.pool._lock:
        while not bench.pool.turns.are_late():
            assert time.monotonic() < deadline
            time.sleep(0.01)
    while bench.pool.turns.are_late():
        assert time.monotonic() < deadline
        time.sleep(0.01)
