"""Many trajectories on this host's GPUs: a process for each, which solves them in slots.

A process that dies or hangs costs nobody's trajectories: the other devices get them; the last one
is started again, once without having solved anything. What a device does not solve, or what two
processes did not survive, goes to worker processes on the CPU.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import queue
import threading
import time
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from palpate.errors import ConfigError, ErrorCode, RemoteError
from palpate.process import Closing
from palpate_fem.indenter.catalogue import indenter_names
from palpate_fem.result import IndentationStep
from palpate_fem.service.batch import (
    BatchReport,
    OnReport,
    OnTrajectory,
    TrajectoryPlan,
    account_for,
)
from palpate_fem.service.device_process import HANG_S, START_S, DeviceProcess
from palpate_fem.service.jobs import (
    DeviceEvent,
    DeviceReady,
    DeviceSetup,
    JobEnded,
    JobEvent,
    JobFailed,
    JobStarted,
    NumberedPress,
    PressEnded,
    PressRefused,
    PressUnsolved,
    ResultTaken,
    SimulationJob,
    StepConverged,
    WorkerSetup,
)
from palpate_fem.service.pool import WorkerPool
from palpate_fem.store.content import StoredFingertip

_log = logging.getLogger(__name__)

SLOTS = 128
"""Trajectories at once on a device: more gain little there, and each takes 0.22 GB."""

SLOTFULS = 2
"""Times its slots that a device has trajectories: as many wait there as are at work."""

LOSSES_MOST = 2
"""Processes of devices that end with a trajectory on them; then a CPU solves it: it may be what
ends them."""

ON_CPU_MOST = 256
"""Trajectories that run or wait on CPUs; then devices get no new ones."""

POLL_S = 0.1
"""Longest wait for an event before other things are looked at [s]."""

_THREADS_MOST = 4  # the fingertip is made on the CPU, and takes little more
_WORKERS_MOST = 16  # few trajectories need the CPU

_PACKERS_EACH = 8
"""For each device: it has a trajectory every 30 to 50 ms, and waited for two (ADR 26)."""


def threads_and_packers(devices: Sequence[str], packers: int = 0) -> tuple[int, int]:
    """Threads for the process of each device, and processes that make files, on this host.

    Args:
        devices: The devices.
        packers: Requested number of processes that make files; 0 = eight for each device, if there
            are as many cores.
    """
    cores = os.cpu_count() or 1
    threads = max(1, min(_THREADS_MOST, cores // len(devices)))
    return threads, packers or min(cores, _PACKERS_EACH * len(devices))


class _Supply:
    """The trajectories that no device has: new ones, and those that lost devices had."""

    def __init__(self, plans: Iterable[TrajectoryPlan]) -> None:
        self._new: Iterator[TrajectoryPlan] = iter(plans)
        self._numbers = itertools.count()
        self.given_back: deque[tuple[int, TrajectoryPlan]] = deque()
        self.used_up = False

    def next(self) -> tuple[int, TrajectoryPlan] | None:
        """One of them, with its number; None = there are no more at the moment."""
        if self.given_back:
            return self.given_back.popleft()
        plan = None if self.used_up else next(self._new, None)
        if plan is None:
            self.used_up = True
            return None
        return next(self._numbers), plan


class BusyDevice(Protocol):
    """A device as a batch sees it; see `DeviceProcess`."""

    open: dict[int, TrajectoryPlan]
    ready: bool
    warm: bool
    last_words: JobFailed | None

    def give(self, press: NumberedPress, owner: TrajectoryPlan, /) -> None:
        """Give it a trajectory."""

    def send(self, message: object, /) -> None:
        """Send it a message; lost if it has ended."""

    def kill(self) -> None:
        """End it now."""

    def join(self) -> None:
        """Wait until it has ended."""

    def why_it_ended(self) -> str:
        """The end of an error message."""
        ...


Device = TypeVar("Device", bound=BusyDevice)


@dataclass(frozen=True, slots=True)
class PlanEnded:
    """The end of a trajectory, its steps, and the device that has solved it; None = another end."""

    plan: TrajectoryPlan
    end: JobEnded | JobFailed
    steps: Sequence[IndentationStep] = ()
    device: BusyDevice | None = None


class CpuShare(Protocol):
    """Solves on CPUs what devices do not."""

    @property
    def open(self) -> int:
        """Trajectories that run or wait."""

    def put(self, plan: TrajectoryPlan) -> None:
        """Solve a trajectory when there is room."""

    def hand_out(self) -> None:
        """Start what waits, if there is room; to be called often."""

    def close(self) -> None:
        """Drop what runs or waits."""


class WorkerShare(Closing):
    """What devices do not solve: in worker processes, which start when there is something.

    Args:
        setup: How workers make the fingertip.
        limit_s: Longest time for a trajectory [s].
        on_end: Called with each end, from threads of its own.

    Attributes:
        open: Trajectories that run or wait; who takes their ends counts them down.
    """

    def __init__(
        self, setup: WorkerSetup, limit_s: float, on_end: Callable[[PlanEnded], None]
    ) -> None:
        self._setup, self._limit_s, self._on_end = setup, limit_s, on_end
        self._waiting: deque[TrajectoryPlan] = deque()
        self._pool: WorkerPool | None = None
        self.open = 0

    def put(self, plan: TrajectoryPlan) -> None:
        """Solve a trajectory when a worker is free."""
        if self._pool is None:
            workers = max(1, min(_WORKERS_MOST, (os.cpu_count() or 1) - 1))
            self._pool = WorkerPool(self._setup, workers=workers, threads=1, waiting=workers)
        self._waiting.append(plan)
        self.open += 1

    def hand_out(self) -> None:
        """Start what waits, if workers are free; to be called often."""
        pool = self._pool
        # A trajectory's time runs from its submission, so it must not wait in the pool.
        while (
            pool is not None
            and self._waiting
            and (pool.broken is not None or pool.busy + pool.waiting < pool.ready)
        ):
            self._submit(pool, self._waiting.popleft())

    def close(self) -> None:
        """End the workers; what runs or waits is dropped."""
        if self._pool is not None:
            self._pool.close()

    def _submit(self, pool: WorkerPool, plan: TrajectoryPlan) -> None:
        steps: list[IndentationStep] = []

        def on_event(event: JobEvent) -> None:
            if isinstance(event, StepConverged):
                steps.append(event.step)
            elif isinstance(event, JobEnded | JobFailed):
                self._on_end(PlanEnded(plan, event, steps))

        job = SimulationJob(plan.name, self._setup.warm, plan.indenter, plan.path, self._limit_s)
        try:
            pool.submit(job, on_event)
        except RemoteError as error:
            self._on_end(PlanEnded(plan, JobFailed.of(error)))


class SlottedBatch(Closing, Generic[Device]):
    """A `TrajectoryBatch` on devices that solve many trajectories at once, whatever carries them.

    Args:
        slots: Trajectories at once on each device.
        cpu: Solves what they do not.

    Raises:
        ConfigError: There are no slots.
    """

    ahead: int
    _has_devices = True  # else it is a matter of course that CPUs solve all

    def __init__(self, slots: int, cpu: CpuShare) -> None:
        if slots < 1:
            raise ConfigError(f"{slots} slots", remedy="give one or more")
        self._slots, self._cpu = slots, cpu
        self._devices: list[Device] = []
        self._first: StoredFingertip | None = None
        self._supply = _Supply(())
        self._closing = False

    @abstractmethod
    def _receive(self) -> tuple[Device, DeviceEvent | None] | PlanEnded | None:
        """Wait a moment for an event of a device, None of one that is gone, or an end on the CPU.

        Raises:
            RemoteError: There are no devices any more; says why.
        """

    @abstractmethod
    def _on_gone(self, device: Device) -> None:
        """Take a lost device from the others, and see to its trajectories.

        Raises:
            RemoteError: It was the last one; says why.
        """

    def fingertip(self, stop: threading.Event) -> StoredFingertip | None:
        """See ``TrajectoryBatch.fingertip``."""
        while self._first is None and not stop.is_set():
            self._next()
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
        """See ``TrajectoryBatch.run``.

        A trajectory that begins inside the skin, or whose path is not valid, counts as failed.
        When ``stop`` is set the devices end, so nothing can be run any more.
        """
        self._supply = supply = _Supply(plans)
        report, began = BatchReport(total), time.monotonic()
        while True:
            if stop.is_set():
                report.stopped = True
                self.close()
                break
            self._hand_out(total)
            if supply.used_up and not (supply.given_back or self._open):
                break
            ended = self._next()
            if ended is None:
                continue
            account_for(report, ended.plan, ended.end, ended.steps, on_trajectory)
            if ended.device is not None:
                ended.device.send(ResultTaken())
            elif isinstance(ended.end, JobEnded):
                report.on_cpu += self._has_devices
            if on_report is not None:
                on_report(report)
        report.wall_s = time.monotonic() - began
        return report

    def close(self) -> None:
        """End the devices' processes; may be called again."""
        self._closing = True
        for device in self._devices:
            device.kill()
        for device in self._devices:
            device.join()
        self._cpu.close()

    @property
    def _open(self) -> int:
        """Trajectories that are taken and have not ended, but for those given back."""
        return sum(len(device.open) for device in self._devices) + self._cpu.open

    def _hand_out(self, total: int) -> None:
        """Fill the devices, the emptiest first, and the CPU."""
        self._cpu.hand_out()
        # What one has in store another cannot solve: a small batch is shared evenly.
        share = math.ceil(total / max(1, len(self._devices)))
        most = max(1, min(SLOTFULS * self._slots, share))
        while self._open < self.ahead:
            free = [one for one in self._devices if one.ready and len(one.open) < most]
            found = self._supply.next() if free else None
            if found is None:
                return
            number, plan = found
            emptiest = min(free, key=lambda one: len(one.open))
            emptiest.give(NumberedPress(number, plan.indenter, plan.path), plan)

    def _next(self) -> PlanEnded | None:
        """Wait a moment for the end of a trajectory, and see to the devices.

        Raises:
            RemoteError: The last one is gone; says why.
        """
        found = self._receive()
        if found is None or isinstance(found, PlanEnded):
            return found
        device, event = found
        match event:
            case PressEnded(number, result):
                plan = device.open.pop(number)
                return PlanEnded(plan, JobEnded.of(result), result.steps, device)
            case PressRefused(number, failed):
                return PlanEnded(device.open.pop(number), failed)
            case PressUnsolved(number):
                self._cpu.put(device.open.pop(number))
            case JobStarted(fingertip):
                device.ready = True
                self._first = self._first or fingertip
            case DeviceReady():
                device.warm = True
            case JobFailed():
                device.last_words = event
            case None:
                self._on_gone(device)
        return None


