"""How strongly skin is held back when it creeps into an equilibrium that Newton cannot reach.

Pinched between a hard indenter and the core, skin may have an unstable direction: a node of its
inner surface that is let go moves *into* the core, and one that is held pulls. No order of touching
and letting go ends then. Real skin is viscous and moves to its next stable state; so does this one,
by implicit Euler steps of one Newton iteration each (pseudo-transient continuation; Kelley and
Keyes 1998): a drag, of the skin's own shear stiffness times a factor, is added to the tangent, and
not to the forces. What it converges to is an equilibrium without any drag.

It is raised until no direction is unstable, which the inertia of the factorised matrix tells, and
falls from iteration to iteration. (By what is unbalanced it cannot be steered: that grows while the
skin leaves an unstable state.)

Newton's method for one increment: bordered by the fluid, with friction's unsymmetric share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres

from palpate.errors import SimulationError
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.state import ForceBalance, SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.sparse.blas import one_thread
from palpate_fem.sparse.factor import SparseFactor

START = 1.0
FALL, RISE = 0.3, 3.0
NONE, LEAST, MOST = 3e-3, 1e-2, 100.0
STALLED = 0.8
"""Unbalanced force over that two iterations ago from which it is taken not to fall."""


@dataclass(slots=True)
class PseudoTransient:
    """Drag from iteration to iteration.

    Attributes:
        drag: Its factor now.
    """

    drag: float = START
    _past: list[float] = field(default_factory=list)

    @property
    def may_rise(self) -> bool:
        """Whether more drag is worth trying."""
        return self.drag < MOST

    def rise(self) -> None:
        """A direction is unstable: hold back more."""
        self.drag = min(MOST, max(LEAST, RISE * self.drag))

    def after(self, residual: float) -> None:
        """An iteration has left this much of the force unbalanced."""
        stalled = len(self._past) >= 2 and residual > STALLED * self._past[-2]
        if stalled and self.drag == 0.0:
            self.drag = START
        else:
            self.drag = FALL * self.drag if FALL * self.drag > NONE else 0.0
        self._past.append(residual)


Floats = NDArray[np.float64]


DAMP_FROM = 6
"""Iterations after which an error that does not fall is taken for a cycle."""


SMALL_REST = 0.3
"""Share of the answer below which friction's rest is answered by one correction."""


@dataclass(frozen=True, slots=True)
class NewtonSettings:
    """When to stop, and how far to go.

    Attributes:
        tolerance: Unbalanced force over the scale of the forces that cancel.
        volume_tolerance: Relative error of the cavity's volume and of each element's.
        gap_tolerance_m: Error of the gap that belongs to a contact pressure [m].
        traction_tolerance: Error of a point's friction over the largest traction.
        iterations: Give up after this many.
        pseudo_transient_iterations: The same where the skin is held back.
        largest_move_m: A longer step of any node is shortened [m].
        keep_factor: A factor is kept while each iteration shrinks the error at least this much
            and no contact changes.
        keep_elastic: The skin's share of the tangent is kept within an increment while each
            iteration shrinks the error at least this much.
    """

    tolerance: float = 1e-6
    volume_tolerance: float = 1e-6
    gap_tolerance_m: float = 0.1e-6
    traction_tolerance: float = 0.01
    iterations: int = 20
    pseudo_transient_iterations: int = 40
    largest_move_m: float = 0.25e-3
    keep_factor: float = 0.3
    keep_elastic: float = 0.15


@dataclass(slots=True)
class NewtonReport:
    """How an increment went."""

    iterations: int = 0
    factorisations: int = 0
    residuals: list[float] = field(default_factory=list)
    converged: bool = False
    reason: str = ""


