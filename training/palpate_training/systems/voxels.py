"""Networks on a grid of voxels around the electrodes: the paper's, and that of Sundaralingam 2019.

A grid has 16 x 16 x 8 voxels, of which 19 hold an electrode, each its own. The grid is gathered
from a vector with a zero behind it by constant indices, so the networks export without operators of
their own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_training.learning.fit import FeaturesFitConfig, fit, fit_standardised
from palpate_training.learning.networks import Standardised, predict
from palpate_training.systems.samples import Estimate, Quantity, Samples, System, error_of

GRID = (16, 16, 8)
PROJECTED_RADIUS_M = 5.5e-3
"""Of the cylinder and sphere on which Sundaralingam 2019 puts the contact estimate [m]."""

SHARPNESS = 10.0
"""Exponent of the weight of a row by the direction of its force."""

VOXEL_CONFIG = FeaturesFitConfig(epochs=25, patience=8, batch_rows=256, learning_rate=1e-3)
PROJECTION_CONFIG = FeaturesFitConfig(epochs=120, patience=20, batch_rows=512, learning_rate=1e-3)


def voxel_of(points: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
    """Voxel of points [m], shape (N, 3), in a grid that spans the electrodes; clipped to it."""
    low, high = ELECTRODE_POSITIONS.min(axis=0), ELECTRODE_POSITIONS.max(axis=0)
    last = np.array(GRID) - 1
    # Divided into one part less than there are voxels: only the far end itself is in the last.
    index = np.floor((points - low) / (high - low) * last + 1e-9).astype(np.int64)
    clipped: npt.NDArray[np.int64] = np.clip(index, 0, last)
    return clipped


def _flat(voxels: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.asarray(np.ravel_multi_index(tuple(voxels.T), GRID), np.int64)


class ElectrodeGrid(nn.Module):
    """Electrodes (N, 19) -> grid (N, 1, 16, 16, 8), zero where there is none."""

    source: Tensor

    def __init__(self) -> None:
        super().__init__()
        source = np.full(math.prod(GRID), len(ELECTRODE_POSITIONS))
        source[_flat(voxel_of(ELECTRODE_POSITIONS))] = np.arange(len(ELECTRODE_POSITIONS))
        self.register_buffer("source", torch.from_numpy(source))

    def forward(self, electrodes: Tensor) -> Tensor:
        """The grid."""
        padded = nn.functional.pad(electrodes, (0, 1))
        return torch.index_select(padded, 1, self.source).reshape(-1, 1, *GRID)


class PaperVoxelNet(nn.Module):
    """The paper's voxel network: 64 and 256 filters in 3D, 512 in 2D, 256 and 128 neurons.

    Kernels and strides are not published: 3 and 2, with the depth of the grid folded into the
    filters for the 2D layer, give "an order of magnitude" more weights than PointNet++.
    """

    def __init__(self, outputs: int = 3) -> None:
        super().__init__()
        depth = math.ceil(GRID[2] / 4)
        self.grid = ElectrodeGrid()
        self.solid = nn.Sequential(
            nn.Conv3d(1, 64, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv3d(64, 256, 3, stride=2, padding=1),
            nn.ReLU(),
        )
        self.flat = nn.Sequential(nn.Conv2d(256 * depth, 512, 3, stride=2, padding=1), nn.ReLU())
        self.head = nn.Sequential(
            nn.Flatten(),
            nn.Linear(512 * 2 * 2, 256),
            nn.ReLU(),
            nn.Linear(256, 128),
            nn.ReLU(),
            nn.Linear(128, outputs),
        )

    def forward(self, electrodes: Tensor) -> Tensor:
        """Estimate (N, outputs) of standardised electrodes (N, 19)."""
        solid = self.solid(self.grid(electrodes))  # (N, 256, 4, 4, 2)
        rows = solid.shape[0]
        folded = solid.permute(0, 1, 4, 2, 3).reshape(rows, -1, *solid.shape[2:4])
        estimate: Tensor = self.head(self.flat(folded))
        return estimate


def _normalised(layer: nn.Module, width: int) -> nn.Sequential:
    """A layer, normalised over all values of a row, with a factor and offset for each filter."""
    return nn.Sequential(layer, nn.GroupNorm(1, width, eps=1e-12), nn.ReLU())


class ProjectionNet(nn.Module):
    """Sundaralingam 2019: electrodes and contact estimate as grids -> force [N].

    The contact estimate is the centroid by squared tared counts, projected radially on the finger;
    it becomes a grid with a one at its voxel.
    """

    positions: Tensor
    low: Tensor
    extent: Tensor
    last: Tensor
    voxels: Tensor
    axis: Tensor

    def __init__(self) -> None:
        super().__init__()
        positions = ELECTRODE_POSITIONS.astype(np.float32)
        span = positions.max(axis=0) - positions.min(axis=0)
        for name, values in (
            ("positions", positions),
            ("low", positions.min(axis=0)),
            ("extent", span),
            ("last", np.array(GRID, np.float32) - 1.0),
            ("voxels", np.arange(math.prod(GRID), dtype=np.float32)),
            ("axis", np.array([1.0, 0.0, 0.0], np.float32)),
        ):
            self.register_buffer(name, torch.from_numpy(values))
        self.grid = ElectrodeGrid()
        self.of_electrodes = _normalised(nn.Conv3d(1, 64, 2, stride=2), 64)
        self.of_contact = _normalised(nn.Conv3d(1, 64, 2, stride=2), 64)
        self.solid = nn.Sequential(
            _normalised(nn.Conv3d(128, 64, 2, stride=2), 64),
            _normalised(nn.Conv3d(64, 64, 2, stride=2), 64),
        )
        self.flat = _normalised(nn.Conv2d(64, 128, 2, stride=2), 128)
        self.head = nn.Sequential(
            _normalised(nn.Linear(128, 64), 64),
            _normalised(nn.Linear(64, 32), 32),
            nn.Linear(32, 3),
        )

    def contact(self, tared_counts: Tensor) -> Tensor:
        """Contact estimate [m], shape (N, 3)."""
        weight = torch.square(tared_counts)
        weight = weight / torch.clamp(weight.sum(dim=1, keepdim=True), min=1e-12)
        centroid = weight @ self.positions
        on_cylinder = (centroid[:, :1] <= 0.0).to(centroid.dtype)
        along = centroid * self.axis * on_cylinder
        radial = centroid - along
        length = torch.clamp(torch.linalg.vector_norm(radial, dim=1, keepdim=True), min=1e-9)
        return along + radial * PROJECTED_RADIUS_M / length

    def inward(self, tared_counts: Tensor) -> Tensor:
        """Unit normal into the finger at the contact estimate, shape (N, 3)."""
        contact = self.contact(tared_counts)
        on_cylinder = (contact[:, :1] <= 0.0).to(contact.dtype)
        return -nn.functional.normalize(contact - contact * self.axis * on_cylinder, dim=1)

    def contact_grid(self, tared_counts: Tensor) -> Tensor:
        """The contact estimate as a grid (N, 1, 16, 16, 8), by the same edges as the electrodes."""
        share = (self.contact(tared_counts) - self.low) / self.extent
        index = torch.clamp(torch.floor(share * self.last + 1e-4), min=0.0)
        index = torch.minimum(index, self.last)
        flat = (index[:, :1] * GRID[1] + index[:, 1:2]) * GRID[2] + index[:, 2:]
        return (flat == self.voxels).to(tared_counts.dtype).reshape(-1, 1, *GRID)

    def forward(self, tared_counts: Tensor) -> Tensor:
        """Force [N], shape (N, 3), of tared counts (N, 19)."""
        both = torch.cat(
            [
                self.of_electrodes(self.grid(tared_counts)),
                self.of_contact(self.contact_grid(tared_counts)),
            ],
            dim=1,
        )
        flat = self.flat(self.solid(both).squeeze(4))
        force: Tensor = self.head(flat.flatten(1))
        return force

    def load_published(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Take the published weights, by their names in the original framework."""
        layers = [
            self.of_electrodes, self.of_contact, *self.solid, self.flat, *self.head
        ]  # fmt: skip
        names = ["Conv", "Conv_1", "Conv_2", "Conv_3", "Conv_4"]
        names += ["fully_connected", "fully_connected_1", "fully_connected_2"]
        for number, (layer, name) in enumerate(zip(layers, names, strict=True)):
            inner = layer[0] if isinstance(layer, nn.Sequential) else layer
            weight = np.moveaxis(arrays[f"{name}.weights"], (-1, -2), (0, 1))
            inner.weight.data = torch.from_numpy(np.ascontiguousarray(weight))
            inner.bias.data = torch.from_numpy(arrays[f"{name}.biases"].copy())
            if isinstance(layer, nn.Sequential):
                norm = "LayerNorm" + (f"_{number}" if number else "")
                layer[1].weight.data = torch.from_numpy(arrays[f"{norm}.gamma"].copy())
                layer[1].bias.data = torch.from_numpy(arrays[f"{norm}.beta"].copy())


