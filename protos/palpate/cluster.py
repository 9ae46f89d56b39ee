"""A Ray cluster, whose machines share the work of a command."""

from __future__ import annotations

import contextlib
import signal
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, TypeVar

from palpate.errors import ErrorCode, LinkError, PalpateError
from palpate.process import Closing, require

Task = TypeVar("Task")
Answer = TypeVar("Answer")

AHEAD = 2
"""Tasks that each worker has: enough that none idles, few enough to stay in memory."""

REACH_S = 5.0
"""How long a cluster's port may take to answer [s]."""

RETRIES = 3
"""How often a task is repeated whose process or machine is lost."""


class WorkerLostError(PalpateError, RuntimeError):
    """A process or machine that ran a task is gone."""

    code = ErrorCode.UNAVAILABLE


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


class RayCluster(Closing):
    """A Ray cluster; tasks keep what they make between calls in processes that Ray reuses.

    Attributes:
        ray: Ray's module, connected.
        sees_files: Whether its workers see the files of this host.
    """

    sees_files = False

    def __init__(self, address: str) -> None:
        """Join it.

        Args:
            address: Of the cluster, ``HOST:PORT``; ``auto`` = the one that runs on this host;
                ``local`` = a new one of this host alone.

        Raises:
            MissingExtraError: Ray is not installed.
            LinkError: No cluster answers.
        """
        self.ray: Any = require("ray", extra="cluster")
        if ":" in address:
            _check_reachable(address)
        on_term = signal.getsignal(signal.SIGTERM)
        try:
            self._join(address)
        except LinkError:
            if address != "local":
                raise
            self.ray.shutdown()  # a busy host is slower than Ray waits, which nothing changes
            self._join(address)
        finally:  # Ray sets a handler of its own, which would end the command at once
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, on_term)

    def _join(self, address: str) -> None:
        try:
            self.ray.init(
                address=None if address == "local" else address,
                include_dashboard=False,
                log_to_driver=False,
                logging_level="ERROR",
            )
        except Exception as error:
            # A bare Exception says that a new node did not start in time.
            known = ConnectionError, ValueError, RuntimeError
            if not isinstance(error, known) and type(error) is not Exception:
                raise
            why = str(error).splitlines()[0]
            if address == "local":
                raise LinkError(
                    f"Ray does not start on this host, which may be too busy: {why}",
                    remedy="leave --ray out: the processes of one host need no cluster; or run it "
                    "again when the host is less busy",
                ) from error
            raise LinkError(
                f"no Ray cluster answers at {address!r}: {why}",
                remedy="start one (ray start --head), or leave --ray out",
            ) from error

    def count(self, resource: str) -> int:
        """How many of a resource its machines have now, free or not: ``CPU`` or ``GPU``."""
        return int(self.ray.cluster_resources().get(resource, 0))

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Iterator[tuple[Task, Answer]]:
        """Yield each task with its answer as it is done, in any order.

        Raises:
            WorkerLostError: A machine was lost more often than Ray repeats a task.
        """
        ray = self.ray

        def call(task: Task) -> Answer:  # Ray takes functions only, no partial ones
            return function(task)

        remote = ray.remote(num_cpus=1, max_retries=RETRIES)(call)
        most = AHEAD * max(1, self.count("CPU"))
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
            self.ray.shutdown()
