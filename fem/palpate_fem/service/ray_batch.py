"""Many trajectories on the machines of a Ray cluster: on its GPUs in slots, else on its CPUs.

Ray carries messages and results; the processes behind it are those of one host. Only this process
keeps the list of what is to be done, so a machine that is lost costs nobody's trajectories.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from palpate.cluster import AHEAD, RETRIES, RayCluster
from palpate.errors import ConfigError, ErrorCode, RemoteError
from palpate_fem.indenter.catalogue import indenter_names
from palpate_fem.result import IndentationResult
from palpate_fem.service.batch import SimulationBatch, TrajectoryPlan, allow_open_files
from palpate_fem.service.device_batch import (
    ON_CPU_MOST,
    POLL_S,
    SLOTFULS,
    SLOTS,
    PlanEnded,
    SlottedBatch,
)
from palpate_fem.service.device_process import HANG_S, START_S
from palpate_fem.service.jobs import (
    DeviceEvent,
    DeviceSetup,
    JobEnded,
    JobFailed,
    WorkerSetup,
)
from palpate_fem.service.ray_actor import RayDevice, last_line
from palpate_fem.store.content import StoredFingertip

_log = logging.getLogger(__name__)

WAIT_S = 600.0
"""How long a sweep waits for machines if none is left [s]."""

LOOK_S = 5.0
"""How often it looks for machines that have joined [s]."""

_LOSSES_MOST = 3  # of actors that had a trajectory; then a CPU solves it: it may be what ends them
_PACKERS_MOST = 16


def cluster_packers(packers: int = 0) -> int:
    """Processes that make files on the host whose command uses a cluster.

    Args:
        packers: Requested number; 0 = as many as cores, but no more than 16.
    """
    return packers or min(_PACKERS_MOST, os.cpu_count() or 1)


_kept: dict[str, tuple[WorkerSetup, float, SimulationBatch]] = {}
"""The solver that a process of Ray keeps for its next task."""


def _solver(setup: WorkerSetup, limit_s: float) -> SimulationBatch:
    """This process's solver: a worker process, which can be ended if it hangs."""
    found = _kept.get("solver")
    if found is None or found[:2] != (setup, limit_s):
        if found is not None:
            found[2].close()
        made = SimulationBatch(setup, workers=1, threads=1, limit_s=limit_s)
        found = _kept["solver"] = (setup, limit_s, made)
    return found[2]


def _describe(setup: WorkerSetup, limit_s: float) -> StoredFingertip | JobFailed:
    """The pressurised fingertip, made on the cluster."""
    try:
        fingertip = _solver(setup, limit_s).fingertip(threading.Event())
    except RemoteError as error:
        return JobFailed.of(error)
    assert fingertip is not None
    return fingertip


def _solve(
    setup: WorkerSetup, limit_s: float, plan: TrajectoryPlan
) -> IndentationResult | JobFailed:
    """Solve a trajectory on a CPU of the cluster."""
    results: list[IndentationResult] = []
    try:
        report = _solver(setup, limit_s).run(
            [plan],
            1,
            stop=threading.Event(),
            on_trajectory=lambda _, result: results.append(result),
        )
    except RemoteError as error:
        _kept.pop("solver")[2].close()
        return JobFailed.of(error)
    if results:
        return results[0]
    (early,) = report.early
    return JobFailed(ErrorCode.SIMULATION, early.reason, "the same command tries it again")


class RayShare:
    """Trajectories on the CPUs of a cluster, one a task; a `CpuShare`.

    Args:
        cluster: The cluster.
        setup: How the fingertip is made.
        limit_s: Longest time for a trajectory [s].

    Attributes:
        tasks: What runs or is on its way, by Ray's references.
    """

    def __init__(self, cluster: RayCluster, setup: WorkerSetup, limit_s: float) -> None:
        self._cluster, self._setup, self._limit_s = cluster, setup, limit_s
        task = cluster.ray.remote(num_cpus=1, max_retries=RETRIES)
        self._solve, self._describe = task(_solve), task(_describe)
        self._waiting: deque[TrajectoryPlan] = deque()
        self.tasks: dict[Any, TrajectoryPlan] = {}

    @property
    def open(self) -> int:
        """Trajectories that run or wait."""
        return len(self.tasks) + len(self._waiting)

    def put(self, plan: TrajectoryPlan) -> None:
        """Solve a trajectory when there is room."""
        self._waiting.append(plan)

    def hand_out(self) -> None:
        """Start what waits, but no more than keeps the CPUs busy: results stay where they are."""
        if not self._waiting:
            return
        most = AHEAD * max(1, self._cluster.count("CPU"))
        while self._waiting and len(self.tasks) < most:
            plan = self._waiting.popleft()
            self.tasks[self._solve.remote(self._setup, self._limit_s, plan)] = plan

    def fingertip(self) -> Any:
        """Ray's reference of a fingertip, or of a ``JobFailed``."""
        return self._describe.remote(self._setup, self._limit_s)

    def end_of(self, reference: Any) -> PlanEnded:
        """The end of a trajectory, when Ray has it."""
        plan, ray = self.tasks.pop(reference), self._cluster.ray
        try:
            found = ray.get(reference)
        except ray.exceptions.RayError as error:
            lost = JobFailed(
                ErrorCode.UNAVAILABLE,
                f"the cluster did not solve it: {last_line(error)}",
                "look at the cluster's logs; the same command tries it again",
            )
            return PlanEnded(plan, lost)
        if isinstance(found, JobFailed):
            return PlanEnded(plan, found)
        return PlanEnded(plan, JobEnded.of(found), found.steps)

    def close(self) -> None:
        """Drop what runs or waits."""
        for reference in self.tasks:
            with contextlib.suppress(Exception):  # the cluster itself may be gone
                self._cluster.ray.cancel(reference, force=True)
        self.tasks.clear()
        self._waiting.clear()