def projection_loss(net: ProjectionNet, estimate: Tensor, truth: Tensor, counts: Tensor) -> Tensor:
    """Loss of Sundaralingam 2019 for three-dimensional forces, estimates and truth (B, 3) [N].

    Rows count more the closer the force is to the normal at the contact estimate. The article's
    normal is taken as into the finger, where a press pushes.
    """
    size = torch.clamp(torch.linalg.vector_norm(truth, dim=1), min=1e-3)
    cosine = (net.inward(counts) * truth).sum(dim=1) / size
    angle = torch.arccos(torch.clamp(cosine, -1.0 + 1e-6, 1.0 - 1e-6))
    weight = torch.exp2(SHARPNESS * (1.0 - angle / math.pi)) / 2.0**SHARPNESS
    squares = torch.square(estimate - truth).sum(dim=1)
    return torch.sqrt((weight * squares / size).mean() + 1e-12)


def fit_paper_voxels(
    quantity: Quantity, train: Samples, validation: Samples, seed: int
) -> Estimate:
    """The paper's voxel network."""
    torch.manual_seed(seed)
    net = Standardised(PaperVoxelNet())
    fit_standardised(
        net,
        (train.tared, train.truth(quantity)),
        (validation.tared, validation.truth(quantity)),
        VOXEL_CONFIG,
    )
    return lambda samples: predict(net, samples.tared)


