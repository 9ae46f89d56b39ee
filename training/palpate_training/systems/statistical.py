"""Systems of classical statistics: baselines, Gaussian mixture, support vectors, LWPR, trees.

Wettels and Loeb 2014, Ciobanu 2014, Su 2015 (LWPR) and Zai El Amri 2024 (gradient-boosted trees).
Settings that the articles leave open are chosen on the validation rows from a few.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.mixture import GaussianMixture
from sklearn.neighbors import KNeighborsRegressor
from sklearn.svm import SVR

from palpate_training.learning import baselines
from palpate_training.systems.samples import (
    Estimate,
    FloatArray,
    Quantity,
    Samples,
    System,
    error_of,
)

Floats = npt.NDArray[np.float64]

NEIGHBOURS = (1, 3, 10)
MIXTURE_INPUTS = (6, 8, 10)
MIXTURE_PARTS = (8, 12, 16, 20)
SVR_COSTS = (1.0, 10.0, 100.0)
SVR_WIDTHS = (0.5, 1.0, 2.0)
"""Times 1 / 19."""
SVR_TUBE = 0.05
"""In standard deviations of the target."""
SVR_CHOICE_ROWS = 1500
SVR_ROWS = 6000
"""Support vector machines take time with the square of the rows: more are left out, evenly."""
LWPR_INPUTS = 8
LWPR_METRICS = (0.03, 0.1, 0.3, 1.0)
LWPR_GENERATE = 0.2
"""A row that activates no receptive field so much makes a new one (article's w_gen)."""
LWPR_DIRECTIONS = 4
TREES = 300

_EVERY: tuple[Quantity, ...] = ("location", "force", "centre", "normal")


@dataclass(frozen=True, slots=True)
class Scaling:
    """Standardisation by training rows.

    Attributes:
        mean: Shape (I,).
        sd: Shape (I,).
    """

    mean: Floats
    sd: Floats

    @classmethod
    def of(cls, values: npt.NDArray[np.floating]) -> Scaling:
        """From rows (N, I)."""
        sd = values.std(axis=0, dtype=np.float64)
        return cls(values.mean(axis=0, dtype=np.float64), np.where(sd > 0, sd, 1.0))

    def apply(self, values: npt.NDArray[np.floating]) -> Floats:
        """Standardised rows."""
        return np.asarray((values - self.mean) / self.sd, np.float64)

    def undo(self, values: npt.NDArray[np.floating]) -> FloatArray:
        """Rows in their own unit."""
        return np.asarray(values * self.sd + self.mean, np.float32)


def _chosen(candidates: Iterable[Estimate], quantity: Quantity, validation: Samples) -> Estimate:
    """The candidate with the smallest median error on the validation rows."""
    truth = validation.truth(quantity)
    return min(candidates, key=lambda estimate: error_of(estimate(validation), truth))


def fit_zero(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Always zero."""
    return lambda samples: np.zeros((len(samples), 3), np.float32)


def fit_mean(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Always the mean of the training rows."""
    mean = train.truth(quantity).mean(axis=0, dtype=np.float64).astype(np.float32)
    return lambda samples: np.repeat(mean[None], len(samples), axis=0)


def fit_ridge(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Linear with a penalty that the validation rows choose."""
    model = baselines.ridge(
        train.tared, train.truth(quantity), validation.tared, validation.truth(quantity)
    )
    return lambda samples: model.predict(samples.tared).astype(np.float32)


def fit_neighbours(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Mean of the nearest training rows."""
    scale = Scaling.of(train.tared)

    def of(count: int) -> Estimate:
        model = KNeighborsRegressor(min(count, len(train))).fit(
            scale.apply(train.tared), train.truth(quantity)
        )
        return lambda samples: np.asarray(model.predict(scale.apply(samples.tared)), np.float32)

    return _chosen(map(of, NEIGHBOURS), quantity, validation)


def fit_mixture(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Wettels and Loeb 2014: joint Gaussian mixture, then the mean force given the electrodes.

    The electrodes are reduced to principal components; the number of Gaussians has the least BIC.
    """
    inputs, target = Scaling.of(train.tared), Scaling.of(train.truth(quantity))
    x, y = inputs.apply(train.tared), target.apply(train.truth(quantity))
    turn = np.linalg.svd(x, full_matrices=False)[2].T

    def of(components: int) -> Estimate:
        joint = np.hstack([x @ turn[:, :components], y])
        models = [
            GaussianMixture(parts, reg_covar=1e-4, random_state=seed, max_iter=200).fit(joint)
            for parts in MIXTURE_PARTS
            if parts * 10 < len(joint)
        ] or [GaussianMixture(1, reg_covar=1e-4, random_state=seed).fit(joint)]
        model = min(models, key=lambda one: one.bic(joint))

        def estimate(samples: Samples) -> FloatArray:
            given = inputs.apply(samples.tared) @ turn[:, :components]
            return target.undo(conditional_mean(model, given))

        return estimate

    return _chosen(map(of, MIXTURE_INPUTS), quantity, validation)


def conditional_mean(model: GaussianMixture, given: Floats) -> Floats:
    """Mean of the last values of a mixture where the first are given, (N, I) -> (N, O)."""
    inputs = given.shape[1]
    log_weights, means = [], []
    for weight, mean, covariance in zip(
        model.weights_, model.means_, model.covariances_, strict=True
    ):
        away = given - mean[:inputs]
        factor = np.linalg.cholesky(covariance[:inputs, :inputs])
        white = np.linalg.solve(factor, away.T)
        log_weights.append(
            np.log(weight) - np.log(np.diag(factor)).sum() - 0.5 * np.square(white).sum(axis=0)
        )
        gain = np.linalg.solve(covariance[:inputs, :inputs], covariance[:inputs, inputs:])
        means.append(mean[inputs:] + away @ gain)
    logs = np.array(log_weights)
    share = np.exp(logs - logs.max(axis=0))
    share /= share.sum(axis=0)
    return np.asarray(np.einsum("kn,kno->no", share, np.array(means)))


def fit_support_vectors(
    quantity: Quantity, train: Samples, validation: Samples, seed: int
) -> Estimate:
    """Ciobanu 2014: epsilon-SVR with a radial kernel, one machine for each component."""
    inputs, target = Scaling.of(train.tared), Scaling.of(train.truth(quantity))
    x, y = inputs.apply(train.tared), target.apply(train.truth(quantity))

    def of(cost: float, width: float, rows: int) -> Estimate:
        some = np.unique(np.linspace(0, len(x) - 1, min(rows, len(x))).astype(int))
        machines = [
            SVR(C=cost, gamma=width / x.shape[1], epsilon=SVR_TUBE, cache_size=500).fit(
                x[some], y[some, axis]
            )
            for axis in range(y.shape[1])
        ]

        def estimate(samples: Samples) -> FloatArray:
            scaled = inputs.apply(samples.tared)
            return target.undo(np.column_stack([one.predict(scaled) for one in machines]))

        return estimate

    truth = validation.truth(quantity)
    cost, width = min(
        itertools.product(SVR_COSTS, SVR_WIDTHS),
        key=lambda pair: error_of(of(pair[0], pair[1], SVR_CHOICE_ROWS)(validation), truth),
    )
    return of(cost, width, SVR_ROWS)


def fit_lwpr(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Su 2015: locally weighted projection regression on whitened principal components.

    Every receptive field keeps the metric it begins with, which the validation rows choose, so that
    its regression is the weighted partial least squares that many passes of the incremental
    algorithm approach.
    """
    inputs, target = Scaling.of(train.tared), Scaling.of(train.truth(quantity))
    centred = train.tared - inputs.mean
    values, vectors = np.linalg.eigh(np.cov(centred, rowvar=False))
    kept = min(LWPR_INPUTS, int((values > 1e-9 * values[-1]).sum()))
    white = vectors[:, ::-1][:, :kept] / np.sqrt(values[::-1][:kept])
    x, y = centred @ white, target.apply(train.truth(quantity))

    def of(metric: float) -> Estimate:
        fields = ReceptiveFields.of(x, y, metric)
        return lambda samples: target.undo(fields.estimate((samples.tared - inputs.mean) @ white))

    return _chosen(map(of, LWPR_METRICS), quantity, validation)


class ReceptiveFields:
    """Local lines around centres, blended by Gaussian kernels (Vijayakumar and Schaal 2000)."""

    def __init__(
        self, centres: Floats, metric: float, offsets: Floats, slopes: Floats, means: Floats
    ) -> None:
        self._centres, self._metric = centres, metric
        self._offsets, self._slopes, self._means = offsets, slopes, means

    @classmethod
    def of(cls, x: Floats, y: Floats, metric: float) -> ReceptiveFields:
        """Place fields over rows (N, I) in their order, and fit a line (to (N, O)) in each."""
        reach = -2.0 * np.log(LWPR_GENERATE) / metric
        centres: list[Floats] = []
        nearest = np.full(len(x), np.inf)
        for row, point in enumerate(x):
            if nearest[row] > reach:
                centres.append(point)
                nearest = np.minimum(nearest, np.square(x - point).sum(axis=1))
        fitted = [_weighted_pls(x, y, _kernel(x, centre[None], metric)[:, 0]) for centre in centres]
        offsets, slopes, means = (np.array(part) for part in zip(*fitted, strict=True))
        return cls(np.array(centres), metric, offsets, slopes, means)

    def __len__(self) -> int:
        return len(self._centres)

    def estimate(self, x: Floats) -> Floats:
        """Blended lines of rows (N, I), shape (N, O)."""
        found = []
        for part in np.array_split(x, max(1, len(x) // 512)):
            weight = _kernel(part, self._centres, self._metric)
            # Far from all fields the nearest decides; its weight underflows without this.
            weight /= weight.sum(axis=1, keepdims=True)
            away = part[:, None] - self._means
            lines = self._offsets + np.einsum("nki,kio->nko", away, self._slopes)
            found.append(np.einsum("nk,nko->no", weight, lines))
        return np.concatenate(found)


def _kernel(x: Floats, centres: Floats, metric: float) -> Floats:
    """Activation of each centre by each row, relative to that of the nearest centre, (N, K)."""
    squares = np.square(x[:, None] - centres).sum(axis=2)
    if len(centres) > 1:
        squares = squares - squares.min(axis=1, keepdims=True)
    return np.asarray(np.exp(-0.5 * metric * squares))


def _weighted_pls(x: Floats, y: Floats, weight: Floats) -> tuple[Floats, Floats, Floats]:
    """Offset (O,), slope (I, O) and mean (I,) of weighted partial least squares."""
    total = weight.sum()
    mean_x, mean_y = weight @ x / total, weight @ y / total
    left_x, left_y = x - mean_x, y - mean_y
    slope = np.zeros((x.shape[1], y.shape[1]))
    # One chain of directions for each output, as LWPR has a model for each.
    for output in range(y.shape[1]):
        slope[:, output] = _pls_of_one(left_x, left_y[:, output], weight)
    return mean_y, slope, mean_x


def _pls_of_one(x: Floats, y: Floats, weight: Floats) -> Floats:
    """Slope (I,) after a few directions, each along what is left of the correlation."""
    directions, loadings, gains = [], [], []
    energy = weight @ np.square(x).sum(axis=1)
    left = x
    for _ in range(min(LWPR_DIRECTIONS, x.shape[1])):
        direction = left.T @ (weight * y)
        length = np.linalg.norm(direction)
        score = left @ (direction / length) if length > 0 else np.zeros(len(x))
        power = float(weight @ np.square(score))
        if not power > 1e-8 * energy:
            break
        loading = left.T @ (weight * score) / power
        gain = float(weight @ (score * y)) / power
        directions.append(direction / length)
        loadings.append(loading)
        gains.append(gain)
        left = left - np.outer(score, loading)
        y = y - gain * score
    if not gains:
        return np.zeros(x.shape[1])
    w, p = np.array(directions).T, np.array(loadings).T
    return np.asarray(w @ np.linalg.solve(p.T @ w, np.array(gains)))


def boosted_trees(
    x: npt.NDArray[np.floating], y: npt.NDArray[np.floating]
) -> Callable[[npt.NDArray[np.floating]], FloatArray]:
    """Gradient-boosted trees (N, I) -> (N, O), one ensemble for each output, the same each time."""
    ensembles = [
        HistGradientBoostingRegressor(
            max_iter=TREES,
            learning_rate=0.06,
            max_leaf_nodes=31,
            min_samples_leaf=20,
            l2_regularization=1.0,
            early_stopping=False,
            random_state=0,  # of more than 200,000 rows it draws some to choose its bins
        ).fit(x, y[:, output])
        for output in range(y.shape[1])
    ]
    return lambda values: np.column_stack([one.predict(values) for one in ensembles]).astype(
        np.float32
    )


def fit_trees(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Zai El Amri 2024: gradient-boosted trees."""
    predicted = boosted_trees(train.tared, train.truth(quantity))
    return lambda samples: predicted(samples.tared)


STATISTICAL = (
    System("zero", "baseline", fit_zero, ("force",)),
    System("training mean", "baseline", fit_mean, _EVERY),
    System("nearest neighbours", "baseline", fit_neighbours, _EVERY),
    System("ridge", "baseline", fit_ridge, _EVERY),
    System(
        "Wettels 2014: Gaussian mixture",
        "Wettels and Loeb, Springer STAR 95, 2014",
        fit_mixture,
        ("force",),
        seeded=True,
    ),
    System(
        "Ciobanu 2014: support vectors",
        "Ciobanu et al., CISIS 2014",
        fit_support_vectors,
        ("location", "force"),
    ),
    System("Su 2015: LWPR", "Su et al., Humanoids 2015", fit_lwpr, ("force",)),
    System(
        "Zai El Amri 2024: boosted trees",
        "Zai El Amri and Navarro-Guerrero, IJCNN 2024",
        fit_trees,
        _EVERY,
    ),
)
