"""The solver as calibration and validation see it, and the processes it runs in."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache

from palpate.fem.align import Floats
from palpate.fem.calibrate_runs import Simulated
from palpate.fem.calibrate_threads import limit_threads
from palpate.fem.config import FingertipParameters
from palpate.fem.fingertips import Fingertips, load_factory

_KEPT = 2
"""Pressurised fingertips a process keeps: runs come point by point, and a batch may end in the
middle of one."""


@dataclass(frozen=True)
class FingertipSimulator:
    """Runs trajectories on fingertips of a factory; goes to other processes as three values.

    Attributes:
        factory: ``module:function`` that makes fingertips, see ``palpate.fem.fingertips``.
        options: Its keyword arguments.
    """

    factory: str = "palpate.fem.biotac:biotac"
    options: Mapping[str, object] = field(default_factory=dict)

    def simulate(self, parameters: FingertipParameters, indenter: str, path: Floats) -> Simulated:
        """See ``calibrate_runs.Simulator``."""
        tips = _tips(self.factory, tuple(sorted(self.options.items())))
        tip = tips.get(parameters, lambda _: None)
        trajectory = tip.indent(
            indenter, path, friction_coefficient=parameters.friction_coefficient
        )
        state = tip.describe()
        return Simulated.of(
            trajectory,
            thickness_m=state.total_thickness_m,
            fluid_volume_m3=state.fluid_volume_m3,
        )


@lru_cache(maxsize=1)
def _tips(factory: str, options: tuple[tuple[str, object], ...]) -> Fingertips:
    """The fingertips of this process."""
    return Fingertips(load_factory(factory)(**dict(options)), _KEPT)


def simulation_pool(workers: int, threads: int) -> ProcessPoolExecutor:
    """Processes for ``FingertipSimulator``; use it with ``with``.

    Args:
        workers: How many.
        threads: Threads of each one's libraries.
    """
    # Not forked: a copy of loaded numerical libraries and their threads may hang.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, context, limit_threads, (threads,))
