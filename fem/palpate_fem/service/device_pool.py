"""A device in front of a pool of workers: requests for one fingertip are solved there together.

Whatever the device does not solve, and whatever it had when its process died or hung, the workers
solve from the first step on; what still waits for a worker when the device is back goes back to it.
The owner of a job gets one answer: steps that it has are not sent again, and if other forces are
found for them, the answer is an error.
"""

from __future__ import annotations

import itertools
import logging
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from palpate.errors import ErrorCode, RemoteError
from palpate.heartbeat import Turns
from palpate.process import Closing
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.result import IndentationOutcome, IndentationStep
from palpate_fem.service.device_batch import LOSSES_MOST
from palpate_fem.service.device_process import HANG_S, START_S, DeviceProcess
from palpate_fem.service.jobs import (
    DeviceEvent,
    DeviceReady,
    DeviceSetup,
    JobEnded,
    JobEvent,
    JobFailed,
    JobStarted,
    JobWaiting,
    NumberedPress,
    PressEnded,
    PressRefused,
    PressStep,
    PressUnsolved,
    ResultTaken,
    SimulationJob,
    StepConverged,
    StopPress,
    WorkerSetup,
)
from palpate_fem.service.pool import OnEvent, WorkerPool, pool_full, pool_stopping
from palpate_fem.store.content import StoredFingertip

_log = logging.getLogger(__name__)

SAME = 1e-2
"""Share of the largest force by which a step's forces on a device and on the CPU may differ; over
54 presses they differed by 7e-5 at most (ADR 26)."""

PAUSE_S = 1.0
"""Time after which a device's process is started again [s]; doubled each time until one solves a
trajectory."""

_LONGEST_PAUSE_S = 300.0
_LEAST_FORCE_N = 0.01
_TICK_S = 0.05
_TURN_S = 2.0  # a turn takes far less
_FIRST_GUESS_S = 5.0  # of a trajectory's duration, before one has ended


@dataclass(slots=True, eq=False)
class DeviceTask:
    """A job that a device was to solve.

    Attributes:
        job: As submitted.
        on_event: Its owner's.
        deadline: When it must stop [s, monotonic].
        number: Its number on the device; -1 = it waits, or the workers have it.
        overdue: When its owner gets an answer in any case, while a device has it [s, monotonic].
        before: Number of jobs before it, as its owner was told.
        started: Whether its owner was told that it has started.
        forces: Of the steps that its owner has [N], each of shape (3,).
        made: Steps that whoever has it now has made.
        losses: Processes of the device that have ended with it.
        workers_only: Whether it does not go back to the device.
        cancelled: Whether it is to be stopped.
        over: Whether its owner has had the last event.
    """

    job: SimulationJob
    on_event: OnEvent
    deadline: float
    number: int = -1
    overdue: float = math.inf
    before: int = -1
    started: bool = False
    forces: list[Floats] = field(default_factory=list)
    made: int = 0
    losses: int = 0
    workers_only: bool = False
    cancelled: bool = False
    over: bool = False


