"""Systems without a network: a few constants fitted to the training rows.

Wettels 2009, Wettels and Loeb 2011 (location), Su 2012, and Lin, Fishel and Loeb 2013. What their
articles leave open is said where it is chosen. The articles say "impedance" for the change of the
counts and for that of the impedance in ohm, so both are tried and the better on the training rows
is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from palpate.anatomy import ELECTRODE_NORMALS, ELECTRODE_POSITIONS
from palpate_training.systems.samples import (
    Estimate,
    FloatArray,
    Quantity,
    Samples,
    System,
    error_of,
    impedance_ohm,
)

Floats = npt.NDArray[np.float64]
Convention = Callable[[Samples], Floats]
"""Change of each electrode against the untouched state, negative where the film gets thinner."""

STRONGEST_POWERS = (0.5, 1.0, 2.0)
NORMAL_ELECTRODES = 2
TANGENTIAL_ELECTRODES = 4


def counts_change(samples: Samples) -> Floats:
    """Tared counts, shape (N, 19)."""
    return samples.tared.astype(np.float64)


def impedance_change(samples: Samples) -> Floats:
    """Fall of the impedance [kohm], shape (N, 19); negative where the film gets thinner."""
    return 1e-3 * (impedance_ohm(samples.rest) - impedance_ohm(samples.rest + samples.tared))


def _conventions(samples: Samples) -> Iterator[Convention]:
    yield counts_change
    if samples.knows_rest:
        yield impedance_change


def _best(candidates: Iterator[Estimate], quantity: Quantity, train: Samples) -> Estimate:
    """The candidate with the smallest median error on the training rows."""
    truth = train.truth(quantity)
    return min(candidates, key=lambda estimate: error_of(estimate(train), truth))


def normal_sums(change: Floats) -> Floats:
    """Sum over the electrodes of change times normal, shape (N, 3) (Su 2012)."""
    return np.asarray(change @ ELECTRODE_NORMALS)


def fit_su(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Su 2012: each component of the force is proportional to that of the normal sum."""

    def candidates() -> Iterator[Estimate]:
        for change in _conventions(train):
            sums = normal_sums(change(train))
            scale = (sums * train.force).sum(axis=0) / np.maximum((sums * sums).sum(axis=0), 1e-30)

            def estimate(
                samples: Samples, change: Convention = change, scale: Floats = scale
            ) -> FloatArray:
                return np.asarray(normal_sums(change(samples)) * scale, np.float32)

            yield estimate

    return _best(candidates(), quantity, train)


def fit_free_normals(
    quantity: Quantity, train: Samples, validation: Samples, seed: int
) -> Estimate:
    """Su 2012 with normals that are fitted: 3 x 19 numbers, the ceiling of its kind."""

    def candidates() -> Iterator[Estimate]:
        for change in _conventions(train):
            x = change(train)
            gram = x.T @ x
            gram += 1e-4 * np.trace(gram) / len(gram) * np.eye(len(gram))
            weight = np.asarray(np.linalg.solve(gram, x.T @ train.force), np.float64)

            def estimate(
                samples: Samples, change: Convention = change, weight: Floats = weight
            ) -> FloatArray:
                return np.asarray(change(samples) @ weight, np.float32)

            yield estimate

    return _best(candidates(), quantity, train)


def centroid(change: Floats, power: float = 2.0) -> Floats:
    """Mean of the electrodes' positions, weighted with a power of their change [m], (N, 3).

    A row without any change is at the mean of all electrodes.
    """
    weight = np.abs(change) ** power
    total = weight.sum(axis=1, keepdims=True)
    weight = np.where(total > 0, weight / np.where(total > 0, total, 1.0), 1.0 / change.shape[1])
    return np.asarray(weight @ ELECTRODE_POSITIONS)


def onto_finger(points: Floats, radius_m: float) -> Floats:
    """Project points (N, 3) radially on a cylinder about x with a spherical end [m] (Lin 2013)."""
    radial = np.where(points[:, :1] <= 0.0, points * (0.0, 1.0, 1.0), points)
    length = np.linalg.norm(radial, axis=1, keepdims=True)
    return np.asarray(points - radial + radial * radius_m / np.where(length > 0, length, 1.0))


