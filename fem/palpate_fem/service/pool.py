"""A bounded pool of worker processes with a bounded queue in front of it.

A fault of one worker costs only its own job. A worker that dies is replaced, and the owner of its
job gets an error. A worker that does not stop at its deadline, or when its job is cancelled, is
killed. Each job's owner gets exactly one last event, whatever happens.
"""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

from palpate.errors import ErrorCode, RemoteError
from palpate.heartbeat import Turns
from palpate.process import Closing
from palpate_fem.config import FingertipParameters
from palpate_fem.result import IndentationOutcome
from palpate_fem.service.channel import ChildProcess
from palpate_fem.service.device_process import START_S
from palpate_fem.service.fingertips import without_friction
from palpate_fem.service.jobs import (
    CancelJob,
    JobEnded,
    JobEvent,
    JobFailed,
    JobStarted,
    JobWaiting,
    SimulationJob,
    WorkerSetup,
)
from palpate_fem.store.content import StoredFingertip

_log = logging.getLogger(__name__)

OnEvent = Callable[[JobEvent], None]

_TICK_S = 0.05
_TURN_S = 2.0  # the upkeep takes far less for a turn
_STARTS_BEFORE_GIVING_UP = 3
_PAUSE_S = 0.25  # after a worker that did not start; doubled each time
_LONGEST_PAUSE_S = 30.0
_FIRST_GUESS_S = 5.0  # of a job's duration, before one has ended


class WorkerState(Enum):
    """State of a worker process."""

    STARTING = "starting"
    IDLE = "idle"
    BUSY = "busy"


class WorkerProcess(ChildProcess):
    """One worker process, as its pool sees it.

    Args:
        setup: How it makes fingertips.
        threads: Threads that its libraries may use.
        on_event: Called with each of its events, from a thread of its own.
        on_gone: Called once, from that thread, when it has ended.

    Attributes:
        state: Kept up to date by the pool.
    """

    def __init__(
        self,
        setup: WorkerSetup,
        threads: int,
        on_event: Callable[[WorkerProcess, JobEvent], None],
        on_gone: Callable[[WorkerProcess], None],
    ) -> None:
        self.state = WorkerState.STARTING
        self._on_event, self._hung = on_event, False
        self._turns = Turns()
        self._turns.next(START_S)
        super().__init__(
            "palpate_fem.service.worker",
            setup,
            threads=threads,
            on_message=WorkerProcess._on_message_of_worker,
            on_gone=on_gone,
        )

    def start(self, job: SimulationJob) -> None:
        """Send it a job."""
        self.state = WorkerState.BUSY
        self.send(job)

    def cancel(self, job_id: str) -> None:
        """Ask it to stop a job."""
        self.send(CancelJob(job_id))

    def end_if_stuck(self) -> None:
        """End it if it starts and has been silent for too long; to be asked at every turn."""
        late = self._turns.are_late()
        if late and self.state is WorkerState.STARTING and not self._hung:
            self._hung = True
            self.kill()

    def how_it_ended(self) -> str:
        """See ``ChildProcess.how_it_ended``."""
        if self._hung:
            return f"was ended as it had been silent for {START_S:g} s"
        return super().how_it_ended()

    def _on_message_of_worker(self, event: JobEvent) -> None:
        self._turns.next(START_S)
        self._on_event(self, event)


@dataclass(slots=True, eq=False)
class PoolTask:
    """A job on its way through the pool.

    ``key`` is its id towards its worker; no other task has it. ``deadline`` and ``overdue`` are
    monotonic times [s]: when it must stop, and when its worker is killed because it has not.
    """

    job: SimulationJob
    key: str
    on_event: OnEvent
    deadline: float
    overdue: float = math.inf
    worker: WorkerProcess | None = None
    cancelled: bool = False
    over: bool = False


