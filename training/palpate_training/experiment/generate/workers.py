"""Tasks over the processes of this host, or over the machines of a cluster (`RayCluster`)."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context
from typing import Protocol, TypeVar

from palpate.cluster import AHEAD, WorkerLostError
from palpate.process import begin_worker, require

Task = TypeVar("Task")
Answer = TypeVar("Answer")


class TaskRunner(Protocol):
    """Runs tasks somewhere.

    Attributes:
        sees_files: Whether its workers see the files of this host.
    """

    sees_files: bool

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Iterator[tuple[Task, Answer]]:
        """Yield each task with its answer as it is done, in any order."""

    def close(self) -> None:
        """End the workers."""


def _begin() -> None:
    """Let a worker use one core: there are as many, and threads of each would only wait."""
    begin_worker()
    limit_threads(1)


def limit_threads(count: int) -> None:
    """Let products of matrices in this process use so many threads at most."""
    importlib.import_module("scipy.linalg")  # brings a linear algebra of its own, as NumPy does
    require("threadpoolctl", extra="training").threadpool_limits(count)


class WorkerProcesses:
    """Worker processes of this host."""

    sees_files = True

    def __init__(self, workers: int) -> None:
        self._workers = workers
        # Spawned: forked children would share locks of threads that they do not have.
        self._pool = ProcessPoolExecutor(
            workers, mp_context=get_context("spawn"), initializer=_begin
        )

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Iterator[tuple[Task, Answer]]:
        """See `TaskRunner.run`.

        Raises:
            WorkerLostError: A worker died, e.g. because memory ran out.
        """
        pending: dict[Future[Answer], Task] = {}
        more = iter(tasks)
        try:
            while True:
                for task in islice(more, AHEAD * self._workers - len(pending)):
                    pending[self._pool.submit(function, task)] = task
                if not pending:
                    return
                done, _ = wait(pending, return_when=FIRST_COMPLETED)
                for future in done:
                    task = pending.pop(future)
                    yield task, future.result()
        except BrokenProcessPool as error:
            raise WorkerLostError(
                "a worker process died", remedy="give it more memory, or use fewer workers"
            ) from error
        finally:
            for future in pending:
                future.cancel()

    def close(self) -> None:
        """End the workers."""
        self._pool.shutdown(wait=True, cancel_futures=True)
