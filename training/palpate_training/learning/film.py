"""How near the skin is to every electrode, and what the electrodes read of it.

The film's thickness is pooled with kernels. The core is a half-cylinder about the x axis with a
spherical tip about the origin (docs/conventions.md), so its normal is radial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from palpate.anatomy import CORE_RADIUS_M, ELECTRODE_POSITIONS, EXCITATION_POSITIONS, core_normal
from palpate.errors import DatasetError
from palpate.messages import COUNTS_MAX
from palpate_training.datasets.experiment import SkinMesh
from palpate_training.learning.electrode_nets import MIRROR_AXES, in_lanes, log_impedance
from palpate_training.learning.networks import Standardised

FloatArray = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

SITES: Floats = np.vstack([ELECTRODE_POSITIONS, EXCITATION_POSITIONS])
"""Centres of E1..E19 and of the excitation electrodes X1..X4 [m], shape (23, 3), sensor frame."""

MIRRORED_SITES = cKDTree(SITES).query(SITES * MIRROR_AXES)[1]
"""Site that is the mirror image of each site, shape (23,)."""

RADII_M = (1.25e-3, 2.5e-3, 5e-3)
"""Radius of an electrode's disc, its diameter, and what surrounds it [m] (learning notes, 6.5)."""

MIRRORED_FILM = (MIRRORED_SITES[:, None] * len(RADII_M) + np.arange(len(RADII_M))).ravel()
"""Pooled value that is the mirror image of each, shape (P,)."""

_THINNEST_REST_M = 5e-5
"""Film of a coarse mesh that touches the core at rest; keeps its relative thickness finite [m]."""


@dataclass(frozen=True, slots=True)
class FilmPooling:
    """Linear map from nodal displacement to the change of the film near every electrode.

    Attributes:
        nodes: Inner nodes that any site looks at, shape (I,).
        normals: The core's outward normal below each, shape (I, 3).
        weights: Share of each node in each pooled value, shape (I, P), columns sum to 1; P is 23
            sites times three radii, site by site.
        rest_m: Pooled thickness of the film in the untouched state [m], shape (P,), positive.
    """

    nodes: npt.NDArray[np.int64]
    normals: FloatArray
    weights: FloatArray
    rest_m: FloatArray

    def pool(self, displacement: npt.NDArray[np.floating]) -> FloatArray:
        """Change of the pooled film [m], shape (N, P), of displacements [m], shape (N, V, 3).

        Negative where the skin comes nearer to the core.
        """
        change = np.sum(displacement[:, self.nodes] * self.normals, axis=2)
        return np.asarray(change @ self.weights, np.float32)


def pooling(mesh: SkinMesh) -> FilmPooling:
    """Kernel ``(1 - (d/r)^2)^2`` on the core's surface, weighted by the nodes' share of the area.

    A site with no inner node within the radius takes the nearest one.

    Raises:
        DatasetError: The mesh has no inner surface.
    """
    if not len(mesh.inner_faces):
        raise DatasetError(
            "the skin mesh has no inner faces, so the film under it is unknown",
            remedy="generate the data set anew with a mesh that marks its inner surface",
        )
    inner = np.unique(mesh.inner_faces).astype(np.int64)
    points = mesh.nodes[inner]
    normals = core_normal(points)
    axis = np.minimum(points[:, :1], 0.0) * [[1.0, 0.0, 0.0]]
    film = np.sum((points - axis) * normals, axis=1) - CORE_RADIUS_M
    foot = axis + CORE_RADIUS_M * normals
    area = mesh.areas(mesh.inner_faces)[inner]
    distance = np.linalg.norm(foot[:, None] - SITES[None], axis=2)  # (I, 23)
    columns = []
    for site in range(len(SITES)):
        for radius in RADII_M:
            near = np.maximum(1.0 - (distance[:, site] / radius) ** 2, 0.0) ** 2 * area
            if near.sum() <= 0:
                near[np.argmin(distance[:, site])] = 1.0
            columns.append(near / near.sum())
    weights = np.stack(columns, axis=1)
    used = np.flatnonzero(weights.any(axis=1))
    return FilmPooling(
        nodes=inner[used],
        normals=normals[used].astype(np.float32),
        weights=weights[used].astype(np.float32),
        rest_m=np.maximum(film @ weights, _THINNEST_REST_M).astype(np.float32),
    )


THINNEST_FILM = 0.02
"""Relative thickness below which a film counts as closed; keeps the logarithm finite."""

SMALLEST_MODE = 0.1
"""Modes that vary less than this share of the first are not scaled to unit variance: they hold
little but the rounding and the peculiarities of single trajectories."""


class FilmNet(nn.Module):
    """Coefficients and pooled film change -> tared counts of one unit; the mean of some networks.

    The impedance of an electrode under a thin film is nearly inverse in its thickness, so networks
    see the logarithm of the film's relative thickness, and estimate the fall of the logarithm of
    the impedance (learning notes, section 4.2).

    Args:
        nets: Members, ``(N, K + 2P)`` -> fall of the logarithm of the impedance ``(N, 19)``.
        modes: K.
        rest_m: Pooled film of the untouched finger [m], shape ``(P,)``.
        rest: Untouched counts of the unit [counts], shape ``(19,)``.
    """

    rest_m: Tensor
    rest: Tensor
    log_rest: Tensor

    def __init__(
        self, nets: Sequence[Standardised], modes: int, rest_m: FloatArray, rest: FloatArray
    ) -> None:
        super().__init__()
        self.nets = nn.ModuleList(nets)
        self.modes = modes
        self.register_buffer("rest_m", torch.from_numpy(rest_m))
        self.register_buffer("rest", torch.from_numpy(rest.astype(np.float32)))
        self.register_buffer("log_rest", log_impedance(self.rest))

    def widen(self, features: Tensor) -> Tensor:
        """Features ``(N, K + P)`` [m] with the logarithms behind them, ``(N, K + 2P)``."""
        thickness = 1.0 + features[:, self.modes :] / self.rest_m
        logarithm = in_lanes(torch.log, torch.clamp(thickness, min=THINNEST_FILM))
        return torch.cat([features, logarithm], dim=1)

    def fall_of(self, tared: Tensor) -> Tensor:
        """Fall of the logarithm of the impedance that tared counts ``(N, 19)`` mean."""
        return self.log_rest - log_impedance(self.rest + tared)

    def counts_of(self, fall: Tensor) -> Tensor:
        """Tared counts of a fall of the logarithm of the impedance, ``(N, 19)``."""
        return COUNTS_MAX / (1.0 + in_lanes(torch.exp, self.log_rest - fall)) - self.rest

    def forward(self, features: Tensor) -> Tensor:
        """Tared counts ``(N, 19)`` of features ``(N, K + P)`` [m]."""
        wide = self.widen(features)
        falls: list[Tensor] = [net(wide) for net in self.nets]
        return self.counts_of(torch.stack(falls).sum(dim=0) / len(falls))
