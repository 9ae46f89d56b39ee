"""The solver's process: takes jobs from its pool, one at a time, and reports their events.

``WorkerProcess`` starts it with ``python -m`` and the descriptor of a socket; it ends when the
socket closes. As a process of its own, a crash, a leak or an endless loop of the solver costs one
trajectory and not the service.
"""

from __future__ import annotations

import math
import os
import queue
import sys
import threading
import time

from palpate.errors import PalpateError
from palpate_fem.result import IndentationOutcome
from palpate_fem.service.channel import Channel, channel_to_parent
from palpate_fem.service.fingertips import FingertipCache, check_start, load_factory
from palpate_fem.service.jobs import (
    CancelJob,
    JobEnded,
    JobEvent,
    JobFailed,
    JobStarted,
    Pressurising,
    SimulationJob,
    StepConverged,
    WorkerSetup,
)

_REPORT_EVERY_S = 0.2


class _Stopped(Exception):
    """Ends the pressurisation of a job that was cancelled or is late."""


class Worker:
    """Solves jobs and reports to the other end of the channel."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._jobs: queue.SimpleQueue[SimulationJob] = queue.SimpleQueue()
        self._cancelled: set[str] = set()
        self._reported = -math.inf

    def run(self) -> None:
        """Serve until the other end is closed."""
        setup: WorkerSetup = self._channel.receive()
        threading.Thread(target=self._listen, daemon=True).start()
        try:
            tips = FingertipCache(load_factory(setup.factory)(**setup.options), setup.keep)
            tips.get(setup.warm, self._tell)  # a sign of life, too
        except Exception as error:
            self._report(JobFailed.of(error))
            if isinstance(error, PalpateError):
                sys.exit(1)  # the other end says it; a traceback is for defects
            raise
        self._report(JobStarted(tips.describe(setup.warm)))
        while True:
            self._report(self._solve(self._jobs.get(), tips))

    def _listen(self) -> None:
        while True:
            try:
                message = self._channel.receive()
            except (EOFError, OSError):
                os._exit(0)  # the pool is gone, and the solver's thread has no other end
            if isinstance(message, SimulationJob):
                self._jobs.put(message)
            elif isinstance(message, CancelJob):
                self._cancelled.add(message.id)

    def _solve(self, job: SimulationJob, tips: FingertipCache) -> JobEnded | JobFailed:
        deadline = time.monotonic() + job.deadline_s

        def should_stop() -> IndentationOutcome | None:
            if job.id in self._cancelled:
                return IndentationOutcome.CANCELLED
            return IndentationOutcome.DEADLINE if time.monotonic() > deadline else None

        def on_fraction(fraction: float) -> None:
            if should_stop() is not None:
                raise _Stopped
            self._tell(fraction)

        try:
            tip = tips.get(job.parameters, on_fraction)
            fingertip = tips.describe(job.parameters)
            check_start(fingertip, job.indenter, job.path[0])
            self._report(JobStarted(fingertip))
            done = tip.indent(
                job.indenter,
                job.path,
                friction_coefficient=job.parameters.friction_coefficient,
                on_step=lambda step: self._report(StepConverged(step)),
                should_stop=should_stop,
            )
        except _Stopped:
            outcome = should_stop() or IndentationOutcome.CANCELLED
            return JobEnded(outcome, "stopped while the fluid was filled in")
        except Exception as error:  # whatever it is, it ends this job only
            if not isinstance(error, PalpateError):
                sys.excepthook(type(error), error, error.__traceback__)
            return JobFailed.of(error)
        finally:
            self._cancelled.clear()  # also of what came too late for an earlier job
        return JobEnded(done.outcome, done.reason, done.travel_m, done.seconds)

    def _tell(self, _: float) -> None:
        """Report that the fluid is being filled in."""
        if time.monotonic() - self._reported > _REPORT_EVERY_S:
            self._reported = time.monotonic()
            self._report(Pressurising())

    def _report(self, event: JobEvent) -> None:
        try:
            self._channel.send(event)
        except OSError:
            os._exit(0)


def main() -> None:
    """Run as a worker until the socket closes."""
    Worker(channel_to_parent()).run()


if __name__ == "__main__":
    main()
