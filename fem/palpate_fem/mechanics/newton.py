"""Newton's method for one state: an iteration's linear system, and the step along its solution.

The linear system is the sparse symmetric tangent, bordered by the fluid pressure, plus the
unsymmetric share of friction, which corrects the solution of the symmetric part. Where a symmetric
part that is nearly singular would magnify what this leaves over, all of it is solved together. When
to do what is decided by ``iteration``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, gcrotmk, gmres

from palpate.errors import SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.iteration import (
    Correct,
    Factorise,
    NewtonReport,
    NewtonSettings,
    PseudoTransient,
    Step,
    newton_iterations,
)
from palpate_fem.mechanics.state import ForceBalance, SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem, OffsetChanges
from palpate_fem.sparse.blas import one_thread
from palpate_fem.sparse.factor import SparseFactor

WHOLE_BELOW = 1e-4
"""Residual below which continuation solves all of a linear system together.

Far away an unsymmetric share that belongs to an active set still to change is better left out."""

WHOLE_ACCURACY = 1e-2
"""Share of the right-hand side that a whole solution leaves over; it takes 4 to 10 products."""

WHOLE_SEARCH, WHOLE_KEPT, WHOLE_ROUNDS = 40, 8, 2
"""Directions of a round of GMRES, directions kept between rounds, and most rounds."""


class NewtonSolver:
    """Solves increments of one system; keeps its factorised tangent between them."""

    def __init__(
        self, system: EquilibriumSystem, factor: SparseFactor, settings: NewtonSettings
    ) -> None:
        self.system, self.factor, self.settings = system, factor, settings
        # Border of the factorised tangent K: the volume gradient b there, and K^-1 b.
        self._border: tuple[Floats, Floats] | None = None
        self._has_elastic = False  # whether the tangent of skin and fluid was ever evaluated
        # Upper triangle of the factorised tangent of continuation; None = of Newton's method.
        self._continued: Floats | None = None

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
        report, system = NewtonReport(), self.system
        system.correct_contact(state, indenter)
        balance = system.balance(state, indenter)
        requests = newton_iterations(
            report,
            balance,
            volume,
            self.settings,
            has_elastic=self._has_elastic,
            continuation=PseudoTransient() if pseudo_transient else None,
        )
        wanted, asked = next(requests, None), -1
        while wanted is not None:
            answer: object = None
            if not isinstance(wanted, Correct) and asked < report.iterations:
                asked = report.iterations
                if should_stop is not None and should_stop():
                    report.reason = "stopped"
                    break
            try:
                if isinstance(wanted, Factorise):
                    if wanted.viscosity is not None and wanted.elastic:
                        system.renew_spread(state, indenter)
                    answer = self._factorise(wanted)
                else:
                    if isinstance(wanted, Correct):
                        balance = system.corrected_balance(state, indenter)
                    else:
                        balance = self._step(state, indenter, balance, volume, wanted)
                    answer = balance, system.sets_changed
            except SimulationError as failure:
                with contextlib.suppress(StopIteration):
                    requests.throw(failure)
                break
            try:
                wanted = requests.send(answer)
            except StopIteration:
                break
        return report, balance

    def forget(self) -> None:
        """Drop the last tangent, so that the next solution does not depend on earlier ones."""
        self._border, self._has_elastic, self._continued = None, False, None

    def _factorise(self, wanted: Factorise) -> bool:
        """Factorise the present tangent; whether it has no unstable direction.

        By Sylvester's law of inertia the signs of the pivots are those of the eigenvalues, so the
        factor tells the number of unstable directions at no cost.
        """
        self._border = None
        values = self.system.tangent_values(
            elastic=wanted.elastic, viscosity=wanted.viscosity or 0.0
        )
        self._has_elastic = True
        self._continued = None if wanted.viscosity is None else values
        if wanted.viscosity and wanted.can_rise:
            return self.factor.factorise_definite(values)
        self.factor.factorise(values)  # single precision may doubt a tangent that is definite
        return self.factor.negative == 0

    def _step(
        self,
        state: SolutionState,
        indenter: PosedIndenter | None,
        balance: ForceBalance,
        volume: float | None,
        wanted: Step,
    ) -> ForceBalance:
        """Solve the linear system once and move along its solution, shortened where needed."""
        settings, system = self.settings, self.system
        change, pressure_change, offsets = self._linear_solution(
            state, balance, volume, renews=wanted.renews
        )
        move = system.as_field(change)
        if not np.isfinite(change).all():
            raise SimulationError("the linear solve gave no number", remedy="smaller increments")
        longest = float(np.sqrt((move * move).sum(axis=1).max()))
        fraction = min(wanted.damping, settings.largest_move_m / max(longest, 1e-300))
        targets = system.updated_pressures(move, offsets)
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
            if wanted.renews:
                system.correct_contact(state, indenter)
            trial = system.balance(state, indenter)
            if trial.smallest_jacobian > 0.0:
                return trial
            fraction *= 0.5
        raise SimulationError("an element turns inside out", remedy="use smaller increments")

    def _linear_solution(
        self, state: SolutionState, balance: ForceBalance, volume: float | None, *, renews: bool
    ) -> tuple[Floats, float, OffsetChanges | None]:
        """Change of the free unknowns (n,), of the fluid pressure [Pa], and of the gaps' offsets.

        With the fluid sealed, the tangent K is bordered by the volume gradient b::

            [ K   -b ] [dx]   [ -r          ]
            [ b^T  0 ] [dp] = [ V_goal - V  ]

        and solved by block elimination: dx = x0 + dp K^-1 b, with b^T dx = V_goal - V.

        Args:
            state: Where.
            balance: There.
            volume: Volume that the cavity has to take [m^3]; None = the fluid pressure is given.
            renews: Whether the offsets follow the change; else they are kept, and None returned.
        """
        system = self.system
        # The pressures are condensed, so their misfit loads the nodes.
        right = -(balance.unbalanced + system.misfit_force(state))
        near = balance.residual < WHOLE_BELOW
        if self._continued is not None and volume is not None and near:
            right -= system.coupled_force()
            return *self._whole_solution(self._continued, right, balance, volume), None
        if volume is None or self._border is not None:
            change = np.asarray(self.factor.solve(right))
        else:
            gradient = balance.volume_gradient.reshape(-1)[system.pattern.free].copy()
            change, answer = self.factor.solve(np.stack((right, gradient), axis=1)).T
            # K^-1 b leaves out the unsymmetric share. The volume is met exactly all the same; the
            # error of the forces is small, as the pressure changes little in a step.
            self._border = (gradient, answer)
        missing = None if volume is None else volume - balance.volume
        change, pressure_change = self._sealed(change, missing)
        offsets = None
        if system.is_unsymmetric:
            load = -system.coupled_force()
            if renews:
                offsets = system.offset_changes(change)
                load -= system.offset_force(offsets)
            more = self._correction(change, load, whole=not renews)
            change, further = self._sealed(change + more, missing)
            pressure_change += further
        return change, pressure_change, offsets

    def _sealed(self, change: Floats, missing_m3: float | None) -> tuple[Floats, float]:
        """A change that also fills the cavity, and the change of the fluid pressure that does so.

        ``missing_m3`` is the volume that the cavity lacks; None = the fluid pressure is given.
        """
        if missing_m3 is None:
            return change, 0.0
        assert self._border is not None
        gradient, answer = self._border
        pressure = (missing_m3 - float(gradient @ change)) / float(gradient @ answer)
        return change + pressure * answer, pressure

    def _whole_solution(
        self, values: Floats, right: Floats, balance: ForceBalance, volume: float
    ) -> tuple[Floats, float]:
        """Solve the bordered system with the unsymmetric share in it; see `_linear_solution`.

        In a pinch the symmetric tangent may be nearly singular, or indefinite, where with its
        unsymmetric share it is neither. One correction then leaves over a hundred times the
        right-hand side. Here what is left over is that of the forces themselves.

        Args:
            values: Upper triangle of the factorised tangent.
            right: Right-hand side of the forces (n,).
            balance: At the state.
            volume: Volume that the cavity has to take [m^3].
        """
        system, solve, count = self.system, self.factor.solve, len(right)
        pattern = system.pattern
        upper = sparse.csr_array((values, pattern.indices, pattern.indptr), shape=(count, count))
        lower, diagonal = upper.T, upper.diagonal()
        gradient = balance.volume_gradient.reshape(-1)[pattern.free].copy()
        answer = np.asarray(solve(gradient))
        stiffness = float(gradient @ answer)
        # A missing volume counts as the forces of the pressure that it takes.
        weight = float(np.linalg.norm(gradient)) / abs(stiffness)

        def product(unknown: Floats) -> Floats:
            x, pressure = unknown[:count], unknown[count]
            force = upper @ x + lower @ x - diagonal * x + system.unsymmetric_product(x)
            return np.append(force - pressure * gradient, weight * (gradient @ x))

        def precondition(load: Floats) -> Floats:
            x = np.asarray(solve(load[:count]))
            pressure = (load[count] / weight - gradient @ x) / stiffness
            return np.append(x + pressure * answer, pressure)

        shape = (count + 1, count + 1)
        solution, _ = gcrotmk(
            LinearOperator(shape, matvec=product, dtype=np.float64),
            np.append(right, weight * (volume - balance.volume)),
            M=LinearOperator(shape, matvec=precondition, dtype=np.float64),
            rtol=WHOLE_ACCURACY,
            atol=0.0,
            m=WHOLE_SEARCH,
            k=WHOLE_KEPT,
            maxiter=WHOLE_ROUNDS,
        )
        return np.asarray(solution[:count]), float(solution[count])

    def _correction(self, answer: Floats, load: Floats, *, whole: bool) -> Floats:
        """What a solution of the symmetric tangent lacks because of the unsymmetric share.

        That is sliding friction, which follows the pressure, and mortar's loads at neighbours.

        Args:
            answer: Solution with the symmetric tangent S.
            load: Further load, which the unsymmetric share U times the answer nearly cancels.
            whole: Whether to go on with GMRES where one correction is not enough.

        Returns:
            Approximate solution x of (S + U) x = load - U answer.
        """
        left_over = load - self.system.unsymmetric_product(answer)
        more = np.asarray(self.factor.solve(left_over))
        tolerance = self.settings.linear_tolerance
        if whole and np.linalg.norm(more) > tolerance * np.linalg.norm(answer):
            operator = LinearOperator(
                (len(answer), len(answer)),
                matvec=lambda v: v + self.factor.solve(self.system.unsymmetric_product(v)),
                dtype=np.float64,
            )
            more, _ = gmres(operator, more, rtol=tolerance / 3, atol=0.0, restart=8, maxiter=5)
        return np.asarray(more)