class WorkerPool(Closing):
    """Runs jobs in worker processes.

    Three kinds of threads enter it: callers, one reader for each worker, and its own upkeep thread.
    Shared state is changed under one lock; callbacks to owners run outside of it, so that an owner
    may call the pool.

    Args:
        setup: How workers make fingertips.
        workers: Number of workers.
        threads: Threads that each may use.
        waiting: Most jobs that wait.
        grace_s: Time after its deadline, or after it was cancelled, at which the worker of a job
            that still runs is killed [s].
        on_fingertip: Called with every fingertip that a worker has built.

    Attributes:
        broken: Error that says why no worker starts; None while they do.
        restarts: Number of workers that were started again.
        turns: Those of the thread that starts, ends and replaces workers.
    """

    def __init__(
        self,
        setup: WorkerSetup,
        *,
        workers: int,
        threads: int,
        waiting: int,
        grace_s: float = 5.0,
        on_fingertip: Callable[[StoredFingertip], None] | None = None,
    ) -> None:
        self.broken: RemoteError | None = None
        self.restarts = 0
        self.turns = Turns()
        self._setup = setup
        self._threads = threads
        self._capacity = waiting
        self._grace_s = grace_s
        self._on_fingertip = on_fingertip or (lambda _: None)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._numbers = itertools.count()
        self._waiting: deque[PoolTask] = deque()
        self._running: dict[WorkerProcess, PoolTask] = {}
        # Fingertips that each worker keeps, the last used one at the end, as in `FingertipCache`.
        self._kept: dict[WorkerProcess, list[FingertipParameters]] = {}
        self._starts_at = [0.0] * workers  # when each missing worker is due
        self._failed_starts = 0
        self._ever_ready = False
        self._typical_s = _FIRST_GUESS_S
        self._workers: list[WorkerProcess] = []
        self._upkeep = threading.Thread(target=self._keep_up, name="pool", daemon=True)
        self._upkeep.start()

    @property
    def ready(self) -> int:
        """Workers that have started, idle or busy."""
        with self._lock:
            return sum(worker.state is not WorkerState.STARTING for worker in self._workers)

    @property
    def busy(self) -> int:
        """Jobs that run."""
        with self._lock:
            return len(self._running)

    @property
    def waiting(self) -> int:
        """Jobs that wait."""
        with self._lock:
            return len(self._waiting)

    @property
    def counts(self) -> dict[str, int]:
        """What has happened so far, for the health report."""
        return {"worker_restarts": self.restarts}

    @property
    def serves(self) -> str:
        """Where jobs run, if that has to be said."""
        return ""

    @property
    def trouble(self) -> str:
        """Why jobs take longer than they should; empty = they do not."""
        return ""

    def hangs(self) -> bool:
        """Whether a thread of the pool hangs; to be asked at every turn of the caller's loop."""
        return self.turns.are_late()

    def submit(self, job: SimulationJob, on_event: OnEvent, *, accepted: bool = False) -> None:
        """Run a job as soon as a worker is free.

        Args:
            job: What to run.
            on_event: Called with its events, from the pool's threads. ``JobEnded`` or ``JobFailed``
                comes last, exactly once.
            accepted: Whether its owner was promised an answer: then it may wait however many do.

        Raises:
            RemoteError: Too many wait (RESOURCE_EXHAUSTED, with the time to wait), or the pool is
                closing or broken (UNAVAILABLE).
        """
        now = time.monotonic()
        with self._lock:
            if self._closing.is_set() or self.broken is not None:
                raise self.broken or pool_stopping()
            free = sum(worker.state is WorkerState.IDLE for worker in self._workers)
            if not accepted and len(self._waiting) >= self._capacity + free:
                wait_s = self._typical_s * (len(self._waiting) + 1) / max(1, len(self._workers))
                raise pool_full(len(self._running), len(self._waiting), wait_s)
            key = str(next(self._numbers))
            self._waiting.append(PoolTask(job, key, on_event, now + job.deadline_s))
        self._dispatch()

    def cancel(self, job_id: str) -> bool:
        """Stop a job; it ends with what has converged.

        Returns:
            Whether it waited or ran.
        """
        with self._lock:
            tasks = [*self._waiting, *self._running.values()]
            task = next((task for task in tasks if task.job.id == job_id), None)
            if task is None or task.over:
                return False
            task.cancelled = True
            worker = task.worker
            if worker is None:
                self._waiting.remove(task)
            else:
                task.overdue = min(task.overdue, time.monotonic() + self._grace_s)
        if worker is None:
            self._finish(task, JobEnded(IndentationOutcome.CANCELLED, "cancelled while it waited"))
            self._report_waiting()
        else:
            # By its own id: another job may have the caller's by the time that the worker hears it.
            worker.cancel(task.key)
        return True

    def take_back(self, wanted: Callable[[SimulationJob], bool]) -> list[PoolTask]:
        """Jobs that still wait, in order; the pool forgets them, and their owners hear nothing."""
        with self._lock:
            taken = [task for task in self._waiting if wanted(task.job)]
            for task in taken:
                self._waiting.remove(task)
        return taken

    def close(self) -> None:
        """End every job with UNAVAILABLE, and every worker."""
        with self._lock:
            self._closing.set()
            tasks = [*self._waiting, *self._running.values()]
            workers = list(self._workers)
            self._waiting.clear()
        for worker in workers:
            worker.kill()
        for task in tasks:
            self._finish(task, JobFailed.of(pool_stopping()))
        self._upkeep.join(timeout=5)
        for worker in workers:
            worker.join()

    def _idle(self, job: SimulationJob) -> WorkerProcess | None:
        """An idle worker, if possible one that keeps the job's fingertip; None if all are busy.

        Pressurising a fingertip takes longer than many a job, so a warm worker is preferred.
        """
        idle = [worker for worker in self._workers if worker.state is WorkerState.IDLE]
        needed = without_friction(job.parameters)
        warm = [worker for worker in idle if needed in self._kept.get(worker, ())]
        return next(iter(warm or idle), None)

    def _dispatch(self) -> None:
        """Start waiting jobs in order, while there are idle workers."""
        moved = False
        while True:
            with self._lock:
                if not self._waiting:
                    break
                worker = self._idle(self._waiting[0].job)
                if worker is None:
                    break
                task = self._waiting.popleft()
                task.worker = worker
                task.overdue = task.deadline + self._grace_s
                self._running[worker] = task
                left_s = max(0.0, task.deadline - time.monotonic())
                worker.start(replace(task.job, id=task.key, deadline_s=left_s))
                moved = True
        if moved or self.waiting:
            self._report_waiting()

    def _report_waiting(self) -> None:
        """Tell each waiting job its place in the queue."""
        with self._lock:
            waiting = list(self._waiting)
        for before, task in enumerate(waiting):
            if task.worker is None:  # else it has been started meanwhile
                self._report(task, JobWaiting(before))

    def _on_worker_event(self, worker: WorkerProcess, event: JobEvent) -> None:
        # Before the worker counts as ready: whoever sees it ready relies on the fingertip.
        if isinstance(event, JobStarted):
            self._on_fingertip(event.fingertip)
        with self._lock:
            task = self._running.get(worker)
            starting = worker.state is WorkerState.STARTING
            if isinstance(event, JobStarted):
                self._note_fingertip(worker, without_friction(event.fingertip.parameters))
                if starting:
                    worker.state = WorkerState.IDLE
                    self._ever_ready, self._failed_starts = True, 0
            elif isinstance(event, JobFailed) and starting and not self._ever_ready:
                self.broken = event.error()
            over = isinstance(event, JobEnded | JobFailed)
            if over and task is not None:
                del self._running[worker]
                worker.state = WorkerState.IDLE
                if isinstance(event, JobEnded):
                    self._typical_s += 0.3 * (event.seconds - self._typical_s)
        if task is not None and isinstance(event, JobEnded | JobFailed):
            self._finish(task, event)
        elif task is not None:
            self._report(task, event)
        if over or starting:
            self._dispatch()

    def _note_fingertip(self, worker: WorkerProcess, used: FingertipParameters) -> None:
        kept = [one for one in self._kept.get(worker, ()) if one != used]
        self._kept[worker] = [*kept, used][-self._setup.keep :]

    def _on_worker_gone(self, worker: WorkerProcess) -> None:
        how = worker.how_it_ended()
        with self._lock:
            task = self._running.pop(worker, None)
            self._kept.pop(worker, None)
            self._workers.remove(worker)
            closing = self._closing.is_set()
            pause_s = 0.0
            if worker.state is WorkerState.STARTING:
                self._failed_starts += 1
                pause_s = min(_PAUSE_S * 2.0**self._failed_starts, _LONGEST_PAUSE_S)
                if not self._ever_ready and self._failed_starts >= _STARTS_BEFORE_GIVING_UP:
                    self.broken = self.broken or RemoteError(
                        f"the solver's process {how} before it was ready, again and again",
                        remedy="look at the log above; try it alone: palpate fem run",
                        code=ErrorCode.UNAVAILABLE,
                    )
            self._starts_at.append(time.monotonic() + pause_s)
            self.restarts += not closing
        if not closing:
            _log.warning("worker %d %s", worker.pid, how)
        if task is not None:
            self._finish(
                task, JobFailed.of(pool_stopping()) if closing else self._last_event(task, how)
            )

    def _last_event(self, task: PoolTask, how: str) -> JobEnded | JobFailed:
        """Last event of a job whose worker is gone."""
        overdue = time.monotonic() >= task.overdue
        if overdue and task.cancelled:
            return JobEnded(
                IndentationOutcome.CANCELLED, "cancelled; the solver was ended as it did not stop"
            )
        if overdue:
            return JobEnded(
                IndentationOutcome.DEADLINE,
                f"the solver was ended as it did not stop within {self._grace_s:g} s after the "
                "deadline",
            )
        return JobFailed(
            ErrorCode.INTERNAL,
            f"the process that ran the simulation {how}",
            "ask again; if it happens again, look at the log of the fem service",
            1.0,
        )

    def _keep_up(self) -> None:
        """Start missing workers; end jobs that are too late, or that no worker will take."""
        while not self._closing.wait(_TICK_S):
            self.turns.next(_TURN_S)
            now = time.monotonic()
            with self._lock:
                if self._closing.is_set():
                    return
                self._start_due(now)
                late = [task for task in self._waiting if task.deadline <= now]
                for task in late:
                    self._waiting.remove(task)
                hung = [worker for worker, task in self._running.items() if task.overdue <= now]
                workers = list(self._workers)
                hopeless = list(self._waiting) if self.broken else []
                for task in hopeless:
                    self._waiting.remove(task)
            for task in late:
                self._finish(
                    task,
                    JobEnded(IndentationOutcome.DEADLINE, "the deadline passed while it waited"),
                )
            for worker in hung:
                worker.kill()
            for worker in workers:
                worker.end_if_stuck()
            for task in hopeless:
                assert self.broken is not None
                self._finish(task, JobFailed.of(self.broken))
            if late:
                self._report_waiting()

    def _start_due(self, now: float) -> None:
        for at in [at for at in self._starts_at if at <= now and self.broken is None]:
            self._starts_at.remove(at)
            try:
                worker = WorkerProcess(
                    self._setup, self._threads, self._on_worker_event, self._on_worker_gone
                )
            except OSError as error:  # out of memory or of processes
                _log.warning("no worker can be started: %s", error)
                self._starts_at.append(now + _LONGEST_PAUSE_S)
            else:
                self._workers.append(worker)

    def _report(self, task: PoolTask, event: JobEvent) -> None:
        try:
            task.on_event(event)
        except Exception:  # a defect of one owner must not end this thread, which serves others too
            _log.exception("owner of job %s", task.job.id)

    def _finish(self, task: PoolTask, event: JobEnded | JobFailed) -> None:
        with self._lock:
            if task.over:
                return
            task.over = True
        self._report(task, event)


def pool_stopping() -> RemoteError:
    """Error of a job that a pool does not finish, as it is closed."""
    return RemoteError(
        "the finite-element service is stopping",
        remedy="ask again when it is back: palpate status",
        code=ErrorCode.UNAVAILABLE,
        retry_after_s=2.0,
    )


def pool_full(running: int, waiting: int, retry_after_s: float) -> RemoteError:
    """Error of a job that finds no room; says when to ask again [s]."""
    return RemoteError(
        f"{running} simulations run and {waiting} wait",
        remedy="ask again later, or start the service with more workers",
        code=ErrorCode.RESOURCE_EXHAUSTED,
        retry_after_s=round(min(max(retry_after_s, 0.5), 60.0), 1),
    )