class DeviceBatch(SlottedBatch[DeviceProcess[TrajectoryPlan]]):
    """Runs trajectories on fingertips with one set of parameters, on devices; a `TrajectoryBatch`.

    Args:
        setup: How the fingertip is made; all trajectories use its ``warm`` parameters. What it
            makes is a ``SlottedTip``.
        devices: Warp devices, see ``check_devices``; a process for each.
        slots: Trajectories at once on each.
        threads: Threads that the libraries of each process may use.
        limit_s: Longest time for a trajectory that has to be computed on the CPU [s].
        hang_s: A process that should be at work and is silent for so long is ended [s].
        start_s: The same before its device is ready [s].
        indenters: Names of all that trajectories may have.
        gives_up: Whether a trajectory that has no equilibrium on a device ends there; else the CPU
            begins it anew, which copes with indefinite tangents.

    Raises:
        ConfigError: There are no devices or no slots.
    """

    def __init__(
        self,
        setup: WorkerSetup,
        devices: Sequence[str],
        *,
        slots: int = SLOTS,
        threads: int = 1,
        limit_s: float = math.inf,
        hang_s: float = HANG_S,
        start_s: float = START_S,
        indenters: tuple[str, ...] = indenter_names(),
        gives_up: bool = False,
    ) -> None:
        if not devices:
            raise ConfigError("no devices", remedy="give one or more")
        self._events: queue.SimpleQueue[
            tuple[DeviceProcess[TrajectoryPlan], DeviceEvent | None] | PlanEnded
        ] = queue.SimpleQueue()
        self._workers = WorkerShare(setup, limit_s, self._events.put)
        super().__init__(slots, self._workers)
        self.ahead = SLOTFULS * slots * len(devices) + ON_CPU_MOST
        self._setup, self._threads = setup, threads
        self._hang_s, self._start_s = hang_s, start_s
        self._indenters, self._gives_up = indenters, gives_up
        self._losses: Counter[int] = Counter()  # of processes that had a trajectory
        self._again = False  # whether the last one was started again and has solved nothing since
        for device in devices:
            self._start(device)

    @property
    def pids(self) -> list[int]:
        """Process ids of the devices that are left, in order."""
        return [process.pid for process in self._devices]

    def _start(self, device: str) -> None:
        setup = DeviceSetup(
            self._setup, device, self._slots, self._indenters, gives_up=self._gives_up
        )
        self._devices.append(
            DeviceProcess(
                setup,
                self._threads,
                lambda process, event: self._events.put((process, event)),
                hang_s=self._hang_s,
                start_s=self._start_s,
            )
        )

    def _receive(
        self,
    ) -> tuple[DeviceProcess[TrajectoryPlan], DeviceEvent | None] | PlanEnded | None:
        for process in self._devices:
            process.end_if_hung()
        try:
            found = self._events.get(timeout=POLL_S)
        except queue.Empty:
            return None
        if isinstance(found, PlanEnded):
            self._workers.open -= 1
        elif isinstance(found[1], PressEnded | PressUnsolved):
            self._again = False
        return found

    def _on_gone(self, process: DeviceProcess[TrajectoryPlan]) -> None:
        """Give back what a process had; start it again if it was the last."""
        self._devices.remove(process)
        to_cpu = False
        for number, plan in process.open.items():
            self._losses[number] += 1
            if self._losses[number] < LOSSES_MOST:
                self._supply.given_back.append((number, plan))
            else:
                to_cpu = True
                self._cpu.put(plan)
        why, said = process.why_it_ended(), process.last_words
        if self._closing:
            return
        _log.warning("the solver on %s %s", process.device, why)
        if self._devices:
            return
        # One that says why it does not start would say it again. Without those that are left to the
        # CPU it may work.
        if (self._again and not to_cpu) or (said is not None and not process.warm):
            raise RemoteError(
                f"the solver on {process.device} {why}" + ", again" * self._again,
                remedy=said.remedy
                if said is not None
                else "look at the log above and at nvidia-smi; what has ended is kept",
                code=ErrorCode.UNAVAILABLE if said is None else said.code,
            )
        self._again = True
        self._start(process.device)
