"""Tasks over the processes of this host, or over the machines of a cluster (`RayCluster`)."""

from __future__ import annotations

import importlib
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context
from typing import Protocol, TypeVar

from palpate.cluster import AHEAD, WorkerLostError
from palpate.process import end_with_parent, require

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


def begin_worker() -> None:
    """Let a worker use one core: there are as many, and threads of each would only wait."""
    # Ctrl-C is for the command. A worker that it ended would look as if memory had run out.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
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
            workers, mp_context=get_context("spawn"), initializer=begin_worker
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
