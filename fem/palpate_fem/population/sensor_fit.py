"""A specimen fitted to one real sensor: to its counts at rest and to a few touches with force.

The place of a touch and its indenter are not measured. So the fit goes to and fro (an
expectation-maximisation): with the present specimen, each simulated press of a library gets the
probability that it was this touch, from the electrodes and from the direction of the force; with
these probabilities the specimen is fitted by Gauss-Newton steps, whose derivatives the film gives
exactly (`electrodes.sensitivity`). Priors of the parameters are part of the residuals, so what the
touches do not say stays at the prior.

Two things belong to the touches and not to the specimen. The core warms up after the rest was
taken, so each touch has its own change of the conductivity, small by its prior. And no simulated
press is the real one: the standard deviation of what is left, the same for all electrodes, is
estimated with the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from palpate.errors import DatasetError
from palpate_fem.electrodes.gap import Gap
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.sensitivity import AXES, counts_by_log_sigma, counts_by_parameters
from palpate_fem.electrodes.specimen import LIMITS, LOG_SD, SENSING, SpecimenParameters
from palpate_fem.population.members import (
    CLAMP_CLOSING,
    CORE_FORWARD_M,
    CORE_SIDEWAYS_SD_M,
    CORE_UP_M,
    SERIES_OHM,
    SIDE_CLOSING_M,
    SIGMA_LOG_SD,
    SIGMA_S_M,
)
from palpate_fem.population.press_library import Candidates, PressLibrary
from palpate_fem.population.touches import SensorTouches

Floats = NDArray[np.float64]
OnRound = Callable[[int, float], None]

WARMTH_SD = 0.06
"""Of ln of the conductivity between rest and a touch: the idle sensor beside rose by up to 9 %."""

ANGLE_SD_RAD = math.radians(20.0)
"""Between the measured and the simulated force: friction differs, and the axes of the real force
are only known by correlation."""

SPREAD = 200.0
"""Deviation of the electrodes that the fit begins with [counts]: broad, so that no press is ruled
out by the specimen that it starts from."""
REST_SPREAD = 50.0
"""Of counts at rest when they are all that is fitted: what fits leave of real ones
(docs/results/twin/units.md)."""
LEAST_SPREAD = 5.0
KEPT = 4
"""Presses for each touch that a fit of the specimen uses, the most probable ones."""


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
        """d parameter / d scaled, at a parameter."""
        return self.sd * (value if self.log else 1.0)


def _uniform(name: str, ends: tuple[float, float], low: float, high: float) -> ParameterPrior:
    """A normal prior with the mean and the deviation of a uniform one."""
    return ParameterPrior(name, sum(ends) / 2, (ends[1] - ends[0]) / math.sqrt(12), low, high)


def _limits(name: str) -> tuple[float, float]:
    return LIMITS[name]


PRIORS = (
    ParameterPrior("sigma_s_m", SIGMA_S_M, SIGMA_LOG_SD, *_limits("sigma_s_m"), log=True),
    _uniform("series_ohm", SERIES_OHM, *_limits("series_ohm")),
    _uniform("side_closing_m", SIDE_CLOSING_M, *_limits("side_closing_m")),
    _uniform("clamp_closing", CLAMP_CLOSING, *_limits("clamp_closing")),
    _uniform("core_x_m", CORE_FORWARD_M, *_limits("core_offset_m")),
    ParameterPrior("core_y_m", 0.0, CORE_SIDEWAYS_SD_M, *_limits("core_offset_m")),
    _uniform("core_z_m", CORE_UP_M, *_limits("core_offset_m")),
    # A film cannot be thicker between pressed asperities than between loose ones.
    ParameterPrior("asperity_m", 80e-6, LOG_SD["asperity_m"], 20e-6, 300e-6, log=True),
    ParameterPrior("floor_m", 5e-6, LOG_SD["floor_m"], 0.5e-6, 20e-6, log=True),
    ParameterPrior("squeeze_pa", 30e3, LOG_SD["squeeze_pa"], *_limits("squeeze_pa"), log=True),
    _uniform("squeeze_exponent", (0.5, 1.0), *_limits("squeeze_exponent")),
)
"""Of the fit: as wide as the specimens of ``palpate fem units draw``."""

ASYMMETRY = ParameterPrior("asymmetry", 1.0, LOG_SD["asymmetry"], *_limits("asymmetry"), log=True)
"""Of each electrode's factor, 19 of them."""


