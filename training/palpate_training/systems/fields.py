"""The displacement of the skin from electrodes: the systems of that table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from sklearn.neighbors import KNeighborsRegressor
from torch import Tensor

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_training.datasets.experiment import MixedDataset
from palpate_training.learning import baselines
from palpate_training.learning.electrode_nets import GAIN_SPREAD
from palpate_training.learning.field_code import FieldCode, fit_code, in_parts
from palpate_training.learning.fit import fit
from palpate_training.learning.metrics import field_errors
from palpate_training.learning.networks import Standardised, predict
from palpate_training.learning.splits import RowSplit
from palpate_training.systems.latent import fit_latents
from palpate_training.systems.points import FITTED, PUBLISHED, Abstraction, PointNetPlus
from palpate_training.systems.statistical import Scaling, boosted_trees
from palpate_training.systems.synthesis import POINTS_CONFIG, moved_nodes
from palpate_training.tasks.fields import FieldFitConfig, fit_field, tared_counts

FloatArray = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int64]
Errors = dict[str, npt.NDArray[np.float64]]

TREE_MODES = 16
"""Coefficients that boosted trees estimate; the rest stay at the mean. Each is an ensemble."""
MEMBERS = 3


class WholeSkinEstimate:
    """Estimated fields of rows of a data set."""

    def __init__(self, data: MixedDataset, fields: Callable[[Rows], FloatArray]) -> None:
        self._data = data
        self._fields = fields

    def errors(self, rows: Rows) -> Errors:
        """Errors of rows by name (``metrics.field_errors``); fields are made in small parts."""
        parts = []
        for some in in_parts(rows):
            truth = self._data.displacement(some)
            parts.append(field_errors(self._fields(some), truth, self._data.mesh.subset))
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


class NodeSubsetEstimate:
    """Estimated displacement of the paper's 128 nodes."""

    def __init__(self, data: MixedDataset, moved: Callable[[Rows], FloatArray]) -> None:
        self._truth = moved_nodes(data)
        self._moved = moved

    def errors(self, rows: Rows) -> Errors:
        """Mean nodal distance of rows; other nodes are not estimated."""
        left = (self._moved(rows) - self._truth[rows]).reshape(len(rows), -1, 3)
        return {"subset_m": np.linalg.norm(left, axis=2).mean(axis=1).astype(np.float64)}


@dataclass(frozen=True, slots=True)
class FieldSystem:
    """A row of the table; the attributes are those of ``System``."""

    name: str
    source: str
    fit: Callable[[MixedDataset, RowSplit, int], WholeSkinEstimate | NodeSubsetEstimate]
    seeded: bool = False


def fit_zero(data: MixedDataset, rows: RowSplit, seed: int) -> WholeSkinEstimate:
    """Nothing moves."""
    return WholeSkinEstimate(
        data, lambda some: np.zeros((len(some), *data.mesh.nodes.shape), np.float32)
    )


def _of_code(
    data: MixedDataset, code: FieldCode, estimate: Callable[[FloatArray], npt.NDArray[np.floating]]
) -> WholeSkinEstimate:
    """From tared counts to coefficients to fields."""
    counts = tared_counts(data)
    return WholeSkinEstimate(data, lambda some: code.decode(estimate(counts[some])))


def fit_mean(data: MixedDataset, rows: RowSplit, seed: int) -> WholeSkinEstimate:
    """The mean field of the training rows."""
    code = fit_code(data, rows.train, rows.validation)
    mean = code.encode(data.coefficients)[rows.train].mean(axis=0)
    return _of_code(data, code, lambda counts: np.repeat(mean[None], len(counts), axis=0))


def fit_ridge(data: MixedDataset, rows: RowSplit, seed: int) -> WholeSkinEstimate:
    """Coefficients linear in the counts."""
    code = fit_code(data, rows.train, rows.validation)
    x, y = tared_counts(data), code.encode(data.coefficients)
    line = baselines.ridge(x[rows.train], y[rows.train], x[rows.validation], y[rows.validation])
    return _of_code(data, code, line.predict)


def fit_neighbours(data: MixedDataset, rows: RowSplit, seed: int) -> WholeSkinEstimate:
    """Mean field of the three training rows whose counts are nearest."""
    code = fit_code(data, rows.train, rows.validation)
    x, y = tared_counts(data)[rows.train], code.encode(data.coefficients)[rows.train]
    scale = Scaling.of(x)
    model = KNeighborsRegressor(3).fit(scale.apply(x), y)
    return _of_code(data, code, lambda counts: model.predict(scale.apply(counts)))


