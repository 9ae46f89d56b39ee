"""Newton's method for one increment of the load.

The linear system of an iteration is the sparse symmetric tangent, bordered by the fluid pressure,
plus the unsymmetric share of friction, which corrects the solution of the symmetric part. Where
skin is pinched so hard that this does not converge, pseudo-transient continuation takes its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from palpate.errors import SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.state import ForceBalance, SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.sparse.blas import one_thread
from palpate_fem.sparse.factor import SparseFactor

DAMP_FROM = 6
"""Iterations after which an error that does not decrease is taken for a cycle."""

MORTAR_FROM = 1e-2
"""Error from which on the mortar correction is evaluated again: near enough to the solution."""

HOPELESS = 0.3
"""Error at which Newton's method, after some iterations, gives up; continuation takes over."""

FIRST_VISCOSITY = 1.0
VISCOSITY_FALL, VISCOSITY_RISE = 0.3, 3.0
NO_VISCOSITY, LEAST_VISCOSITY, MOST_VISCOSITY = 3e-3, 1e-2, 100.0

STALLED = 0.8
"""Residual over that two iterations before from which the iteration is taken to stall."""


@dataclass(frozen=True, slots=True)
class NewtonSettings:
    """Tolerances and limits of an increment.

    Attributes:
        tolerance: Unbalanced force over the scale of the forces that cancel.
        volume_tolerance: Relative error of the cavity's volume and of each element's.
        gap_tolerance_m: Error of the gap that belongs to a contact pressure [m].
        traction_tolerance: Error of a point's friction over the largest traction.
        iterations: Most iterations of Newton's method.
        patience: Iterations of Newton's method after which an error above `HOPELESS` ends it.
        pseudo_transient_iterations: Most iterations of pseudo-transient continuation.
        mortar_updates: How often the mortar correction of contact, which is first evaluated at the
            start, is evaluated again near the solution. Each time leaves a tenth of its error or
            less.
        linear_tolerance: Share of a linear solution below which one correction for the unsymmetric
            tangent is enough; else GMRES goes on until a third of this share of it is left over.
        largest_move_m: Displacement of any node in one iteration; longer moves are shortened [m].
        keep_factor: The factorised matrix is used again while each iteration shrinks the error to
            this share of it or less, and the active set of contact does not change.
        keep_elastic: The tangent of skin and fluid is used again within an increment while each
            iteration shrinks the error to this share of it or less.
    """

    tolerance: float = 1e-6
    volume_tolerance: float = 1e-6
    gap_tolerance_m: float = 0.1e-6
    traction_tolerance: float = 0.01
    iterations: int = 20
    patience: int = 10
    pseudo_transient_iterations: int = field(default=40, metadata={"stored_as": "creep_iterations"})
    mortar_updates: int = 2
    linear_tolerance: float = 0.3
    largest_move_m: float = 0.25e-3
    keep_factor: float = 0.3
    keep_elastic: float = 0.15


@dataclass(slots=True)
class NewtonReport:
    """How an increment went; ``reason`` says why it did not converge."""

    iterations: int = 0
    factorisations: int = 0
    residuals: list[float] = field(default_factory=list)
    converged: bool = False
    reason: str = ""


@dataclass(slots=True)
class PseudoTransient:
    """Pseudo-transient continuation (Kelley and Keyes 1998): the viscosity of each iteration.

    Skin that is pinched between a hard indenter and the core may have an unstable direction: a node
    of its inner surface moves *into* the core when its contact is released, and its contact pulls
    when it is kept. The active set of contact then never comes to rest. Real skin is viscous and
    flows to its next stable state. So does this one, by implicit Euler steps of one Newton
    iteration each::

        (K + eta M) dx = -r(x)

    with the tangent K, the unbalanced force r and a diagonal M of the size of the skin's stiffness.
    The viscosity eta (over the time step) is in the tangent only, not in the forces, so the limit
    is an equilibrium without viscosity.

    eta rises until K + eta M has no negative eigenvalue, which the inertia of its factor tells, and
    falls from iteration to iteration. It must not be steered by the residual, as usual elsewhere:
    the residual grows while the skin leaves an unstable state.

    Attributes:
        viscosity: eta of the next iteration.
    """

    viscosity: float = FIRST_VISCOSITY
    _residuals: list[float] = field(default_factory=list)

    @property
    def can_rise(self) -> bool:
        """Whether the viscosity is below its limit."""
        return self.viscosity < MOST_VISCOSITY

    def rise(self) -> None:
        """Raise the viscosity, because a direction is unstable."""
        self.viscosity = min(MOST_VISCOSITY, max(LEAST_VISCOSITY, VISCOSITY_RISE * self.viscosity))

    def after(self, residual: float) -> None:
        """Lower the viscosity after an iteration; begin again where it is 0 and nothing is won."""
        stalled = len(self._residuals) >= 2 and residual > STALLED * self._residuals[-2]
        if stalled and self.viscosity == 0.0:
            self.viscosity = FIRST_VISCOSITY
        else:
            lower = VISCOSITY_FALL * self.viscosity
            self.viscosity = lower if lower > NO_VISCOSITY else 0.0
        self._residuals.append(residual)


