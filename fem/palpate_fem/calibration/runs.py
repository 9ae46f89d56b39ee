"""Runs of the simulator for comparison with measurements: each only once, several at a time."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Executor, Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np

from palpate.errors import ConfigError, PalpateError, SimulationError
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.calibration.alignment import ForceCurve, along
from palpate_fem.calibration.measured import MeasuredIndentation
from palpate_fem.config import EDGE_M, FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.adjoint import sensitivities
from palpate_fem.mechanics.load_stepping import ConvergedIncrement
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
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
class RunSlopes:
    """Derivatives of a run by P parameters, each in its unit.

    Attributes:
        names: The parameters, as in `FingertipParameters`.
        force: Of the forces [N], shape (k, 3, P).
        thickness_m: Of the total thickness, shape (P,).
        fluid_volume_m3: Of the fluid's volume, shape (P,).
    """

    names: tuple[str, ...]
    force: Floats
    thickness_m: Floats
    fluid_volume_m3: Floats


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
        slopes: Its derivatives, if they were asked for.
    """

    forces: Floats
    travel: Floats
    thickness_m: float
    fluid_volume_m3: float
    outcome: IndentationOutcome
    reason: str = ""
    slopes: RunSlopes | None = None

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

    def curve_slopes(self, values: Floats) -> Floats | None:
        """Derivatives of the curve by logarithms of the parameters, shape (P, K, 3).

        Args:
            values: Of the parameters, shape (P,).
        """
        if self.slopes is None:
            return None
        by_log = self.slopes.force * values
        return np.stack([along(self.travel, by_log[:, :, i]).force_n for i in range(len(values))])


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


@runtime_checkable
class SlopeSimulator(Simulator, Protocol):
    """A simulator that knows the derivatives of its runs, at about the cost of the run."""

    def simulate_slopes(
        self,
        parameters: FingertipParameters,
        indenter: str,
        path: Floats,
        names: tuple[str, ...],
    ) -> SimulatedRun:
        """As `simulate`, with derivatives by these parameters if there are any."""
        ...


@dataclass(frozen=True, slots=True)
class FingertipSimulator:
    """Simulates the parametric finger in this process, with derivatives if wanted.

    A process keeps one finger, so it runs one simulation at a time: for several, use a
    ``ProcessPoolExecutor``.

    Attributes:
        edge_m: Edge of the elements on the pad [m].
        layers: Elements through the skin.
    """

    edge_m: float = EDGE_M
    layers: int = 2

    def simulate(
        self, parameters: FingertipParameters, indenter: str, path: Floats
    ) -> SimulatedRun:
        """See `Simulator.simulate`."""
        return self.simulate_slopes(parameters, indenter, path, ())

    def simulate_slopes(
        self,
        parameters: FingertipParameters,
        indenter: str,
        path: Floats,
        names: tuple[str, ...],
    ) -> SimulatedRun:
        """See `SlopeSimulator.simulate_slopes`.

        A run that cannot be derived is returned without derivatives.

        Raises:
            SimulationError: The finger cannot be filled, or the indenter begins inside of it.
        """
        # Friction has no effect before contact.
        tip = _filled(replace(parameters, friction_coefficient=0.0), self.edge_m, self.layers)
        tip.parameters = parameters
        history: list[ConvergedIncrement] = []
        result = tip.indent(make_indenter(indenter), path, history=history if names else None)
        run = SimulatedRun.of(
            result, thickness_m=tip.total_thickness_m, fluid_volume_m3=tip.fluid_volume_m3
        )
        if not names or not result.steps:
            return run
        try:
            found = sensitivities(tip, history, names)
        except SimulationError:
            return run
        slopes = RunSlopes(
            names,
            np.concatenate([np.zeros((1, 3, len(names))), found.force]),
            found.total_thickness_m,
            found.fluid_volume_m3,
        )
        return replace(run, slopes=slopes)


