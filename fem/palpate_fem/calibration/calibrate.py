"""Calibration: skin thickness, modulus, friction and fluid volume from measured forces.

The paper minimises its cost by SLSQP over four parameters, with simulator runs for every
evaluation. Two of the parameters need no run: forces scale exactly with the modulus at an unchanged
shape, and the fluid's volume follows from the total thickness. So a coarse scan in thickness and
friction finds a starting point. Each step from there runs the simulator near the point, once for
each parameter, builds a model that is linear in those and exact in the modulus, and minimises the
cost of that model by SLSQP. The step is accepted only if runs at its end confirm it.

A `SlopeSimulator` knows the derivatives of its runs, so the runs near a point are not needed, nor
is the scan: the search begins in the middle of the bounds, unless a trajectory fails there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from palpate.errors import DatasetError, SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.calibration.alignment import AlignmentError, rms_n
from palpate_fem.calibration.local import LocalModel, estimates, minimise
from palpate_fem.calibration.measured import SIMULATED, MeasuredIndentation
from palpate_fem.calibration.point import (
    CalibrationCase,
    ModulusFit,
    SimulatedPoint,
    compare,
    failures_at,
    fit_modulus,
)
from palpate_fem.calibration.result import Calibration, Evaluation, TrajectoryFit, axis_rms
from palpate_fem.calibration.runs import SimulatedRun, SimulationRuns, Simulator
from palpate_fem.calibration.settings import (
    FRICTION,
    STEPS,
    THICKNESS,
    VOLUME,
    CalibrationSettings,
)
from palpate_fem.result import IndentationOutcome

_REACH = {THICKNESS: 0.15, FRICTION: 0.6, VOLUME: 0.15}
"""Initial and largest change of a logarithm in one step: about half a cell of the scan."""
_CONVERGED = {THICKNESS: 1e-3, FRICTION: 5e-3, VOLUME: 1e-3}
"""Changes of the logarithms at which the search has converged: a tenth of the required accuracy."""
_ENOUGH = 1e-5
"""Smallest predicted gain, as a part of the cost, that is worth another run: moving all parameters
by one standard deviation changes the cost of N samples by about 1 / 2N of it."""


def calibrate(
    simulator: Simulator,
    measured: Sequence[MeasuredIndentation],
    settings: CalibrationSettings | None = None,
    *,
    executor: Executor | None = None,
    on_evaluation: Callable[[Evaluation], None] | None = None,
    on_run: Callable[[int, int], None] | None = None,
) -> Calibration:
    """Find the parameters that bring simulated forces closest to measured ones.

    Args:
        simulator: Runs indentations, which do not depend on the sensor.
        measured: Trajectories of one or several sensors. Friction is visible only where the
            indenter slips, so include angled ones. Thickness and modulus act alike until the skin
            is pinched on the core: one indentation with the long cylinder and noise of 0.02 N gives
            the thickness within 2.2 % up to 6 N, and within 0.13 % up to 12 N.
        settings: Bounds, weights, search; None = the paper's.
        executor: Runs simulations in parallel, e.g. a process pool; None = one after the
            other.
        on_evaluation: Called with every evaluation of the cost that took runs.
        on_run: Called after each run with the number of finished and of all runs of the batch.

    Returns:
        The parameters, their uncertainty, how well they fit, and everything that was left out.

    Raises:
        DatasetError: No measured trajectory can be compared.
        SimulationError: No simulation can be compared with its measurement.
    """
    runs = SimulationRuns(simulator, executor, on_run)
    return _Search(runs, measured, settings or CalibrationSettings(), on_evaluation).run()


class _Search:
    """State of one calibration."""

    def __init__(
        self,
        runs: SimulationRuns,
        measured: Sequence[MeasuredIndentation],
        settings: CalibrationSettings,
        on_evaluation: Callable[[Evaluation], None] | None,
    ) -> None:
        self.settings, self.runs, self.on_evaluation = settings, runs, on_evaluation
        self.history: list[Evaluation] = []
        self.excluded: dict[str, str] = {}
        self.notes: list[str] = []
        self.cases: list[CalibrationCase] = []
        for item in measured:
            try:
                self.cases.append(CalibrationCase.of(item, settings))
            except AlignmentError as error:
                self.excluded[item.name] = error.problem
        if not self.cases:
            reasons = "; ".join(f"{name}: {why}" for name, why in self.excluded.items())
            raise DatasetError(
                f"no measured trajectory can be compared ({reasons or 'none given'})",
                remedy=f"record from above the skin to well above {settings.threshold_n:g} N",
            )

    def run(self) -> Calibration:
        state, fit = self.scan()
        if self.settings.volume_is_free:
            low, high = self.settings.bounds[VOLUME]
            volume = min(max(state.fluid_volume_m3, low), high)
            state = self.simulate([np.append(state.point, volume)])[0]
            fit = self.evaluate(state, "start")
            if not math.isfinite(fit.cost):
                raise _hopeless(self.cases, [state], [fit])
        return self.refine(state, fit)

    def simulate(self, points: Sequence[Floats]) -> list[SimulatedPoint]:
        """Run all cases at all points, in one batch."""
        jobs = [
            (self.settings.parameters(point), case.item) for point in points for case in self.cases
        ]
        names = self.settings.simulated[: len(points[0])] if self.runs.knows_slopes else ()
        results = self.runs.run(jobs, names)
        count = len(self.cases)
        batches = [results[i * count : (i + 1) * count] for i in range(len(points))]
        for batch in batches:
            self._note_early_ends(batch)
        return [SimulatedPoint.of(p, batch) for p, batch in zip(points, batches, strict=True)]

    def _note_early_ends(self, batch: Sequence[SimulatedRun]) -> None:
        for case, result in zip(self.cases, batch, strict=True):
            if result.outcome is not IndentationOutcome.COMPLETE:
                why = f" ({result.reason})" if result.reason else ""
                note = f"{case.item.name}: some runs ended early: {result.outcome}{why}"
                if note not in self.notes:
                    self.notes.append(note)

    def evaluate(self, state: SimulatedPoint, stage: str) -> ModulusFit:
        """Fit the modulus at a point, and report the evaluation."""
        fit = fit_modulus(state, self.cases, self.settings)
        names = [case.item.name for case in self.cases]
        entry = Evaluation(
            stage=stage,
            parameters=self.settings.parameters(
                state.point, fit.modulus_pa if math.isfinite(fit.cost) else None
            ),
            cost=fit.cost,
            axis_rms_n=axis_rms(fit.pairs),
            thickness_m=state.thickness_m,
            fluid_volume_m3=state.fluid_volume_m3,
            simulations=self.runs.count,
            failures={names[i]: why for i, why in fit.failures.items()},
        )
        self.history.append(entry)
        if self.on_evaluation is not None:
            self.on_evaluation(entry)
        return fit

    def drop(self, which: int, why: str, states: Sequence[SimulatedPoint]) -> list[SimulatedPoint]:
        """Exclude a case from now on, and record why."""
        self.excluded[self.cases[which].item.name] = why
        kept = [i for i in range(len(self.cases)) if i != which]
        self.cases = [self.cases[i] for i in kept]
        return [state.only(kept) for state in states]

    def scan(self) -> tuple[SimulatedPoint, ModulusFit]:
        """Best point of the coarse scan; a case that fails at most points is left out.

        A point at which most cases fail says nothing about them: there, e.g., paths begin inside a
        thick skin.
        """
        if self.runs.knows_slopes:
            state = self.simulate([self.settings.middle()])[0]
            fit = self.evaluate(state, "start")
            if math.isfinite(fit.cost):
                return state, fit
        states = self.simulate(self.settings.scan_points())
        while True:
            fits = [self.evaluate(state, "scan") for state in states]
            fair = [fit for fit in fits if len(fit.failures) <= len(self.cases) / 2] or fits
            failed = [sum(i in fit.failures for fit in fair) for i in range(len(self.cases))]
            worst = int(np.argmax(failed))
            none_left = not any(math.isfinite(fit.cost) for fit in fits)
            if not none_left and failed[worst] <= len(fair) / 2:
                best = int(np.argmin([fit.cost for fit in fits]))
                return states[best], fits[best]
            if len(self.cases) == 1:
                raise _hopeless(self.cases, states, fits)
            states = self.drop(worst, f"simulation: {_reasons(worst, states, fits)}", states)

    def refine(self, state: SimulatedPoint, fit: ModulusFit) -> Calibration:
        """Step to the optimum; each step is confirmed by runs."""
        names = self.settings.simulated
        largest = np.array([_REACH[name] for name in names])
        smallest = np.array([_CONVERGED[name] for name in names])
        reach, model, converged = largest.copy(), None, False
        for _ in range(self.settings.iterations):
            if model is None:
                state, fit, model = self.local_model(state, fit)
            shift, promised = minimise(model, math.log(fit.modulus_pa), reach)
            gain = fit.cost - promised
            if (np.abs(shift) <= smallest).all() or gain <= _ENOUGH * fit.cost:
                converged = True
                break
            logs = np.log(state.point) + shift
            point = [self.settings.bounded(*pair) for pair in zip(names, logs, strict=True)]
            trial = self.simulate([np.array(point)])[0]
            trial_fit = self.evaluate(trial, "step")
            won = fit.cost - trial_fit.cost
            # A trust region: accept a step that wins a tenth of what the model promised, and let
            # the reach grow if the model was good, shrink if it was not.
            if won > 0.1 * gain:
                state, fit, model = trial, trial_fit, None
                reach = np.minimum(reach * (1.5 if won > 0.75 * gain else 1.0), largest)
            else:
                reach = 0.3 * np.minimum(np.abs(shift), reach)
                reach = np.maximum(reach, smallest)
        else:
            self.notes.append(f"stopped after {self.settings.iterations} steps, not converged")
        if model is None:
            state, fit, model = self.local_model(state, fit)
        return self._result(model, fit, converged)

    def local_model(
        self, state: SimulatedPoint, fit: ModulusFit
    ) -> tuple[SimulatedPoint, ModulusFit, LocalModel]:
        """Model from runs near a point, with one parameter moved each; drops cases that fail."""
        if state.curve_slopes:
            return state, fit, LocalModel(state, (), self.cases, self.settings)
        while True:
            moved, failures = self._moved(state, fit.modulus_pa)
            if not failures:
                return state, fit, LocalModel(state, moved, self.cases, self.settings)
            which, why = next(iter(failures.items()))
            if len(self.cases) == 1:
                raise SimulationError(
                    f"no simulation near the optimum can be compared: {why}",
                    remedy="choose a shallower trajectory, or find out why the solver stops",
                )
            (state,) = self.drop(which, f"simulation near the optimum: {why}", [state])
            fit = fit_modulus(state, self.cases, self.settings)

    def _moved(
        self, state: SimulatedPoint, modulus_pa: float
    ) -> tuple[list[SimulatedPoint], dict[int, str]]:
        points = []
        for i, name in enumerate(self.settings.simulated):
            ahead = state.point.copy()
            ahead[i] *= 1.0 + STEPS[name]
            if ahead[i] > self.settings.bounds[name][1]:
                ahead[i] = state.point[i] / (1.0 + STEPS[name])
            points.append(ahead)
        moved = self.simulate(points)
        for i, beside in enumerate(moved):
            if not failures_at(beside, self.cases, modulus_pa, self.settings):
                continue
            back = state.point.copy()
            back[i] *= state.point[i] / beside.point[i]
            moved[i] = self.simulate([back])[0]
            failures = failures_at(moved[i], self.cases, modulus_pa, self.settings)
            if failures:
                return moved, failures
        return moved, {}

    def _result(self, model: LocalModel, fit: ModulusFit, converged: bool) -> Calibration:
        state, settings = model.base, self.settings
        still = np.zeros(len(state.point))
        paper = replace(settings, fit_offsets=False)
        factor = fit.modulus_pa / settings.reference_shear_modulus_pa
        paper_pairs = [
            compare(line, case, factor, paper)
            for line, case in zip(state.curves, self.cases, strict=True)
        ]
        found = estimates(model, still, math.log(fit.modulus_pa))
        thickness_sd = next(e.sd for e in found if e.name == THICKNESS) / state.point[0]
        stiff = replace(settings.parameters(state.point), shear_modulus_pa=fit.modulus_pa)
        return Calibration(
            parameters=stiff,
            estimates=found,
            fluid_volume_m3=state.fluid_volume_m3,
            fluid_volume_sd_m3=float(abs(model.volume_slopes[0]) * thickness_sd)
            if not settings.volume_is_free
            else next(e.sd for e in found if e.name == VOLUME),
            thickness_m=state.thickness_m,
            cost=fit.cost,
            axis_rms_n=axis_rms(fit.pairs),
            paper_axis_rms_n=axis_rms(paper_pairs),
            trajectories=tuple(
                TrajectoryFit(
                    case.item.name,
                    case.item.indenter,
                    case.item.sensor,
                    rms_n(pair),
                    rms_n(paper_pair),
                    pair.depth_offset_m,
                    pair.coverage,
                    pair,
                )
                for case, pair, paper_pair in zip(self.cases, fit.pairs, paper_pairs, strict=True)
            ),
            history=tuple(self.history),
            simulations=self.runs.count,
            converged=converged,
            excluded=dict(self.excluded),
            notes=tuple(self.notes),
            self_test=any(case.item.origin == SIMULATED for case in self.cases),
        )


def _reasons(which: int, states: Sequence[SimulatedPoint], fits: Sequence[ModulusFit]) -> str:
    """Why a case failed, each different reason with the skins at which it did."""
    skins: dict[str, dict[str, None]] = {}
    for state, fit in zip(states, fits, strict=True):
        if which in fit.failures:
            skins.setdefault(fit.failures[which], {})[f"{1e3 * state.point[0]:.2f}"] = None
    return "; ".join(f"{why} (skin of {', '.join(mm)} mm)" for why, mm in skins.items())


def _hopeless(
    cases: Sequence[CalibrationCase], states: Sequence[SimulatedPoint], fits: Sequence[ModulusFit]
) -> SimulationError:
    failed = sorted({which for fit in fits for which in fit.failures})
    reasons = "; ".join(f"{cases[i].item.name}: {_reasons(i, states, fits)}" for i in failed)
    return SimulationError(
        f"no simulation can be compared with its measurement ({reasons})",
        remedy="check indenter, sensor frame, path and total thickness; begin paths some 0.5 mm"
        " above the skin: fingers of all thicknesses are tried",
    )
