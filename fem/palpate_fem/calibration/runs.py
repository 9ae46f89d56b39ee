"""Runs of the simulator for comparison with measurements: each only once, several at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Executor, Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from palpate.errors import ConfigError, SimulationError
from palpate_fem.calibration.alignment import Floats, ForceCurve, along
from palpate_fem.calibration.measured import MeasuredIndentation
from palpate_fem.config import FingertipParameters
from palpate_fem.mechanics.load_stepping import path_lengths
from palpate_fem.result import IndentationOutcome, IndentationResult

Key = tuple[object, ...]

_PLACES = 9
"""Decimals of a path in metres that distinguish runs; a nanometre has no effect on a solver."""


@dataclass(frozen=True, slots=True)
class PlannedPath:
    """A trajectory to simulate: id, indenter, poses (K, 7) that begin above the skin."""

    name: str
    indenter: str
    path: Floats


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """One simulated indentation, reduced to what a comparison needs.

    Attributes:
        forces: Net force on the BioTac at the first k poses of the path [N], sensor frame,
            shape (k, 3); the first pose is untouched.
        travel: Path length at each of them [m], shape (k,).
        thickness_m: Total thickness of the pressurised finger [m].
        fluid_volume_m3: Fluid between skin and core [m^3].
        outcome: How it ended.
        reason: Why it did not complete.
    """

    forces: Floats
    travel: Floats
    thickness_m: float
    fluid_volume_m3: float
    outcome: IndentationOutcome
    reason: str = ""

    @classmethod
    def of(
        cls, trajectory: IndentationResult, *, thickness_m: float, fluid_volume_m3: float
    ) -> SimulatedRun:
        """From a solver's result, whose steps begin at the second pose, and its finger."""
        forces = from_rest(trajectory.forces)
        return cls(
            forces,
            path_lengths(trajectory.path)[: len(forces)],
            thickness_m,
            fluid_volume_m3,
            trajectory.outcome,
            trajectory.reason,
        )

    @property
    def curve(self) -> ForceCurve:
        """Force against travel."""
        return along(self.travel, self.forces)


def from_rest(force_n: Floats) -> Floats:
    """Forces at a solver's steps [N], with zero force in front for the untouched first pose."""
    return np.concatenate([np.zeros((1, 3)), force_n])


class Simulator(Protocol):
    """Runs one indentation; it must be picklable for a process pool.

    Successive calls in a process mostly share their parameters, so an implementation should keep
    the last pressurised finger. A run that ends early is a result, not an error.
    """

    def simulate(
        self, parameters: FingertipParameters, indenter: str, path: Floats
    ) -> SimulatedRun:
        """Indent a finger of these parameters along a path, shape (K, 7)."""
        ...


class SimulationRuns:
    """Results of runs, each made only once, through an executor.

    Args:
        simulator: Runs one indentation.
        executor: Runs several at a time, e.g. a process pool; None = one after the other.
        on_run: Called after each run with the number of finished and of all runs of this call.

    Attributes:
        count: Number of runs so far.
    """

    def __init__(
        self,
        simulator: Simulator,
        executor: Executor | None = None,
        on_run: Callable[[int, int], None] | None = None,
    ) -> None:
        self._simulator = simulator
        self._executor = executor
        self._on_run = on_run
        self._memo: dict[Key, SimulatedRun] = {}
        self.count = 0

    def run(
        self, jobs: Iterable[tuple[FingertipParameters, MeasuredIndentation]]
    ) -> list[SimulatedRun]:
        """Results in the order of the jobs; what ran before is not run again.

        A run that the simulator refuses gives a result without steps, with the reason.

        Raises:
            SimulationError: A process of the simulation died.
        """
        wanted = [(_key(parameters, item), parameters, item) for parameters, item in jobs]
        new = {key: (p, item) for key, p, item in wanted if key not in self._memo}
        for done, (key, result) in enumerate(self._results(new), start=1):
            self._memo[key] = result
            self.count += 1
            if self._on_run is not None:
                self._on_run(done, len(new))
        return [self._memo[key] for key, _, _ in wanted]

    def _results(
        self, new: dict[Key, tuple[FingertipParameters, MeasuredIndentation]]
    ) -> Iterable[tuple[Key, SimulatedRun]]:
        if self._executor is None:
            for key, (parameters, item) in new.items():
                yield key, _simulate(self._simulator, parameters, item.indenter, item.pose)
            return
        futures: dict[Future[SimulatedRun], Key] = {}
        try:
            for key, (parameters, item) in new.items():
                future = self._executor.submit(
                    _simulate, self._simulator, parameters, item.indenter, item.pose
                )
                futures[future] = key
            for future in as_completed(futures):
                yield futures[future], future.result()
        except (BrokenProcessPool, CancelledError) as error:
            raise SimulationError(
                f"a process of the simulation died: {error}",
                remedy="check the memory of the machine, or use fewer processes",
            ) from error
        finally:  # after an error or Ctrl-C the rest is not needed
            for future in futures:
                future.cancel()


def _simulate(
    simulator: Simulator, parameters: FingertipParameters, indenter: str, path: Floats
) -> SimulatedRun:
    """One run; if it is refused, only this trajectory has no result."""
    try:
        return simulator.simulate(parameters, indenter, path)
    except (SimulationError, ConfigError) as error:
        nothing = np.empty(0)
        return SimulatedRun(
            np.empty((0, 3)),
            nothing,
            math.nan,
            math.nan,
            IndentationOutcome.DIVERGED,
            f"refused: {error}",
        )


def _key(parameters: FingertipParameters, item: MeasuredIndentation) -> Key:
    """Key of a run: sensor and measured force have no effect on it."""
    path = np.round(item.pose, _PLACES) + 0.0  # -0.0 and 0.0 are the same place
    return (parameters, item.indenter, path.tobytes())


def simulate_all(
    simulator: Simulator,
    parameters: FingertipParameters,
    measured: Sequence[MeasuredIndentation],
    *,
    executor: Executor | None = None,
    on_run: Callable[[int, int], None] | None = None,
) -> dict[str, SimulatedRun]:
    """Simulate every measured trajectory; sensors that share a path share its run.

    Returns:
        Simulations by the name of the trajectory.

    Raises:
        SimulationError: A process of the simulation died.
    """
    results = SimulationRuns(simulator, executor, on_run).run(
        (parameters, item) for item in measured
    )
    return {item.name: result for item, result in zip(measured, results, strict=True)}
