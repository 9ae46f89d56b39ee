"""The cost near a simulated point: its linear model, its minimum, and how certain the minimum is.

The modulus enters exactly, the other parameters to first order. SLSQP finds the lowest cost within
reach of the model. The uncertainty is a Gauss-Newton covariance in which noise does not only enter
sample by sample: the point where the measured curve crosses the threshold is noisy too, and moves
the whole curve. So the noise is carried from the raw samples through the alignment (by
differences), and then through the stationarity of the cost. First order only: in 65 repetitions on
a formula in place of the solver the spread was 1.2 to 1.3 times the stated one. It does not include
what repetition cannot show, such as a wrong model or a wrong registration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import minimize

from palpate_fem.arrays import Floats
from palpate_fem.calibration.alignment import AlignmentError, ForceCurve
from palpate_fem.calibration.point import (
    CalibrationCase,
    SimulatedPoint,
    compare,
    force_and_thickness_cost,
)
from palpate_fem.calibration.settings import MODULUS, CalibrationSettings

_LOG_STEP = 1e-3
"""Difference step of a logarithm. The model is linear; only the alignment is not."""
_LEAST_RMS_N = 1e-4
"""Smallest RMS for the weight of an axis [N]: no instrument resolves a better fit."""


class LocalModel:
    """Force curves around a base point, linear in the logarithms of the simulated parameters.

    Args:
        base: Runs at the base point.
        moved: Runs with one parameter moved each, in the order of ``settings.simulated``; none if
            the base knows its slopes.
        cases: Measurements that they are compared with.
        settings: Settings of the comparison.
    """

    def __init__(
        self,
        base: SimulatedPoint,
        moved: Sequence[SimulatedPoint],
        cases: Sequence[CalibrationCase],
        settings: CalibrationSettings,
    ) -> None:
        self.base, self.cases, self.settings = base, cases, settings
        if base.thickness_slopes is not None and base.volume_slopes is not None and not moved:
            self._travel = [line.travel_m for line in base.curves]
            self._force = [line.force_n for line in base.curves]
            self._slopes = list(base.curve_slopes)
            self.thickness_slopes, self.volume_slopes = base.thickness_slopes, base.volume_slopes
            return
        steps = [float(np.log(state.point[i] / base.point[i])) for i, state in enumerate(moved)]
        self._travel, self._force, self._slopes = [], [], []
        for j, line in enumerate(base.curves):
            # Runs may have stopped early: use what all of them have.
            length = min(len(state.curves[j].travel_m) for state in (base, *moved))
            self._travel.append(line.travel_m[:length])
            self._force.append(line.force_n[:length])
            self._slopes.append(
                np.stack(
                    [
                        (state.curves[j].force_n[:length] - line.force_n[:length]) / step
                        for state, step in zip(moved, steps, strict=True)
                    ]
                )
            )
        self.thickness_slopes = self._scalar_slopes("thickness_m", moved, steps)
        self.volume_slopes = self._scalar_slopes("fluid_volume_m3", moved, steps)

    def _scalar_slopes(
        self, name: str, moved: Sequence[SimulatedPoint], steps: list[float]
    ) -> Floats:
        start = getattr(self.base, name)
        return np.array([(getattr(s, name) - start) / d for s, d in zip(moved, steps, strict=True)])

    def curves(self, shift: Floats) -> list[ForceCurve]:
        """Curves at the base point times exp(shift), at the modulus of the runs."""
        return [
            ForceCurve(travel, force + np.tensordot(shift, slopes, axes=1))
            for travel, force, slopes in zip(self._travel, self._force, self._slopes, strict=True)
        ]

    def thickness_m(self, shift: Floats) -> float:
        """Total thickness at the base point times exp(shift) [m]."""
        return float(self.base.thickness_m + self.thickness_slopes @ shift)

    def cost(self, shift: Floats, log_modulus: float) -> float:
        """Cost there [N]; infinite if a case cannot be compared."""
        return self._cost(shift, log_modulus, self.thickness_m(shift))

    def force_cost(self, shift: Floats, log_modulus: float) -> float:
        """Cost there without the thickness term [N]; infinite if a case cannot be compared."""
        return self._cost(shift, log_modulus, self.settings.target_thickness_m)

    def _cost(self, shift: Floats, log_modulus: float, thickness_m: float) -> float:
        factor = math.exp(log_modulus) / self.settings.reference_shear_modulus_pa
        return force_and_thickness_cost(
            self.curves(shift), self.cases, factor, thickness_m, self.settings
        )

    def simulated(self, shift: Floats, log_modulus: float) -> list[ForceCurve]:
        """Curves there, at that modulus."""
        factor = math.exp(log_modulus) / self.settings.reference_shear_modulus_pa
        return [line.scaled(factor) for line in self.curves(shift)]

    def residuals(self, shift: Floats, log_modulus: float) -> Floats:
        """Simulation minus measurement of all samples of all cases [N], shape (N, 3).

        Raises:
            AlignmentError: One does not reach the threshold force.
        """
        parts = []
        for line, case in zip(self.simulated(shift, log_modulus), self.cases, strict=True):
            pair = compare(line, case, 1.0, self.settings)
            parts.append(pair.simulated_n - pair.measured_n)
        return np.concatenate(parts)

    def slopes(self, shift: Floats, log_modulus: float) -> Floats:
        """Slopes of the residuals in all logarithms, the modulus last [N], shape (N, 3, P).

        Raises:
            AlignmentError: One does not reach the threshold force.
        """
        columns = []
        for i in range(len(shift) + 1):
            step = np.zeros(len(shift) + 1)
            step[i] = _LOG_STEP
            ahead = self.residuals(shift + step[:-1], log_modulus + step[-1])
            behind = self.residuals(shift - step[:-1], log_modulus - step[-1])
            columns.append((ahead - behind) / (2 * _LOG_STEP))
        return np.stack(columns, axis=-1)


def curvature(slopes: Floats, residuals: Floats) -> tuple[Floats, Floats]:
    """Gauss-Newton curvature (P, P) of the force cost, and the weight of each axis (3,).

    The weight is the derivative of an axis' RMS by its summed squares, times two.
    """
    rms = np.maximum(np.sqrt((residuals**2).mean(axis=0)), _LEAST_RMS_N)
    weight = 1.0 / (len(residuals) * rms)
    return np.einsum("nai,naj,a->ij", slopes, slopes, weight), weight


_ROUNDS = 6
_ENOUGH = 1e-6
"""A round that gains less than this part of the cost is the last one."""
_FLATTEST = 1e-8
"""Directions with less than this part of the greatest curvature are not stretched further."""


def minimise(model: LocalModel, log_modulus: float, reach: Floats) -> tuple[Floats, float]:
    """Minimise the cost over the logarithms of all parameters together.

    Thickness and modulus have nearly the same effect, so the cost is a long valley. SLSQP starts
    with a curvature of one in every direction and stalls in it. So it works in coordinates in which
    the Gauss-Newton curvature is one; where it ends, it starts again with the curvature there.

    Args:
        model: Model built at the starting point.
        log_modulus: Logarithm of the modulus at the start.
        reach: Largest change of the logarithm of each simulated parameter.

    Returns:
        Change of the logarithms of the simulated parameters, and the cost there [N].
    """
    at = np.append(np.zeros(len(reach)), log_modulus)
    cost = model.cost(at[:-1], at[-1])
    for _ in range(_ROUNDS):
        try:
            new = _round(model, at, reach)
        except AlignmentError:  # no slopes exist at the edge of what can be compared
            break
        new_cost = model.cost(new[:-1], new[-1])
        if new_cost >= cost * (1.0 - _ENOUGH):
            break
        at, cost = new, new_cost
    return at[:-1], cost


def _round(model: LocalModel, start: Floats, reach: Floats) -> Floats:
    """One run of SLSQP from logarithms ``start``, the modulus last; returns where it ends."""
    settings, count = model.settings, len(start)
    hessian, _ = curvature(
        model.slopes(start[:-1], start[-1]), model.residuals(start[:-1], start[-1])
    )
    # Coordinates w with logarithms = start + stretch @ w have unit curvature at the start.
    bend, directions = np.linalg.eigh(hessian)
    stretch = directions / np.sqrt(np.maximum(bend, max(_FLATTEST * bend[-1], 1e-300)))
    low, high = _limits(model, reach)
    worst = 10.0 * model.force_cost(start[:-1], start[-1]) + 1.0

    def logs(w: Floats) -> Floats:
        return np.asarray(np.clip(start + stretch @ w[:count], low, high))

    def force_cost(w: Floats) -> float:
        v = logs(w)
        # SLSQP's line search recovers from a high cost, but not from infinity.
        return min(model.force_cost(v[:-1], v[-1]), worst)

    constraints: list[dict[str, Any]] = [
        {
            "type": "ineq",
            "fun": lambda w: np.concatenate(
                [start + stretch @ w[:count] - low, high - start - stretch @ w[:count]]
            ),
        }
    ]
    begin = np.zeros(count)
    objective = force_cost
    if settings.volume_is_free:
        # |thickness error| has its kink at the optimum, so one more unknown bounds it from above.
        weight = settings.weights.thickness

        def error(w: Floats) -> float:
            v = start + stretch @ w[:count]
            return weight * (model.thickness_m(v[:-1]) - settings.target_thickness_m)

        constraints.append({"type": "ineq", "fun": lambda w: w[-1] - error(w)})
        constraints.append({"type": "ineq", "fun": lambda w: w[-1] + error(w)})
        begin = np.append(begin, abs(error(begin)))

        def objective(w: Floats) -> float:
            return force_cost(w) + float(w[-1])

    found = minimize(
        objective,
        begin,
        method="SLSQP",
        jac="3-point",
        constraints=constraints,
        options={"ftol": 1e-9, "maxiter": 100},
    )
    return logs(found.x) if math.isfinite(found.fun) else start


def _limits(model: LocalModel, reach: Floats) -> tuple[Floats, Floats]:
    """Bounds of the logarithms: those of the parameters, and the reach of the model."""
    settings = model.settings
    low, high = np.transpose(
        [settings.log_bounds(name) for name in (*settings.simulated, MODULUS)]
    ).copy()
    base = np.log(model.base.point)
    low[:-1] = np.maximum(low[:-1] - base, -reach)
    high[:-1] = np.minimum(high[:-1] - base, reach)
    return low, high


_FORCE_STEP_N = 1e-4
_AT_BOUND = 1e-3
"""A parameter closer to a bound than this part of its logarithmic range is at the bound."""
_BLIND = 1e-8
"""In directions with less than this part of the greatest curvature, the data determine nothing."""


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """One calibrated parameter.

    Attributes:
        name: Of the parameter.
        value: Found value [SI].
        sd: One standard deviation from noise alone; infinite if the data do not determine it, NaN
            if it stopped at a bound.
        sensitivity_n: Change of the force for a change of 1 %: sum over the axes of the RMS [N].
        lower: Its lower bound.
        upper: Its upper bound.
        at_bound: Whether it stopped at a bound.
    """

    name: str
    value: float
    sd: float
    sensitivity_n: float
    lower: float
    upper: float
    at_bound: bool


def estimates(
    model: LocalModel, shift: Floats, log_modulus: float
) -> tuple[ParameterEstimate, ...]:
    """Values and uncertainties of all parameters at a point of a local model.

    Args:
        model: Model built close to the optimum.
        shift: Change of the logarithms of the simulated parameters from its base.
        log_modulus: Logarithm of the modulus.
    """
    settings = model.settings
    names = (*settings.simulated, MODULUS)
    logs = np.append(np.log(model.base.point) + shift, log_modulus)
    limits = [settings.log_bounds(name) for name in names]
    at_bound = [
        bool(min(log - low, high - log) < _AT_BOUND * (high - low))
        for log, (low, high) in zip(logs, limits, strict=True)
    ]
    slopes, residuals = model.slopes(shift, log_modulus), model.residuals(shift, log_modulus)
    free = [i for i, stopped in enumerate(at_bound) if not stopped]
    variance = np.full(len(names), np.nan)
    variance[free] = _variance(model, slopes, residuals, free, log_modulus, shift)
    result = []
    for i, name in enumerate(names):
        value = settings.bounded(name, logs[i])
        sensitivity = 0.01 * float(np.sqrt((slopes[:, :, i] ** 2).mean(axis=0)).sum())
        low, high = settings.bounds[name]
        sd = value * float(np.sqrt(variance[i]))
        result.append(ParameterEstimate(name, value, sd, sensitivity, low, high, at_bound[i]))
    return tuple(result)


def _variance(
    model: LocalModel,
    slopes: Floats,
    residuals: Floats,
    free: Sequence[int],
    log_modulus: float,
    shift: Floats,
) -> Floats:
    """Variance of the logarithms of the free parameters; infinite if not determined."""
    slopes = slopes[:, :, free]
    hessian, weight = curvature(slopes, residuals)

    # A free volume is tied to the target thickness, so only directions along it remain.
    basis = np.eye(len(free))
    along = np.append(model.thickness_slopes, 0.0)[free]
    if model.settings.volume_is_free and np.abs(along).max(initial=0.0) > 0.0:
        basis = null_space(along[None])
    bend, directions = np.linalg.eigh(basis.T @ hessian @ basis)
    seen = bend > _BLIND * max(float(bend.max(initial=0.0)), 1e-300)
    directions = basis @ directions
    inverse = directions[:, seen] / bend[seen]

    # Delta method: the optimum moves by -H^-1 times the change of the gradient.
    carried = _noise(model, slopes, weight, residuals, log_modulus, shift)
    gradient_cov = carried.T @ carried
    half = inverse @ directions[:, seen].T
    variance = np.asarray(np.diag(half @ gradient_cov @ half.T)).copy()
    blind = np.abs(directions[:, ~seen]).max(axis=1, initial=0.0) > 1e-3
    variance[blind] = np.inf
    return variance


def _noise(
    model: LocalModel,
    slopes: Floats,
    weight: Floats,
    residuals: Floats,
    log_modulus: float,
    shift: Floats,
) -> Floats:
    """Gradient of the cost by each raw sample, times that sample's noise; shape (samples, P).

    The noise is one number for all axes: the one that explains the residuals after alignment.
    """
    settings, start = model.settings, 0
    gradients, explained = [], 0.0
    for ours, case in zip(model.simulated(shift, log_modulus), model.cases, strict=True):
        part = slice(start, start + settings.increments)
        start += settings.increments
        for change in _sample_effects(ours, case, settings):
            gradients.append(np.einsum("na,nai,a->i", change, slopes[part], weight))
            explained += float((change**2).sum())
    noise_n = math.sqrt(float((residuals**2).sum()) / max(explained, 1e-300))
    return np.stack(gradients) * noise_n


def _sample_effects(
    ours: ForceCurve, case: CalibrationCase, settings: CalibrationSettings
) -> list[Floats]:
    """Derivative of the residuals by each raw force value, each of shape (increments, 3)."""
    effects = []
    pair = compare(ours, case, 1.0, settings)
    before = pair.simulated_n - pair.measured_n
    # The last sample below the threshold is the first one that matters.
    first = max(int(np.searchsorted(case.whole.travel_m, case.contact.travel_m[0])) - 1, 0)
    for row in range(first, len(case.whole.travel_m)):
        for axis in range(3):
            force = case.whole.force_n.copy()
            force[row, axis] += _FORCE_STEP_N
            try:
                moved = CalibrationCase.of_curve(
                    case.item, ForceCurve(case.whole.travel_m, force), settings
                )
                pair = compare(ours, moved, 1.0, settings)
            except AlignmentError:
                continue
            effects.append((pair.simulated_n - pair.measured_n - before) / _FORCE_STEP_N)
    return effects