class BalanceErrors(Protocol):
    """How far a state is from equilibrium; see `ForceBalance`."""

    @property
    def residual(self) -> float:
        """Unbalanced force over the scale of the forces that cancel."""

    @property
    def volume(self) -> float:
        """Of the cavity [m^3]."""

    @property
    def strain_error(self) -> float:
        """Largest relative error of an element's volume."""

    @property
    def gap_error_m(self) -> float:
        """Largest error of a contact point's gap [m]."""

    @property
    def traction_error(self) -> float:
        """Largest error of a traction, over the largest one."""


def largest_error(balance: BalanceErrors, volume: float | None) -> float:
    """Largest of the relative errors, weighted by their tolerances.

    Args:
        balance: At some state.
        volume: Volume that the cavity has to take [m^3]; None = any.
    """
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


def has_converged(balance: BalanceErrors, volume: float | None, settings: NewtonSettings) -> bool:
    """Whether all errors are within their tolerances; see `largest_error`."""
    # Written so that what is not a number has not converged.
    return (
        balance.residual <= settings.tolerance
        and (volume is None or abs(balance.volume - volume) <= settings.volume_tolerance * volume)
        and balance.gap_error_m <= settings.gap_tolerance_m
        and balance.traction_error <= settings.traction_tolerance
        and balance.strain_error <= settings.volume_tolerance
    )


def damping_after(errors: Sequence[float]) -> float:
    """Share of the next step: less than 1 where the error cycles.

    The sets of sticking and sliding points may alternate between two. Steps of half and three
    quarters, in turn, end between them.

    Args:
        errors: Since the last mortar correction, the first before any iteration.
    """
    done = len(errors) - 1
    if done < DAMP_FROM or errors[-1] < 0.3 * min(errors[-4:-1]):
        return 1.0
    return 0.5 if done % 2 else 0.75