@lru_cache(maxsize=1)
def _filled(parameters: FingertipParameters, edge_m: float, layers: int) -> Fingertip:
    """The last finger again if it is the same."""
    geometry = biotac(thickness_m=parameters.skin_thickness_m, edge_m=edge_m, layers=layers)
    return Fingertip.pressurised(geometry, parameters)


class SimulationRuns:
    """Results of runs, each made only once, through an executor.

    Args:
        simulator: Runs one indentation.
        executor: Runs several at a time, e.g. a process pool; None = one after the other.
        on_run: Called after each run with the number of finished and of all runs of this call.

    Attributes:
        count: Number of runs so far.
        knows_slopes: Whether the simulator derives its runs.
    """

    def __init__(
        self,
        simulator: Simulator,
        executor: Executor | None = None,
        on_run: Callable[[int, int], None] | None = None,
    ) -> None:
        self._simulator = simulator
        self.knows_slopes = isinstance(simulator, SlopeSimulator)
        self._executor = executor
        self._on_run = on_run
        self._memo: dict[Key, SimulatedRun] = {}
        self.count = 0

    def run(
        self,
        jobs: Iterable[tuple[FingertipParameters, MeasuredIndentation]],
        slopes: tuple[str, ...] = (),
    ) -> list[SimulatedRun]:
        """Results in the order of the jobs; what ran before is not run again.

        With names of parameters in ``slopes`` a `SlopeSimulator` derives by them. A run that the
        simulator refuses, or that a defect ends, gives a result without steps, with the reason.

        Raises:
            SimulationError: A process of the simulation died.
        """
        wanted = [(_key(parameters, item, slopes), parameters, item) for parameters, item in jobs]
        new = {key: (p, item) for key, p, item in wanted if key not in self._memo}
        for done, (key, result) in enumerate(self._results(new, slopes), start=1):
            self._memo[key] = result
            self.count += 1
            if self._on_run is not None:
                self._on_run(done, len(new))
        return [self._memo[key] for key, _, _ in wanted]

    def _results(
        self,
        new: dict[Key, tuple[FingertipParameters, MeasuredIndentation]],
        slopes: tuple[str, ...],
    ) -> Iterable[tuple[Key, SimulatedRun]]:
        if self._executor is None:
            for key, (parameters, item) in new.items():
                yield key, _simulate(self._simulator, parameters, item.indenter, item.pose, slopes)
            return
        futures: dict[Future[SimulatedRun], Key] = {}
        try:
            for key, (parameters, item) in new.items():
                future = self._executor.submit(
                    _simulate, self._simulator, parameters, item.indenter, item.pose, slopes
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
    simulator: Simulator,
    parameters: FingertipParameters,
    indenter: str,
    path: Floats,
    slopes: tuple[str, ...],
) -> SimulatedRun:
    """One run; if it is refused or fails, only this trajectory has no result."""
    try:
        if slopes and isinstance(simulator, SlopeSimulator):
            return simulator.simulate_slopes(parameters, indenter, path, slopes)
        return simulator.simulate(parameters, indenter, path)
    except (SimulationError, ConfigError) as error:
        return _without_steps(f"refused: {error}")
    except PalpateError:  # of all runs, e.g. no process can start
        raise
    except Exception as error:  # a defect, which costs this run only, as in the worker of a service
        sys.excepthook(type(error), error, error.__traceback__)
        return _without_steps(f"failed: {type(error).__name__}: {error}")


def _without_steps(reason: str) -> SimulatedRun:
    none = np.empty((0, 3))
    return SimulatedRun(none, none[:, 0], math.nan, math.nan, IndentationOutcome.DIVERGED, reason)


def _key(
    parameters: FingertipParameters, item: MeasuredIndentation, slopes: tuple[str, ...]
) -> Key:
    """Key of a run: sensor and measured force have no effect on it."""
    path = np.round(item.pose, _PLACES) + 0.0  # -0.0 and 0.0 are the same place
    return (parameters, item.indenter, path.tobytes(), slopes)


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
