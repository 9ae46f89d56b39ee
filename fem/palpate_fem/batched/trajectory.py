"""What one trajectory of a batch asks for next: Newton's method and load stepping as a generator.

The decisions are those of ``newton`` and ``load_stepping``; the arrays are elsewhere (``solver``).
A generator yields one request at a time and is resumed with its answer, so each trajectory goes its
own way, and the solver serves many requests of a kind at once.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np

from palpate.rigid import interpolate_pose, path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.batched.state import SlotNumbers
from palpate_fem.mechanics.load_stepping import (
    EASY_ITERATIONS,
    OVERSHOOT,
    SNAP,
    SUCTION_PA,
    SolverSettings,
)
from palpate_fem.mechanics.newton import (
    HOPELESS,
    MORTAR_FROM,
    PseudoTransient,
    damping_after,
    has_converged,
    largest_error,
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
class Correct:
    """Evaluate the mortar correction and the balance again; answered by `SlotNumbers`."""


@dataclass(frozen=True, slots=True)
class Factorise:
    """Factorise the tangent of the present state; answered by whether it is definite.

    Attributes:
        elastic: Whether the tangent of skin and fluid is evaluated, too.
        viscosity: See `PseudoTransient`.
    """

    elastic: bool
    viscosity: float


@dataclass(frozen=True, slots=True)
class Step:
    """Solve, move and evaluate; answered by `SlotNumbers`, or by None if an element turned over.

    Attributes:
        damping: Share of the solution to move by.
    """

    damping: float


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


Request = Begin | Correct | Factorise | Step | MovesIn | Accept | Reach
Requests = Generator[Request, object, None]


@dataclass(slots=True)
class _Solved:
    """How an increment went."""

    numbers: SlotNumbers
    iterations: int = 0
    factorisations: int = 0
    converged: bool = False
    reason: str = ""


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
            done = 0.0
            while done < 1.0 - 1e-9:
                size = min(size, 1.0 - done)
                goal = done + size
                if 1.0 - goal < 1e-6:
                    goal = 1.0
                solved = yield from self._increment(
                    interpolate_pose(self.path[k - 1], self.path[k], goal), size
                )
                increments += 1
                iterations += solved.iterations
                factorisations += solved.factorisations
                if solved.converged:
                    done = goal
                    self.travel_m = lengths[k - 1] + done * (lengths[k] - lengths[k - 1])
                    if solved.iterations <= EASY_ITERATIONS:
                        size = min(1.0, 2.0 * size)
                    self._check_force()
                elif self.outcome is None:
                    size *= 0.5
                    if size < self.settings.smallest_increment:
                        self.outcome = IndentationOutcome.DIVERGED
                        self.unsolved = True
                        self.reason = (
                            f"{solved.reason}, {self.travel_m * 1e3:.3f} mm along the path"
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
        if not solved.converged:
            first = solved
            solved = yield from self._solve(pose, 0.0, PseudoTransient())
            solved.iterations += first.iterations
            solved.factorisations += first.factorisations
            force = float(np.linalg.norm(solved.numbers.net_force))
            if solved.converged and force < (1.0 - SNAP) * self._force_n and (yield MovesIn(pose)):
                self.outcome = IndentationOutcome.DIVERGED
                self.reason = f"the skin snaps: {self._force_n:.1f} N fall to {force:.1f} N"
                solved.converged = False
        numbers = solved.numbers
        if solved.converged and numbers.fluid_pressure < -SUCTION_PA:
            self.outcome = IndentationOutcome.DIVERGED
            self.reason = f"the fluid sucks the skin inwards: {numbers.fluid_pressure:.0f} Pa"
            solved.converged = False
        force = float(np.linalg.norm(numbers.net_force))
        too_far = force > (1.0 + OVERSHOOT) * self.settings.force_limit_n
        if solved.converged and too_far and 0.5 * length >= self.settings.smallest_increment:
            solved.converged, solved.reason = False, "beyond the force limit"
            return solved  # what came before stays, for the prediction of a shorter one
        if solved.converged:
            yield Accept()
            self._previous_length, self._force_n = length, force
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
        """Newton's method at one pose; see `NewtonSolver.solve`."""
        settings, volume = self.settings.newton, self.cavity_m3
        limit = settings.pseudo_transient_iterations if continuation else settings.iterations
        fits, elastic = False, not (self._has_elastic and settings.keep_elastic)
        updates, done = 0, 0
        solved = _Solved(_numbers((yield Begin(pose, ratio))))
        errors = [largest_error(solved.numbers, volume)]
        while True:
            moved = solved.iterations > done
            if moved and updates < settings.mortar_updates and errors[-1] < MORTAR_FROM:
                solved.numbers = _numbers((yield Correct()))
                errors[-1] = largest_error(solved.numbers, volume)
                updates, done = updates + 1, solved.iterations
                fits = fits and not solved.numbers.sets_changed
            if has_converged(solved.numbers, volume, settings):
                solved.converged = True
                return solved
            hopeless = solved.iterations == settings.patience and errors[-1] > HOPELESS
            if solved.iterations >= limit or (hopeless and not continuation):
                solved.reason = f"no equilibrium after {solved.iterations} iterations"
                return solved
            if continuation:
                definite = yield from self._factorise_stable(continuation, solved)
            elif not fits:
                definite = bool((yield Factorise(elastic, 0.0)))
                solved.factorisations += 1
            else:
                definite = True
            self._has_elastic = True
            if not definite:
                solved.reason = "a direction is unstable"
                return solved
            damping = 1.0 if continuation else damping_after(errors[done:])
            answer = yield Step(damping)
            if answer is None:
                solved.reason = "an element turns inside out"
                return solved
            solved.numbers = _numbers(answer)
            solved.iterations += 1
            errors.append(largest_error(solved.numbers, volume))
            if not np.isfinite(errors[-1]):
                solved.reason = "the equations gave no number"
                return solved
            elastic = solved.iterations == 1 or errors[-1] > settings.keep_elastic * errors[-2]
            fits = (
                errors[-1] < settings.keep_factor * errors[-2] and not solved.numbers.sets_changed
            )
            if continuation:
                continuation.after(solved.numbers.residual)

    @staticmethod
    def _factorise_stable(
        continuation: PseudoTransient, solved: _Solved
    ) -> Generator[Request, object, bool]:
        """Factorise with a viscosity that leaves no unstable direction; whether there is one."""
        elastic = True
        while True:
            stable = bool((yield Factorise(elastic, continuation.viscosity)))
            solved.factorisations += 1
            elastic = False
            if stable or not continuation.can_rise:
                return stable
            continuation.rise()


def _numbers(answer: object) -> SlotNumbers:
    assert isinstance(answer, SlotNumbers)
    return answer
