"""Load stepping: the increments of one indentation, their cut-backs, and where it ends.

A step is the way from one pose of a path to the next. It is solved in one increment of the load, or
in several shorter ones where it is long or Newton's method needs them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from palpate.rigid import interpolate_pose, path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics.contact import ContactSettings, PosedIndenter
from palpate_fem.mechanics.element_kernels import VOLUME_BARRIER
from palpate_fem.mechanics.iteration import NewtonReport, NewtonSettings
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.state import ForceBalance, SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.result import Convergence, IndentationOutcome, IndentationResult, IndentationStep

CONTACT_SHARE = 1e-3
"""A surface point counts as touching if its pressure exceeds this share of the largest."""

VOIGT = [0, 4, 8, 5, 2, 1]
"""Places of xx yy zz yz xz xy in a flattened tensor."""

OVERSHOOT = 0.1
"""By how much the force may exceed the force limit at the end of the last increment."""

SNAP = 0.1
"""Share of the force that may be lost where only pseudo-transient continuation converges.

A larger loss, while the indenter moves into the skin, means that the solution has left its branch:
nodes that carried the pinch have slipped out of it, which a continuous skin would not do. Shorter
increments may stay on it, as continuation begins nearer to it, but all of them together may lose no
more; where the shortest one leaves it, too, the indentation ends before the snap. On the way out or
along the skin the force may fall."""

INWARD = 0.5
"""An indenter moves into the skin where its motion is within 60 degrees of its force on the skin.

Friction turns the force of one that slides along the skin by atan(mu), 11 degrees by default, so
its motion is 79 degrees away from it."""

SUCTION_PA = 1.0
"""How far the fluid pressure may fall below ambient [Pa]: what a solver may leave of none."""

EASY_ITERATIONS = 8
"""After an increment that took no more Newton iterations than this, the next is twice as long."""

LONGEST_M = 0.5e-3
"""Longest travel of an increment [m].

