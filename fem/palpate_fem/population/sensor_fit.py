"""A specimen fitted to one real sensor: to its counts at rest and to a few touches with force.

The place of a touch and its indenter are not measured. So the fit goes to and fro (an
expectation-maximisation): with the present specimen, each simulated press of a library gets the
probability that it was this touch, from the electrodes and from the direction of the force; with
these probabilities the specimen is fitted by Gauss-Newton steps, whose derivatives the film gives
exactly (`electrodes.sensitivity`). Priors of the parameters are part of the residuals, so what the
touches do not say stays at the prior.

Three things belong to the touches and not to the specimen, and are estimated with it: each touch's
warmth, because the core warms up after the rest was taken; where the recording was touched, given
the force; and the deviation of the electrodes from the nearest press, because none is the real one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from palpate.errors import DatasetError
from palpate_fem.electrodes.gap import Gap
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.sensitivity import AXES, counts_by_parameters
from palpate_fem.electrodes.specimen import LIMITS, LOG_SD, SENSING, SpecimenParameters
from palpate_fem.population.explain import (
    ANGLE_SD_RAD,
    SPREAD,
    Explanation,
    TouchExplainer,
    TouchPrior,
)
from palpate_fem.population.members import (
    CLAMP_CLOSING,
    CORE_FORWARD_M,
    CORE_SIDEWAYS_SD_M,
    CORE_UP_M,
    SERIES_OHM,
    SIDE_CLOSING_M,
    SIGMA_LOG_SD,
    SIGMA_S_M,
    Member,
)
from palpate_fem.population.press_library import Candidates, PressLibrary
from palpate_fem.population.touches import SensorTouches

Floats = NDArray[np.float64]
OnRound = Callable[[int, float], None]

REST_SPREAD = 50.0
"""Deviation of counts at rest [counts], if that of touches is not smaller: what fits leave of real
ones (docs/results/twin/units.md)."""
KEPT, LEAST_SHARE = 4, 0.02
"""Presses for each touch that a fit of the specimen uses: how many at most, and how probable each
must be over the most probable one. Probabilities themselves fall with the size of the library."""

MOST_ANGLE_RAD = 3 * ANGLE_SD_RAD
"""Between the forces of touches and those of the nearest presses, median: those of a real sensor
are off by 10 degrees, with the wrong sign by 110."""


@dataclass(frozen=True, slots=True)
class ParameterPrior:
    """A normal prior on a parameter or on its logarithm, cut off at limits.

    Attributes:
        name: As in `SpecimenParameters`, or one of ``core_x_m``, ``core_y_m``, ``core_z_m``.
        centre: Mean, in the parameter's unit.
        sd: Standard deviation, of the logarithm if ``log``.
        low: Limit, in the parameter's unit.
        high: Limit.
        log: Whether the logarithm is normal.
    """

    name: str
    centre: float
    sd: float
    low: float
    high: float
    log: bool = False

    def value(self, scaled: float) -> float:
        """Parameter at so many standard deviations from the centre, within the limits."""
        shift = self.sd * scaled
        raw = self.centre * math.exp(shift) if self.log else self.centre + shift
        return min(max(raw, self.low), self.high)

    def scaled(self, value: float) -> float:
        """The inverse of `value`."""
        raw = math.log(value / self.centre) if self.log else value - self.centre
        return raw / self.sd

    def slope(self, value: float) -> float:
        """Derivative of the parameter by its scaled value, at a parameter."""
        return self.sd * (value if self.log else 1.0)


def _uniform(name: str, ends: tuple[float, float], low: float, high: float) -> ParameterPrior:
    """A normal prior with the mean and the deviation of a uniform one."""
    return ParameterPrior(name, sum(ends) / 2, (ends[1] - ends[0]) / math.sqrt(12), low, high)


PRIORS = (
    ParameterPrior("sigma_s_m", SIGMA_S_M, SIGMA_LOG_SD, *LIMITS["sigma_s_m"], log=True),
    _uniform("series_ohm", SERIES_OHM, *LIMITS["series_ohm"]),
    _uniform("side_closing_m", SIDE_CLOSING_M, *LIMITS["side_closing_m"]),
    _uniform("clamp_closing", CLAMP_CLOSING, *LIMITS["clamp_closing"]),
    _uniform("core_x_m", CORE_FORWARD_M, *LIMITS["core_offset_m"]),
    ParameterPrior("core_y_m", 0.0, CORE_SIDEWAYS_SD_M, *LIMITS["core_offset_m"]),
    _uniform("core_z_m", CORE_UP_M, *LIMITS["core_offset_m"]),
    # A film cannot be thicker between pressed asperities than between loose ones.
    ParameterPrior("asperity_m", 80e-6, LOG_SD["asperity_m"], 20e-6, 300e-6, log=True),
    ParameterPrior("floor_m", 5e-6, LOG_SD["floor_m"], 0.5e-6, 20e-6, log=True),
    ParameterPrior("squeeze_pa", 30e3, LOG_SD["squeeze_pa"], *LIMITS["squeeze_pa"], log=True),
    _uniform("squeeze_exponent", (0.5, 1.0), *LIMITS["squeeze_exponent"]),
)
"""Of the fit: as wide as the specimens of ``palpate fem units draw``."""

ASYMMETRY = ParameterPrior("asymmetry", 1.0, LOG_SD["asymmetry"], *LIMITS["asymmetry"], log=True)
"""Of each electrode's factor, 19 of them."""


