"""Electrodes from the skin's displacement, or from what presses it: the systems of that table.

Each is trained on one unit. Those that see points see the paper's 128 nodes; those of Ruppel see
the contact's position and force instead of a field.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from sklearn.neighbors import KNeighborsRegressor
from torch import Tensor

from palpate_training.datasets.experiment import MixedDataset
from palpate_training.learning import baselines
from palpate_training.learning.field_code import fit_code
from palpate_training.learning.film import pooling
from palpate_training.learning.fit import FitConfig, fit
from palpate_training.learning.networks import Standardised, predict
from palpate_training.learning.splits import RowSplit
from palpate_training.systems.latent import fit_latents
from palpate_training.systems.points import FITTED_NODES, PointNet, PointNetPlus
from palpate_training.systems.ruppel import CONFIG as RUPPEL_CONFIG
from palpate_training.systems.ruppel import BranchedLayers, network_a, network_b, ruppel_inputs
from palpate_training.systems.samples import samples_of
from palpate_training.systems.statistical import Scaling, boosted_trees
from palpate_training.tasks.fields import FieldFitConfig, tared_counts
from palpate_training.tasks.synthesis import fit_synthesis, synthesis_features

FloatArray = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int64]
CountsOf = Callable[[Rows], FloatArray]
"""Estimates the tared counts of rows of the data set, shape (R, 19)."""

POINTS_CONFIG = FitConfig(epochs=40, patience=10, batch_rows=128, learning_rate=1e-3)
FILM_MEMBERS = 3


@dataclass(frozen=True, slots=True)
class SynthesisSystem:
    """A row of the table; the attributes are those of ``System``."""

    name: str
    source: str
    fit: Callable[[MixedDataset, RowSplit, int], CountsOf]
    seeded: bool = False


def moved_nodes(data: MixedDataset) -> FloatArray:
    """Displacement of the 128 nodes in all rows [m], shape (N, 128 * 3)."""
    modes = data.basis.modes[:, data.mesh.subset].reshape(len(data.basis.modes), -1)
    mean = data.basis.mean[data.mesh.subset].reshape(-1)
    return np.asarray(data.coefficients @ modes + mean, np.float32)


def fit_zero(data: MixedDataset, rows: RowSplit, seed: int) -> CountsOf:
    """Nothing changes."""
    width = data.experiment.tared.shape[1]
    return lambda some: np.zeros((len(some), width), np.float32)


def fit_mean(data: MixedDataset, rows: RowSplit, seed: int) -> CountsOf:
    """The mean of the training rows."""
    mean = tared_counts(data)[rows.train].mean(axis=0, dtype=np.float64).astype(np.float32)
    return lambda some: np.repeat(mean[None], len(some), axis=0)


def _features(data: MixedDataset, rows: RowSplit) -> FloatArray:
    code = fit_code(data, rows.train, rows.validation)
    return synthesis_features(data, code, pooling(data.mesh))


def fit_ridge(data: MixedDataset, rows: RowSplit, seed: int) -> CountsOf:
    """Linear in coefficients and pooled film."""
    x, y = _features(data, rows), tared_counts(data)
    line = baselines.ridge(x[rows.train], y[rows.train], x[rows.validation], y[rows.validation])
    return lambda some: line.predict(x[some]).astype(np.float32)


def fit_neighbours(data: MixedDataset, rows: RowSplit, seed: int) -> CountsOf:
    """Mean of the three training rows whose coefficients are nearest."""
    y = tared_counts(data)
    # Modes are orthonormal: distances of coefficients are those of the fields.
    model = KNeighborsRegressor(3).fit(data.coefficients[rows.train], y[rows.train])
    return lambda some: np.asarray(model.predict(data.coefficients[some]), np.float32)


def fit_trees(data: MixedDataset, rows: RowSplit, seed: int) -> CountsOf:
    """Zai El Amri 2024: boosted trees on coefficients and pooled film."""
    x = _features(data, rows)
    predicted = boosted_trees(x[rows.train], tared_counts(data)[rows.train])
    return lambda some: predicted(x[some])


def _fit_net(
    net: Standardised, x: FloatArray, y: FloatArray, rows: RowSplit, config: FitConfig
) -> CountsOf:
    """Train on the mean square of standardised counts; the validation rows stop it."""
    net.normalise_from(x[rows.train], y[rows.train])
    branched = net.layers if isinstance(net.layers, BranchedLayers) else None

    def loss_of(estimate: Tensor, wanted: Tensor) -> Tensor:
        loss = torch.square((estimate - wanted) / net.output_sd).mean()
        return loss if branched is None else loss + branched.penalty()

    def score_of(_: torch.nn.Module) -> float:
        left = predict(net, x[rows.validation]) - y[rows.validation]
        return float(np.sqrt(np.mean(np.square(left))))

    fit(net, x[rows.train], y[rows.train], loss_of=loss_of, score_of=score_of, config=config)
    return lambda some: predict(net, x[some])


def fit_points(make: str, data: MixedDataset, rows: RowSplit, seed: int) -> CountsOf:
    """A network on the 128 nodes: ``PointNet++`` or ``PointNet``."""
    torch.manual_seed(seed)
    x, y = moved_nodes(data), tared_counts(data)
    points = data.mesh.nodes[data.mesh.subset]
    if make == "PointNet":
        net = Standardised(PointNet(points, y.shape[1]), x.shape[1], y.shape[1])
    else:
        layers = PointNetPlus(points, 3, y.shape[1], FITTED_NODES)
        net = Standardised(layers, x.shape[1], y.shape[1])
    return _fit_net(net, x, y, rows, POINTS_CONFIG)


def fit_ruppel(
    make: Callable[[int], Standardised], data: MixedDataset, rows: RowSplit, seed: int
) -> CountsOf:
    """Ruppel 2019, from contact location and force."""
    torch.manual_seed(seed)
    x, y = ruppel_inputs(samples_of(data.experiment)), tared_counts(data)
    return _fit_net(make(y.shape[1]), x, y, rows, RUPPEL_CONFIG)


def fit_narang(data: MixedDataset, rows: RowSplit, seed: int) -> CountsOf:
    """Narang 2021, from the skin to the electrodes."""
    code = fit_code(data, rows.train, rows.validation)
    x, y = code.encode(data.coefficients), tared_counts(data)
    mesh, signal = Scaling.of(x[rows.train]), Scaling.of(y[rows.train])
    given = mesh.apply(x).astype(np.float32)
    latents = fit_latents(
        signal.apply(y[rows.train]).astype(np.float32), given[rows.train], to_mesh=False, seed=seed
    )
    return lambda some: signal.undo(latents.apply(given[some]))


def fit_film(members: int, data: MixedDataset, rows: RowSplit, seed: int) -> CountsOf:
    """Ours: modes, and the film near each electrode with its logarithm; mean of some networks."""
    model = fit_synthesis(data, rows, config=FieldFitConfig(members=members), seed=seed)
    x = synthesis_features(data, model.code, model.pooling)
    return lambda some: model.counts(x[some])


SYNTHESIS_SYSTEMS = (
    SynthesisSystem("zero", "baseline", fit_zero),
    SynthesisSystem("training mean", "baseline", fit_mean),
    SynthesisSystem("nearest neighbours", "baseline", fit_neighbours),
    SynthesisSystem("ridge", "baseline", fit_ridge),
    SynthesisSystem(
        "PointNet++ (the paper's)",
        "Narang et al. 2021, section on synthesis",
        partial(fit_points, "PointNet++"),
        seeded=True,
    ),
    SynthesisSystem(
        "Ruppel 2019: network A", "Ruppel et al., IAS-15, 2019",
        partial(fit_ruppel, network_a), seeded=True,
    ),
    SynthesisSystem(
        "Ruppel 2019: network B", "Ruppel et al., IAS-15, 2019",
        partial(fit_ruppel, network_b), seeded=True,
    ),
    SynthesisSystem(
        "Zapata 2021: PointNet", "Zapata-Impata et al., IEEE Trans. Haptics 14(1), 2021",
        partial(fit_points, "PointNet"), seeded=True,
    ),
    SynthesisSystem(
        "Narang 2021: latent projection", "Narang et al., ICRA 2021, arXiv 2103.16747",
        fit_narang, seeded=True,
    ),
    SynthesisSystem(
        "Zai El Amri 2024: boosted trees",
        "Zai El Amri and Navarro-Guerrero, IJCNN 2024",
        fit_trees,
    ),
    SynthesisSystem("film network", "ours", partial(fit_film, 1), seeded=True),
    SynthesisSystem(
        "film networks, mean of three", "ours", partial(fit_film, FILM_MEMBERS), seeded=True
    ),
)  # fmt: skip
