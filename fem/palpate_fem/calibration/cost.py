"""The paper's cost function: how far simulated and measured forces are apart, in newton.

Paper, equation "cost_function": J = w1 J_force + w2 J_thick; J_force is the sum over the axes of
the RMS over all samples (sensors x steps), J_thick the thickness minus 15.1 mm. The paper writes
that difference with its sign, which would pay for a finger that is too thin; here it is the
absolute value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpate_fem.calibration.align import Aligned, Floats

TARGET_THICKNESS_M = 15.1e-3
"""Total thickness of the pressurised finger [m], the manufacturer's (paper, SynTouch manual)."""


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of the cost, hand-selected in the paper.

    Attributes:
        force: w1, of the force error in newton.
        thickness: w2 [N/m], of the thickness error in metre.
    """

    force: float = 1.0
    thickness: float = 1e4


def axis_rms_n(pairs: Sequence[Aligned]) -> Floats:
    """RMS force error of each axis over all samples of all pairs [N], shape (3,)."""
    squares = sum((((p.simulated_n - p.measured_n) ** 2).sum(axis=0) for p in pairs), np.zeros(3))
    return np.asarray(np.sqrt(squares / sum(len(p.displacement_m) for p in pairs)))


def rms_n(pair: Aligned) -> float:
    """RMS force error of one trajectory [N]: the sum of its axes', as in the cost."""
    return float(axis_rms_n([pair]).sum())


def peak_n(pair: Aligned) -> float:
    """Greatest measured force magnitude in the compared part of a trajectory [N]."""
    return float(np.linalg.norm(pair.measured_n, axis=1).max())


def relative_rms(pair: Aligned) -> float:
    """RMS force error of one trajectory over its greatest measured force."""
    return rms_n(pair) / peak_n(pair)


def thickness_error_m(thickness_m: float, target_m: float = TARGET_THICKNESS_M) -> float:
    """Absolute error of the total thickness [m]."""
    return abs(thickness_m - target_m)


def cost(
    pairs: Sequence[Aligned],
    thickness_m: float,
    *,
    weights: Weights,
    target_m: float = TARGET_THICKNESS_M,
) -> float:
    """Total cost [N] of simulations against measurements.

    Args:
        pairs: Every compared trajectory.
        thickness_m: Simulated total thickness [m].
        weights: Of force and thickness.
        target_m: Thickness to reach [m].
    """
    force = float(axis_rms_n(pairs).sum())
    return weights.force * force + weights.thickness * thickness_error_m(thickness_m, target_m)
