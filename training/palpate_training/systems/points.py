"""Networks on points: PointNet++ on the electrodes or on nodes of the skin, and PointNet.

Points never move: their rest positions are constants, so which points are centres and which are
near them is worked out once, and the graph gathers by constant indices. It exports without
operators of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_training.learning.fit import FeaturesFitConfig, fit_standardised
from palpate_training.learning.networks import Standardised, predict
from palpate_training.systems.samples import Estimate, Quantity, Samples, System

Floats = npt.NDArray[np.float64]

MILLIMETRE = 1e-3
POINTS_CONFIG = FeaturesFitConfig(epochs=40, patience=10, batch_rows=256, learning_rate=1e-3)


@dataclass(frozen=True, slots=True)
class Abstraction:
    """Size of a set abstraction layer.

    Attributes:
        centres: How many; None = one for all points.
        radius_m: Points as near as this to a centre belong to it [m].
        widths: Neurons of its shared layers.
    """

    centres: int | None
    radius_m: float
    widths: tuple[int, ...]


def abstractions(first_m: float, second_m: float) -> tuple[Abstraction, ...]:
    """The paper's three layers, with other radii [m]."""
    return (
        Abstraction(32, first_m, (64, 64, 128)),
        Abstraction(8, second_m, (128, 128, 256)),
        Abstraction(None, np.inf, (256, 256, 512)),
    )


PUBLISHED = abstractions(2.5e-3, 7e-3)
"""Electrodes are 2.8 mm apart or more, so the first layer of these sees single points only."""

FITTED = abstractions(6e-3, 10e-3)
"""Radii that hold several electrodes."""


FITTED_NODES = abstractions(4e-3, 10e-3)
"""For 128 nodes of the skin, which are 3 mm apart; the paper gives radii for electrodes only."""


def farthest_points(points: Floats, count: int) -> npt.NDArray[np.int64]:
    """Indices of points that are far from one another, the first being that nearest to the mean."""
    chosen = [int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    away = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


class SetAbstraction(nn.Module):
    """Features of points (N, P, C) -> features of centres (N, M, D): the most of each centre's set.

    A point's features are joined by its place relative to the centre [mm] before the shared layers.
    Sets are padded with their centre's nearest point, which the maximum does not see.
    """

    near: Tensor
    offset: Tensor

    def __init__(self, points: Floats, channels: int, size: Abstraction) -> None:
        super().__init__()
        if size.centres is None:
            self.centres = points.mean(axis=0, keepdims=True)
        else:
            self.centres = points[farthest_points(points, size.centres)]
        away = np.linalg.norm(points - self.centres[:, None], axis=2)  # (M, P)
        order = np.argsort(away, axis=1, kind="stable")
        inside = np.take_along_axis(away, order, axis=1) <= size.radius_m
        most = int(inside.sum(axis=1).max())
        near = np.where(inside, order, order[:, :1])[:, :most]
        offset = (points[near] - self.centres[:, None]) / MILLIMETRE
        self.register_buffer("near", torch.from_numpy(near.reshape(-1)))
        self.register_buffer("offset", torch.from_numpy(offset.astype(np.float32)))
        # The first layer is linear, so a point's own part of it is computed once for all its sets.
        self.of_point = nn.Linear(channels, size.widths[0])
        self.of_offset = nn.Linear(3, size.widths[0], bias=False)
        rest: list[nn.Module] = [nn.ReLU()]
        for before, after in zip(size.widths[:-1], size.widths[1:], strict=True):
            rest += [nn.Linear(before, after), nn.ReLU()]
        self.rest = nn.Sequential(*rest)

    def forward(self, features: Tensor) -> Tensor:
        """Features of the centres."""
        own = self.of_point(features)
        gathered = torch.index_select(own, 1, self.near)
        sets = gathered.reshape(features.shape[0], *self.offset.shape[:2], own.shape[2])
        return torch.amax(self.rest(sets + self.of_offset(self.offset)), dim=2)


class PointNetPlus(nn.Module):
    """PointNet++: three set abstractions, then 256 and 128 neurons (the paper's).

    Args:
        points: Rest positions [m], shape (P, 3).
        channels: Features of a point: 1 for an electrode, 3 for a displacement.
        outputs: Estimated values.
        layers: Sizes of the abstractions.
    """

    def __init__(
        self,
        points: Floats,
        channels: int,
        outputs: int,
        layers: Sequence[Abstraction] = PUBLISHED,
    ) -> None:
        super().__init__()
        self.channels = channels
        made = []
        for size in layers:
            made.append(SetAbstraction(points, channels, size))
            points, channels = made[-1].centres, size.widths[-1]
        self.layers = nn.ModuleList(made)
        self.head = nn.Sequential(
            nn.Linear(channels, 256),
            nn.ReLU(),
            nn.Linear(256, 128),
            nn.ReLU(),
            nn.Linear(128, outputs),
        )

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimate (N, outputs) of features (N, P * channels), point after point."""
        features = inputs.reshape(inputs.shape[0], -1, self.channels)
        for layer in self.layers:
            features = layer(features)
        estimate: Tensor = self.head(features[:, 0])
        return estimate


class PointNet(nn.Module):
    """PointNet: shared layers on each moved point, the most over all points, then a head.

    As Zapata-Impata 2021 uses it: a point cloud in, electrodes out. Its sizes are not published;
    these are those of the original PointNet without its transforms.

    Args:
        points: Rest positions [m], shape (P, 3).
        outputs: Estimated values.
    """

    points: Tensor

    def __init__(self, points: Floats, outputs: int) -> None:
        super().__init__()
        place = (points / MILLIMETRE).astype(np.float32)
        self.register_buffer("points", torch.from_numpy(place))
        self.shared = nn.Sequential(
            nn.Linear(6, 64), nn.ReLU(), nn.Linear(64, 128), nn.ReLU(), nn.Linear(128, 512)
        )
        self.head = nn.Sequential(
            nn.Linear(512, 256), nn.ReLU(), nn.Linear(256, 128), nn.ReLU(), nn.Linear(128, outputs)
        )

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimate (N, outputs) of standardised displacements (N, P * 3)."""
        moved = inputs.reshape(inputs.shape[0], -1, 3)
        placed = self.points.expand(moved.shape[0], -1, -1)
        estimate: Tensor = self.head(torch.amax(self.shared(torch.cat([placed, moved], 2)), 1))
        return estimate


def fit_points(
    layers: Sequence[Abstraction],
    quantity: Quantity,
    train: Samples,
    validation: Samples,
    seed: int,
) -> Estimate:
    """PointNet++ on the electrodes."""
    torch.manual_seed(seed)
    net = Standardised(PointNetPlus(ELECTRODE_POSITIONS, 1, 3, layers))
    fit_standardised(
        net,
        (train.tared, train.truth(quantity)),
        (validation.tared, validation.truth(quantity)),
        POINTS_CONFIG,
    )
    return lambda samples: predict(net, samples.tared)


_EVERY: tuple[Quantity, ...] = ("location", "force", "centre", "normal")

POINTS = (
    System(
        "PointNet++ (the paper's)",
        "Narang et al. 2021, radii 2.5 and 7 mm",
        partial(fit_points, PUBLISHED),
        _EVERY,
        seeded=True,
    ),
    System(
        "PointNet++, radii 6 and 10 mm",
        "Narang et al. 2021 with radii that hold several electrodes",
        partial(fit_points, FITTED),
        _EVERY,
        seeded=True,
    ),
)