class DevicePool(Closing):
    """Runs jobs on a device, and with workers; used like a `WorkerPool`.

    Jobs whose parameters are those of the warm fingertip and whose indenter is one of the nine go
    to the device while it is ready, all others to the workers. Its process is started again
    whenever it has ended, and gets what still waits for a worker then. All events of a device are
    handled by one thread; workers' threads come in with those of jobs that are redone. Shared state
    is changed under one lock, and callbacks to owners run outside of it.

    Args:
        setup: How the fingertip is made; what makes it is a ``SlottedTip``.
        device: Warp device, see ``check_devices``.
        cpu: The workers; closed with this.
        slots: Jobs at once on the device.
        waiting: Most jobs that wait for it.
        threads: Threads that the libraries of its process may use.
        grace_s: Time after its deadline, or after it was cancelled, at which a job that has not
            stopped is answered nevertheless [s].
        on_fingertip: Called with the device's fingertip.
        hang_s: Its process is ended if it should be at work and is silent for so long [s].
        start_s: The same before it is ready [s].

    Attributes:
        restarts: Times that its process has ended.
        redone: Jobs that were the device's and that workers have, or had, to solve.
        trouble: Why the device does not serve; empty = it does, or is started for the first time.
    """

    def __init__(
        self,
        setup: WorkerSetup,
        device: str,
        cpu: WorkerPool,
        *,
        slots: int,
        waiting: int,
        threads: int = 1,
        grace_s: float = 5.0,
        on_fingertip: Callable[[StoredFingertip], None] | None = None,
        hang_s: float = HANG_S,
        start_s: float = START_S,
    ) -> None:
        self.restarts = self.redone = 0
        self.trouble = ""
        self._setup = DeviceSetup(setup, device, slots, indenter_names(), streams=True)
        self._cpu, self._capacity = cpu, waiting
        self._threads, self._grace_s = threads, grace_s
        self._on_fingertip = on_fingertip or (lambda _: None)
        self._hang_s, self._start_s = hang_s, start_s
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._events: queue.SimpleQueue[
            tuple[DeviceProcess[DeviceTask], DeviceEvent | None] | None
        ] = queue.SimpleQueue()
        self._numbers = itertools.count()
        self._tasks: dict[str, DeviceTask] = {}  # that are not over, those with workers included
        self._waiting: deque[DeviceTask] = deque()
        self._process: DeviceProcess[DeviceTask] | None = None
        self._fingertip: StoredFingertip | None = None
        self._start_at, self._pause_s = 0.0, PAUSE_S
        self._typical_s = _FIRST_GUESS_S
        self._turns = Turns()
        self._thread = threading.Thread(target=self._serve, name="device", daemon=True)
        self._thread.start()

    @property
    def ready(self) -> int:
        """Workers that have started, and the device if it has."""
        return self._cpu.ready + (self._ready_process() is not None)

    @property
    def busy(self) -> int:
        """Jobs that run."""
        process = self._process
        return self._cpu.busy + (0 if process is None else len(process.open))

    @property
    def waiting(self) -> int:
        """Jobs that wait."""
        return self._cpu.waiting + len(self._waiting)

    @property
    def broken(self) -> RemoteError | None:
        """Error that says why no worker starts."""
        return self._cpu.broken

    @property
    def counts(self) -> dict[str, int]:
        """See ``WorkerPool.counts``."""
        mine = {"device_restarts": self.restarts, "simulations_redone": self.redone}
        return {**self._cpu.counts, **mine}

    @property
    def serves(self) -> str:
        """See ``WorkerPool.serves``."""
        device = self._setup.device
        if self._ready_process() is None:
            return f"{device} is being prepared; until then the CPU serves"
        return f"{device} serves, {self._setup.slots} at once"

    @property
    def pid(self) -> int | None:
        """Process id of the device's process, if there is one."""
        process = self._process
        return None if process is None else process.pid

    def hangs(self) -> bool:
        """See ``WorkerPool.hangs``."""
        return any([self._turns.are_late(), self._cpu.hangs()])  # both have to be asked

    def submit(self, job: SimulationJob, on_event: OnEvent) -> None:
        """Run a job; see ``WorkerPool.submit``."""
        ours = self._is_ours(job)
        with self._lock:
            if self._closing.is_set():
                raise pool_stopping()
            process = self._ready_process() if ours else None
            if process is not None:
                free, slots = self._setup.slots - len(process.open), self._setup.slots
                waiting = len(self._waiting)
                if waiting >= self._capacity + free:
                    wait_s = self._typical_s * (waiting + 1) / slots
                    raise pool_full(len(process.open), waiting, wait_s)
                task = DeviceTask(job, on_event, time.monotonic() + job.deadline_s)
                self._tasks[job.id] = task
                self._waiting.append(task)
        if process is not None:
            self._events.put(None)  # its thread looks at what waits
        else:
            self._cpu.submit(job, on_event)

    def cancel(self, job_id: str) -> bool:
        """Stop a job; see ``WorkerPool.cancel``."""
        # One that came while the device was away may be taken back between the first two looks.
        return self._cancel_task(job_id) or self._cpu.cancel(job_id) or self._cancel_task(job_id)

    def _cancel_task(self, job_id: str) -> bool:
        """Stop a job that the device was to solve; False = there is none of that id."""
        with self._lock:
            task = self._tasks.get(job_id)
            if task is None:
                return False
            task.cancelled = True
            waited = task in self._waiting
            if waited:
                self._waiting.remove(task)
            elif self._process is not None and task.number in self._process.open:
                task.overdue = min(task.overdue, time.monotonic() + self._grace_s)
                self._process.send(StopPress(task.number))
                return True
        if waited:
            self._finish(task, self._cancelled_waiting(task))
        else:  # on its way to or from the workers it is seen to be cancelled
            self._cpu.cancel(job_id)
        return True

    def close(self) -> None:
        """End every job with UNAVAILABLE, the device's process and every worker."""
        with self._lock:
            self._closing.set()
            process, tasks = self._process, list(self._tasks.values())
        if process is not None:
            process.kill()
        for task in tasks:
            self._finish(task, JobFailed.of(pool_stopping()))
        self._cpu.close()
        self._thread.join(timeout=5)
        if process is not None:
            process.join()

    def _ready_process(self) -> DeviceProcess[DeviceTask] | None:
        process = self._process
        return process if process is not None and process.ready and not process.hung else None

    def _is_ours(self, job: SimulationJob) -> bool:
        """Whether the device can solve a job."""
        there = make_indenter(job.indenter).name in self._setup.indenters
        return there and job.parameters == self._setup.worker.warm

    def _serve(self) -> None:
        while not self._closing.is_set():
            self._turns.next(_TURN_S)
            self._start_if_due()
            self._end_late()
            self._dispatch()
            try:
                found = self._events.get(timeout=_TICK_S)
            except queue.Empty:
                continue
            if found is not None:
                self._on_event(*found)

    def _start_if_due(self) -> None:
        with self._lock:
            if self._process is None:
                if self._closing.is_set() or time.monotonic() < self._start_at:
                    return
                try:
                    self._process = DeviceProcess(
                        self._setup,
                        self._threads,
                        lambda process, event: self._events.put((process, event)),
                        hang_s=self._hang_s,
                        start_s=self._start_s,
                    )
                except OSError as error:  # out of memory or of processes
                    self._start_later(f"cannot be started: {error}")
            else:
                self._process.end_if_hung()

    def _start_later(self, why: str) -> None:
        """Start the device's process after a wait; the caller holds the lock."""
        device, pause_s = self._setup.device, self._pause_s
        self.trouble = f"{device} {why}; until it is back the CPU serves"
        _log.warning("the solver on %s %s; it is started again in %g s", device, why, pause_s)
        self._start_at = time.monotonic() + pause_s
        self._pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)

    def _end_late(self) -> None:
        """Answer jobs that waited for too long, or that a device has not stopped in time."""
        now, grace_s = time.monotonic(), self._grace_s
        ends: list[tuple[DeviceTask, JobEnded]] = []
        with self._lock:
            for task in [task for task in self._waiting if task.deadline <= now]:
                self._waiting.remove(task)
                how = "the deadline passed while it waited"
                ends.append((task, self._ended(task, JobEnded(IndentationOutcome.DEADLINE, how))))
            there = [] if self._process is None else list(self._process.open.values())
            for task in there:
                if task.overdue <= now and not task.over:
                    outcome = (
                        IndentationOutcome.CANCELLED
                        if task.cancelled
                        else IndentationOutcome.DEADLINE
                    )
                    how = f"{outcome}; the solver did not stop within {grace_s:g} s"
                    ends.append((task, self._ended(task, JobEnded(outcome, how))))
        for task, end in ends:
            self._finish(task, end)

    def _dispatch(self) -> None:
        """Give the device what waits while slots are free, and tell the others their place."""
        started: list[DeviceTask] = []
        with self._lock:
            # Those that were cancelled while they were taken back from the workers.
            cancelled = [task for task in self._waiting if task.cancelled]
            for task in cancelled:
                self._waiting.remove(task)
            process = self._ready_process()
            while process is not None and self._waiting and len(process.open) < self._setup.slots:
                task = self._waiting.popleft()
                task.number, task.overdue = next(self._numbers), task.deadline + self._grace_s
                left_s = max(0.0, task.deadline - time.monotonic())
                job = task.job
                process.give(NumberedPress(task.number, job.indenter, job.path, left_s), task)
                started.append(task)
            waiting = list(self._waiting)
        for task in cancelled:
            self._finish(task, self._cancelled_waiting(task))
        for task in started:
            assert self._fingertip is not None
            if not task.started:
                task.started = True
                self._report(task, JobStarted(self._fingertip))
        for before, task in enumerate(waiting):
            if before != task.before and not task.started:
                task.before = before
                self._report(task, JobWaiting(before))

    def _on_event(self, process: DeviceProcess[DeviceTask], event: DeviceEvent | None) -> None:
        match event:
            case PressStep(number, step):
                task = process.open[number]
                if (apart_n := self._passed_on(task, step)) is not None:
                    process.send(StopPress(number))
                    self._finish(task, self._cannot_continue(task, apart_n))
            case PressEnded(number, result):
                process.send(ResultTaken())
                self._pause_s = PAUSE_S
                self._typical_s += 0.3 * (result.seconds - self._typical_s)
                task = self._taken(process, number)
                self._finish(task, self._ended(task, JobEnded.of(result)))
            case PressRefused(number, failed):
                self._finish(self._taken(process, number), failed)
            case PressUnsolved(number):
                task = self._taken(process, number)
                task.workers_only = True
                self._redo(task)
            case JobStarted(fingertip):
                self._fingertip = fingertip
                # Before it counts as ready: whoever sees it ready relies on the fingertip.
                self._on_fingertip(fingertip)
            case DeviceReady():
                process.ready, self.trouble = True, ""
                _log.info("%s", self.serves)
                self._take_back()
            case JobFailed():
                process.last_words = event
            case None:
                self._on_gone(process)

    def _taken(self, process: DeviceProcess[DeviceTask], number: int) -> DeviceTask:
        """A task that the device no longer has."""
        with self._lock:
            task = process.open.pop(number)
            task.number, task.overdue = -1, math.inf
            return task

    def _on_gone(self, process: DeviceProcess[DeviceTask]) -> None:
        """Have workers redo what the device had and what waited for it."""
        with self._lock:
            if self._closing.is_set():
                return
            self._process = None
            self.restarts += 1
            self._start_later(process.why_it_ended())
            for task in process.open.values():
                task.losses += 1
                task.workers_only = task.losses >= LOSSES_MOST
            left = [*process.open.values(), *self._waiting]
            self._waiting.clear()
            for task in left:
                task.number, task.overdue = -1, math.inf
        for task in left:
            self._redo(task)

    def _take_back(self) -> None:
        """Give the device what still waits for a worker."""

        def is_mine(job: SimulationJob) -> bool:
            known = self._tasks.get(job.id)
            return self._is_ours(job) and not (known and known.workers_only)

        with self._lock:
            for one in self._cpu.take_back(is_mine):
                task = self._tasks.get(one.job.id)
                if task is None:  # came while the device was away
                    task = DeviceTask(one.job, one.on_event, one.deadline)
                    self._tasks[one.job.id] = task
                else:
                    self.redone -= 1
                self._waiting.append(task)

    def _redo(self, task: DeviceTask) -> None:
        """Have workers solve a job from its first step on."""
        if task.over:
            return
        if task.cancelled:
            self._finish(task, self._ended(task, JobEnded(IndentationOutcome.CANCELLED)))
            return
        self.redone += 1
        task.made = 0
        left_s = max(0.0, task.deadline - time.monotonic())
        try:
            self._cpu.submit(
                replace(task.job, deadline_s=left_s),
                lambda event: self._on_redone(task, event),
                accepted=True,
            )
        except RemoteError as error:
            self._finish(task, JobFailed.of(error))
        if task.cancelled:  # meanwhile
            self._cpu.cancel(task.job.id)

    def _on_redone(self, task: DeviceTask, event: JobEvent) -> None:
        """Pass on what a job's owner has not had."""
        match event:
            case StepConverged(step):
                if (apart_n := self._passed_on(task, step)) is not None:
                    # First, as its owner may use the id again when it has the answer.
                    self._cpu.cancel(task.job.id)
                    self._finish(task, self._cannot_continue(task, apart_n))
            case JobEnded():
                self._finish(task, self._ended(task, event))
            case JobFailed():
                self._finish(task, event)
            case _:
                if not task.started:
                    self._report(task, event)

    def _passed_on(self, task: DeviceTask, step: IndentationStep) -> float | None:
        """Pass on a step that the owner does not have.

        Returns:
            How far its force is from that of the step that the owner has [N]; None = it is the
            same, or the step was new.
        """
        task.made += 1
        if task.made > len(task.forces):
            task.forces.append(step.force)
            self._report(task, StepConverged(step))
            return None
        largest = max(_LEAST_FORCE_N, *(float(np.linalg.norm(one)) for one in task.forces))
        apart = float(np.linalg.norm(step.force - task.forces[task.made - 1]))
        return None if apart <= SAME * largest else apart

    def _cannot_continue(self, task: DeviceTask, apart_n: float) -> JobFailed:
        return JobFailed(
            ErrorCode.SIMULATION,
            f"{self._setup.device} went another way than the CPU, which has to go on: in step "
            f"{task.made} their forces are {apart_n:.3f} N apart",
            "ask again with shorter steps, or serve without --device",
        )

    def _cancelled_waiting(self, task: DeviceTask) -> JobEnded:
        how = "cancelled while it waited"
        return self._ended(task, JobEnded(IndentationOutcome.CANCELLED, how))

    @staticmethod
    def _ended(task: DeviceTask, end: JobEnded) -> JobEnded:
        """An end that does not come before the last step that was sent."""
        sent_m = float(path_lengths(task.job.path)[len(task.forces)])
        return replace(end, travel_m=max(end.travel_m, sent_m))

    def _report(self, task: DeviceTask, event: JobEvent) -> None:
        if not task.over:
            self._tell(task, event)

    def _finish(self, task: DeviceTask, event: JobEnded | JobFailed) -> None:
        with self._lock:
            if task.over:
                return
            task.over = True
            del self._tasks[task.job.id]
        self._tell(task, event)

    @staticmethod
    def _tell(task: DeviceTask, event: JobEvent) -> None:
        try:
            task.on_event(event)
        except Exception:  # a defect of one owner must not end this thread, which serves others too
            _log.exception("owner of job %s", task.job.id)
