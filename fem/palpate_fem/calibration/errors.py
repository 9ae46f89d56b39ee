"""How well a calibration knows its parameters: Gauss-Newton covariance, with the noise's own way.

Noise reaches the cost not only sample by sample: where the measured curve crosses the threshold is
noisy too, and moves the whole curve. So the noise is carried from the raw samples through the
alignment (by differences), and then through the stationarity of the cost. First order only: in 65
repetitions on a formula in place of the solver the spread was 1.2 to 1.3 times the stated one. What
no repetition shows, such as a wrong model or a wrong registration, is not in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from palpate_fem.calibration.align import Curve, Floats, Unalignable
from palpate_fem.calibration.local import LocalModel, curvature
from palpate_fem.calibration.model import Case, compare
from palpate_fem.calibration.settings import MODULUS, CalibrationSettings

_FORCE_STEP_N = 1e-4
_AT_BOUND = 1e-3
"""A parameter within this part of its logarithmic range of a bound is at the bound."""
_BLIND = 1e-8
"""Curvature below this part of the greatest: the data say nothing about that direction."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """One calibrated parameter.

    Attributes:
        name: Of the parameter.
        value: Found value [SI].
        sd: One standard deviation from the noise alone; infinite if the data do not determine it,
            NaN if it stopped at a bound.
        sensitivity_n: Change of the force when it changes by 1 %: sum of the axes' RMS [N].
        lower: Its bound.
        upper: Its bound.
        at_bound: Whether it stopped there.
    """

    name: str
    value: float
    sd: float
    sensitivity_n: float
    lower: float
    upper: float
    at_bound: bool


def estimates(model: LocalModel, shift: Floats, log_modulus: float) -> tuple[Estimate, ...]:
    """Values and uncertainties of all parameters at a point of a local model.

    Args:
        model: Built close to the optimum.
        shift: Logarithms of the simulated parameters from its base.
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
        value = math.exp(logs[i])
        sensitivity = 0.01 * float(np.sqrt((slopes[:, :, i] ** 2).mean(axis=0)).sum())
        low, high = settings.bounds[name]
        sd = value * float(np.sqrt(variance[i]))
        result.append(Estimate(name, value, sd, sensitivity, low, high, at_bound[i]))
    return tuple(result)


def _variance(
    model: LocalModel,
    slopes: Floats,
    residuals: Floats,
    free: Sequence[int],
    log_modulus: float,
    shift: Floats,
) -> Floats:
    """Variance of the logarithms of the free parameters; infinite where data are blind."""
    slopes = slopes[:, :, free]
    hessian, weight = curvature(slopes, residuals)

    # A free volume follows the thickness target: only directions along it remain.
    basis = np.eye(len(free))
    along = np.append(model.thickness_slopes, 0.0)[free]
    if model.settings.volume_is_free and np.abs(along).max() > 0.0:
        basis = null_space(along[None])
    bend, directions = np.linalg.eigh(basis.T @ hessian @ basis)
    seen = bend > _BLIND * max(float(bend.max(initial=0.0)), 1e-300)
    directions = basis @ directions
    inverse = directions[:, seen] / bend[seen]

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

    The noise, one for all axes, is what explains the residuals after the alignment.
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


def _sample_effects(ours: Curve, case: Case, settings: CalibrationSettings) -> list[Floats]:
    """By how much each raw force value moves the residuals, each (increments, 3) per newton."""
    effects = []
    pair = compare(ours, case, 1.0, settings)
    before = pair.simulated_n - pair.measured_n
    # the last sample below the threshold is the first that matters
    first = max(int(np.searchsorted(case.whole.travel_m, case.contact.travel_m[0])) - 1, 0)
    for row in range(first, len(case.whole.travel_m)):
        for axis in range(3):
            force = case.whole.force_n.copy()
            force[row, axis] += _FORCE_STEP_N
            try:
                moved = Case.of_curve(case.item, Curve(case.whole.travel_m, force), settings)
                pair = compare(ours, moved, 1.0, settings)
            except Unalignable:
                continue
            effects.append((pair.simulated_n - pair.measured_n - before) / _FORCE_STEP_N)
    return effects