An equilibrium is found where the indenter is, not on the way there: in one leap it could pass
through the finger without a touch."""


@dataclass(frozen=True, slots=True)
class SolverSettings:
    """How a fingertip is solved.

    Attributes:
        newton: Tolerances of one increment.
        contact: Constants of the contact laws for a shear modulus of `solver.REFERENCE_MODULUS_PA`;
            each fingertip scales them with its own modulus, so that forces scale exactly with it.
        force_limit_n: An indentation ends where the force on the indenter exceeds this [N]; the
            paper saw 23-32 N at most.
        smallest_increment: Fraction of a step below which the indentation is given up.
        volume_barrier: See `energy_density`.
        predict: Whether increments start from an extrapolation of the last two.
        solver: See `make_factor`.
    """

    newton: NewtonSettings = field(default_factory=NewtonSettings)
    contact: ContactSettings = field(default_factory=ContactSettings)
    force_limit_n: float = 32.0
    smallest_increment: float = 1 / 64
    volume_barrier: float = VOLUME_BARRIER
    predict: bool = True
    solver: str = "auto"


@dataclass(frozen=True, slots=True)
class ConvergedIncrement:
    """One increment of an indentation, recorded for its gradients (``adjoint``).

    Attributes:
        step: Step that it belongs to, from 1; it leads from pose step - 1 to pose step of the path.
            0 is the start, pressurised and untouched.
        share: How much of the step is done at its end; 1 = all of it.
        state: Its solution, with the anchors that it leaves to the next one.
        indenter: At its pose.
    """

    step: int
    share: float
    state: SolutionState
    indenter: PosedIndenter


@dataclass(slots=True)
class _Progress:
    """Where the load stepping stands; an increment that is given up restores the last one.

    Attributes:
        state: Converged solution.
        indenter: At the pose of that solution.
        load: Nodal forces of the indenter on the skin [N], (V, 3).
        previous: Solution one increment before, for the predictor; None = no prediction.
        previous_length: Length of the increment between the two, as in `LoadStepping.increment`.
    """

    state: SolutionState
    indenter: PosedIndenter
    load: Floats
    previous: SolutionState | None = None
    previous_length: float = 0.0


def pieces_of(travel_m: float) -> int:
    """Into how many equal increments a step of so much travel [m] is divided at least."""
    return max(1, math.ceil(travel_m / LONGEST_M - 1e-6))


def moves_in(position: Floats, load: Floats, at: PosedIndenter, to: PosedIndenter) -> bool:
    """Whether an indenter goes into the skin from one pose to another.

    Its motion, turns included, is taken where it touches: the mean over the nodes, weighted by
    their forces. What counts is its component along the net force, relative to its length, so
    that a twist or a roll, whose points go every way, is none.

    Args:
        position: Nodal positions [m], (V, 3).
        load: Nodal forces of the indenter on the skin [N], (V, 3).
        at: The indenter there.
        to: The indenter at its next pose.
    """
    weight = np.linalg.norm(load, axis=1)
    touched = weight > 0.0
    place, weight = position[touched], weight[touched] / weight.sum()
    motion = at.to_local(place) @ to.rotation.T + to.tip - place
    net = load.sum(axis=0)
    along = float(net @ (weight @ motion))
    return along > INWARD * float(np.linalg.norm(net) * (weight @ np.linalg.norm(motion, axis=1)))


@dataclass(slots=True)
class _StepCost:
    """What the increments of one step have cost."""

    started: float = field(default_factory=time.perf_counter)
    increments: int = 0
    iterations: int = 0
    factorisations: int = 0

    def add(self, report: NewtonReport) -> None:
        """Count an increment."""
        self.increments += 1
        self.iterations += report.iterations
        self.factorisations += report.factorisations


class LoadStepping:
    """One indentation while it is computed."""

    def __init__(
        self,
        newton: NewtonSolver,
        settings: SolverSettings,
        rest: SolutionState,
        cavity_m3: float,
        indenter: Indenter,
        path: Floats,
        *,
        friction: float,
        fluid_m3: float,
        on_step: Callable[[IndentationStep], None] | None = None,
        should_stop: Callable[[], IndentationOutcome | None] | None = None,
        history: list[ConvergedIncrement] | None = None,
    ) -> None:
        """Prepare an indentation; see `Fingertip.indent`.

        ``rest`` is the pressurised, untouched state, which stays as it is. The sealed fluid keeps
        the volume ``cavity_m3`` inside the skin [m^3], ``fluid_m3`` of it beside the core.
        """
        self.newton, self.settings, self.rest = newton, settings, rest
        self.cavity_m3, self.fluid_m3 = cavity_m3, fluid_m3
        self.path = np.asarray(path, np.float64)
        self.on_step, self.should_stop = on_step, should_stop
        untouched = np.zeros_like(rest.position)
        self.at = _Progress(rest.copy(), PosedIndenter(indenter, self.path[0], friction), untouched)
        self.outcome: IndentationOutcome | None = None
        self.reason = ""
        self.history = history
        self._snapped_from_n = 0.0  # force before the last snap [N], while the indenter moves in
        newton.system.update_anchors(self.at.state, self.at.indenter)
        newton.forget()
        self._record(0, 1.0)

    def run(self) -> IndentationResult:
        """Follow the whole path."""
        started = time.perf_counter()
        lengths = path_lengths(self.path)
        steps: list[IndentationStep] = []
        travel = 0.0
        size = 1.0  # of the next increment, as a share of its step, or of a piece of a long one
        for k in range(1, len(self.path)):
            cost, done, way = _StepCost(), 0.0, lengths[k] - lengths[k - 1]
            pieces = pieces_of(way)
            while done < 1.0 - 1e-9 and self.outcome is None:
                if self._stop():
                    break
                size = min(size, (1.0 - done) * pieces)
                goal = done + size / pieces
                if 1.0 - goal < 1e-6:
                    goal = 1.0  # the poses of the path are reached exactly
                pose = interpolate_pose(self.path[k - 1], self.path[k], goal)
                before = replace(self.at)
                report, balance = self.increment(pose, size)
                cost.add(report)
                # Converged, but so far beyond the force limit that the end is not resolved: go
                # back.
                if report.converged and self._overshoots(balance, size):
                    self.at = before
                    size *= 0.5
                    continue
                if report.converged:
                    done = goal
                    self._record(k, done)
                    travel = lengths[k - 1] + done * way
                    if report.iterations <= EASY_ITERATIONS:
                        size = min(1.0, 2.0 * size)
                    self._check_force(balance, travel)
                    continue
                size *= 0.5
                if self.outcome is None and size < self.settings.smallest_increment:
                    self.outcome = IndentationOutcome.DIVERGED
                    self.reason = f"{report.reason}, {travel * 1e3:.3f} mm along the path"
            if done < 1.0 - 1e-9:
                break
            steps.append(self._step(self.path[k], balance, cost))
            if self.on_step is not None:
                self.on_step(steps[-1])
            if self.outcome is not None:
                break
        return IndentationResult(
            indenter=self.at.indenter.shape.name,
            path=self.path,
            steps=tuple(steps),
            outcome=self.outcome or IndentationOutcome.COMPLETE,
            reason=self.reason,
            travel_m=float(travel),
            seconds=time.perf_counter() - started,
        )

    def _record(self, step: int, share: float) -> None:
        """Append the last solution to the history, if there is one."""
        if self.history is not None:
            self.history.append(ConvergedIncrement(step, share, self.at.state, self.at.indenter))

    def increment(self, pose: Floats, length: float) -> tuple[NewtonReport, ForceBalance]:
        """Solve for one pose; the solution moves on only if it converged.

        Args:
            pose: Pose of the indenter (7,).
            length: Length of the increment, in steps, or in pieces of a long one.
        """
        start = self.at.state
        indenter = self.at.indenter.at(pose)
        trial = self._predicted(length)
        report, balance = self._solve(trial, indenter)
        watched = self._snapped_from_n > 0.0
        if not report.converged and self.outcome is None:
            # The extrapolation may be wrong (e.g. at first touch), or the pinched skin has an
            # unstable direction: continue without the one and with a remedy for the other.
            trial = start.copy()
            second, balance = self._solve(trial, indenter, pseudo_transient=True)
            second.iterations += report.iterations
            second.factorisations += report.factorisations
            report = second
            watched = True
        if report.converged and watched:
            force, last = _force(balance), float(np.linalg.norm(self.at.load.sum(axis=0)))
            last = max(last, self._snapped_from_n)
            inwards = moves_in(start.position, self.at.load, self.at.indenter, indenter)
            if inwards and force < (1.0 - SNAP) * last:
                report.reason = f"the skin snaps: {last:.1f} N fall to {force:.1f} N"
                report.converged = False
                self._snapped_from_n = last
            elif not inwards:
                self._snapped_from_n = 0.0
        if report.converged and trial.fluid_pressure < -SUCTION_PA:
            self.outcome = IndentationOutcome.DIVERGED
            self.reason = (
                f"the fluid sucks the skin inwards: {trial.fluid_pressure / 1e3:.2f} kPa with "
                f"{self.fluid_m3 * 1e6:.3f} ml; fill in more"
            )
            report.converged = False
        if report.converged:
            self.at = _Progress(trial, indenter, -balance.indenter, start, length)
            self.newton.system.update_anchors(trial, indenter)
        else:
            self.at.previous = None
        return report, balance

    def _solve(
        self, trial: SolutionState, indenter: PosedIndenter, *, pseudo_transient: bool = False
    ) -> tuple[NewtonReport, ForceBalance]:
        return self.newton.solve(
            trial,
            indenter,
            volume=self.cavity_m3,
            should_stop=self._stop,
            pseudo_transient=pseudo_transient,
        )

    def _predicted(self, length: float) -> SolutionState:
        """Linear extrapolation of the last two solutions; a copy of the last if there is one."""
        at, before = self.at.state, self.at.previous
        trial = at.copy()
        if self.settings.predict and before is not None:
            ratio = length / self.at.previous_length
            trial.position += ratio * (at.position - before.position)
            trial.pressure += ratio * (at.pressure - before.pressure)
            trial.fluid_pressure += ratio * (at.fluid_pressure - before.fluid_pressure)
            trial.traction += ratio * (at.traction - before.traction)
            for now, earlier in (
                (trial.core_pressure, before.core_pressure),
                (trial.indenter_pressure, before.indenter_pressure),
            ):
                now += ratio * (now - earlier)
                np.maximum(now, 0.0, out=now)  # contact does not pull
        return trial

    def _overshoots(self, balance: ForceBalance, size: float) -> bool:
        """Whether an increment ends so far beyond the force limit that it must be shortened."""
        settings = self.settings
        return (
            _force(balance) > (1.0 + OVERSHOOT) * settings.force_limit_n
            and 0.5 * size >= settings.smallest_increment
        )

    def _check_force(self, balance: ForceBalance, travel: float) -> None:
        """End the indentation where the force limit is exceeded."""
        force = _force(balance)
        if force > self.settings.force_limit_n:
            self.outcome = IndentationOutcome.FORCE_LIMIT
            self.reason = f"{force:.1f} N, {travel * 1e3:.3f} mm along the path"

    def _stop(self) -> bool:
        """Ask the caller whether to go on."""
        if self.should_stop is not None and self.outcome is None:
            self.outcome = self.should_stop()
            if self.outcome is not None:
                self.reason = str(self.outcome)
        return self.outcome is not None

    def _step(self, pose: Floats, balance: ForceBalance, cost: _StepCost) -> IndentationStep:
        """Quantities of the converged solution."""
        system = self.newton.system
        convergence = Convergence(
            increments=cost.increments,
            iterations=cost.iterations,
            factorisations=cost.factorisations,
            residual=balance.residual,
            volume_error=abs(balance.volume - self.cavity_m3) / self.cavity_m3,
            penetration_m=max(0.0, -system.outer.smallest_gap, -system.inner.smallest_gap),
            seconds=time.perf_counter() - cost.started,
        )
        return indentation_step(
            system, self.rest, self.at.state, pose, -balance.indenter, -balance.core, convergence
        )


def indentation_step(
    system: EquilibriumSystem,
    rest: SolutionState,
    state: SolutionState,
    pose: Floats,
    indenter_force: Floats,
    core_force: Floats,
    convergence: Convergence,
) -> IndentationStep:
    """Quantities of a converged solution.

    Args:
        system: The equations.
        rest: Pressurised, untouched state.
        state: The solution.
        pose: Of the indenter (7,).
        indenter_force: Nodal forces of the indenter on the skin [N], (V, 3).
        core_force: Of the core on the skin [N], (V, 3).
        convergence: How it was solved.
    """
    surface = system.outer
    weight = state.indenter_pressure * surface.area_values
    points = surface.points_at(state.position)
    touching = state.indenter_pressure > CONTACT_SHARE * max(
        float(state.indenter_pressure.max()), 1.0
    )
    centre = np.full(3, np.nan)
    if touching.any():
        centre = (weight[..., None] * points).sum(axis=(0, 1)) / weight.sum()
    stress = system.skin.stress(state.position, state.pressure)
    return IndentationStep(
        pose=np.array(pose),
        displacement=state.position - rest.position,
        fluid_pressure_pa=state.fluid_pressure,
        force=indenter_force.sum(axis=0),
        torque=np.cross(state.position, indenter_force).sum(axis=0),
        indenter_force=indenter_force,
        core_force=core_force,
        contact_area_m2=float(surface.current_area(state.position)[touching].sum()),
        centre_of_pressure=centre,
        stress=stress.reshape(-1, 9)[:, VOIGT],
        convergence=convergence,
    )


def _force(balance: ForceBalance) -> float:
    """Size of the net force on the indenter [N]."""
    return float(np.linalg.norm(balance.indenter.sum(axis=0)))