def scaled_of(specimen: SpecimenParameters) -> Floats:
    """Parameters of a specimen in standard deviations of the priors, shape (11 + 19,)."""
    core = dict(zip(AXES, specimen.core_offset_m, strict=True))
    plain = [
        p.scaled(core[p.name] if p.name in core else getattr(specimen, p.name)) for p in PRIORS
    ]
    return np.array([*plain, *(ASYMMETRY.scaled(one) for one in specimen.asymmetry)])


def specimen_at(scaled: Floats, start: SpecimenParameters) -> SpecimenParameters:
    """The specimen with these parameters; all others are those of ``start``."""
    values = {p.name: p.value(float(s)) for p, s in zip(PRIORS, scaled, strict=False)}
    core = tuple(values.pop(axis) for axis in AXES)
    asymmetry = tuple(ASYMMETRY.value(float(s)) for s in scaled[len(PRIORS) :])
    return replace(start, **values, core_offset_m=core, asymmetry=asymmetry)


@dataclass(frozen=True)
class Explanation:
    """What presses of a library say of touches, under one specimen.

    Attributes:
        tared: Expected counts minus those at rest, shape (N, 19).
        probability: Of each press, shape (N, J); rows sum to one.
        warmth: Expected ln of the conductivity over that at rest, by press, shape (N, J).
        left: Root mean square of given counts minus those of each press, weighted by their
            probability [counts]; NaN if no electrode was given.
    """

    tared: Floats
    probability: Floats
    warmth: Floats
    left: float

    @property
    def mean_warmth(self) -> Floats:
        """Expected warmth of each touch, shape (N,)."""
        return np.asarray((self.probability * self.warmth).sum(axis=1))


class TouchExplainer:
    """A specimen that is asked which presses of a library some touches were, and what it reads."""

    def __init__(self, model: ElectrodeModel, library: PressLibrary) -> None:
        """Nothing is computed yet.

        Args:
            model: The specimen, on the library's fingertip.
            library: Simulated presses.
        """
        self.model, self._library = model, library
        self._rest = model.of_gap(library.rest).counts
        self._known: dict[int, tuple[Floats, Floats]] = {}

    def _tared(self, places: Candidates) -> tuple[Floats, Floats]:
        """Tared counts of candidates and their derivative by ln sigma, each (N, J, 19)."""
        some = np.isfinite(places.angle_rad)
        for state in np.union1d(places.low[some], places.high[some]).tolist():
            if state not in self._known:
                answer = self.model.of_gap(self._library.gaps[state])
                self._known[state] = (answer.counts, counts_by_log_sigma(self.model, answer))
        size = len(self._library.gaps)
        counts, warm = np.zeros((size, SENSING)), np.zeros((size, SENSING))
        for state, (one, other) in self._known.items():
            counts[state], warm[state] = one, other
        return places.at(counts) - self._rest, places.at(warm)

    def explain(
        self,
        touches: SensorTouches,
        *,
        spread: float,
        given: NDArray[np.bool_] | None = None,
        warmth: float = 0.0,
        places: Candidates | None = None,
    ) -> Explanation:
        """Find the presses, and what the electrodes are expected to read.

        Args:
            touches: With forces; of the counts only those of the given electrodes are used.
            spread: Standard deviation of an electrode from the simulated one [counts].
            given: Electrodes whose counts are known, shape (19,); None = all. With none the force
                alone decides.
            warmth: Expected ln of the conductivity over that at rest.
            places: Of the library for these forces; None = they are found.

        Raises:
            DatasetError: A force is beyond all presses.
        """
        if places is None:
            places = self._library.candidates(touches.force)
        tared, warm = self._tared(places)
        known = np.ones(SENSING, bool) if given is None else given
        off = touches.tared[:, None, known] - tared[..., known] - warmth * warm[..., known]
        slope = warm[..., known]
        # The best warmth of each candidate, and what the electrodes and its prior then cost.
        rise = (slope * off).sum(axis=2) / ((slope**2).sum(axis=2) + (spread / WARMTH_SD) ** 2)
        left = off - rise[..., None] * slope
        cost = (left**2).sum(axis=2) / spread**2 + (rise / WARMTH_SD) ** 2
        cost = cost + (places.angle_rad / ANGLE_SD_RAD) ** 2
        cost -= cost.min(axis=1, keepdims=True)
        probability = np.exp(-0.5 * cost)
        probability /= probability.sum(axis=1, keepdims=True)
        expected = tared + (warmth + rise)[..., None] * warm
        square = float((probability[..., None] * left**2).sum())
        count = len(touches) * int(known.sum())
        return Explanation(
            np.einsum("nj,nji->ni", probability, expected),
            probability,
            warmth + rise,
            math.sqrt(square / count) if count else math.nan,
        )

    def spread_of(self, touches: SensorTouches, *, rounds: int = 8) -> tuple[float, Explanation]:
        """Deviation of the electrodes from this specimen's, with the presses that fit best.

        Raises:
            DatasetError: There is no touch, or a force is beyond all presses.
        """
        if not len(touches):
            raise DatasetError("no touch to compare with", remedy="give at least one")
        places = self._library.candidates(touches.force)
        spread = SPREAD
        for _ in range(rounds):
            found = self.explain(touches, spread=spread, places=places)
            spread = max(found.left, LEAST_SPREAD)
        return spread, found


