"""Messages between a process and the workers that it starts: plain values on a private channel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ErrorCode, PalpateError, RemoteError
from palpate_fem.arrays import Floats
from palpate_fem.config import FingertipParameters
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.store.content import StoredFingertip


@dataclass(frozen=True, slots=True)
class WorkerSetup:
    """First message to a worker: how it makes fingertips.

    Attributes:
        factory: ``module:function`` that returns a ``BuildTip``, see ``service.fingertips``.
        options: Keyword arguments of that function.
        warm: Parameters of the fingertip to build before the first job.
        keep: Number of pressurised fingertips to keep.
    """

    factory: str
    options: Mapping[str, object]
    warm: FingertipParameters
    keep: int


@dataclass(frozen=True, slots=True)
class SimulationJob:
    """One trajectory to simulate.

    Attributes:
        id: Unique among the jobs that wait or run; at a worker, among all jobs of its pool.
        parameters: Of the fingertip.
        indenter: Name of the indenter.
        path: Poses, shape (K, 7); the first does not touch the skin.
        deadline_s: Time that it may take from now on [s]; inf = no limit.
    """

    id: str
    parameters: FingertipParameters
    indenter: str
    path: Floats
    deadline_s: float


@dataclass(frozen=True, slots=True)
class CancelJob:
    """To a worker: stop this job."""

    id: str


@dataclass(frozen=True, slots=True)
class JobWaiting:
    """All workers are busy; this many jobs are before it in the queue."""

    before: int


@dataclass(frozen=True, slots=True)
class Pressurising:
    """The fluid is being filled in."""


@dataclass(frozen=True, slots=True)
class JobStarted:
    """The fingertip is ready and the indenter starts. Also the first message of an idle worker."""

    fingertip: StoredFingertip


@dataclass(frozen=True, slots=True)
class StepConverged:
    """A step has converged."""

    step: IndentationStep


@dataclass(frozen=True, slots=True)
class JobEnded:
    """Last event of a job that ran: how it ended, as in ``IndentationResult``."""

    outcome: IndentationOutcome
    reason: str = ""
    travel_m: float = 0.0
    seconds: float = 0.0

    @classmethod
    def of(cls, result: IndentationResult) -> JobEnded:
        """The end of a result."""
        return cls(result.outcome, result.reason, result.travel_m, result.seconds)

    def trajectory(
        self, indenter: str, path: Floats, steps: Sequence[IndentationStep]
    ) -> IndentationResult:
        """The whole result, from the steps that were reported before."""
        return IndentationResult(
            indenter, path, tuple(steps), self.outcome, self.reason, self.travel_m, self.seconds
        )


@dataclass(frozen=True, slots=True)
class JobFailed:
    """Last event of a job that could not run, or whose worker died: an error as plain values."""

    code: ErrorCode
    problem: str
    remedy: str
    retry_after_s: float = 0.0

    @classmethod
    def of(cls, error: BaseException) -> JobFailed:
        """From an exception; one that is not ours is reported as a defect."""
        if isinstance(error, PalpateError):
            retry_after_s = error.retry_after_s if isinstance(error, RemoteError) else 0.0
            return cls(error.code, error.problem, error.remedy, retry_after_s)
        return cls(
            ErrorCode.INTERNAL,
            f"{type(error).__name__}: {error}",
            "this is a defect of the finite-element solver: look at its log",
        )

    def error(self) -> RemoteError:
        """As an exception."""
        return RemoteError(
            self.problem, remedy=self.remedy, code=self.code, retry_after_s=self.retry_after_s
        )


JobEvent = JobWaiting | Pressurising | JobStarted | StepConverged | JobEnded | JobFailed
"""Event of a job; ``JobEnded`` or ``JobFailed`` is the last one and comes exactly once."""


@dataclass(frozen=True, slots=True)
class DeviceSetup:
    """First message to the process of a device.

    Attributes:
        worker: How it makes the fingertip.
        device: Warp device, for example ``cuda:0``.
        slots: Trajectories at once.
        indenters: Names of all that presses may have.
        streams: Whether each step is sent as it is made; results then come without steps.
        gives_up: Whether a trajectory that has no equilibrium on the device ends there; else it is
            reported as not solved.
    """

    worker: WorkerSetup
    device: str
    slots: int
    indenters: tuple[str, ...]
    streams: bool = False
    gives_up: bool = False


@dataclass(frozen=True, slots=True)
class NumberedPress:
    """A trajectory for a device.

    Attributes:
        number: Unique for its process.
        indenter: Name of the indenter.
        path: Poses, shape (K, 7).
        deadline_s: Time that it may take from now on [s].
    """

    number: int
    indenter: str
    path: Floats
    deadline_s: float = math.inf


@dataclass(frozen=True, slots=True)
class StopPress:
    """To the process of a device: end this trajectory as cancelled."""

    number: int


@dataclass(frozen=True, slots=True)
class ResultTaken:
    """To the process of a device: there is room for another result."""


@dataclass(frozen=True, slots=True)
class Swept:
    """From the process of a device: it is alive."""


@dataclass(frozen=True, slots=True)
class DeviceReady:
    """From the process of a device: all is compiled and in its memory; comes once."""


@dataclass(frozen=True, slots=True)
class PressStep:
    """A step of a trajectory has converged on a device."""

    number: int
    step: IndentationStep


@dataclass(frozen=True, slots=True)
class PressEnded:
    """Last event of a trajectory on a device."""

    number: int
    result: IndentationResult


@dataclass(frozen=True, slots=True)
class PressUnsolved:
    """Likewise of one that finds no equilibrium there; the CPU may find one."""

    number: int


@dataclass(frozen=True, slots=True)
class PressRefused:
    """Likewise of one that cannot be run."""

    number: int
    failed: JobFailed


DeviceEvent = (
    JobStarted
    | DeviceReady
    | Swept
    | PressStep
    | PressEnded
    | PressUnsolved
    | PressRefused
    | JobFailed
)
"""Message from the process of a device; ``JobStarted`` when the fingertip is there and presses may
come, ``JobFailed`` says why the process ends."""


@dataclass(frozen=True, slots=True)
class ImageJob:
    """To a process that makes files: a trajectory, by its id."""

    number: int
    trajectory: str
    result: IndentationResult


@dataclass(frozen=True, slots=True)
class ImageMade:
    """From it: the content of the file, bytes as an array."""

    number: int
    image: NDArray[np.uint8]
