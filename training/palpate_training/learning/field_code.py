"""A displacement field as the few numbers a network estimates: modes of the training rows.

The data set's own basis was fitted to all its rows, held-out ones included. Its modes are
orthonormal, so the principal components of the *training* rows' coefficients are exactly the POD
modes of the training rows' fields; nothing of a held-out trajectory shapes them.

How near the skin is to every electrode: the film's thickness, pooled with kernels.

The core is a half-cylinder about the x axis with a spherical tip about the origin
(docs/conventions.md), so its normal is radial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from palpate.anatomy import CORE_RADIUS_M, ELECTRODE_POSITIONS, EXCITATION_POSITIONS, core_normal
from palpate.errors import DatasetError
from palpate_training.datasets.experiment import MixedDataset, SkinMesh
from palpate_training.learning.splits import Rows

FloatArray = npt.NDArray[np.float32]

MODE_COUNTS = (8, 16, 24, 32, 48, 64)
"""Numbers of modes to choose from; 64 of a skin of 6870 nodes are 2.6 MB in half precision."""

TRUNCATION_LIMIT_M = 5e-6
"""Enough modes are those that lose no more on validation rows, mean over rows and nodes [m]: a
fortieth of the paper's best field error (0.20 mm)."""

_CHOICE_ROWS = 400
_CHUNK_ROWS = 256


@dataclass(frozen=True, slots=True)
class FieldCode:
    """field = mean + (coefficients * scale) @ modes, with the modes as they are shipped.

    Attributes:
        mean: Mean field of the training rows [m], shape (3V,).
        modes: Largest entry of each is 1, half precision, shape (K, 3V).
        scale: Turns coefficients of orthonormal modes [m] into factors of ``modes``, shape (K,).
        centre: Mean of the data set's coefficients over the training rows [m], shape (C,).
        rotation: From the data set's coefficients to these, shape (C, K).
        truncation_m: Number of modes -> mean nodal distance between validation fields and their
            projection on so many modes [m], half precision included.
    """

    mean: FloatArray
    modes: npt.NDArray[np.float16]
    scale: FloatArray
    centre: FloatArray
    rotation: FloatArray
    truncation_m: dict[int, float]

    @property
    def size(self) -> int:
        """Number of modes."""
        return len(self.modes)

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return len(self.mean) // 3

    def encode(self, coefficients: FloatArray) -> FloatArray:
        """Coefficients (N, K) [m] of rows given by the data set's coefficients (N, C)."""
        return np.asarray((coefficients - self.centre) @ self.rotation, np.float32)

    def project(self, displacement: FloatArray) -> FloatArray:
        """Coefficients (N, K) [m] of fields [m], shape (N, 3V), as the shipped graph has them."""
        modes = self.modes.astype(np.float32)
        return np.asarray(((displacement - self.mean) @ modes.T) * self.scale, np.float32)

    def decode(self, coefficients: npt.NDArray[np.floating]) -> FloatArray:
        """Displacement [m], shape (N, V, 3), of coefficients (N, K)."""
        scaled = np.asarray(coefficients, np.float32) * self.scale
        flat = scaled @ self.modes.astype(np.float32) + self.mean
        return np.asarray(flat.reshape(len(flat), -1, 3), np.float32)


def fit_code(
    data: MixedDataset,
    train: Rows,
    validation: Rows,
    *,
    mode_counts: Sequence[int] = MODE_COUNTS,
    limit_m: float = TRUNCATION_LIMIT_M,
) -> FieldCode:
    """Modes of the training rows: the fewest that lose ``limit_m`` or less on validation rows.

    Args:
        data: Rows with the coefficients of their fields.
        train: Rows to take the modes from.
        validation: Rows to choose their number on.
        mode_counts: Numbers to choose from, ascending; the last is taken if none is enough.
        limit_m: Mean nodal distance that may be lost [m].

    Raises:
        DatasetError: The training rows all have the same field.
    """
    known = data.coefficients[train].astype(np.float64)
    centre = known.mean(axis=0)
    values, vectors = np.linalg.eigh(
        np.cov(known - centre, rowvar=False).reshape(2 * [len(centre)])
    )
    if not values[-1] > 0:
        raise DatasetError(
            "the fields of all training rows are the same",
            remedy="generate a data set in which the skin moves",
        )
    rank = int(np.sum(values > values[-1] * 1e-12))
    rotation = vectors[:, ::-1][:, : min(rank, max(mode_counts))]
    flat = data.basis.modes.reshape(len(centre), -1).astype(np.float64)
    modes = rotation.T @ flat
    scale = np.abs(modes).max(axis=1)
    code = FieldCode(
        mean=(centre @ flat + data.basis.mean.reshape(-1)).astype(np.float32),
        modes=(modes / scale[:, None]).astype(np.float16),
        scale=scale.astype(np.float32),
        centre=centre.astype(np.float32),
        rotation=rotation.astype(np.float32),
        truncation_m={},
    )
    seen = np.unique(validation[np.linspace(0, len(validation) - 1, _CHOICE_ROWS).astype(int)])
    lost: dict[int, float] = {}
    for count in sorted({min(count, rotation.shape[1]) for count in mode_counts}):
        shorter = _first(code, count, lost)
        lost[count] = _truncation(data, shorter, seen)
        if lost[count] <= limit_m:
            break
    return _first(code, max(lost), lost)


def _first(code: FieldCode, count: int, lost: dict[int, float]) -> FieldCode:
    return replace(
        code,
        modes=code.modes[:count],
        scale=code.scale[:count],
        rotation=code.rotation[:, :count],
        truncation_m=lost,
    )


def _truncation(data: MixedDataset, code: FieldCode, rows: Rows) -> float:
    total = 0.0
    for start in range(0, len(rows), _CHUNK_ROWS):
        part = rows[start : start + _CHUNK_ROWS]
        lost = code.decode(code.encode(data.coefficients[part])) - data.displacement(part)
        total += float(np.linalg.norm(lost, axis=2).mean(axis=1).sum())
    return total / len(rows)


Floats = npt.NDArray[np.float64]

SITES: Floats = np.vstack([ELECTRODE_POSITIONS, EXCITATION_POSITIONS])
"""Centres of E1..E19 and of the excitation electrodes X1..X4 [m], shape (23, 3), sensor frame."""

RADII_M = (1.25e-3, 2.5e-3, 5e-3)
"""Radius of an electrode's disc, its diameter, and what surrounds it [m] (learning notes, 6.5)."""

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
    area = _nodal_area(mesh, inner)
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


def _nodal_area(mesh: SkinMesh, inner: npt.NDArray[np.int64]) -> Floats:
    corners = mesh.nodes[mesh.inner_faces]  # (G, 3, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    third = np.linalg.norm(cross, axis=1) / 6.0
    area = np.bincount(mesh.inner_faces.ravel(), np.repeat(third, 3), minlength=len(mesh.nodes))
    return np.asarray(area[inner], np.float64)
