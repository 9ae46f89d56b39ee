"""One trajectory in the making: increments, cut-back, prediction, and when to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics.balance import Balance
from palpate_fem.mechanics.laws import Press
from palpate_fem.mechanics.newton import Report
from palpate_fem.mechanics.outputs import make_step
from palpate_fem.mechanics.path import interpolate_pose, path_lengths
from palpate_fem.mechanics.state import State
from palpate_fem.result import Convergence, Outcome, Step, Trajectory

if TYPE_CHECKING:
    from palpate_fem.mechanics.solver import Fingertip

Floats = NDArray[np.float64]

OVERSHOOT = 0.1
"""By how much of the force limit its last increment may go beyond it."""


SNAP = 0.1
"""Share of the force that may be lost where plain steps find no equilibrium and creeping does.

More is not the branch that the skin was on: nodes that bear the pinch have slipped out of it, which
a continuous skin does not do. The trajectory ends before."""


@dataclass(slots=True)
class _Work:
    """What the increments of one step cost."""

    started: float = field(default_factory=time.perf_counter)
    increments: int = 0
    iterations: int = 0
    factorisations: int = 0

    def add(self, report: Report) -> None:
        """Count an increment."""
        self.increments += 1
        self.iterations += report.iterations
        self.factorisations += report.factorisations


class Indentation:
    """One trajectory in the making."""

    def __init__(
        self,
        tip: Fingertip,
        indenter: Indenter,
        path: Floats,
        on_step: Callable[[Step], None] | None,
        should_stop: Callable[[], Outcome | None] | None,
    ) -> None:
        self.tip, self.indenter, self.path = tip, indenter, np.asarray(path, np.float64)
        self.on_step, self.should_stop = on_step, should_stop
        self.press = Press(indenter, self.path[0], tip.parameters.friction_coefficient)
        self.state = tip.state.copy()
        self.outcome: Outcome | None = None
        self.reason = ""
        self.force = 0.0  # of the last increment [N]
        tip.system.settle(self.state, self.press)
        tip.newton.forget()
        # Of the last two increments: where they ended and how long they were, for the predictor.
        self.before: State | None = None
        self.before_length = 0.0

    def run(self) -> Trajectory:
        """Follow the whole path."""
        started = time.perf_counter()
        lengths = path_lengths(self.path)
        steps: list[Step] = []
        travel = 0.0
        size = 1.0
        for k in range(1, len(self.path)):
            work, done = _Work(), 0.0
            while done < 1.0 - 1e-9 and self.outcome is None:
                if self._stop():
                    break
                size = min(size, 1.0 - done)
                goal = done + size
                if 1.0 - goal < 1e-6:
                    goal = 1.0
                pose = interpolate_pose(self.path[k - 1], self.path[k], goal)
                origin = (self.state, self.press, self.before, self.before_length, self.force)
                report, balance = self.increment(pose, size)
                work.add(report)
                if report.converged and self._overshoots(balance, size):
                    self.state, self.press, self.before, self.before_length, self.force = origin
                    size *= 0.5
                    continue
                if report.converged:
                    done = goal
                    travel = lengths[k - 1] + done * (lengths[k] - lengths[k - 1])
                    if report.iterations <= 8:
                        size = min(1.0, 2.0 * size)
                    self.check_force(balance, travel)
                    continue
                size *= 0.5
                if self.outcome is None and size < self.tip.settings.smallest_increment:
                    self.outcome = Outcome.DIVERGED
                    self.reason = f"{report.reason}, {travel * 1e3:.3f} mm along the path"
            if done < 1.0 - 1e-9:
                break
            steps.append(
                make_step(
                    self.tip,
                    self.state,
                    self.press,
                    self.path[k],
                    balance,
                    _cost(work, report, balance, self.tip),
                )
            )
            if self.on_step is not None:
                self.on_step(steps[-1])
            if self.outcome is not None:
                break
        return Trajectory(
            indenter=self.indenter.name,
            path=self.path,
            steps=tuple(steps),
            outcome=self.outcome or Outcome.COMPLETE,
            reason=self.reason,
            travel_m=float(travel),
            seconds=time.perf_counter() - started,
        )

    def _overshoots(self, balance: Balance, size: float) -> bool:
        """Whether the skin is pinched so hard at the end of an increment that less is wanted."""
        settings = self.tip.settings
        return (
            _force(balance) > (1.0 + OVERSHOOT) * settings.force_limit_n
            and 0.5 * size >= settings.smallest_increment
        )

    def check_force(self, balance: Balance, travel: float) -> None:
        """End the trajectory where the skin is pinched."""
        force = _force(balance)
        if force > self.tip.settings.force_limit_n:
            self.outcome = Outcome.FORCE_LIMIT
            self.reason = f"{force:.1f} N, {travel * 1e3:.3f} mm along the path"

    def increment(self, pose: Floats, length: float) -> tuple[Report, Balance]:
        """Solve for one pose; the state moves on only if it converged."""
        kept, press = self.state.copy(), self.press.at(pose)
        trial = self.predicted(length)
        report, balance = self.tip.equilibrium(trial, press, self.tip.cavity, self._stop)
        if not report.converged and self.outcome is None:
            # The extrapolation may have led astray, e.g. at first touch, or the skin is pinched.
            trial = kept.copy()
            second, balance = self.tip.equilibrium(
                trial, press, self.tip.cavity, self._stop, creep=True
            )
            second.iterations += report.iterations
            second.factorisations += report.factorisations
            report = second
            if report.converged and _force(balance) < (1.0 - SNAP) * self.force:
                self.outcome = Outcome.DIVERGED
                self.reason = f"the skin snaps: {self.force:.1f} N fall to {_force(balance):.1f} N"
                report.converged = False
        if report.converged:
            self.before, self.before_length = kept, length
            self.state, self.press, self.force = trial, press, _force(balance)
            self.tip.system.settle(trial, press)
        else:
            self.before = None
        return report, balance

    def predicted(self, length: float) -> State:
        """Where the last two increments point to; where they ended if there are none."""
        trial = self.state.copy()
        if self.tip.settings.predict and self.before is not None:
            ratio = length / self.before_length
            trial.position += ratio * (self.state.position - self.before.position)
            trial.pressure += ratio * (self.state.pressure - self.before.pressure)
            trial.fluid_pressure += ratio * (self.state.fluid_pressure - self.before.fluid_pressure)
            trial.traction += ratio * (self.state.traction - self.before.traction)
            for now, before in (
                (trial.core_pressure, self.before.core_pressure),
                (trial.indenter_pressure, self.before.indenter_pressure),
            ):
                now += ratio * (now - before)
                np.maximum(now, 0.0, out=now)
        return trial

    def _stop(self) -> bool:
        if self.should_stop is not None and self.outcome is None:
            self.outcome = self.should_stop()
            if self.outcome is not None:
                self.reason = str(self.outcome)
        return self.outcome is not None


def _force(balance: Balance) -> float:
    """Size of the net force on the indenter [N]."""
    return float(np.linalg.norm(balance.indenter.sum(axis=0)))


def _cost(work: _Work, report: Report, balance: Balance, tip: Fingertip) -> Convergence:
    inner, outer = tip.system.inner, tip.system.outer
    return Convergence(
        increments=work.increments,
        iterations=work.iterations,
        factorisations=work.factorisations,
        residual=balance.residual,
        volume_error=abs(balance.volume - tip.cavity) / tip.cavity,
        penetration_m=max(0.0, -float(outer.gap.min()), -float(inner.gap.min())),
        seconds=time.perf_counter() - work.started,
    )