def specimen_at(scaled: Floats, start: SpecimenParameters) -> SpecimenParameters:
    """The specimen with parameters in standard deviations of their priors, shape (11 + 19,).

    All others are those of ``start``.
    """
    values: dict[str, Any] = {
        p.name: p.value(float(s)) for p, s in zip(PRIORS, scaled, strict=False)
    }
    core = tuple(values.pop(axis) for axis in AXES)
    asymmetry = tuple(ASYMMETRY.value(float(s)) for s in scaled[len(PRIORS) :])
    return replace(start, **values, core_offset_m=core, asymmetry=asymmetry)


@dataclass(frozen=True)
class SensorFit:
    """A specimen that was fitted to a sensor.

    Attributes:
        specimen: The specimen, with the sensor's name.
        rest_error: Root mean square of the counts at rest minus its own [counts].
        learned: What its touches teach of others of the same recording; None without touches.
        rounds: To and fro.
        angle_rad: Between the force of a touch and that of the nearest press, median; NaN without
            touches.
    """

    specimen: SpecimenParameters
    rest_error: float
    learned: TouchPrior | None
    rounds: int
    angle_rad: float

    @property
    def tells_nothing(self) -> bool:
        """Whether the electrodes are no nearer to the presses than before anything is known."""
        return self.learned is not None and self.learned.spread >= SPREAD

    def member(self, touches: int) -> Member:
        """As a member of a population, with what the fit found."""
        found = {"touches": float(touches), "rest_error_counts": self.rest_error}
        if self.learned is not None:
            found |= {"spread_counts": self.learned.spread, "warmth": self.learned.warmth}
        return Member(self.specimen, None, 0.0, found)


def fit_sensor(
    sensor: ElectrodeModel,
    library: PressLibrary,
    touches: SensorTouches,
    *,
    rounds: int = 10,
    on_round: OnRound | None = None,
) -> SensorFit:
    """Fit a specimen to a sensor's rest and touches.

    Args:
        sensor: Model on the library's fingertip; parameters that are not fitted are its own.
        library: Simulated presses.
        touches: Of the sensor; with none the rest alone is fitted.
        rounds: To and fro, at most; it ends earlier when the spread moves by less than 1 %.
        on_round: Called after each with its number and the spread [counts].

    Raises:
        DatasetError: A force is beyond all presses of the library, or most point elsewhere.
    """
    places = library.candidates(touches.force) if len(touches) else None
    angle_rad = math.nan if places is None else float(np.median(places.angle_rad.min(axis=1)))
    if angle_rad > MOST_ANGLE_RAD:
        raise DatasetError(
            f"{touches.name}: forces point {math.degrees(angle_rad):.0f} degrees away from those of"
            " the nearest simulated presses (median)",
            remedy="give the force on the sensor, not by it, in the sensor frame; or simulate "
            "presses from that side",
        )
    at = _fitted(sensor, library, touches, np.zeros(len(PRIORS) + SENSING), [], REST_SPREAD)

    def explained(places: Candidates, prior: TouchPrior) -> Explanation:
        model = sensor.with_specimen(specimen_at(at, sensor.specimen))
        return TouchExplainer(model, library).explain(touches, prior, places=places)

    learned: TouchPrior | None = None
    done = 0
    if places is not None:
        found = explained(places, TouchPrior())
        for done in range(1, rounds + 1):
            before = found.learned
            at = _fitted(sensor, library, touches, at, _pairs(places, found), before.spread)
            found = explained(places, before)
            if on_round is not None:
                on_round(done, found.learned.spread)
            if abs(found.learned.spread / before.spread - 1) < 0.01:
                break
        learned = found.learned
    specimen = replace(specimen_at(at, sensor.specimen), name=touches.name)
    rest = sensor.with_specimen(specimen).of_gap(library.rest).counts
    error = float(np.sqrt(np.mean((rest - touches.rest) ** 2)))
    return SensorFit(specimen, error, learned, done, angle_rad)