def fit_lin(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Lin 2013: centroid by squared changes, projected on the finger.

    Its radius and an offset are fitted, because the location is that of the indenter's tip, which
    is not on the skin for every indenter.
    """
    truth = train.truth(quantity).astype(np.float64)

    def candidates() -> Iterator[Estimate]:
        for change in _conventions(train):
            points = centroid(change(train))

            def residual(values: Floats, points: Floats = points) -> Floats:
                placed = onto_finger(points, values[0]) + values[1:]
                return np.asarray(1e3 * (placed - truth).ravel())

            start = np.array([7e-3, 0.0, 0.0, 0.0])
            found = least_squares(residual, start, x_scale=1e-3, loss="soft_l1").x

            def estimate(
                samples: Samples, change: Convention = change, found: Floats = found
            ) -> FloatArray:
                placed = onto_finger(centroid(change(samples)), found[0]) + found[1:]
                return np.asarray(placed, np.float32)

            yield estimate

    return _best(candidates(), quantity, train)


def strongest(change: Floats, power: float, *, fallen_only: bool) -> Floats:
    """Mean position of the three electrodes that changed most [m], (N, 3) (Wettels 2011)."""
    strength = np.maximum(-change, 0.0) if fallen_only else np.abs(change)
    third = np.sort(strength, axis=1)[:, -3][:, None]
    return centroid(np.where(strength >= third, strength, 0.0), power)


def fit_strongest(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Wettels and Loeb 2011: three strongest electrodes; the power and an offset are fitted."""
    truth = train.truth(quantity).astype(np.float64)

    def candidates() -> Iterator[Estimate]:
        for change in _conventions(train):
            for power in STRONGEST_POWERS:
                for fallen_only in (False, True):
                    points = strongest(change(train), power, fallen_only=fallen_only)
                    offset = np.median(truth - points, axis=0)

                    def estimate(
                        samples: Samples,
                        change: Convention = change,
                        power: float = power,
                        fallen_only: bool = fallen_only,
                        offset: Floats = offset,
                    ) -> FloatArray:
                        points = strongest(change(samples), power, fallen_only=fallen_only)
                        return np.asarray(points + offset, np.float32)

                    yield estimate

    return _best(candidates(), quantity, train)


def fit_wettels(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Wettels 2009: the force along z by a line in two electrodes, across it by a Kalman filter.

    The article's prototype had fewer electrodes; here the two, and the four, are those that vary
    most. Its matrices are not published: all come from least squares on the training rows, with the
    state (F_x, F_y and their change from row to row) and a trial beginning untouched.
    """
    x = counts_change(train)
    order = np.argsort(-x.std(axis=0))
    two, four = order[:NORMAL_ELECTRODES], order[:TANGENTIAL_ELECTRODES]
    design = np.column_stack([np.ones(len(x)), x[:, two]])
    line = np.linalg.lstsq(design, train.force[:, 2].astype(np.float64), rcond=None)[0]
    kalman = KalmanModel.fit(
        [(train.force[rows, :2].astype(np.float64), x[rows][:, four]) for rows in _trials(train)]
    )

    def estimate(samples: Samples) -> FloatArray:
        seen = counts_change(samples)
        force = np.empty((len(samples), 3), np.float32)
        force[:, 2] = np.column_stack([np.ones(len(seen)), seen[:, two]]) @ line
        for rows in _trials(samples):
            force[rows, :2] = kalman.filtered(seen[rows][:, four])
        return force

    return estimate


def _trials(samples: Samples) -> Iterator[npt.NDArray[np.int64]]:
    """Rows of each trial, in their order."""
    order = np.argsort(samples.trial, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(samples.trial[order])) + 1)


class KalmanModel:
    """A linear state with Gaussian noise, observed by electrodes.

    The state of a row is the tangential force and its change since the row before; an untouched row
    comes before the first.
    """

    def __init__(self, step: Floats, step_noise: Floats, seen: Floats, seen_noise: Floats) -> None:
        self._step, self._step_noise = step, step_noise
        self._seen, self._seen_noise = seen, seen_noise

    @classmethod
    def fit(cls, sequences: list[tuple[Floats, Floats]]) -> KalmanModel:
        """From pairs of force (R, 2) and electrodes (R, M), one for each trial."""
        befores, afters, observed = [], [], []
        for force, electrodes in sequences:
            padded = np.vstack([np.zeros((2, 2)), force])
            state = np.hstack([padded[1:], np.diff(padded, axis=0)])  # (R + 1, 4)
            befores.append(state[:-1])
            afters.append(state[1:])
            observed.append(electrodes)
        before, after, y = (np.concatenate(part) for part in (befores, afters, observed))
        step, step_noise = _regressed(before, after)
        seen, seen_noise = _regressed(after, y)
        return cls(step, step_noise, seen, seen_noise)

    def filtered(self, electrodes: Floats) -> Floats:
        """Tangential force [N], shape (R, 2), of the electrodes of one trial (R, M)."""
        state, spread = np.zeros(4), np.zeros((4, 4))
        found = np.empty((len(electrodes), 2))
        for row, values in enumerate(electrodes):
            state = self._step @ state
            spread = self._step @ spread @ self._step.T + self._step_noise
            across = spread @ self._seen.T
            gain = np.linalg.solve(self._seen @ across + self._seen_noise, across.T).T
            state = state + gain @ (values - self._seen @ state)
            spread = spread - gain @ self._seen @ spread
            found[row] = state[:2]
        return found


def _regressed(given: Floats, wanted: Floats) -> tuple[Floats, Floats]:
    """Matrix of the least squares fit wanted = matrix @ given, and covariance of what is left."""
    matrix = np.asarray(np.linalg.lstsq(given, wanted, rcond=None)[0].T, np.float64)
    left = wanted - given @ matrix.T
    floor = 1e-9 * max(1.0, float(np.square(left).mean())) * np.eye(left.shape[1])
    return matrix, left.T @ left / len(left) + floor


ANALYTIC = (
    System(
        "Wettels 2009: line and Kalman filter",
        "Wettels et al., IEEE/ASME Trans. Mechatronics 2009",
        fit_wettels,
        ("force",),
    ),
    System(
        "Wettels 2011: three strongest electrodes",
        "Wettels and Loeb, ROBIO 2011",
        fit_strongest,
        ("location", "centre"),
    ),
    System("Su 2012: normal sum", "Su et al., Front. Neurorobotics 6:7, 2012", fit_su, ("force",)),
    System(
        "Su 2012 with fitted normals",
        "the linear ceiling of Su et al. 2012",
        fit_free_normals,
        ("force",),
    ),
    System(
        "Lin 2013: squared centroid",
        "Lin, Fishel and Loeb, SynTouch report 2013",
        fit_lin,
        ("location", "centre"),
    ),
)
