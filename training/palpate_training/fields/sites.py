"""How near the skin is to every electrode: the film's thickness, pooled with kernels.

The core is a half-cylinder about the x axis with a spherical tip about the origin
(docs/conventions.md), so its normal is radial.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.anatomy import ELECTRODE_POSITIONS, EXCITATION_POSITIONS
from palpate.errors import DatasetError
from palpate_training.twin.content import SkinMesh

Floats = npt.NDArray[np.float64]
FloatArray = npt.NDArray[np.float32]

SITES: Floats = np.vstack([ELECTRODE_POSITIONS, EXCITATION_POSITIONS])
"""Centres of E1..E19 and of the excitation electrodes X1..X4 [m], shape (23, 3), sensor frame."""

RADII_M = (1.25e-3, 2.5e-3, 5e-3)
"""Radius of an electrode's disc, its diameter, and what surrounds it [m] (learning notes, 6.5)."""

CORE_RADIUS_M = 5.08e-3
"""Distance of the electrodes from the core's axis or tip centre [m]; the flat tip with E7..E10 lies
up to 0.56 mm deeper, so its film is taken for thinner than it is."""

_THINNEST_REST_M = 5e-5
"""Film of a coarse mesh that touches the core at rest; keeps its relative thickness finite [m]."""


@dataclass(frozen=True, slots=True)
class Pooling:
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


def core_normal(points: npt.NDArray[np.floating]) -> Floats:
    """Outward unit normal of the core below points of the film, shape (N, 3).

    Args:
        points: Positions [m], shape (N, 3), sensor frame.
    """
    radial = points.astype(np.float64)
    radial[:, 0] = np.maximum(radial[:, 0], 0.0)
    return np.asarray(radial / np.linalg.norm(radial, axis=1, keepdims=True))


def pooling(mesh: SkinMesh) -> Pooling:
    """Kernel ``(1 - (d/r)^2)^2`` on the core's surface, weighted by the nodes' share of the area.

    A site with no inner node within the radius takes the nearest one.

    Args:
        mesh: The skin, in its pressurised state.

    Raises:
        DatasetError: The mesh has no inner surface.
    """
    if not len(mesh.inner_faces):
        raise DatasetError(
            "the skin mesh has no inner faces, so the film under it is unknown",
            remedy="generate the data set anew with a mesh that tells its inner surface",
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
    return Pooling(
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
