"""The cost at one simulated point, with the best modulus there, which takes no further run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from palpate_fem.arrays import Floats
from palpate_fem.calibration.alignment import (
    AlignedCurves,
    AlignmentError,
    AlignmentProblem,
    ForceCurve,
    align,
    cost,
    curve,
    from_contact,
)
from palpate_fem.calibration.measured import MeasuredIndentation
from palpate_fem.calibration.runs import SimulatedRun
from palpate_fem.calibration.settings import MODULUS, CalibrationSettings

_GRID = 13
"""Moduli that are tried before the search between two of them: steps of 20 % over the bounds."""


@dataclass(frozen=True, slots=True)
class CalibrationCase:
    """A measured trajectory, its whole curve, and the part after the threshold force."""

    item: MeasuredIndentation
    whole: ForceCurve
    contact: ForceCurve

    @classmethod
    def of(cls, item: MeasuredIndentation, settings: CalibrationSettings) -> CalibrationCase:
        """Prepare a trajectory.

        Raises:
            AlignmentError: It does not reach the threshold from below.
        """
        return cls.of_curve(item, curve(item.pose, item.force), settings)

    @classmethod
    def of_curve(
        cls, item: MeasuredIndentation, whole: ForceCurve, settings: CalibrationSettings
    ) -> CalibrationCase:
        """Prepare a trajectory with a different curve."""
        threshold = settings.threshold_n
        return cls(item, whole, from_contact(whole, side="measurement", threshold_n=threshold))


@dataclass(frozen=True, slots=True)
class SimulatedPoint:
    """All runs at one point.

    Attributes:
        point: Values of the simulated parameters.
        curves: One for each case, at the modulus of the runs.
        thickness_m: Total thickness [m].
        fluid_volume_m3: Fluid [m^3].
        reasons: Why each run did not complete; "" = it did.
        curve_slopes: Of each curve by the logarithms of the point, shape (P, K, 3); () = unknown.
        thickness_slopes: Of the total thickness [m], shape (P,).
        volume_slopes: Of the fluid [m^3], shape (P,).
    """

    point: Floats
    curves: tuple[ForceCurve, ...]
    thickness_m: float
    fluid_volume_m3: float
    reasons: tuple[str, ...]
    curve_slopes: tuple[Floats, ...] = ()
    thickness_slopes: Floats | None = None
    volume_slopes: Floats | None = None

    @classmethod
    def of(cls, point: Floats, runs: Sequence[SimulatedRun]) -> SimulatedPoint:
        """From the runs of all cases; refused runs have no thickness."""
        known = [run for run in runs if math.isfinite(run.thickness_m)]
        first = known[0] if known else runs[0]
        plain = cls(
            point,
            tuple(run.curve for run in runs),
            first.thickness_m,
            first.fluid_volume_m3,
            reasons=tuple(run.reason for run in runs),
        )
        slopes = [run.curve_slopes(point) for run in runs]
        found = tuple(slope for slope in slopes if slope is not None)
        if first.slopes is None or len(found) < len(runs):
            return plain
        return replace(
            plain,
            curve_slopes=found,
            thickness_slopes=first.slopes.thickness_m * point,
            volume_slopes=first.slopes.fluid_volume_m3 * point,
        )

    def only(self, kept: Sequence[int]) -> SimulatedPoint:
        """The same without the cases that are not kept."""
        curves = tuple(self.curves[i] for i in kept)
        slopes = tuple(self.curve_slopes[i] for i in kept) if self.curve_slopes else ()
        reasons = tuple(self.reasons[i] for i in kept)
        return replace(self, curves=curves, curve_slopes=slopes, reasons=reasons)


@dataclass(frozen=True, slots=True)
class ModulusFit:
    """The best modulus at one point, and how well it fits.

    Attributes:
        cost: Total cost [N]; infinite if a case cannot be compared.
        modulus_pa: Best modulus [Pa].
        pairs: Aligned curves, one for each case.
        failures: Index of each case that cannot be compared, and why.
    """

    cost: float
    modulus_pa: float
    pairs: tuple[AlignedCurves, ...]
    failures: dict[int, str]


def compare(
    simulated: ForceCurve, case: CalibrationCase, factor: float, settings: CalibrationSettings
) -> AlignedCurves:
    """A simulated curve, scaled by the modulus, against a measured one.

    Raises:
        AlignmentError: It does not reach the threshold.
    """
    return align(
        simulated.scaled(factor),
        case.contact,
        threshold_n=settings.threshold_n,
        increments=settings.increments,
        fit_offset=settings.fit_offsets,
    )


def fit_modulus(
    state: SimulatedPoint, cases: Sequence[CalibrationCase], settings: CalibrationSettings
) -> ModulusFit:
    """Find the modulus that fits the runs of one point best; needs no further run."""
    low, high = settings.log_bounds(MODULUS)
    grid = np.linspace(low, high, _GRID)
    costs = np.array([_cost_at(log, state, cases, settings) for log in grid])
    best = int(costs.argmin())
    if not math.isfinite(costs[best]):
        return ModulusFit(math.inf, math.nan, (), _failures(state, cases, settings, grid))
    if best > 0 and not math.isfinite(costs[best - 1]):
        # The optimum is softer still, but there a case cannot be compared as it ends early.
        softer = math.exp(grid[best - 1])
        return ModulusFit(math.inf, math.nan, (), failures_at(state, cases, softer, settings))
    bracket = (grid[max(best - 1, 0)], grid[min(best + 1, _GRID - 1)])
    worst = 10.0 * float(costs[best]) + 1.0  # parabolic interpolation fails with infinity
    found = minimize_scalar(
        lambda log: min(_cost_at(log, state, cases, settings), worst),
        bounds=bracket,
        method="bounded",
        options={"xatol": 1e-4},
    )
    log, lowest = (found.x, found.fun) if found.fun < costs[best] else (grid[best], costs[best])
    modulus_pa = settings.bounded(MODULUS, log)
    factor = modulus_pa / settings.reference_shear_modulus_pa
    pairs = tuple(
        compare(line, case, factor, settings)
        for line, case in zip(state.curves, cases, strict=True)
    )
    return ModulusFit(float(lowest), modulus_pa, pairs, {})


def failures_at(
    state: SimulatedPoint,
    cases: Sequence[CalibrationCase],
    modulus_pa: float,
    settings: CalibrationSettings,
) -> dict[int, str]:
    """Index of each case that cannot be compared at this modulus, and why."""
    failures = {}
    for i, (line, case) in enumerate(zip(state.curves, cases, strict=True)):
        try:
            pair = compare(line, case, modulus_pa / settings.reference_shear_modulus_pa, settings)
        except AlignmentError as error:
            # A run without steps is refused or fails: that it is short is not why.
            short = error.reason is AlignmentProblem.TOO_SHORT
            failures[i] = (state.reasons[i] if short else "") or error.problem
        else:
            if pair.coverage < settings.least_coverage:
                failures[i] = f"covers {pair.coverage:.0%} of the displacement"
    return failures


def _cost_at(
    log_modulus: float,
    state: SimulatedPoint,
    cases: Sequence[CalibrationCase],
    settings: CalibrationSettings,
) -> float:
    factor = math.exp(log_modulus) / settings.reference_shear_modulus_pa
    return force_and_thickness_cost(state.curves, cases, factor, state.thickness_m, settings)


def force_and_thickness_cost(
    curves: Sequence[ForceCurve],
    cases: Sequence[CalibrationCase],
    factor: float,
    thickness_m: float,
    settings: CalibrationSettings,
) -> float:
    """Cost of scaled curves [N]; infinite if one cannot be compared."""
    pairs = []
    for line, case in zip(curves, cases, strict=True):
        try:
            pairs.append(compare(line, case, factor, settings))
        except AlignmentError:
            return math.inf
        if pairs[-1].coverage < settings.least_coverage:
            return math.inf
    return cost(pairs, thickness_m, weights=settings.weights, target_m=settings.target_thickness_m)


def _failures(
    state: SimulatedPoint,
    cases: Sequence[CalibrationCase],
    settings: CalibrationSettings,
    grid: Floats,
) -> dict[int, str]:
    """Cases that cannot be compared at any modulus, and why not at the stiffest one."""
    at_each = [failures_at(state, cases, math.exp(log), settings) for log in grid]
    always = set(at_each[0]).intersection(*at_each)
    # Each may be comparable alone, but not at a modulus where the others are.
    return {i: at_each[-1][i] for i in sorted(always)} or dict.fromkeys(
        range(len(cases)), "no modulus suits it and the others"
    )
