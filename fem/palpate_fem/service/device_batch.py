"""Many trajectories on GPUs: a process for each device, which solves them in slots.

A process that dies or hangs costs nobody's trajectories: the other devices get them; the last one
is started once more.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence

from palpate.errors import ConfigError, ErrorCode, RemoteError
from palpate.heartbeat import Turns
from palpate.process import Closing
from palpate_fem.indenter.catalogue import indenter_names
from palpate_fem.service.batch import (
    BatchReport,
    OnReport,
    OnTrajectory,
    TrajectoryPlan,
    account_for,
)
from palpate_fem.service.channel import ChildProcess
from palpate_fem.service.jobs import (
    DeviceEvent,
    DeviceSetup,
    JobEnded,
    JobFailed,
    JobStarted,
    NumberedPress,
    PressEnded,
    PressRefused,
    ResultTaken,
    Swept,
    WorkerSetup,
)
from palpate_fem.store.content import StoredFingertip

_log = logging.getLogger(__name__)

SLOTS = 128
"""Trajectories at once on a device: more gain little there, and each takes 232 MiB."""

HANG_S = 120.0
"""Longest time between two sweeps of slots [s]; they take seconds."""

START_S = 900.0
"""The same before a process has solved its first trajectory [s]: kernels are compiled until then,
which takes minutes."""

_SLOTFULS = 2  # of trajectories that a device has: one at work, one that waits
_POLL_S = 0.1
_THREADS_MOST = 4  # the fingertip is made on the CPU, and takes little more


def check_devices(names: Sequence[str]) -> None:
    """Check that Warp sees these devices, e.g. ``cuda:0``.

    Raises:
        ConfigError: It does not see one of them; lists those that it sees.
    """
    from palpate_fem.device import known_devices

    known = known_devices()
    for name in names:
        if name not in known:
            raise ConfigError(
                f"there is no device {name!r}",
                remedy=f"give one of: {', '.join(known)}; if a GPU is missing, see nvidia-smi",
            )


def threads_and_packers(devices: Sequence[str], packers: int = 0) -> tuple[int, int]:
    """Threads for the process of each device, and processes that make files, on this host.

    Args:
        devices: The devices.
        packers: Requested number of processes that make files; 0 = two for each device, if there
            are as many cores: a device solves a trajectory in the time in which two pack it.
    """
    cores = os.cpu_count() or 1
    threads = max(1, min(_THREADS_MOST, cores // len(devices)))
    return threads, packers or min(cores, 2 * len(devices))


class DeviceProcess(ChildProcess):
    """The process of a device, as its batch sees it.

    Attributes:
        device: Its Warp device.
        open: The trajectories that it has, by number.
        ready: Whether its fingertip is there.
        last_words: Why it ends, if it said so.
        hung: Whether it was ended because it was silent.
    """

    def __init__(
        self,
        setup: DeviceSetup,
        threads: int,
        events: queue.SimpleQueue[tuple[DeviceProcess, DeviceEvent | None]],
        *,
        hang_s: float,
        start_s: float,
    ) -> None:
        self.device = setup.device
        self.open: dict[int, TrajectoryPlan] = {}
        self.ready = self.hung = False
        self.last_words: JobFailed | None = None
        self._events, self._hang_s, self._patience_s = events, hang_s, start_s
        self._turns = Turns()
        self._turns.next(start_s)
        super().__init__(
            "palpate_fem.service.device_worker",
            setup,
            threads=threads,
            on_message=DeviceProcess._on_event,
            on_gone=lambda process: events.put((process, None)),
        )

    def give(self, number: int, plan: TrajectoryPlan) -> None:
        """Give it a trajectory."""
        if not self.open:  # it need not have said anything while it had nothing to do
            self._turns.next(self._patience_s)
        self.open[number] = plan
        self.send(NumberedPress(number, plan.indenter, plan.path))

    def end_if_hung(self) -> None:
        """End it if it should be at work and has been silent for too long."""
        if not self.hung and (self.open or not self.ready) and self._turns.are_late():
            self.hung = True
            self.kill()

    def why_it_ended(self) -> str:
        """The end of an error message."""
        if self.last_words is not None:
            return f"ended: {self.last_words.problem}"
        if self.hung:
            return f"was ended as it had been silent for {self._patience_s:g} s"
        return self.how_it_ended()

    def _on_event(self, event: DeviceEvent) -> None:
        if isinstance(event, PressEnded):
            self._patience_s = self._hang_s  # everything is compiled
        self._turns.next(self._patience_s)
        if not isinstance(event, Swept):
            self._events.put((self, event))


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


class DeviceBatch(Closing):
    """Runs trajectories on fingertips with one set of parameters, on devices; a `TrajectoryBatch`.

    Args:
        setup: How the fingertip is made; all trajectories use its ``warm`` parameters. What it
            makes is a ``SlottedTip``.
        devices: Warp devices, see `check_devices`; a process for each.
        slots: Trajectories at once on each.
        threads: Threads that the libraries of each process may use.
        limit_s: Longest time for a trajectory that has to be computed on the CPU [s].
        hang_s: A process that should be at work and is silent for so long is ended [s].
        start_s: The same before it has solved its first trajectory [s].

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
    ) -> None:
        if not devices or slots < 1:
            raise ConfigError(
                f"{len(devices)} devices with {slots} slots", remedy="give one or more of each"
            )
        self.ahead = _SLOTFULS * slots * len(devices)
        self._setup, self._slots, self._threads, self._limit_s = setup, slots, threads, limit_s
        self._hang_s, self._start_s = hang_s, start_s
        self._first: StoredFingertip | None = None
        self._supply = _Supply(())
        self._again = False  # whether the last one was started once more
        self._closing = False
        self._events: queue.SimpleQueue[tuple[DeviceProcess, DeviceEvent | None]] = (
            queue.SimpleQueue()
        )
        self._processes: list[DeviceProcess] = []
        for device in devices:
            self._start(device)

    @property
    def pids(self) -> list[int]:
        """Process ids of the devices that are left, in order."""
        return [process.pid for process in self._processes]

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
        When ``stop`` is set the processes end, so nothing can be run any more.
        """
        self._supply = supply = _Supply(plans)
        report, began = BatchReport(total), time.monotonic()
        while True:
            if stop.is_set():
                report.stopped = True
                self.close()
                break
            self._hand_out(total)
            if supply.used_up and not any(process.open for process in self._processes):
                break
            ended = self._next()
            if ended is None:
                continue
            process, event = ended
            plan = process.open.pop(event.number)
            if isinstance(event, PressEnded):
                result = event.result
                end = JobEnded(result.outcome, result.reason, result.travel_m, result.seconds)
                account_for(report, plan, end, result.steps, on_trajectory)
                process.send(ResultTaken())
            else:
                account_for(report, plan, event.failed, (), on_trajectory)
            if on_report is not None:
                on_report(report)
        report.wall_s = time.monotonic() - began
        return report

    def close(self) -> None:
        """End the processes; may be called again."""
        self._closing = True
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join()

    def _start(self, device: str) -> None:
        setup = DeviceSetup(self._setup, device, self._slots, indenter_names(), self._limit_s)
        self._processes.append(
            DeviceProcess(
                setup, self._threads, self._events, hang_s=self._hang_s, start_s=self._start_s
            )
        )

    def _hand_out(self, total: int) -> None:
        """Fill the devices, the emptiest first."""
        # What one has in store another cannot solve: a small batch is shared evenly.
        share = math.ceil(total / max(1, len(self._processes)))
        most = max(1, min(_SLOTFULS * self._slots, share))
        while True:
            free = [one for one in self._processes if one.ready and len(one.open) < most]
            found = self._supply.next() if free else None
            if found is None:
                return
            min(free, key=lambda one: len(one.open)).give(*found)

    def _next(self) -> tuple[DeviceProcess, PressEnded | PressRefused] | None:
        """Wait a moment for the end of a trajectory, and see to the processes.

        Raises:
            RemoteError: The last one is gone; says why.
        """
        for process in self._processes:
            process.end_if_hung()
        try:
            process, event = self._events.get(timeout=_POLL_S)
        except queue.Empty:
            return None
        if isinstance(event, PressEnded | PressRefused):
            return process, event
        if isinstance(event, JobStarted):
            process.ready = True
            self._first = self._first or event.fingertip
        elif isinstance(event, JobFailed):
            process.last_words = event
        elif event is None:
            self._on_gone(process)
        return None

    def _on_gone(self, process: DeviceProcess) -> None:
        """Give back what a process had; start it again if it was the last."""
        self._processes.remove(process)
        self._supply.given_back.extend(process.open.items())
        why, said = process.why_it_ended(), process.last_words
        if self._closing:
            return
        _log.warning("the solver on %s %s", process.device, why)
        if self._processes:
            return
        # One that says why it does not start would say it again.
        if self._again or (said is not None and not process.ready):
            raise RemoteError(
                f"the solver on {process.device} {why}" + ", again" * self._again,
                remedy=said.remedy
                if said is not None
                else "look at the log above and at nvidia-smi; what has ended is kept",
                code=ErrorCode.UNAVAILABLE if said is None else said.code,
            )
        self._again = True
        self._start(process.device)
