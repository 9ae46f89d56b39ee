"""The process that solves, started by ``WorkerProcess`` as a module with its socket.

Its own process, so that a crash, a leak or an endless loop of the solver costs one trajectory and
not the service. It takes jobs from the socket with descriptor FD, one at a time, and ends with it.
"""

from __future__ import annotations

import faulthandler
import math
import os
import queue
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection

from palpate.errors import PalpateError
from palpate_fem.result import IndentationOutcome
from palpate_fem.service.fingertips import Fingertips, load_factory
from palpate_fem.service.jobs import (
    Began,
    Cancel,
    Ended,
    Event,
    Failed,
    Job,
    Pressurising,
    Setup,
    Stepped,
)
from palpate_fem.service.start import check_start

_TELL_EVERY_S = 0.2


class _Stopped(Exception):
    """Ends a pressurisation that nobody waits for any more."""


class Worker:
    """Solves jobs and tells the other end of the connection."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
        self._cancelled: set[str] = set()

    def run(self) -> None:
        """Serve until the other end is closed."""
        setup: Setup = self._connection.recv()
        threading.Thread(target=self._listen, daemon=True).start()
        try:
            tips = Fingertips(load_factory(setup.factory)(**setup.options), setup.keep)
            tips.get(setup.warm, lambda _: None)
        except Exception as error:
            self._tell(Failed.of(error))
            raise
        self._tell(Began(tips.describe(setup.warm)))
        while True:
            self._tell(self._answer(self._jobs.get(), tips))

    def _listen(self) -> None:
        while True:
            try:
                message = self._connection.recv()
            except (EOFError, OSError):
                os._exit(0)  # nobody is there to hear the rest of it
            if isinstance(message, Job):
                self._jobs.put(message)
            elif isinstance(message, Cancel):
                self._cancelled.add(message.id)

    def _answer(self, job: Job, tips: Fingertips) -> Ended | Failed:
        deadline = time.monotonic() + job.deadline_s
        told = -math.inf

        def should_stop() -> IndentationOutcome | None:
            if job.id in self._cancelled:
                return IndentationOutcome.CANCELLED
            return IndentationOutcome.DEADLINE if time.monotonic() > deadline else None

        def on_fraction(fraction: float) -> None:
            nonlocal told
            if should_stop() is not None:
                raise _Stopped
            if time.monotonic() - told > _TELL_EVERY_S:
                told = time.monotonic()
                self._tell(Pressurising(fraction))

        try:
            tip = tips.get(job.parameters, on_fraction)
            fingertip = tips.describe(job.parameters)
            check_start(fingertip, job.indenter, job.path[0])
            self._tell(Began(fingertip))
            done = tip.indent(
                job.indenter,
                job.path,
                friction_coefficient=job.parameters.friction_coefficient,
                on_step=lambda step: self._tell(Stepped(step)),
                should_stop=should_stop,
            )
        except _Stopped:
            outcome = should_stop() or IndentationOutcome.CANCELLED
            return Ended(outcome, "stopped while the fluid was filled in")
        except Exception as error:  # any trouble is this job's, and its owner is told
            if not isinstance(error, PalpateError):
                sys.excepthook(type(error), error, error.__traceback__)
            return Failed.of(error)
        finally:
            self._cancelled.discard(job.id)
        return Ended(done.outcome, done.reason, done.travel_m, done.seconds)

    def _tell(self, event: Event) -> None:
        try:
            self._connection.send(event)
        except OSError:
            os._exit(0)


def main() -> None:
    """Be a worker."""
    # Libraries print to stdout what is for people; a command's stdout may be JSON for machines.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    faulthandler.enable()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who started us
    Worker(Connection(int(sys.argv[1]))).run()


if __name__ == "__main__":
    main()