def fit_projection(quantity: Quantity, train: Samples, validation: Samples, seed: int) -> Estimate:
    """Sundaralingam 2019: its network and loss; the optimiser is that of all networks here."""
    torch.manual_seed(seed)
    net = ProjectionNet()
    counts = torch.from_numpy(train.tared).to(torch.get_default_device())

    def loss_of(estimate: Tensor, truth_and_row: Tensor) -> Tensor:
        rows = truth_and_row[:, 3].to(torch.int64)
        return projection_loss(net, estimate, truth_and_row[:, :3], counts[rows])

    rows = np.arange(len(train), dtype=np.float32)[:, None]
    fit(
        net,
        train.tared,
        np.hstack([train.force, rows]),
        loss_of=loss_of,
        score_of=lambda net: error_of(predict(net, validation.tared), validation.force),
        config=PROJECTION_CONFIG,
    )
    return lambda samples: predict(net, samples.tared)


VOXELS = (
    System(
        "voxel network (the paper's)",
        "Narang et al. 2021, section on tactile features",
        fit_paper_voxels,
        ("location", "force", "centre", "normal"),
        seeded=True,
    ),
    System(
        "Sundaralingam 2019: voxels, projection loss",
        "Sundaralingam et al., ICRA 2019, arXiv 1810.06187",
        fit_projection,
        ("force",),
        seeded=True,
    ),
)
