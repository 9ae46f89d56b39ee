"""Tasks over the processes of this host, or over the machines of a Ray cluster."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context, parent_process
from typing import Any, Protocol, TypeVar

from palpate.errors import ErrorCode, LinkError, PalpateError
from palpate.process import require

Task = TypeVar("Task")
Answer = TypeVar("Answer")

AHEAD = 2
"""Tasks that wait for each worker: enough that none idles, few enough to stay in memory."""


class WorkerLostError(PalpateError, RuntimeError):
    """A process or machine that ran a task is gone."""

    code = ErrorCode.UNAVAILABLE


class TaskRunner(Protocol):
    """Runs tasks somewhere."""

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Iterator[tuple[Task, Answer]]:
        """Yield each task with its answer as it is done, in any order."""

    def close(self) -> None:
        """End the workers."""


def end_with_parent() -> None:
    """Let a worker not outlive a command that was killed: the pool would wait for ever."""
    parent = parent_process()
    assert parent is not None

    def wait_for_end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_end, name="parent", daemon=True).start()


class WorkerProcesses:
    """Worker processes of this host."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        # Spawned: forked children would share locks of threads that they do not have.
        self._pool = ProcessPoolExecutor(
            workers, mp_context=get_context("spawn"), initializer=end_with_parent
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


def _check_reachable(address: str) -> None:
    """Check that a cluster listens: Ray itself would try for minutes, then end the process.

    Raises:
        LinkError: Nothing listens there, or it is no address.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=REACH_S).close()
    except (OSError, ValueError, OverflowError) as error:
        raise LinkError(
            f"no Ray cluster answers at {address!r}: {error}",
            remedy="start one (ray start --head), or leave --ray out",
        ) from error


REACH_S = 5.0
"""How long a cluster's port may take to answer [s]."""


class RayCluster:
    """A Ray cluster; tasks keep what they make between calls in processes that Ray reuses."""

    def __init__(self, address: str) -> None:
        """Join it.

        Args:
            address: Of the cluster, ``HOST:PORT``; ``auto`` = the one that runs on this host;
                ``local`` = a new one of this host alone.

        Raises:
            MissingExtraError: Ray is not installed.
            LinkError: No cluster answers.
        """
        self._ray: Any = require("ray", extra="cluster")
        if ":" in address:
            _check_reachable(address)
        try:
            self._ray.init(
                address=None if address == "local" else address,
                include_dashboard=False,
                log_to_driver=False,
                logging_level="ERROR",
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise LinkError(
                f"no Ray cluster answers at {address!r}: {str(error).splitlines()[0]}",
                remedy="start one (ray start --head), or leave --ray out",
            ) from error

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Iterator[tuple[Task, Answer]]:
        """See `TaskRunner.run`.

        Raises:
            WorkerLostError: A machine was lost more often than Ray repeats a task.
        """
        ray = self._ray

        def call(task: Task) -> Answer:  # Ray takes functions only, no partial ones
            return function(task)

        remote = ray.remote(num_cpus=1, max_retries=3)(call)
        most = AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
        pending: dict[Any, Task] = {}
        more = iter(tasks)
        while True:
            for task in islice(more, most - len(pending)):
                pending[remote.remote(task)] = task
            if not pending:
                return
            done, _ = ray.wait(list(pending), num_returns=1)
            for reference in done:
                task = pending.pop(reference)
                try:
                    answer: Answer = ray.get(reference)
                except ray.exceptions.RayTaskError as error:
                    raise error.as_instanceof_cause() from error
                except ray.exceptions.RayError as error:
                    raise WorkerLostError(
                        f"the cluster lost a task: {str(error).splitlines()[0]}",
                        remedy="look at the cluster's logs; what is done is kept, run it again",
                    ) from error
                yield task, answer

    def close(self) -> None:
        """Leave the cluster."""
        with contextlib.suppress(Exception):
            self._ray.shutdown()
