"""Worker processes for calibration and validation: a ``Simulator`` that many threads may call."""

from __future__ import annotations

import itertools
import math
import queue
from typing import Self

from palpate.closing import Closing
from palpate.errors import SimulationError
from palpate_fem.calibration.runs import Simulated
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.path import check_path
from palpate_fem.result import Floats, IndentationResult, IndentationStep
from palpate_fem.service.jobs import Began, Ended, Event, Failed, Job, Setup, Stepped
from palpate_fem.service.pool import Pool


class PoolSimulator(Closing):
    """Runs indentations in worker processes.

    Each call waits for its own result, so it takes as many threads as there are workers: give a
    ``ThreadPoolExecutor`` to whatever runs it. A worker that dies is that run's trouble only.

    Args:
        setup: How workers make fingertips.
        workers: Worker processes.
        threads: Threads that each may use.
        limit_s: Longest time that one run may take [s].
    """

    def __init__(
        self, setup: Setup, *, workers: int, threads: int, limit_s: float = math.inf
    ) -> None:
        self._limit_s = limit_s
        self._numbers = itertools.count()
        self._pool = Pool(setup, workers=workers, threads=threads, waiting=10_000)

    def simulate(self, parameters: FingertipParameters, indenter: str, path: Floats) -> Simulated:
        """Indent a finger of these parameters along a path, shape (K, 7).

        Raises:
            SimulationError: It cannot be run; says why.
        """
        events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        poses = check_path(path)
        job = Job(str(next(self._numbers)), parameters, indenter, poses, self._limit_s)
        self._pool.submit(job, events.put)
        steps: list[IndentationStep] = []
        thickness_m = fluid_m3 = math.nan
        while True:
            event = events.get()
            if isinstance(event, Began):
                thickness_m = event.fingertip.total_thickness_m
                fluid_m3 = event.fingertip.fluid_volume_m3
            elif isinstance(event, Stepped):
                steps.append(event.step)
            elif isinstance(event, Failed):
                raise SimulationError(event.problem, remedy=event.remedy)
            elif isinstance(event, Ended):
                done = IndentationResult(
                    indenter,
                    poses,
                    tuple(steps),
                    event.outcome,
                    event.reason,
                    event.travel_m,
                    event.seconds,
                )
                return Simulated.of(done, thickness_m=thickness_m, fluid_volume_m3=fluid_m3)

    def close(self) -> None:
        """End the workers."""
        self._pool.close()

    def __enter__(self) -> Self:
        return self
