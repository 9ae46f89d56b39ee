"""Which simulated press a real touch was, and what the electrodes then read: under one specimen.

Each press of a library gets a probability from what is known of the touch: the direction of its
force, some electrodes or all, and where other touches of the same recording were. What is not
known, place and warmth, is averaged over with these probabilities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import DatasetError
from palpate_fem.arrays import Floats
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.sensitivity import counts_by_log_sigma
from palpate_fem.electrodes.specimen import SENSING
from palpate_fem.population.press_library import Candidates, PressLibrary
from palpate_fem.population.touches import SensorTouches

WARMTH_SD = 0.2
"""Of ln of the conductivity between rest and a touch: in three minutes the idle sensor of the force
logs rose by up to 160 counts, which is 0.2."""

ANGLE_SD_RAD = math.radians(20.0)
"""Between the measured and the simulated force: friction differs, and the axes of the real force
are only known by correlation."""

SPREAD = 200.0
"""Deviation of an electrode before anything is known [counts]: broad, so that the specimen that a
fit starts from rules out no press."""

LEAST_SPREAD = 5.0
PLACE_SD_M, PLACE_BY_FORCE_SD = 3e-3, 3e-3
"""Priors of `PlaceByForce`: of its error [m], and of its slopes [m/N]."""
LEAST_PLACE_SD_M = 1e-3  # the presses of a library are about so far apart


@dataclass(frozen=True)
class PlaceByForce:
    """Where touches of one recording are, given their force: linear, with a normal error.

    Attributes:
        coefficients: Of 1 and the force [N], for the centre of pressure [m], shape (4, 3).
        precision: Inverse covariance of the error [1/m^2], shape (3, 3).
    """

    coefficients: Floats
    precision: Floats

    @classmethod
    def learned(cls, force: Floats, probability: Floats, place: Floats) -> PlaceByForce:
        """Learn it from touches whose presses have probabilities.

        Args:
            force: Of the touches [N], shape (N, 3).
            probability: Of the presses, shape (N, J).
            place: Of their candidates [m], shape (N, J, 3).
        """
        middle = force.mean(axis=0)
        away = np.concatenate([np.ones((len(force), 1)), force - middle], axis=1)
        tight = np.diag([0.0, 1.0, 1.0, 1.0]) * (PLACE_SD_M / PLACE_BY_FORCE_SD) ** 2
        mean = np.einsum("nj,nji->ni", probability, place)
        coefficients = np.linalg.solve(away.T @ away + tight, away.T @ mean)
        error = place - (away @ coefficients)[:, None]
        coefficients[0] -= middle @ coefficients[1:]
        spread = np.einsum("nj,nji,njk->ik", probability, error, error)
        covariance = (spread + PLACE_SD_M**2 * np.eye(3)) / len(force)
        return cls(coefficients, np.linalg.inv(covariance + LEAST_PLACE_SD_M**2 * np.eye(3)))

    def cost(self, force: Floats, place: Floats) -> Floats:
        """Squared error of places, (N, J, 3), over its variance; shape (N, J)."""
        error = place - (self.coefficients[0] + force @ self.coefficients[1:])[:, None]
        return np.asarray(np.einsum("nji,ik,njk->nj", error, self.precision, error))


@dataclass(frozen=True)
class TouchPrior:
    """What is expected of a touch before its electrodes are read.

    Attributes:
        spread: Standard deviation of an electrode from the simulated one [counts].
        warmth: Mean of ln of the conductivity over that at rest.
        where: Where touches are; None = anywhere in the library.
    """

    spread: float = SPREAD
    warmth: float = 0.0
    where: PlaceByForce | None = None


@dataclass(frozen=True)
class Explanation:
    """What presses of a library say of touches, under one specimen.

    Attributes:
        tared: Expected counts minus those at rest, shape (N, 19).
        probability: Of each press, shape (N, J); rows sum to one.
        warmth: Expected ln of the conductivity over that at rest, for each press, shape (N, J).
        left: Root mean square of the given counts minus those of each press, weighted by their
            probability [counts]; NaN if no electrode was given.
        learned: Prior for other touches of the same recording.
    """

    tared: Floats
    probability: Floats
    warmth: Floats
    left: float
    learned: TouchPrior


class TouchExplainer:
    """A specimen, a library, and what the specimen reads at the library's states."""

    def __init__(self, model: ElectrodeModel, library: PressLibrary) -> None:
        """Nothing is computed yet but the rest.

        Args:
            model: The specimen, on the library's fingertip.
            library: Simulated presses.
        """
        self._model, self._library = model, library
        self._rest = model.of_gap(library.rest).counts
        shape = (len(library.gaps), SENSING)
        self._counts, self._warm = np.full(shape, np.nan), np.full(shape, np.nan)

    def explain(
        self,
        touches: SensorTouches,
        prior: TouchPrior,
        *,
        given: NDArray[np.bool_] | None = None,
        places: Candidates | None = None,
    ) -> Explanation:
        """Find the presses, and what the electrodes are expected to read.

        Args:
            touches: With forces; of the counts only those of the given electrodes are used.
            prior: What is expected of them.
            given: Electrodes whose counts are known, shape (19,); None = all. With none the force
                alone decides.
            places: Of the library for these forces; None = they are found.

        Raises:
            DatasetError: There is no touch, or a force is beyond all presses.
        """
        if not len(touches):
            raise DatasetError("there is no touch to explain", remedy="give at least one")
        if places is None:
            places = self._library.candidates(touches.force)
        tared, warm = self._answers(places)
        tared += prior.warmth * warm
        known = np.ones(SENSING, bool) if given is None else given
        slope, off = warm[..., known], (touches.tared[:, None] - tared)[..., known]
        # The best warmth of each press, and what it and the electrodes then cost.
        own = (slope**2).sum(axis=2) + (prior.spread / WARMTH_SD) ** 2
        rise = (slope * off).sum(axis=2) / own
        left = ((off - rise[..., None] * slope) ** 2).sum(axis=2)
        cost = left / prior.spread**2 + (rise / WARMTH_SD) ** 2
        cost += (places.angle_rad / ANGLE_SD_RAD) ** 2
        centres = places.at(self._library.place)
        if prior.where is not None:
            cost += prior.where.cost(touches.force, centres)
        probability = np.exp(-0.5 * (cost - cost.min(axis=1, keepdims=True)))
        probability /= probability.sum(axis=1, keepdims=True)
        expected = np.einsum("nj,nji->ni", probability, tared + rise[..., None] * warm)
        count = len(touches) * int(known.sum())
        error = math.sqrt(float((probability * left).sum()) / count) if count else math.nan
        learned = TouchPrior(
            max(error, LEAST_SPREAD) if count else prior.spread,
            prior.warmth + float((probability * rise).sum(axis=1).mean()),
            PlaceByForce.learned(touches.force, probability, centres),
        )
        return Explanation(expected, probability, prior.warmth + rise, error, learned)

    def learn(self, touches: SensorTouches) -> Explanation:
        """Explain touches until their prior is the one that they teach.

        Raises:
            DatasetError: There is no touch, or a force is beyond all presses.
        """
        places = self._library.candidates(touches.force)
        found = self.explain(touches, TouchPrior(), places=places)
        for _ in range(8):
            found = self.explain(touches, found.learned, places=places)
        return found

    def _answers(self, places: Candidates) -> tuple[Floats, Floats]:
        """Tared counts of candidates, and their derivative by ln sigma, each (N, J, 19)."""
        needed = places.states
        for state in needed[np.isnan(self._counts[needed, 0])].tolist():
            response = self._model.of_gap(self._library.gaps[state])
            self._counts[state] = response.counts
            self._warm[state] = counts_by_log_sigma(self._model, response)
        # Where there is no candidate, any finite number will do: its probability is zero.
        counts, warm = np.nan_to_num(self._counts), np.nan_to_num(self._warm)
        return places.at(counts) - self._rest, places.at(warm)
