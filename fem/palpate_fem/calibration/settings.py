"""Settings of a calibration: parameters, bounds, weights and search."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from palpate.errors import ConfigError
from palpate_fem.arrays import Floats
from palpate_fem.calibration.alignment import (
    INCREMENTS,
    TARGET_THICKNESS_M,
    THRESHOLD_N,
    CostWeights,
)
from palpate_fem.config import LIMITS, FingertipParameters

THICKNESS, MODULUS, FRICTION, VOLUME = (
    "skin_thickness_m",
    "shear_modulus_pa",
    "friction_coefficient",
    "fluid_volume_m3",
)

PAPER_BOUNDS = {THICKNESS: (1e-3, 2e-3), MODULUS: (1e5, 1e6), FRICTION: (0.1, 1.0)}
"""Bounds of the paper (table "Optimization parameters")."""

STEPS = {THICKNESS: 0.02, FRICTION: 0.1, VOLUME: 0.02}
"""Relative steps of the finite differences. They are far above the ripple that a mesh causes in a
force, which is smooth in thickness and volume, and nearly linear in friction while the indenter
slips."""


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """How to calibrate.

    Attributes:
        bounds: Lower and upper bound by name of the parameter. With bounds for ``fluid_volume_m3``
            the volume is free, and the thickness term of the cost determines it. Without, the
            simulator fills in what the target thickness needs; the optimum is the same.
        weights: Weights of the cost.
        target_thickness_m: Required total thickness [m].
        threshold_n: Force at which curves are aligned [N].
        increments: Samples of a curve.
        fit_offsets: Whether each measured curve may be shifted along the path to where it fits
            best. Noise of 0.05 N moves the crossing of 0.5 N by up to 0.1 mm, and all samples with
            it; more samples do not average that out, a shift undoes it. False = the paper's
            alignment.
        least_coverage: Smallest part of the measured displacement that a simulated curve must cover
            to be compared; without it, shorter and shorter curves would fit better and better.
        scan: Points of the coarse scan in thickness and friction.
        iterations: Largest number of steps after the scan.
        reference_shear_modulus_pa: Modulus of all runs [Pa]; forces scale with it exactly.
    """

    bounds: dict[str, tuple[float, float]] = field(default_factory=lambda: dict(PAPER_BOUNDS))
    weights: CostWeights = field(default_factory=CostWeights)
    target_thickness_m: float = TARGET_THICKNESS_M
    threshold_n: float = THRESHOLD_N
    increments: int = INCREMENTS
    fit_offsets: bool = True
    least_coverage: float = 0.5
    scan: tuple[int, int] = (3, 2)
    iterations: int = 8
    reference_shear_modulus_pa: float = 2.8e5

    def __post_init__(self) -> None:
        for name in PAPER_BOUNDS:
            if name not in self.bounds:
                raise ConfigError(f"no bounds for {name}", remedy="give lower and upper bound")
        for name, (low, high) in self.bounds.items():
            if name not in (*PAPER_BOUNDS, VOLUME):
                raise ConfigError(
                    f"{name!r} cannot be calibrated",
                    remedy=f"bounds are for {', '.join((*PAPER_BOUNDS, VOLUME))}",
                )
            least, most = LIMITS[name]
            if not (0.0 < low < high and least <= low and high <= most):
                raise ConfigError(
                    f"bounds of {name}: [{low:g}, {high:g}]",
                    remedy=f"give positive, increasing bounds within [{least:g}, {most:g}]",
                )
        if min(self.scan) < 1 or self.iterations < 1 or self.increments < 2:
            raise ConfigError(
                f"scan {self.scan}, {self.iterations} iterations, {self.increments} increments",
                remedy="give at least one, one and two",
            )
        if not (0.0 < self.least_coverage <= 1.0 and self.threshold_n > 0.0):
            raise ConfigError(
                f"least coverage {self.least_coverage}, threshold {self.threshold_n} N",
                remedy="give a share of 1 and a positive force",
            )
        self.parameters(self.middle())  # refuses a thickness and a modulus out of range

    @property
    def volume_is_free(self) -> bool:
        """Whether the fluid's volume is a parameter of the search."""
        return VOLUME in self.bounds

    @property
    def simulated(self) -> tuple[str, ...]:
        """Parameters that need runs, in the order of a point; the modulus never does."""
        return (THICKNESS, FRICTION, VOLUME) if self.volume_is_free else (THICKNESS, FRICTION)

    def log_bounds(self, name: str) -> tuple[float, float]:
        """Bounds of the logarithm of a parameter."""
        low, high = self.bounds[name]
        return math.log(low), math.log(high)

    def bounded(self, name: str, log_value: float) -> float:
        """A parameter by its logarithm, within its bounds also in the last digit."""
        low, high = self.bounds[name]
        return min(max(math.exp(log_value), low), high)

    def parameters(self, point: Floats, modulus_pa: float | None = None) -> FingertipParameters:
        """The finger at a point.

        Args:
            point: Values of ``simulated``; a shorter one leaves the volume to the thickness.
            modulus_pa: Its modulus; None = the one of the runs.
        """
        volume = float(point[2]) if len(point) > 2 else None
        return FingertipParameters(
            skin_thickness_m=float(point[0]),
            shear_modulus_pa=modulus_pa or self.reference_shear_modulus_pa,
            friction_coefficient=float(point[1]),
            total_thickness_m=self.target_thickness_m,
            fluid_volume_m3=volume,
        )

    def middle(self) -> Floats:
        """Point in the middle of the bounds of thickness and friction, in the logarithm."""
        return np.exp([0.5 * sum(self.log_bounds(name)) for name in (THICKNESS, FRICTION)])

    def scan_points(self) -> list[Floats]:
        """Points of the coarse scan, even in the logarithm, half a step from the bounds."""
        axes = []
        for name, count in zip((THICKNESS, FRICTION), self.scan, strict=True):
            low, high = self.log_bounds(name)
            axes.append(np.exp(low + (high - low) * (np.arange(count) + 0.5) / count))
        return [np.array([thickness, friction]) for thickness in axes[0] for friction in axes[1]]
