"""What goes to a worker process and what comes back; plain values, pickled on a private socket."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from palpate.errors import ErrorCode, PalpateError, RemoteError
from palpate_fem.config import FingertipParameters
from palpate_fem.result import Floats, IndentationOutcome, IndentationStep
from palpate_fem.store.content import StoredFingertip


@dataclass(frozen=True, slots=True)
class Setup:
    """First to a worker: how it makes fingertips.

    Attributes:
        factory: ``module:function`` that builds one, see ``palpate_fem.service.fingertips``.
        options: Its keyword arguments.
        warm: Parameters of the fingertip to build before the first job.
        keep: Pressurised fingertips to keep.
    """

    factory: str
    options: Mapping[str, object]
    warm: FingertipParameters
    keep: int


@dataclass(frozen=True, slots=True)
class Job:
    """One trajectory.

    Attributes:
        id: Names it among those that run at once.
        parameters: Of the fingertip.
        indenter: Name of the indenter.
        path: Poses, shape (K, 7); the first does not touch the skin.
        deadline_s: Time it may take from now on [s]; inf = as long as it takes.
    """

    id: str
    parameters: FingertipParameters
    indenter: str
    path: Floats
    deadline_s: float


@dataclass(frozen=True, slots=True)
class Cancel:
    """To a worker: stop this job."""

    id: str


@dataclass(frozen=True, slots=True)
class Waiting:
    """All workers are busy, and this many jobs are served before."""

    before: int


@dataclass(frozen=True, slots=True)
class Pressurising:
    """The fluid is being filled in."""

    fraction: float


@dataclass(frozen=True, slots=True)
class Began:
    """The fingertip is ready, the indenter starts. Also what an idle worker says first."""

    fingertip: StoredFingertip


@dataclass(frozen=True, slots=True)
class Stepped:
    """A step has converged."""

    step: IndentationStep


@dataclass(frozen=True, slots=True)
class Ended:
    """The last of a job that ran: how it ended, as in ``Trajectory``."""

    outcome: IndentationOutcome
    reason: str = ""
    travel_m: float = 0.0
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class Failed:
    """The last of a job that could not run, or whose worker died. An exception as plain values."""

    code: ErrorCode
    problem: str
    remedy: str
    retry_after_s: float = 0.0

    @classmethod
    def of(cls, error: BaseException) -> Failed:
        """What an exception means to the one who asked."""
        if isinstance(error, PalpateError):
            return cls(error.code, error.problem, error.remedy)
        return cls(
            ErrorCode.INTERNAL,
            f"{type(error).__name__}: {error}",
            "this is a defect of the finite-element room: look at its log",
        )

    def error(self) -> RemoteError:
        """As an exception."""
        return RemoteError(
            self.problem, remedy=self.remedy, code=self.code, retry_after_s=self.retry_after_s
        )


Event = Waiting | Pressurising | Began | Stepped | Ended | Failed
"""What a job's owner hears; ``Ended`` or ``Failed`` is the last, and comes exactly once."""
