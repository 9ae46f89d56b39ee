"""A bounded pool of worker processes with a bounded queue before it.

What a worker does wrong costs its own job: one that dies is replaced and its job's owner is told;
one that does not stop at its deadline, or when it is cancelled, is killed.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from palpate.closing import Closing
from palpate.errors import RemoteError
from palpate_fem.result import IndentationOutcome
from palpate_fem.service.fingertips import without_friction
from palpate_fem.service.jobs import Began, Ended, Event, Failed, Job, Setup, Waiting
from palpate_fem.service.process import WorkerProcess, WorkerState
from palpate_fem.service.tasks import OnEvent, Task, crashed, failed, full, not_starting, stopping
from palpate_fem.store.content import StoredFingertip

log = logging.getLogger(__name__)
_TICK_S = 0.05
_STARTS_BEFORE_GIVING_UP = 3
_PAUSE_S = 0.25  # after a worker that did not start; doubled each time
_LONGEST_PAUSE_S = 30.0
_FIRST_GUESS_S = 5.0  # of a job's duration, before one has ended


class Pool(Closing):
    """Runs jobs in worker processes.

    Args:
        setup: How workers make fingertips.
        workers: How many there are.
        threads: Threads that each may use.
        waiting: Jobs that may wait.
        grace_s: How long a job may go on after its deadline, or after it was cancelled, before its
            worker is killed [s].
        on_fingertip: Called with every fingertip that a worker has at hand.

    Attributes:
        broken: Why there are no workers, when they do not even start.
        restarts: Workers that were started again.
    """

    def __init__(
        self,
        setup: Setup,
        *,
        workers: int,
        threads: int,
        waiting: int,
        grace_s: float = 5.0,
        on_fingertip: Callable[[StoredFingertip], None] | None = None,
    ) -> None:
        self.broken: RemoteError | None = None
        self.restarts = 0
        self._setup = setup
        self._threads = threads
        self._capacity = waiting
        self._grace_s = grace_s
        self._on_fingertip = on_fingertip or (lambda _: None)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._waiting: deque[Task] = deque()
        self._running: dict[WorkerProcess, Task] = {}
        self._held: dict[WorkerProcess, object] = {}
        self._starts_at = [0.0] * workers  # when each missing worker is due
        self._failed_starts = 0
        self._ever_ready = False
        self._typical_s = _FIRST_GUESS_S
        self._workers: list[WorkerProcess] = []
        self._keeper = threading.Thread(target=self._keep, name="pool", daemon=True)
        self._keeper.start()

    @property
    def ready(self) -> int:
        """Workers that could take a job, or are at one."""
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

    def submit(self, job: Job, on_event: OnEvent) -> None:
        """Run a job as soon as a worker is free.

        Args:
            job: What to run.
            on_event: Hears of it, from the pool's threads. ``Ended`` or ``Failed`` comes last,
                exactly once.

        Raises:
            RemoteError: Too many wait (RESOURCE_EXHAUSTED, says when to ask again), or the pool is
                closing or broken (UNAVAILABLE).
        """
        now = time.monotonic()
        with self._lock:
            if self._closing.is_set() or self.broken is not None:
                raise self.broken or stopping()
            free = sum(worker.state is WorkerState.IDLE for worker in self._workers)
            if len(self._waiting) >= self._capacity + free:
                wait_s = self._typical_s * (len(self._waiting) + 1) / max(1, len(self._workers))
                raise full(len(self._running), len(self._waiting), wait_s)
            self._waiting.append(Task(job, on_event, now + job.deadline_s))
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
            self._finish(task, Ended(IndentationOutcome.CANCELLED, "cancelled while it waited"))
            self._tell_waiting()
        else:
            worker.cancel(job_id)
        return True

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
            self._finish(task, failed(stopping()))
        self._keeper.join(timeout=5)
        for worker in workers:
            worker.join()

    def _idle(self, job: Job) -> WorkerProcess | None:
        """A free worker, if possible one that has the job's fingertip at hand."""
        free = [worker for worker in self._workers if worker.state is WorkerState.IDLE]
        wanted = without_friction(job.parameters)
        return next((w for w in free if self._held.get(w) == wanted), free[0] if free else None)

    def _dispatch(self) -> None:
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
                worker.start(replace(task.job, deadline_s=left_s))
                moved = True
        if moved or self.waiting:
            self._tell_waiting()

    def _tell_waiting(self) -> None:
        with self._lock:
            waiting = list(self._waiting)
        for before, task in enumerate(waiting):
            if task.worker is None:  # else it has begun meanwhile
                self._tell(task, Waiting(before))

    def _on_worker_event(self, worker: WorkerProcess, event: Event) -> None:
        if isinstance(event, Began):  # first: who sees a worker ready can count on it
            self._on_fingertip(event.fingertip)
        with self._lock:
            task = self._running.get(worker)
            starting = worker.state is WorkerState.STARTING
            if isinstance(event, Began):
                self._held[worker] = without_friction(event.fingertip.parameters)
                if starting:
                    worker.state = WorkerState.IDLE
                    self._ever_ready, self._failed_starts = True, 0
            elif isinstance(event, Failed) and starting and not self._ever_ready:
                self.broken = event.error()
            over = isinstance(event, Ended | Failed)
            if over and task is not None:
                del self._running[worker]
                worker.state = WorkerState.IDLE
                if isinstance(event, Ended):
                    self._typical_s += 0.3 * (event.seconds - self._typical_s)
        if task is not None and isinstance(event, Ended | Failed):
            self._finish(task, event)
        elif task is not None:
            self._tell(task, event)
        if over or starting:
            self._dispatch()

    def _on_worker_gone(self, worker: WorkerProcess) -> None:
        epitaph = worker.epitaph()
        with self._lock:
            task = self._running.pop(worker, None)
            self._held.pop(worker, None)
            self._workers.remove(worker)
            closing = self._closing.is_set()
            pause_s = 0.0
            if worker.state is WorkerState.STARTING:
                self._failed_starts += 1
                pause_s = min(_PAUSE_S * 2.0**self._failed_starts, _LONGEST_PAUSE_S)
                if not self._ever_ready and self._failed_starts >= _STARTS_BEFORE_GIVING_UP:
                    self.broken = self.broken or not_starting(epitaph)
            self._starts_at.append(time.monotonic() + pause_s)
            self.restarts += not closing
        if not closing:
            log.warning("worker %d %s", worker.pid, epitaph)
        if task is not None:
            self._finish(task, failed(stopping()) if closing else self._last_of(task, epitaph))

    def _last_of(self, task: Task, epitaph: str) -> Ended | Failed:
        """What the owner of a job hears whose worker is gone."""
        overdue = time.monotonic() >= task.overdue
        if overdue and task.cancelled:
            return Ended(
                IndentationOutcome.CANCELLED, "cancelled; the solver was ended as it did not stop"
            )
        if overdue:
            return Ended(
                IndentationOutcome.DEADLINE,
                f"the solver was ended as it did not stop within {self._grace_s:g} s after the "
                "deadline",
            )
        return crashed(epitaph)

    def _keep(self) -> None:
        """Start missing workers; end what is too late."""
        while not self._closing.wait(_TICK_S):
            now = time.monotonic()
            with self._lock:
                if self._closing.is_set():
                    return
                self._start_due(now)
                late = [task for task in self._waiting if task.deadline <= now]
                for task in late:
                    self._waiting.remove(task)
                hung = [worker for worker, task in self._running.items() if task.overdue <= now]
                broken = list(self._waiting) if self.broken else []
                for task in broken:
                    self._waiting.remove(task)
            for task in late:
                self._finish(
                    task, Ended(IndentationOutcome.DEADLINE, "the deadline passed while it waited")
                )
            for worker in hung:
                worker.kill()
            for task in broken:
                assert self.broken is not None
                self._finish(task, failed(self.broken))
            if late:
                self._tell_waiting()

    def _start_due(self, now: float) -> None:
        for at in [at for at in self._starts_at if at <= now and self.broken is None]:
            self._starts_at.remove(at)
            try:
                worker = WorkerProcess(
                    self._setup, self._threads, self._on_worker_event, self._on_worker_gone
                )
            except OSError as error:  # no memory, or no process more
                log.warning("no worker can be started: %s", error)
                self._starts_at.append(now + _LONGEST_PAUSE_S)
            else:
                self._workers.append(worker)

    def _tell(self, task: Task, event: Event) -> None:
        try:
            task.on_event(event)
        except Exception:  # the owner's defect must not end this thread, which serves others too
            log.exception("owner of job %s", task.job.id)

    def _finish(self, task: Task, event: Ended | Failed) -> None:
        with self._lock:
            if task.over:
                return
            task.over = True
        self._tell(task, event)