@dataclass(frozen=True)
class SensorFit:
    """A specimen that was fitted to a sensor.

    Attributes:
        specimen: The specimen.
        spread: Deviation of the electrodes from what it reads at the presses that fit best
            [counts]; NaN without touches.
        rest_error: Root mean square of the counts at rest minus its own [counts].
        warmth: Mean ln of the conductivity of the touches over that at rest; 0 without touches.
        rounds: To and fro.
    """

    specimen: SpecimenParameters
    spread: float
    rest_error: float
    warmth: float
    rounds: int


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
        sensor: Model on the library's fingertip; parameters that are not fitted are its own, and
            discs and recess too.
        library: Simulated presses.
        touches: Of the sensor; with none the rest alone is fitted.
        rounds: To and fro, at most; it ends earlier when the spread moves by less than 1 %.
        on_round: Called after each with its number and the spread.

    Raises:
        DatasetError: A force is beyond all presses of the library.
    """
    rest_only = touches.some(slice(0, 0))
    scaled = _fitted(sensor, library, rest_only, np.zeros(len(PRIORS) + SENSING), [], REST_SPREAD)
    spread, warmth, done = math.nan, 0.0, 0
    if len(touches):
        places = library.candidates(touches.force)
        spread = SPREAD
        for done in range(1, rounds + 1):
            model = sensor.with_specimen(specimen_at(scaled, sensor.specimen))
            found = TouchExplainer(model, library).explain(touches, spread=spread, places=places)
            before, spread = spread, max(found.left, LEAST_SPREAD)
            warmth = float(found.mean_warmth.mean())
            if on_round is not None:
                on_round(done, spread)
            if abs(spread / before - 1) < 0.01:
                break
            pairs = _pairs(places, found)
            scaled = _fitted(sensor, library, touches, scaled, pairs, spread)
    specimen = specimen_at(scaled, sensor.specimen)
    rest = sensor.with_specimen(specimen).of_gap(library.rest).counts
    error = float(np.sqrt(np.mean((rest - touches.rest) ** 2)))
    return SensorFit(replace(specimen, name=touches.name), spread, error, warmth, done)


@dataclass(frozen=True, slots=True)
class _Pair:
    """A touch and one of its presses."""

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
        best = best[row[best] > 0.02]
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
    ends = [
        (p.scaled(p.low or 1e-12) if p.log else p.scaled(p.low), p.scaled(p.high)) for p in PRIORS
    ]
    ends += [(ASYMMETRY.scaled(ASYMMETRY.low), ASYMMETRY.scaled(ASYMMETRY.high))] * SENSING
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
    values, slopes = [(rest - touches.rest) / spread], [rest_slope / spread]
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