class NewtonSolver:
    """Solves increments of one system; keeps its factorised tangent between them."""

    def __init__(
        self, system: EquilibriumSystem, factor: SparseFactor, settings: NewtonSettings
    ) -> None:
        self.system, self.factor, self.settings = system, factor, settings
        # Border of the factorised tangent K: the volume gradient b there, and K^-1 b.
        self._border: tuple[Floats, Floats] | None = None
        self._has_elastic = False  # whether the tangent of skin and fluid was ever evaluated

    @one_thread()
    def solve(
        self,
        state: SolutionState,
        indenter: PosedIndenter | None,
        *,
        volume: float | None,
        should_stop: Callable[[], bool] | None = None,
        pseudo_transient: bool = False,
    ) -> tuple[NewtonReport, ForceBalance]:
        """Bring ``state`` into equilibrium, in place.

        Args:
            state: Start; afterwards the solution, or the last iterate.
            indenter: Indenter at its pose.
            volume: Volume that the cavity has to take [m^3]; None = the fluid pressure is given.
            should_stop: Called in each iteration; True ends it unconverged.
            pseudo_transient: Whether to use pseudo-transient continuation: slower, but it converges
                where the active set of plain Newton iterations cycles.
        """
        continuation = PseudoTransient() if pseudo_transient else None
        settings, system, report = self.settings, self.system, NewtonReport()
        limit = settings.pseudo_transient_iterations if continuation else settings.iterations
        fits, elastic = False, not (self._has_elastic and settings.keep_elastic)
        updates, done = 0, 0  # of the mortar correction, and the iterations before the last one
        system.correct_contact(state, indenter)
        balance = system.balance(state, indenter)
        error = largest_error(balance, volume)
        report.residuals.append(error)
        while True:
            moved = report.iterations > done
            if moved and updates < settings.mortar_updates and error < MORTAR_FROM:
                system.correct_contact(state, indenter)
                balance = system.balance(state, indenter)
                error = largest_error(balance, volume)
                updates, done = updates + 1, report.iterations
                # The state hardly moves any more, so the factor fits as it did.
                fits = fits and not system.sets_changed
            if has_converged(balance, volume, settings):
                report.converged = True
                return report, balance
            hopeless = report.iterations == settings.patience and error > HOPELESS
            if report.iterations >= limit or (hopeless and not continuation):
                report.reason = f"no equilibrium after {report.iterations} iterations"
                return report, balance
            if should_stop is not None and should_stop():
                report.reason = "stopped"
                return report, balance
            try:
                if continuation:
                    report.factorisations += self._factorise_stable(continuation)
                elif not fits:
                    self._factorise(elastic=elastic)
                    report.factorisations += 1
                damping = 1.0 if continuation else damping_after(report.residuals[done:])
                balance = self._step(state, indenter, balance, volume, damping)
            except SimulationError as failure:
                report.reason = failure.problem
                return report, balance
            report.iterations += 1
            before, error = error, largest_error(balance, volume)
            report.residuals.append(error)
            if not np.isfinite(error):
                report.reason = "the equations gave no number"
                return report, balance
            # The active set of contact changes from one iteration to the next, the skin's own
            # tangent little within an increment: it is evaluated again after the first iteration,
            # which brings the state near, and then only where convergence is slow.
            elastic = report.iterations == 1 or error > settings.keep_elastic * before
            fits = error < settings.keep_factor * before and not system.sets_changed
            if continuation:
                continuation.after(balance.residual)

    def forget(self) -> None:
        """Drop the last tangent, so that the next solution does not depend on earlier ones."""
        self._border, self._has_elastic = None, False

    def _factorise(self, *, elastic: bool, viscosity: float = 0.0) -> None:
        self._border = None
        self.factor.factorise(self.system.tangent_values(elastic=elastic, viscosity=viscosity))
        self._has_elastic = True

    def _factorise_stable(self, continuation: PseudoTransient) -> int:
        """Factorise with a viscosity that leaves no unstable direction; returns how often.

        By Sylvester's law of inertia the signs of the pivots are those of the eigenvalues, so the
        factor tells the number of unstable directions at no cost.
        """
        self._border = None
        elastic, count = True, 0
        while True:
            values = self.system.tangent_values(elastic=elastic, viscosity=continuation.viscosity)
            elastic, count = False, count + 1
            if continuation.viscosity and continuation.can_rise:
                stable = self.factor.factorise_definite(values)
            else:  # single precision may doubt a tangent that is definite
                self.factor.factorise(values)
                stable = self.factor.negative == 0
            if stable or not continuation.can_rise:
                self._has_elastic = True
                return count
            continuation.rise()

    def _step(
        self,
        state: SolutionState,
        indenter: PosedIndenter | None,
        balance: ForceBalance,
        volume: float | None,
        damping: float,
    ) -> ForceBalance:
        """Solve the linear system once and move along its solution, shortened where needed."""
        settings, system = self.settings, self.system
        change, pressure_change = self._linear_solution(state, balance, volume)
        move = np.zeros_like(state.position)
        move.reshape(-1)[system.pattern.free] = change
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
            # A contact opens at once, however short the step: a fraction of its pressure again and
            # again would never become zero, and the point would stay in the active set.
            for now, target in zip(
                (state.core_pressure, state.indenter_pressure), targets[1:3], strict=True
            ):
                now[target <= 0.0] = 0.0
            state.traction[targets[2] <= 0.0] = 0.0
            trial = system.balance(state, indenter)
            if trial.smallest_jacobian > 0.0:
                return trial
            fraction *= 0.5
        raise SimulationError("an element turns inside out", remedy="use smaller increments")

    def _linear_solution(
        self, state: SolutionState, balance: ForceBalance, volume: float | None
    ) -> tuple[Floats, float]:
        """Change of the free unknowns (n,) and of the fluid pressure [Pa].

        With the fluid sealed, the tangent K is bordered by the volume gradient b::

            [ K   -b ] [dx]   [ -r          ]
            [ b^T  0 ] [dp] = [ V_goal - V  ]

        and solved by block elimination: dx = x0 + dp K^-1 b, with b^T dx = V_goal - V.
        """
        system = self.system
        # The pressures are condensed, so their misfit loads the nodes.
        right = -(balance.unbalanced + system.misfit_force(state))
        if volume is None or self._border is not None:
            change = np.asarray(self.factor.solve(right))
        else:
            gradient = balance.volume_gradient.reshape(-1)[system.pattern.free].copy()
            change, answer = self.factor.solve(np.stack((right, gradient), axis=1)).T
            # K^-1 b leaves out the unsymmetric share. The volume is met exactly all the same; the
            # error of the forces is small, as the pressure changes little in a step.
            self._border = (gradient, answer)
        if system.is_unsymmetric:
            change = self._with_unsymmetric_share(change, -system.coupled_force())
        if volume is None or self._border is None:
            return change, 0.0
        gradient, answer = self._border
        stiffness = float(gradient @ answer)
        pressure_change = (volume - balance.volume - float(gradient @ change)) / stiffness
        return change + pressure_change * answer, pressure_change

    def _with_unsymmetric_share(self, answer: Floats, coupled: Floats) -> Floats:
        """Correct a solution of the symmetric tangent for the unsymmetric share.

        That is sliding friction, which follows the pressure, and mortar's loads at neighbours.

        Args:
            answer: Solution with the symmetric tangent S.
            coupled: Further load, which the unsymmetric share U times the answer nearly cancels.

        Returns:
            Approximate solution of (S + U) x = S answer + coupled.
        """
        left_over = coupled - self.system.unsymmetric_product(answer)
        more = np.asarray(self.factor.solve(left_over))
        tolerance = self.settings.linear_tolerance
        if np.linalg.norm(more) > tolerance * np.linalg.norm(answer):
            operator = LinearOperator(
                (len(answer), len(answer)),
                matvec=lambda v: v + self.factor.solve(self.system.unsymmetric_product(v)),
                dtype=np.float64,
            )
            more, _ = gmres(operator, more, rtol=tolerance / 3, atol=0.0, restart=8, maxiter=5)
        return np.asarray(answer + more)
