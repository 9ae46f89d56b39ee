"""A job on its way through the pool, and what its owner is told when it does not get through."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from palpate.errors import ErrorCode, RemoteError
from palpate_fem.service.jobs import Event, Failed, Job
from palpate_fem.service.process import WorkerProcess

OnEvent = Callable[[Event], None]


@dataclass(slots=True, eq=False)
class Task:
    """A job on its way.

    ``deadline`` and ``overdue`` are monotonic times [s]: when it must stop, and when its worker is
    killed because it has not.
    """

    job: Job
    on_event: OnEvent
    deadline: float
    overdue: float = math.inf
    worker: WorkerProcess | None = None
    cancelled: bool = False
    over: bool = False


def failed(error: RemoteError) -> Failed:
    """The last event of a job that ends with this error."""
    return Failed(error.code, error.problem, error.remedy, error.retry_after_s)


def stopping() -> RemoteError:
    """The service stops."""
    return RemoteError(
        "the finite-element service is stopping",
        remedy="ask again when it is back: palpate status",
        code=ErrorCode.UNAVAILABLE,
        retry_after_s=2.0,
    )


def not_starting(epitaph: str) -> RemoteError:
    """Workers die before they are ready."""
    return RemoteError(
        f"the solver's process {epitaph} before it was ready, again and again",
        remedy="look at the log above; try it alone: palpate fem run",
        code=ErrorCode.UNAVAILABLE,
    )


def full(running: int, waiting: int, retry_after_s: float) -> RemoteError:
    """No place is free."""
    return RemoteError(
        f"{running} simulations run and {waiting} wait",
        remedy="ask again later, or start the service with more workers",
        code=ErrorCode.RESOURCE_EXHAUSTED,
        retry_after_s=round(min(max(retry_after_s, 0.5), 60.0), 1),
    )


def crashed(epitaph: str) -> Failed:
    """The job's worker died."""
    return Failed(
        ErrorCode.INTERNAL,
        f"the process that ran the simulation {epitaph}",
        "ask again; if it happens again, look at the log of the fem service",
        1.0,
    )
