"""Newton's method for one increment of the load, as a generator that asks for what it needs.

The decisions are here: when to factorise, how far to go, when to end. Whoever holds the state
serves the requests, for one state (``newton``) or for many at once (``batched``).
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, cast

import numpy as np

from palpate.errors import SimulationError

DAMP_FROM = 6
"""Iterations after which an error that does not decrease is taken for a cycle."""

MORTAR_FROM = 0.1
"""Error from which on the mortar correction is evaluated again: near enough to the solution."""

CONTINUED_MORTAR_FROM = 1e-2
"""The same of continuation, which evaluates it a few times only."""

RENEWALS = 6
"""Iterations that evaluate it, one after another; if they do not end, it is kept in between."""

CONTINUED_UPDATES = 4
"""How often, at most, continuation evaluates it; each time leaves a tenth of its error or less."""

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
        mortar_updates: How often, at most, the mortar correction of contact, which is first
            evaluated at the start, is evaluated again near the solution: there, and after each
            iteration from there on (`RENEWALS`).
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
    gap_tolerance_m: float = 1e-9
    traction_tolerance: float = 0.01
    iterations: int = 20
    patience: int = 10
    pseudo_transient_iterations: int = field(default=40, metadata={"stored_as": "creep_iterations"})
    mortar_updates: int = 12
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


@dataclass(frozen=True, slots=True)
class Correct:
    """Evaluate the mortar correction and the balance again; answered by `Evaluated`."""


@dataclass(frozen=True, slots=True)
class Factorise:
    """Factorise the tangent of the present state; answered by whether it has no unstable direction.

    Attributes:
        elastic: Whether the tangent of skin and fluid is evaluated anew.
        viscosity: Of `PseudoTransient`; None = Newton's method, which does not ask for stability.
        can_rise: Whether the viscosity will be raised if there is an unstable direction; else the
            tangent is used as it is.
    """

    elastic: bool
    viscosity: float | None = None
    can_rise: bool = False


@dataclass(frozen=True, slots=True)
class Step:
    """Solve, move and evaluate; answered by `Evaluated`.

    Attributes:
        damping: Share of the solution to move by.
        renews: Whether the mortar correction is evaluated again where the step ends, and the
            solution tells how the gaps' offsets follow it; else they are kept.
    """

    damping: float
    renews: bool = False


IterationRequest = Correct | Factorise | Step
"""A server that cannot serve one throws a `SimulationError`, which ends the increment."""

Evaluated = tuple[BalanceErrors, bool]
"""Errors of the present state, and whether the active set of contact differs from that of the last
tangent."""


def newton_iterations(
    report: NewtonReport,
    start: BalanceErrors,
    volume: float | None,
    settings: NewtonSettings,
    *,
    has_elastic: bool,
    continuation: PseudoTransient | None,
) -> Generator[IterationRequest, object, BalanceErrors]:
    """Bring a state into equilibrium.

    Args:
        report: Takes up how it goes.
        start: Errors of the first state, its mortar correction evaluated.
        volume: Volume that the cavity has to take [m^3]; None = the fluid pressure is given.
        settings: Tolerances and limits.
        has_elastic: Whether the tangent of skin and fluid was ever evaluated.
        continuation: Pseudo-transient continuation: slower, but it converges where the active set
            of plain Newton iterations cycles. None = Newton's method.

    Returns:
        Errors of the last state.
    """
    limit = settings.pseudo_transient_iterations if continuation else settings.iterations
    fits, elastic = False, not (has_elastic and settings.keep_elastic)
    most = min(settings.mortar_updates, CONTINUED_UPDATES if continuation else limit)
    near = CONTINUED_MORTAR_FROM if continuation else MORTAR_FROM
    updates, done = 0, 0  # of the mortar correction, and the iterations before it was asked for
    renews, renewals = False, 0
    found, error = start, largest_error(start, volume)
    report.residuals.append(error)
    while True:
        moved = report.iterations > done
        if moved and updates < most and not renews and error < near:
            found, changed = cast("Evaluated", (yield Correct()))
            error = largest_error(found, volume)
            updates, done = updates + 1, report.iterations
            renews = updates < most and renewals < RENEWALS and not continuation
            fits = fits and not changed  # the state hardly moves any more
        if has_converged(found, volume, settings):
            report.converged = True
            return found
        hopeless = report.iterations == settings.patience and error > HOPELESS
        if report.iterations >= limit or (hopeless and not continuation):
            report.reason = f"no equilibrium after {report.iterations} iterations"
            return found
        try:
            if continuation:
                yield from _factorise_stable(continuation, report)
            elif not fits:
                yield Factorise(elastic)
                report.factorisations += 1
            damping = 1.0 if continuation else damping_after(report.residuals[done:])
            found, changed = cast("Evaluated", (yield Step(damping, renews)))
        except SimulationError as failure:
            report.reason = failure.problem
            return found
        report.iterations += 1
        updates, renewals = updates + renews, renewals + renews
        renews = renews and updates < most and renewals < RENEWALS
        before, error = error, largest_error(found, volume)
        report.residuals.append(error)
        if not np.isfinite(error):
            report.reason = "the equations gave no number"
            return found
        # The active set of contact changes from one iteration to the next, the skin's own tangent
        # little within an increment: it is evaluated again after the second iteration, when many
        # increments need no further factor, and otherwise only where convergence is slow.
        elastic = report.iterations == 2 or error > settings.keep_elastic * before
        fits = error < settings.keep_factor * before and not changed
        if continuation:
            continuation.after(found.residual)


def _factorise_stable(
    continuation: PseudoTransient, report: NewtonReport
) -> Generator[IterationRequest, object, None]:
    """Factorise with a viscosity that leaves no unstable direction, if there is one."""
    elastic = True
    while True:
        can_rise = continuation.can_rise
        stable = bool((yield Factorise(elastic, continuation.viscosity, can_rise)))
        report.factorisations += 1
        if stable or not can_rise:
            return
        elastic = False
        continuation.rise()