def fit_trees(data: MixedDataset, rows: RowSplit, seed: int) -> WholeSkinEstimate:
    """Boosted trees for the first coefficients."""
    code = fit_code(data, rows.train, rows.validation)
    y = code.encode(data.coefficients)[rows.train]
    kept = min(TREE_MODES, code.size)
    predicted = boosted_trees(tared_counts(data)[rows.train], y[:, :kept])

    def estimate(counts: FloatArray) -> FloatArray:
        found = np.zeros((len(counts), code.size), np.float32)
        found[:, :kept] = predicted(counts)
        return found

    return _of_code(data, code, estimate)


def fit_points(
    layers: tuple[Abstraction, ...], data: MixedDataset, rows: RowSplit, seed: int
) -> NodeSubsetEstimate:
    """PointNet++ on the electrodes, to the 128 nodes, trained on their mean distance."""
    torch.manual_seed(seed)
    x, y = tared_counts(data), moved_nodes(data)
    net = Standardised(
        PointNetPlus(ELECTRODE_POSITIONS, 1, y.shape[1], layers), x.shape[1], y.shape[1]
    )
    net.normalise_from(x[rows.train], y[rows.train])
    # One scale for all values: an error counts by its length, not by how much its node moves.
    net.output_sd.fill_(float(net.output_sd.square().mean().sqrt()))
    scale = float(net.output_sd[0])

    def loss_of(estimate: Tensor, wanted: Tensor) -> Tensor:
        left = ((estimate - wanted) / scale).reshape(len(estimate), -1, 3)
        return torch.sqrt(left.square().sum(dim=2) + 1e-4).mean()

    def score_of(_: torch.nn.Module) -> float:
        left = (predict(net, x[rows.validation]) - y[rows.validation]).reshape(-1, 3)
        return float(np.linalg.norm(left, axis=1).mean())

    fit(
        net, x[rows.train], y[rows.train],
        loss_of=loss_of, score_of=score_of, config=POINTS_CONFIG,
    )  # fmt: skip
    return NodeSubsetEstimate(data, lambda some: predict(net, x[some]))


def fit_narang(data: MixedDataset, rows: RowSplit, seed: int) -> WholeSkinEstimate:
    """Narang 2021, from the electrodes to the skin."""
    code = fit_code(data, rows.train, rows.validation)
    x, y = tared_counts(data)[rows.train], code.encode(data.coefficients)[rows.train]
    signal, mesh = Scaling.of(x), Scaling.of(y)
    latents = fit_latents(
        signal.apply(x).astype(np.float32), mesh.apply(y).astype(np.float32),
        to_mesh=True, seed=seed,
    )  # fmt: skip
    return _of_code(
        data,
        code,
        lambda counts: mesh.undo(latents.apply(signal.apply(counts).astype(np.float32))),
    )


def fit_modes(
    members: int, gain_spread: float, data: MixedDataset, rows: RowSplit, seed: int
) -> WholeSkinEstimate:
    """Ours: networks to the coefficients of the skin's modes; the mean of some."""
    config = FieldFitConfig(members=members, gain_spread=gain_spread)
    model = fit_field(data, rows, config=config, seed=seed)
    return _of_code(data, model.code, model.coefficients)


FIELD_SYSTEMS = (
    FieldSystem("zero", "baseline", fit_zero),
    FieldSystem("training mean", "baseline", fit_mean),
    FieldSystem("nearest neighbours", "baseline", fit_neighbours),
    FieldSystem("ridge", "baseline", fit_ridge),
    FieldSystem(
        "PointNet++ (the paper's)", "Narang et al. 2021, section on fields",
        partial(fit_points, PUBLISHED), seeded=True,
    ),
    FieldSystem(
        "PointNet++, radii 6 and 10 mm", "with radii that hold several electrodes",
        partial(fit_points, FITTED), seeded=True,
    ),
    FieldSystem(
        "Narang 2021: latent projection", "Narang et al., ICRA 2021, arXiv 2103.16747",
        fit_narang, seeded=True,
    ),
    FieldSystem(
        "Zai El Amri 2024: boosted trees", "Zai El Amri and Navarro-Guerrero, IJCNN 2024",
        fit_trees,
    ),
    FieldSystem("network to modes", "ours", partial(fit_modes, 1, 0.0), seeded=True),
    FieldSystem(
        "networks to modes, mean of three", "ours", partial(fit_modes, MEMBERS, 0.0), seeded=True
    ),
    FieldSystem(
        "networks to modes, gains in training",
        "ours; electrodes of other fingers stood for by random gains",
        partial(fit_modes, MEMBERS, GAIN_SPREAD), seeded=True,
    ),
)  # fmt: skip
