"""What one trajectory of a batch asks for next: load stepping as a generator.

The decisions are those of ``load_stepping``, but that a snap ends a trajectory at once where the
CPU tries shorter increments; Newton's iterations are the same generator that serves one state
(``iteration``); the arrays are elsewhere (``fingertip``). A generator yields one request at a time
and is resumed with its answer, so each trajectory goes its own way, and the solver serves many
requests of a kind at once.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np

from palpate.rigid import interpolate_pose, path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.batched.state import SlotNumbers
from palpate_fem.mechanics.iteration import (
    IterationRequest,
    NewtonReport,
    PseudoTransient,
    newton_iterations,
)
from palpate_fem.mechanics.load_stepping import (
    EASY_ITERATIONS,
    OVERSHOOT,
    SNAP,
    SUCTION_PA,
    SolverSettings,
    pieces_of,
)
from palpate_fem.result import IndentationOutcome


@dataclass(frozen=True, slots=True)
class Begin:
    """Start an increment at the last solution, and evaluate it there; answered by `SlotNumbers`.

    Attributes:
        pose: Of the indenter (7,).
        ratio: Extrapolate by this multiple of the last increment's change; 0 = do not.
    """

    pose: Floats
    ratio: float


@dataclass(frozen=True, slots=True)
class MovesIn:
    """Whether the indenter moves into the skin from the last solution to a pose (7,)."""

    pose: Floats


@dataclass(frozen=True, slots=True)
class Accept:
    """Make the present state the last solution; no answer."""


@dataclass(frozen=True, slots=True)
class Reach:
    """A pose of the path is reached: its step is to be kept; no answer.

    Attributes:
        pose: Which (7,).
        numbers: At the solution.
        increments: Increments of the step.
        iterations: Their iterations, those in vain included.
        factorisations: Their factorisations.
    """

    pose: Floats
    numbers: SlotNumbers
    increments: int
    iterations: int
    factorisations: int


Request = Begin | IterationRequest | MovesIn | Accept | Reach
Requests = Generator[Request, object, None]


@dataclass(slots=True)
class _Solved:
    """An increment: how it went, and the numbers of its last state."""

    report: NewtonReport
    numbers: SlotNumbers


@dataclass(slots=True)
class BatchedTrajectory:
    """One trajectory while it is computed.

    Attributes:
        path: Poses (K, 7), the first clear of the skin.
        settings: Tolerances and limits.
        cavity_m3: Volume that the sealed fluid keeps inside the skin [m^3].
        outcome: How it ended; None = it goes on.
        reason: One sentence if it is not complete.
        travel_m: Travel at the last solution [m].
        unsolved: Whether it ended for want of an equilibrium, not for what the skin did.
    """

    path: Floats
    settings: SolverSettings
    cavity_m3: float
    outcome: IndentationOutcome | None = None
    reason: str = ""
    travel_m: float = 0.0
    unsolved: bool = False
    _has_elastic: bool = False
    _previous_length: float = field(default=0.0)
    _force_n: float = 0.0

    def requests(self) -> Requests:
        """Follow the whole path; see `LoadStepping.run`."""
        lengths = path_lengths(self.path)
        size = 1.0
        for k in range(1, len(self.path)):
            increments = iterations = factorisations = 0
            done, way = 0.0, lengths[k] - lengths[k - 1]
            pieces = pieces_of(way)
            while done < 1.0 - 1e-9:
                size = min(size, (1.0 - done) * pieces)
                goal = done + size / pieces
                if 1.0 - goal < 1e-6:
                    goal = 1.0
                solved = yield from self._increment(
                    interpolate_pose(self.path[k - 1], self.path[k], goal), size
                )
                report = solved.report
                increments += 1
                iterations += report.iterations
                factorisations += report.factorisations
                if report.converged:
                    done = goal
                    self.travel_m = lengths[k - 1] + done * way
                    if report.iterations <= EASY_ITERATIONS:
                        size = min(1.0, 2.0 * size)
                    self._check_force()
                elif self.outcome is None:
                    size *= 0.5
                    if size < self.settings.smallest_increment:
                        self.outcome = IndentationOutcome.DIVERGED
                        self.unsolved = True
                        self.reason = (
                            f"{report.reason}, {self.travel_m * 1e3:.3f} mm along the path"
                        )
                if self.outcome is not None and done < 1.0 - 1e-9:
                    return
            yield Reach(self.path[k], solved.numbers, increments, iterations, factorisations)
            if self.outcome is not None:
                return
        self.outcome = IndentationOutcome.COMPLETE

    def _increment(self, pose: Floats, length: float) -> Generator[Request, object, _Solved]:
        """One pose; the solution moves on only if it converged. See `LoadStepping.increment`."""
        ratio = length / self._previous_length if self._previous_length else 0.0
        solved = yield from self._solve(pose, ratio if self.settings.predict else 0.0, None)
        if not solved.report.converged:
            first = solved.report
            solved = yield from self._solve(pose, 0.0, PseudoTransient())
            solved.report.iterations += first.iterations
            solved.report.factorisations += first.factorisations
            fell = _force_n(solved) < (1.0 - SNAP) * self._force_n
            if solved.report.converged and fell and (yield MovesIn(pose)):
                self.outcome = IndentationOutcome.DIVERGED
                self.reason = (
                    f"the skin snaps: {self._force_n:.1f} N fall to {_force_n(solved):.1f} N"
                )
                solved.report.converged = False
        report, pressure = solved.report, solved.numbers.fluid_pressure
        if report.converged and pressure < -SUCTION_PA:
            self.outcome = IndentationOutcome.DIVERGED
            self.reason = f"the fluid sucks the skin inwards: {pressure:.0f} Pa"
            report.converged = False
        too_far = _force_n(solved) > (1.0 + OVERSHOOT) * self.settings.force_limit_n
        if report.converged and too_far and 0.5 * length >= self.settings.smallest_increment:
            report.converged, report.reason = False, "beyond the force limit"
            return solved  # what came before stays, for the prediction of a shorter one
        if report.converged:
            yield Accept()
            self._previous_length, self._force_n = length, _force_n(solved)
        else:
            self._previous_length = 0.0
        return solved

    def _check_force(self) -> None:
        if self._force_n > self.settings.force_limit_n:
            self.outcome = IndentationOutcome.FORCE_LIMIT
            self.reason = f"{self._force_n:.1f} N, {self.travel_m * 1e3:.3f} mm along the path"

    def _solve(
        self, pose: Floats, ratio: float, continuation: PseudoTransient | None
    ) -> Generator[Request, object, _Solved]:
        """Iterate at one pose."""
        begun = yield Begin(pose, ratio)
        assert isinstance(begun, SlotNumbers)
        report = NewtonReport()
        found = yield from newton_iterations(
            report,
            begun,
            self.cavity_m3,
            self.settings.newton,
            has_elastic=self._has_elastic,
            continuation=continuation,
        )
        assert isinstance(found, SlotNumbers)
        self._has_elastic = self._has_elastic or report.factorisations > 0
        return _Solved(report, found)


def _force_n(solved: _Solved) -> float:
    """Size of the net force on the indenter [N]."""
    return float(np.linalg.norm(solved.numbers.net_force))