class RayBatch(SlottedBatch[RayDevice]):
    """Runs trajectories on the machines of a cluster; a `TrajectoryBatch`.

    On GPUs there is an actor for each that the cluster has, those that join later included. One
    that is lost is replaced while its GPU is there; its trajectories go to the others meanwhile.

    Args:
        cluster: The cluster; the caller leaves it.
        setup: How the fingertip is made; all trajectories use its ``warm`` parameters.
        device: ``cuda`` = the GPUs, ``cpu`` = the solver of GPUs on CPUs, for tests; None = a CPU
            for each trajectory.
        slots: Trajectories at once on each device.
        limit_s: Longest time for a trajectory on a CPU [s].
        hang_s: A device that should be at work and is silent for so long is ended [s].
        start_s: The same before it is ready [s].
        silent_s: A device's machine that does not answer for so long counts as lost [s].
        wait_s: Longest time without any machine [s].
        look_s: Time between two looks for machines [s].
        indenters: Names of all that trajectories may have.
        gives_up: See `DeviceBatch`.

    Raises:
        ConfigError: The cluster has no GPUs, or there are no slots.
    """

    def __init__(
        self,
        cluster: RayCluster,
        setup: WorkerSetup,
        *,
        device: str | None,
        slots: int = SLOTS,
        limit_s: float = math.inf,
        hang_s: float = HANG_S,
        start_s: float = START_S,
        silent_s: float = HANG_S,
        wait_s: float = WAIT_S,
        look_s: float = LOOK_S,
        indenters: tuple[str, ...] = indenter_names(),
        gives_up: bool = False,
    ) -> None:
        self._share = RayShare(cluster, setup, limit_s)
        super().__init__(slots, self._share)
        self._cluster, self._device = cluster, device
        self._setup = DeviceSetup(
            setup,
            "cuda:0" if device == "cuda" else "cpu",
            slots,
            indenters,
            gives_up=gives_up,
        )
        self._hang_s, self._start_s = hang_s, start_s
        self._silent_s, self._wait_s, self._look_s = silent_s, wait_s, look_s
        self._has_devices = device is not None
        self._events: deque[tuple[RayDevice, DeviceEvent | None] | PlanEnded] = deque()
        self._described: Any = None  # reference of the fingertip, if there are no devices
        self._losses: Counter[int] = Counter()
        # Actors that ended without having solved anything, though not with their machine; since
        # one has solved something for the first time.
        self._in_vain = 0
        self._looked_s = -math.inf
        self._there_s = time.monotonic()  # when there was a machine last
        if device is None:
            self.ahead = max(ON_CPU_MOST, AHEAD * cluster.count("CPU"))
            self._described = self._share.fingertip()
        elif not self._units():
            raise ConfigError(
                "the cluster has no GPU",
                remedy="see what it has with: ray status; without --device its CPUs are used",
            )
        else:
            self.ahead = SLOTFULS * slots * self._units() + ON_CPU_MOST

    def _units(self) -> int:
        """Devices that the cluster has room for; on CPUs one is left for other tasks."""
        if self._device == "cuda":
            return self._cluster.count("GPU")
        cpus = self._cluster.count("CPU")
        return cpus if self._device is None else max(min(cpus, 1), cpus - 1)

    def _look(self) -> None:
        """Start actors for devices that have none, and see whether there are machines at all.

        Raises:
            RemoteError: There are none, for too long, or those that there are do not work.
        """
        now_s = time.monotonic()
        if now_s < self._looked_s + self._look_s:
            return
        self._looked_s, units = now_s, self._units()
        if self._device is not None:
            # One that says why it does not start would say it again, and counts twice.
            wanted = units - self._in_vain // 2
            while len(self._devices) < wanted:
                self._start()
            self._make_room(wanted)
            units = sum(device.heard_s > 0.0 for device in self._devices)
        if units:
            self._there_s = now_s
        elif now_s > self._there_s + self._wait_s:
            raise RemoteError(
                f"the cluster has had no machine for this for {self._wait_s:g} s",
                remedy="see what it has, and who uses it, with: ray status; what has ended is "
                "kept, the same command goes on",
                code=ErrorCode.UNAVAILABLE,
            )

    def _start(self) -> None:
        needs = {"num_gpus": 1, "num_cpus": 0} if self._device == "cuda" else {"num_cpus": 1}
        self._devices.append(
            RayDevice(
                self._cluster,
                self._setup,
                needs,
                hang_s=self._hang_s,
                start_s=self._start_s,
                silent_s=self._silent_s,
            )
        )

    def _make_room(self, devices: int) -> None:
        """Take more trajectories at once when there are more devices, if files may be open."""
        ahead = SLOTFULS * self._slots * devices + ON_CPU_MOST
        if ahead > self.ahead:
            with contextlib.suppress(ConfigError):
                allow_open_files(ahead)
                self.ahead = ahead

    def _hand_out(self, total: int) -> None:
        """Fill the devices, or without any the CPUs."""
        if self._device is None and self._first is not None:  # there is one who can make it
            while self._open < self.ahead and (found := self._supply.next()) is not None:
                self._share.put(found[1])
        super()._hand_out(total)

    def _receive(self) -> tuple[RayDevice, DeviceEvent | None] | PlanEnded | None:
        self._look()
        if not self._events:
            self._ask()
        return self._events.popleft() if self._events else None

    def _ask(self) -> None:
        """Wait a moment for what Ray has next."""
        for device in self._devices:
            if device.is_silent():
                self._events.append((device, None))
                return
        # Those come first that have waited for longest.
        devices = {
            device.answer: device for device in sorted(self._devices, key=lambda one: one.heard_s)
        }
        wanted = [*devices, *self._share.tasks]
        if self._described is not None:
            wanted.append(self._described)
        if not wanted:
            time.sleep(POLL_S)
            return
        ray = self._cluster.ray
        for reference in ray.wait(wanted, timeout=POLL_S)[0]:
            if reference in devices:
                device = devices[reference]
                was_useful = device.useful
                self._events.extend((device, event) for event in device.events())
                if device.useful and not was_useful:
                    self._in_vain = 0
            elif reference in self._share.tasks:
                self._events.append(self._share.end_of(reference))
            else:
                self._described = None
                self._take_fingertip(reference)

    def _take_fingertip(self, reference: Any) -> None:
        ray = self._cluster.ray
        try:
            found = ray.get(reference)
        except ray.exceptions.RayError as error:
            raise RemoteError(
                f"no machine of the cluster makes a fingertip: {last_line(error)}",
                remedy="install the same palpate[fem,cluster] on all its machines",
                code=ErrorCode.UNAVAILABLE,
            ) from error
        if isinstance(found, JobFailed):
            raise found.error()
        self._first = found

    def _on_gone(self, device: RayDevice) -> None:
        """Give back what an actor had; another is started when the cluster is looked at next."""
        self._devices.remove(device)
        for number, plan in device.open.items():
            self._losses[number] += 1
            if self._losses[number] < _LOSSES_MOST:
                self._supply.given_back.append((number, plan))
            else:
                self._share.put(plan)
        if self._closing:
            return
        device.kill()
        why, said = device.why_it_ended(), device.last_words
        _log.warning("a solver on the cluster %s", why)
        if not (device.useful or device.lost):
            self._in_vain += 2 if said is not None and not device.warm else 1
        units = self._units()
        if not self._devices and 0 < units <= self._in_vain // 2:
            raise RemoteError(
                f"no solver on the cluster works; the last one {why}",
                remedy=said.remedy
                if said is not None
                else "look at the cluster's logs, and at nvidia-smi on its machines; what has "
                "ended is kept",
                code=ErrorCode.UNAVAILABLE if said is None else said.code,
            )


@contextmanager
def ray_batch(
    address: str,
    setup: WorkerSetup,
    *,
    device: str | None,
    slots: int,
    limit_s: float,
    indenters: tuple[str, ...],
) -> Iterator[RayBatch]:
    """Join a cluster and run trajectories there; see `RayCluster` and `RayBatch`."""
    with (
        RayCluster(address) as cluster,
        RayBatch(
            cluster, setup, device=device, slots=slots, limit_s=limit_s, indenters=indenters
        ) as batch,
    ):
        yield batch
