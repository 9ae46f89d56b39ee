"""Load stepping: pressurise once, then follow an indenter's path."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from palpate.fem.config import FingertipParameters
from palpate.fem.indenter.shape import Indenter
from palpate.fem.laws import ContactSettings, Press
from palpate.fem.linear import make_factor
from palpate.fem.mesh.geometry import Geometry
from palpate.fem.newton import Newton, NewtonSettings, Report
from palpate.fem.outputs import make_step
from palpate.fem.path import interpolate_pose, path_lengths
from palpate.fem.result import Convergence, Outcome, Step, Trajectory
from palpate.fem.state import State
from palpate.fem.system import Balance, System
from palpate.protos.errors import SimulationError

Floats = NDArray[np.float64]

STEPS_TO_PRESSURISE = 4
THICKNESS_TOLERANCE_M = 1e-8


@dataclass(frozen=True, slots=True)
class Settings:
    """How a fingertip is solved.

    Attributes:
        newton: Tolerances of one increment.
        contact: Constants of the contact laws.
        force_limit_n: A trajectory ends where the indenter's force exceeds this [N]; the paper saw
            23-32 N at most.
        smallest_increment: Fraction of a step below which it is given up.
        predict: Whether increments start from an extrapolation of the last two.
        solver: ``auto``, ``pardiso`` or ``superlu``.
    """

    newton: NewtonSettings = field(default_factory=NewtonSettings)
    contact: ContactSettings = field(default_factory=ContactSettings)
    force_limit_n: float = 32.0
    smallest_increment: float = 1 / 64
    predict: bool = True
    solver: str = "auto"


@dataclass(slots=True)
class _Work:
    """What the increments of one step cost."""

    started: float = field(default_factory=time.perf_counter)
    increments: int = 0
    iterations: int = 0
    factorisations: int = 0

    def add(self, report: Report) -> None:
        self.increments += 1
        self.iterations += report.iterations
        self.factorisations += report.factorisations


class Fingertip:
    """A pressurised fingertip that can be indented again and again."""

    def __init__(
        self, geometry: Geometry, parameters: FingertipParameters, settings: Settings
    ) -> None:
        """Use `pressurised`; this makes the unfilled one."""
        self.geometry, self.parameters, self.settings = geometry, parameters, settings
        self.system = System(
            geometry.mesh,
            geometry.core.grid if geometry.core else None,
            shear_modulus_pa=parameters.shear_modulus_pa,
            bulk_ratio=parameters.bulk_ratio,
            contact=settings.contact,
        )
        pattern = self.system.pattern
        self.newton = Newton(
            self.system,
            make_factor(pattern.indptr, pattern.indices, solver=settings.solver),
            settings.newton,
        )
        self.state = State.at_rest(geometry.mesh)
        self.core_volume = geometry.core.volume_m3 if geometry.core else 0.0

    @classmethod
    def pressurised(
        cls,
        geometry: Geometry,
        parameters: FingertipParameters | None = None,
        settings: Settings | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Fingertip:
        """Fill the fluid in.

        Args:
            geometry: Mesh and core.
            parameters: Physical parameters.
            settings: How to solve.
            progress: Called with the fraction done.

        Raises:
            SimulationError: No equilibrium, or the fluid volume does not fit the cavity.
        """
        parameters = parameters or FingertipParameters()
        tip = cls(geometry, parameters, settings or Settings())
        tip._pressurise(progress or (lambda _: None))
        return tip

    @property
    def nodes(self) -> Floats:
        """Nodal positions of the pressurised, untouched state [m], (V, 3)."""
        return self.state.position

    @property
    def total_thickness_m(self) -> float:
        """Dorso-ventral extent of the skin [m]."""
        return float(np.ptp(self.state.position[:, 2]))

    @property
    def fluid_pressure_pa(self) -> float:
        """Fluid pressure of the untouched state above ambient [Pa]."""
        return self.state.fluid_pressure

    @property
    def fluid_volume_m3(self) -> float:
        """Fluid between skin and core [m^3]."""
        return self._cavity - self.core_volume

    def _pressurise(self, progress: Callable[[float], None]) -> None:
        parameters, state = self.parameters, self.state
        self._cavity = self.system.balance(state, None).volume
        if parameters.fluid_volume_m3 is not None:
            self._fill_to(parameters.fluid_volume_m3 + self.core_volume, STEPS_TO_PRESSURISE)
            progress(1.0)
            return
        wanted = parameters.total_thickness_m
        outer = self.geometry.mesh.outer_nodes
        area = float(np.ptp(state.position[outer, 0]) * np.ptp(state.position[outer, 1]))
        low = (self._cavity, self.total_thickness_m)
        if wanted < low[1] - THICKNESS_TOLERANCE_M:
            raise SimulationError(
                f"the unpressurised skin is {low[1] * 1e3:.2f} mm thick already, "
                f"{wanted * 1e3:.2f} mm are wanted",
                remedy="raise total_thickness_m or give fluid_volume_m3",
            )
        begin = low[1]
        slope = 0.35 / area  # of thickness by volume; measured on the BioTac: 1.45 mm in 474 mm^3
        previous = low
        for _ in range(40):
            missing = wanted - self.total_thickness_m
            if abs(missing) < THICKNESS_TOLERANCE_M:
                progress(1.0)
                return
            # Steps of at most 0.5 mm: the secant is good there and Newton starts near.
            aim = math.copysign(min(abs(missing), 0.5e-3), missing)
            self._fill_to(self._cavity + aim / slope, 1)
            now = (self._cavity, self.total_thickness_m)
            if abs(now[0] - previous[0]) > 1e-16:
                slope = (now[1] - previous[1]) / (now[0] - previous[0])
            previous = now
            if slope <= 0.0:
                break
            progress(min(1.0, max(0.0, (now[1] - begin) / (wanted - begin))))
        raise SimulationError(
            f"the skin does not get {wanted * 1e3:.2f} mm thick by filling; it reached "
            f"{self.total_thickness_m * 1e3:.2f} mm",
            remedy="check skin_thickness_m and total_thickness_m",
        )

    def _fill_to(self, cavity: float, steps: int) -> None:
        start, done, size = self._cavity, 0.0, 1.0 / steps
        while done < 1.0 - 1e-12:
            kept = self.state.copy()
            goal = min(1.0, done + size)
            volume = start + goal * (cavity - start)
            report, balance = self._equilibrium(self.state, None, volume, None)
            if report.converged:
                done, self._cavity = goal, volume
                continue
            self.state = kept
            size *= 0.5
            if size < 1e-3:
                raise SimulationError(
                    f"pressurisation stopped at {volume * 1e9:.1f} mm^3: {report.reason}",
                    remedy="check the mesh and the fluid volume",
                )

    def _equilibrium(
        self,
        state: State,
        press: Press | None,
        volume: float | None,
        should_stop: Callable[[], bool] | None,
    ) -> tuple[Report, Balance]:
        """One increment."""
        return self.newton.solve(state, press, volume=volume, should_stop=should_stop)

    def indent(
        self,
        indenter: Indenter,
        path: Floats,
        *,
        on_step: Callable[[Step], None] | None = None,
        should_stop: Callable[[], Outcome | None] | None = None,
    ) -> Trajectory:
        """Follow a path of poses (K, 7); the first does not touch the skin.

        Args:
            indenter: What presses.
            path: Poses of the indenter in the sensor frame: position [m], quaternion w x y z.
            on_step: Called with each converged step.
            should_stop: Asked often; an outcome ends the trajectory with it.

        Returns:
            The converged steps; if not all, why, and how far it came.
        """
        return _Indentation(self, indenter, path, on_step, should_stop).run()


class _Indentation:
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
        self.settled(self.press)
        # Of the last two increments: where they ended and how long they were, for the predictor.
        self.before: State | None = None
        self.before_length = 0.0

    def settled(self, press: Press) -> None:
        """Move the anchors of points that slid; all start where they are."""
        surface = self.tip.system.outer
        corners = self.state.position[self.tip.geometry.mesh.outer_faces]
        points = np.einsum("qa,fai->fqi", surface.shape_values, corners)
        stretch = self.state.traction / self.tip.settings.contact.tangential_stiffness
        self.state.anchor[:] = press.to_local(points - stretch)

    def run(self) -> Trajectory:
        started = time.perf_counter()
        lengths = path_lengths(self.path)
        steps: list[Step] = []
        travel = 0.0
        size = 1.0
        for k in range(1, len(self.path)):
            work, done = _Work(), 0.0
            while done < 1.0 - 1e-9 and self.outcome is None:
                size = min(size, 1.0 - done)
                goal = done + size
                if 1.0 - goal < 1e-6:
                    goal = 1.0
                pose = interpolate_pose(self.path[k - 1], self.path[k], goal)
                report, balance = self.increment(pose, size)
                work.add(report)
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
            steps.append(make_step(self.tip, self.state, self.press, self.path[k], balance, _cost(work, report, balance, self.tip)))
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

    def check_force(self, balance: Balance, travel: float) -> None:
        force = float(np.linalg.norm(balance.indenter.sum(axis=0)))
        if force > self.tip.settings.force_limit_n:
            self.outcome = Outcome.FORCE_LIMIT
            self.reason = f"{force:.1f} N, {travel * 1e3:.3f} mm along the path"

    def increment(self, pose: Floats, length: float) -> tuple[Report, Balance]:
        """Solve for one pose; the state moves on only if it converged."""
        kept, press = self.state.copy(), self.press.at(pose)
        trial = self.predicted(length)
        report, balance = self.tip._equilibrium(trial, press, self.tip._cavity, self._stop)
        if not report.converged and trial is not None and self.outcome is None and self.before is not None:
            # The extrapolation may have led astray, e.g. at first touch.
            trial = kept.copy()
            second, balance = self.tip._equilibrium(trial, press, self.tip._cavity, self._stop)
            second.iterations += report.iterations
            second.factorisations += report.factorisations
            report = second
        if report.converged:
            self.before, self.before_length = kept, length
            self.state, self.press = trial, press
            self.settled(press)
        else:
            self.before = None
        return report, balance

    def predicted(self, length: float) -> State:
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


def _cost(work: _Work, report: Report, balance: Balance, tip: Fingertip) -> Convergence:
    inner, outer = tip.system.inner, tip.system.outer
    return Convergence(
        increments=work.increments,
        iterations=work.iterations,
        factorisations=work.factorisations,
        residual=report.residuals[-1],
        volume_error=abs(balance.volume - tip._cavity) / tip._cavity,
        penetration_m=max(0.0, -float(outer.gap.min()), -float(inner.gap.min())),
        seconds=time.perf_counter() - work.started,
    )
