"""How two indentations are compared: the paper's data processing and cost, as pure functions.

Alignment (paper, "Experimental data processing" and "Experimental and simulation data processing"):
force below 0.5 N is noise and is left out; the point of exactly 0.5 N is interpolated and starts
the curve; both curves end at the smaller final displacement, counted from there; both are
interpolated at the ends of 20 even increments. The start itself is no sample: both forces are 0.5 N
there by construction, so it would only flatter the error. Aligning at 0.5 N hides by how much one
of them touches earlier: ``AlignedCurves.depth_offset_m``.

Cost (paper, equation "cost_function"): J = w1 J_force + w2 J_thick. J_force is the sum over the
axes of the RMS over all samples (sensors x steps), J_thick the thickness minus 15.1 mm. The paper
writes that difference with its sign, which would reward a finger that is too thin; here it is the
absolute value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from palpate.errors import DatasetError
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats

THRESHOLD_N = 0.5
"""Force at which curves begin [N] (paper, "Experimental data processing", step 3)."""
INCREMENTS = 20
"""Even displacement increments (paper, "Experimental and simulation data processing", step 5)."""
_LARGEST_SHIFT_M = 0.3e-3
"""Largest fitted shift [m]: three times the shift by noise of 0.05 N where the force rises by
0.5 N/mm."""
_SHIFT_DONE_M = 1e-8
_SHIFTS = 12
_SAME_PLACE_M = 1e-9
"""Poses closer than this are one place: the indenter was held. Robots repeat to 2e-5 m."""


class AlignmentProblem(StrEnum):
    """Why two curves cannot be compared."""

    TOO_SHORT = "has fewer than two samples"
    NEVER_REACHES = "never reaches the threshold force"
    STARTS_ABOVE = "begins above the threshold force"
    NOTHING_BEYOND = "ends where it reaches the threshold force"


class AlignmentError(DatasetError):
    """Two curves cannot be compared.

    Args:
        side: Which curve is unsuitable: ``"simulation"`` or ``"measurement"``.
        reason: Why it is.
        threshold_n: Force at which curves begin [N].
    """

    def __init__(self, side: str, reason: AlignmentProblem, threshold_n: float) -> None:
        super().__init__(
            f"the {side} {reason} ({threshold_n:g} N)",
            remedy="leave this trajectory out, or record it from above the skin and deeper",
        )
        self.side = side
        self.reason = reason


@dataclass(frozen=True, slots=True)
class ForceCurve:
    """Net force against the travel of the indenter.

    Attributes:
        travel_m: Path length since the first pose [m], increasing, shape (K,).
        force_n: Net force on the BioTac [N], sensor frame, shape (K, 3).
    """

    travel_m: Floats
    force_n: Floats

    def begins_at(self, threshold_n: float) -> bool:
        """Whether the first sample has exactly this force, because the curve was cut there."""
        return bool(abs(np.linalg.norm(self.force_n[0]) - threshold_n) < 1e-9 * threshold_n)

    def scaled(self, factor: float) -> ForceCurve:
        """The same curve with ``factor`` times the force."""
        return ForceCurve(self.travel_m, self.force_n * factor)


@dataclass(frozen=True, slots=True)
class AlignedCurves:
    """Two curves at common samples; N = number of increments.

    Attributes:
        displacement_m: Since each curve's own threshold force [m], shape (N,).
        simulated_n: Simulated force [N], shape (N, 3).
        measured_n: Measured force [N], shape (N, 3).
        depth_offset_m: Travel at the threshold, simulation minus measurement [m]: positive if the
            simulation touches later, that is deeper. The comparison of forces does not see it.
        coverage: Common displacement as a part of the measured one; below 1 the simulation stopped
            early or touched late.
    """

    displacement_m: Floats
    simulated_n: Floats
    measured_n: Floats
    depth_offset_m: float
    coverage: float


def curve(path: Floats, force_n: Floats) -> ForceCurve:
    """Curve of a trajectory; shorter than its path if the trajectory stopped early.

    Args:
        path: Poses of the indenter, shape (K, 7).
        force_n: Net force at the first k <= K of them [N], shape (k, 3).
    """
    return along(path_lengths(path)[: len(force_n)], force_n)


def along(travel_m: Floats, force_n: Floats) -> ForceCurve:
    """Curve of samples.

    Of several at one place the last counts, as in the paper ("the final time step of each 0.1 mm
    displacement increment").

    Args:
        travel_m: Path length at each sample [m], not decreasing, shape (K,).
        force_n: Net force there [N], shape (K, 3).
    """
    last = np.append(np.diff(travel_m) > _SAME_PLACE_M, True)[: len(travel_m)]
    return ForceCurve(travel_m[last], np.asarray(force_n, np.float64)[last])


def from_contact(whole: ForceCurve, *, side: str, threshold_n: float = THRESHOLD_N) -> ForceCurve:
    """The part of a curve from exactly the threshold force on.

    Noise may lift single samples over the threshold before contact. So the curve begins at the last
    crossing before its greatest force; later samples below the threshold are left out.

    Args:
        whole: The curve, starting before contact.
        side: Name for the error.
        threshold_n: Force at which it begins [N].

    Raises:
        AlignmentError: It never reaches the threshold, or begins above it.
    """
    magnitude = np.sqrt(np.einsum("ki,ki->k", whole.force_n, whole.force_n))
    if len(magnitude) < 2:
        raise AlignmentError(side, AlignmentProblem.TOO_SHORT, threshold_n)
    peak = int(magnitude.argmax())
    if magnitude[peak] < threshold_n:
        raise AlignmentError(side, AlignmentProblem.NEVER_REACHES, threshold_n)
    # From the peak backwards, so that noise before contact is not taken for the crossing.
    below = np.flatnonzero(magnitude[:peak] < threshold_n)
    if whole.begins_at(threshold_n):
        return whole
    if not len(below):
        raise AlignmentError(side, AlignmentProblem.STARTS_ABOVE, threshold_n)
    before = int(below[-1])
    share = _share_to(whole.force_n[before], whole.force_n[before + 1], threshold_n)
    keep = np.flatnonzero(magnitude[before + 1 :] >= threshold_n) + before + 1
    start_m = whole.travel_m[before] + share * np.diff(whole.travel_m[before : before + 2])[0]
    start_n = whole.force_n[before] + share * np.diff(whole.force_n[before : before + 2], axis=0)[0]
    # A sample exactly at the threshold is the start itself; it must not be counted twice.
    keep = keep[whole.travel_m[keep] > start_m + _SAME_PLACE_M]
    return ForceCurve(
        np.concatenate([[start_m], whole.travel_m[keep]]),
        np.concatenate([start_n[None], whole.force_n[keep]]),
    )


def align(
    simulated: ForceCurve,
    measured: ForceCurve,
    *,
    threshold_n: float = THRESHOLD_N,
    increments: int = INCREMENTS,
    fit_offset: bool = False,
) -> AlignedCurves:
    """Bring a simulated and a measured curve of the same path to the same samples.

    Args:
        simulated: Starting before contact.
        measured: Starting before contact, or at the threshold force.
        threshold_n: Force at which both begin [N].
        increments: Even increments of the common displacement.
        fit_offset: Shift the simulation to where the forces agree best. Noise moves the point where
            the measured curve crosses the threshold, and every sample with it; the shift undoes
            that. The paper does not do it.

    Raises:
        AlignmentError: One of them never reaches the threshold, begins above it, or ends there.
    """
    ours = from_contact(simulated, side="simulation", threshold_n=threshold_n)
    theirs = from_contact(measured, side="measurement", threshold_n=threshold_n)
    for side, part in (("simulation", ours), ("measurement", theirs)):
        if part.travel_m[-1] <= part.travel_m[0]:
            raise AlignmentError(side, AlignmentProblem.NOTHING_BEYOND, threshold_n)
    start_m = float(ours.travel_m[0])
    if fit_offset:
        start_m += _best_shift(simulated, start_m, theirs, increments)
    displacement, coverage = _common(simulated, start_m, theirs, increments)
    measured_start_m = float(theirs.travel_m[0])
    return AlignedCurves(
        displacement,
        _at(simulated, start_m + displacement)[0],
        _at(theirs, measured_start_m + displacement)[0],
        start_m - measured_start_m,
        coverage,
    )


def _common(
    simulated: ForceCurve, start_m: float, measured: ForceCurve, increments: int
) -> tuple[Floats, float]:
    """Common displacements [m], shape (increments,), and their part of the measured one."""
    length = float(measured.travel_m[-1] - measured.travel_m[0])
    common = min(float(simulated.travel_m[-1]) - start_m, length)
    return common * np.arange(1, increments + 1) / increments, common / length


def _best_shift(
    simulated: ForceCurve, start_m: float, measured: ForceCurve, increments: int
) -> float:
    """Shift of the simulation's start with the least squared difference of the forces [m].

    Gauss-Newton in one unknown. The curves are piecewise linear, so it may alternate between two
    pieces, a fraction of a micrometre apart.
    """
    shift, most = 0.0, min(_LARGEST_SHIFT_M, 0.5 * float(simulated.travel_m[-1] - start_m))
    for _ in range(_SHIFTS):
        displacement, _ = _common(simulated, start_m + shift, measured, increments)
        force, slope = _at(simulated, start_m + shift + displacement)
        difference = force - _at(measured, measured.travel_m[0] + displacement)[0]
        step = -float(np.vdot(difference, slope) / np.vdot(slope, slope))
        new = min(max(shift + step, -most), most)
        if abs(new - shift) < _SHIFT_DONE_M:
            return new
        shift = new
    return shift


def _at(line: ForceCurve, travel_m: Floats) -> tuple[Floats, Floats]:
    """Force at some travels, linearly interpolated, and its slope [N/m], shapes (N, 3)."""
    way, force = line.travel_m, line.force_n
    before = np.minimum(np.maximum(way.searchsorted(travel_m) - 1, 0), len(way) - 2)
    start = way[before]
    length = way[before + 1] - start
    slope = (force[before + 1] - force[before]) / length[:, None]
    # The last travel may lie beyond the end by a rounding error.
    return force[before] + np.minimum(travel_m - start, length)[:, None] * slope, slope


def _share_to(a: Floats, b: Floats, magnitude: float) -> float:
    """Share s in (0, 1] where |a + s (b - a)| is ``magnitude``, for |a| < magnitude <= |b|.

    Interpolating the magnitude instead would miss the point if the direction changes.
    """
    step = b - a
    square, half, rest = step @ step, a @ step, a @ a - magnitude**2
    # rest < 0, so this root is the positive one; this form does not cancel for half > 0
    root = np.sqrt(half * half - square * rest)
    share = -rest / (half + root) if half > 0 else (root - half) / square
    return min(float(share), 1.0)


TARGET_THICKNESS_M = 15.1e-3
"""Total thickness of the pressurised finger [m], from the manufacturer (paper, SynTouch manual)."""


@dataclass(frozen=True, slots=True)
class CostWeights:
    """Weights of the cost, selected by hand in the paper.

    Attributes:
        force: w1, of the force error in newton.
        thickness: w2 [N/m], of the thickness error in metre.
    """

    force: float = 1.0
    thickness: float = 1e4


def axis_rms_n(pairs: Sequence[AlignedCurves]) -> Floats:
    """RMS force error of each axis over all samples of all pairs [N], shape (3,)."""
    squares = sum((((p.simulated_n - p.measured_n) ** 2).sum(axis=0) for p in pairs), np.zeros(3))
    return np.asarray(np.sqrt(squares / sum(len(p.displacement_m) for p in pairs)))


def rms_n(pair: AlignedCurves) -> float:
    """RMS force error of one trajectory [N]: the sum over its axes, as in the cost."""
    return float(axis_rms_n([pair]).sum())


def peak_n(pair: AlignedCurves) -> float:
    """Greatest measured force magnitude in the compared part of a trajectory [N]."""
    return float(np.linalg.norm(pair.measured_n, axis=1).max())


def relative_rms(pair: AlignedCurves) -> float:
    """RMS force error of one trajectory over its greatest measured force."""
    return rms_n(pair) / peak_n(pair)


def cost(
    pairs: Sequence[AlignedCurves],
    thickness_m: float,
    *,
    weights: CostWeights,
    target_m: float = TARGET_THICKNESS_M,
) -> float:
    """Total cost [N] of simulations against measurements.

    Args:
        pairs: Every compared trajectory.
        thickness_m: Simulated total thickness [m].
        weights: Of force and thickness.
        target_m: Required thickness [m].
    """
    force = float(axis_rms_n(pairs).sum())
    return weights.force * force + weights.thickness * abs(thickness_m - target_m)