@dataclass(frozen=True, slots=True)
class _Pair:
    """A touch and one of its probable presses, between two states."""

    touch: int
    low: int
    high: int
    share: float
    probability: float
    warmth: float


def _pairs(places: Candidates, found: Explanation) -> list[_Pair]:
    pairs = []
    for n, row in enumerate(found.probability):
        best = np.argsort(-row)[:KEPT]
        best = best[row[best] > LEAST_SHARE * row[best[0]]]
        total = float(row[best].sum())
        pairs += [
            _Pair(
                n,
                int(places.low[n, j]),
                int(places.high[n, j]),
                float(places.share[n, j]),
                float(row[j]) / total,
                float(found.warmth[n, j]),
            )
            for j in best
        ]
    return pairs


def _fitted(
    sensor: ElectrodeModel,
    library: PressLibrary,
    touches: SensorTouches,
    scaled: Floats,
    pairs: list[_Pair],
    spread: float,
) -> Floats:
    """The most probable parameters for touches at known presses, from some on."""
    priors = [*PRIORS, *[ASYMMETRY] * SENSING]
    ends = [(prior.scaled(prior.low), prior.scaled(prior.high)) for prior in priors]
    low, high = np.array(ends).T
    memory: dict[bytes, tuple[Floats, Floats]] = {}

    def both(at: Floats) -> tuple[Floats, Floats]:
        key = at.tobytes()
        if key not in memory:
            memory.clear()  # one point at a time is asked for, first its values, then its slopes
            memory[key] = _residuals(sensor, library, touches, at, pairs, spread)
        return memory[key]

    found = least_squares(
        lambda at: both(at)[0],
        np.clip(scaled, low + 1e-6, high - 1e-6),
        jac=lambda at: both(at)[1],
        bounds=(low, high),
        xtol=1e-3,
        ftol=1e-3,
        max_nfev=30 if not pairs else 8,
    )
    return np.asarray(found.x)


def _residuals(
    sensor: ElectrodeModel,
    library: PressLibrary,
    touches: SensorTouches,
    scaled: Floats,
    pairs: list[_Pair],
    spread: float,
) -> tuple[Floats, Floats]:
    """What is left of rest, touches and priors, in standard deviations; and its derivatives."""
    specimen = specimen_at(scaled, sensor.specimen)
    model = sensor.with_specimen(specimen)

    def answer(gap: Gap, warmth: float) -> tuple[Floats, Floats]:
        response = model.of_gap(gap, log_sigma=warmth)
        return response.counts, _by_scaled(model, specimen, counts_by_parameters(model, response))

    rest, rest_slope = answer(library.rest, 0.0)
    at_rest = min(spread, REST_SPREAD)
    values, slopes = [(rest - touches.rest) / at_rest], [rest_slope / at_rest]
    known: dict[tuple[int, float], tuple[Floats, Floats]] = {}
    for pair in pairs:
        parts = []
        for state in (pair.low, pair.high):
            key = (state, pair.warmth)
            if key not in known:
                known[key] = answer(library.gaps[state], pair.warmth)
            parts.append(known[key])
        (before, before_slope), (after, after_slope) = parts
        weight = math.sqrt(pair.probability) / spread
        tared = (1 - pair.share) * before + pair.share * after - rest
        slope = (1 - pair.share) * before_slope + pair.share * after_slope - rest_slope
        values.append(weight * (tared - touches.tared[pair.touch]))
        slopes.append(weight * slope)
    values.append(scaled)
    slopes.append(np.eye(len(scaled)))
    return np.concatenate(values), np.concatenate(slopes)


def _by_scaled(
    model: ElectrodeModel, specimen: SpecimenParameters, by: dict[str, Floats]
) -> Floats:
    """Derivatives of counts by the scaled parameters, shape (19, 11 + 19)."""
    core = dict(zip(AXES, specimen.core_offset_m, strict=True))
    columns = [
        by[p.name] * p.slope(core[p.name] if p.name in core else getattr(specimen, p.name))
        for p in PRIORS
    ]
    own = by["asymmetry"] * [ASYMMETRY.slope(one) for one in specimen.asymmetry]
    return np.concatenate([np.stack(columns, axis=1), np.diag(own)], axis=1)