class NewtonSolver:
    """Solves increments of one system; keeps its factor between them."""

    def __init__(
        self, system: EquilibriumSystem, factor: SparseFactor, settings: NewtonSettings
    ) -> None:
        self.system, self.factor, self.settings = system, factor, settings
        # Volume gradient at the factorised state, and the factor's answer to it.
        self._border: tuple[Floats, Floats] | None = None
        self._has_elastic = False  # whether the skin's share was ever made

    def solve(
        self,
        state: SolutionState,
        press: PosedIndenter | None,
        *,
        volume: float | None,
        should_stop: Callable[[], bool] | None = None,
        pseudo_transient: bool = False,
    ) -> tuple[NewtonReport, ForceBalance]:
        """Bring ``state`` into equilibrium, in place.

        Args:
            state: Start; holds the answer, or the last iterate, afterwards.
            press: Indenter at its pose.
            volume: Volume the cavity shall have [m^3]; None = the fluid pressure is given.
            should_stop: Asked once an iteration; True ends it unconverged.
            pseudo_transient: Whether to use pseudo-transient continuation, see `PseudoTransient`.
        """
        with one_thread():
            return self._iterate(
                state, press, volume, should_stop, PseudoTransient() if pseudo_transient else None
            )

    def _iterate(
        self,
        state: SolutionState,
        press: PosedIndenter | None,
        volume: float | None,
        should_stop: Callable[[], bool] | None,
        continuation: PseudoTransient | None,
    ) -> tuple[NewtonReport, ForceBalance]:
        settings, system, report = self.settings, self.system, NewtonReport()
        balance = system.balance(state, press)
        fits, elastic = False, not (self._has_elastic and settings.keep_elastic)
        limit = settings.pseudo_transient_iterations if continuation else settings.iterations
        error = self._error(balance, volume)
        report.residuals.append(error)
        while True:
            if self._converged(balance, volume):
                report.converged = True
                return report, balance
            if report.iterations >= limit:
                report.reason = f"no equilibrium after {report.iterations} iterations"
                return report, balance
            if should_stop is not None and should_stop():
                report.reason = "stopped"
                return report, balance
            try:
                if continuation:
                    report.factorisations += self._held_back(continuation)
                elif not fits:
                    self._factorise(elastic=elastic)
                    report.factorisations += 1
                damping = 1.0 if continuation else self._damping(report)
                balance = self._step(state, press, balance, volume, damping)
            except SimulationError as failure:
                report.reason = failure.problem
                return report, balance
            report.iterations += 1
            before, error = error, self._error(balance, volume)
            report.residuals.append(error)
            if not np.isfinite(error):
                report.reason = "the equations gave no number"
                return report, balance
            # What touches and sticks changes from one iteration to the next, the skin's own
            # stiffness from one increment to the next: it is done anew once the first iteration
            # has come near.
            elastic = report.iterations == 1 or error > settings.keep_elastic * before
            fits = error < settings.keep_factor * before and not system.sets_changed
            if continuation:
                continuation.after(balance.residual)

    def forget(self) -> None:
        """Keep nothing of the last tangent: what follows does not depend on what came before."""
        self._border, self._has_elastic = None, False

    def _factorise(self, *, elastic: bool, drag: float = 0.0) -> None:
        self._border = None
        self.factor.factorise(self.system.tangent_values(elastic=elastic, drag=drag))
        self._has_elastic = True

    def _held_back(self, continuation: PseudoTransient) -> int:
        """Factorise with a drag that leaves no unstable direction; how many factorisations."""
        self._factorise(elastic=True, drag=continuation.drag)
        count = 1
        while self.factor.negative and continuation.may_rise:
            continuation.rise()
            self._factorise(elastic=False, drag=continuation.drag)
            count += 1
        return count

    def _damping(self, report: NewtonReport) -> float:
        """Fraction of the next step: half where the error goes round in circles.

        Sets of sticking and sliding points may alternate between two, which a full step jumps over.
        """
        past = report.residuals
        if report.iterations < DAMP_FROM or past[-1] < 0.3 * min(past[-4:-1]):
            return 1.0
        return 0.5 if report.iterations % 2 else 0.75

    def _error(self, balance: ForceBalance, volume: float | None) -> float:
        """Largest of the relative errors, each over its tolerance's size."""
        error = balance.residual
        if volume is not None:
            error = max(error, abs(balance.volume - volume) / volume)
        # A micrometre of gap counts as much as a hundredth of the force, and as all of friction.
        return max(
            error,
            balance.strain_error,
            balance.gap_error_m * 1e4,
            balance.traction_error * 1e-2,
        )

    def _converged(self, balance: ForceBalance, volume: float | None) -> bool:
        settings = self.settings
        if balance.residual > settings.tolerance:
            return False
        if volume is not None and abs(balance.volume - volume) > settings.volume_tolerance * volume:
            return False
        if balance.gap_error_m > settings.gap_tolerance_m:
            return False
        if balance.traction_error > settings.traction_tolerance:
            return False
        return balance.strain_error <= settings.volume_tolerance

    def _step(
        self,
        state: SolutionState,
        press: PosedIndenter | None,
        balance: ForceBalance,
        volume: float | None,
        damping: float,
    ) -> ForceBalance:
        """One linear solve and the move along it, shortened where needed."""
        settings, system = self.settings, self.system
        free = system.pattern.free
        # The condensed residual: pressures are eliminated, so their misfit loads the nodes.
        right = -(balance.unbalanced + system.misfit_force(state))
        if volume is None or self._border is not None:
            change = np.asarray(self.factor.solve(right))
        else:
            gradient = balance.volume_gradient.reshape(-1)[free].copy()
            change, answer = self.factor.solve(np.stack((right, gradient), axis=1)).T
            # Without friction's share: the volume is met exactly all the same, and what the forces
            # miss is small, as the fluid's pressure changes little in a step.
            self._border = (gradient, answer)
        if system.slides:
            change = self._with_rest(change, -system.coupled_force())
        pressure_change = 0.0
        if volume is not None and self._border is not None:
            gradient, answer = self._border
            stiffness = float(gradient @ answer)
            pressure_change = (volume - balance.volume - float(gradient @ change)) / stiffness
            change = change + pressure_change * answer
        move = np.zeros_like(state.position)
        move.reshape(-1)[free] = change
        if not np.isfinite(change).all():
            raise SimulationError("the linear solve gave no number", remedy="smaller increments")
        longest = float(np.sqrt((move * move).sum(axis=1).max()))
        fraction = min(damping, settings.largest_move_m / max(longest, 1e-300))
        targets = system.updated_pressures(move)
        start = state.copy()
        for _ in range(8):
            state.position[:] = start.position + fraction * move
            state.fluid_pressure = start.fluid_pressure + fraction * pressure_change
            for now, before, target in zip(
                (state.pressure, state.core_pressure, state.indenter_pressure, state.traction),
                (start.pressure, start.core_pressure, start.indenter_pressure, start.traction),
                targets,
                strict=True,
            ):
                now[:] = before + fraction * (target - before)
            # A point that lets go does so at once: half of its pressure again and again would
            # never be none, and the point would hang on.
            for now, target in zip(
                (state.core_pressure, state.indenter_pressure), targets[1:3], strict=True
            ):
                now[target <= 0.0] = 0.0
            state.traction[targets[2] <= 0.0] = 0.0
            trial = system.balance(state, press)
            if trial.smallest_jacobian > 0.0:
                return trial
            fraction *= 0.5
        raise SimulationError("an element turns inside out", remedy="use smaller increments")

    def _with_rest(self, answer: Floats, coupled: Floats) -> Floats:
        """Correct an answer of the symmetric tangent for friction's unsymmetric rest.

        Args:
            answer: Of the symmetric tangent.
            coupled: More of the right-hand side, that the rest's product with the answer nearly
                cancels.
        """
        left_over = coupled - self.system.rest_product(answer)
        more = np.asarray(self.factor.solve(left_over))
        if np.linalg.norm(more) > SMALL_REST * np.linalg.norm(answer):
            operator = LinearOperator(
                (len(answer), len(answer)),
                matvec=lambda v: v + self.factor.solve(self.system.rest_product(v)),
                dtype=np.float64,
            )
            more, _ = gmres(operator, more, rtol=1e-1, atol=0.0, restart=8, maxiter=1)
        return np.asarray(answer + more)
