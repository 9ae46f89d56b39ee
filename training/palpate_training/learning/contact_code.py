"""Contact forces on the skin's nodes, as the few numbers a network estimates.

A press touches a few dozen nodes, and another press touches others: forces of single nodes have no
short basis. Nineteen electrodes tell places apart that are about 1.5 mm away, so the force of each
node is first spread over its neighbourhood. The net force stays what it is, and so does the place
of the press. Then the forces have a few modes, each even or odd if the mesh is its own mirror image
(``field_code``). An untouched finger has no forces, so no mean is taken off.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from palpate.errors import DatasetError
from palpate_training.datasets.experiment import MixedDataset, SkinMesh
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.field_code import in_parts, mirror_nodes
from palpate_training.learning.splits import Rows

FloatArray = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

SPREAD_M = 1.5e-3
"""Standard deviation of the Gaussian that a node's force is spread by [m]."""

CONTACT_MODES = 96
"""Of the twin's presses they misplace 6 % of the force (median), 3 % from 2 N on."""

FLOOR_N = 0.5
"""Modes are those of forces over this plus the net force [N]."""

_FIT_ROWS = 2000


@dataclass(frozen=True, slots=True)
class ContactCode:
    """force of outer nodes = (coefficients * scale) @ modes, with the modes as they are shipped.

    Attributes:
        outer: Nodes of the outer surface, shape (O,).
        nodes: Number of nodes of the skin.
        modes: Largest entry of each is 1, half precision, shape (K, 3 O).
        scale: Turns coefficients of orthonormal modes [N] into factors of ``modes``, shape (K,).
        signs: What a mirror image makes of each coefficient, 1 or -1, shape (K,); None = the mesh
            is not its own mirror image.
    """

    outer: Rows
    nodes: int
    modes: npt.NDArray[np.float16]
    scale: FloatArray
    signs: FloatArray | None

    @property
    def size(self) -> int:
        """Number of modes."""
        return len(self.modes)

    def encode(self, forces: FloatArray) -> FloatArray:
        """Coefficients (N, K) [N] of forces on the outer nodes (N, O, 3) [N]."""
        flat = forces.reshape(len(forces), -1)
        return np.asarray((flat @ self.modes.astype(np.float32).T) * self.scale, np.float32)

    def decode(self, coefficients: npt.NDArray[np.floating]) -> FloatArray:
        """Forces on the outer nodes [N], shape (N, O, 3), of coefficients (N, K)."""
        scaled = np.asarray(coefficients, np.float32) * self.scale
        flat = scaled @ self.modes.astype(np.float32)
        return np.asarray(flat.reshape(len(flat), -1, 3), np.float32)


def fit_contact_code(data: MixedDataset, train: Rows, *, modes: int = CONTACT_MODES) -> ContactCode:
    """Modes of the spread contact forces of training rows, and of their mirror images.

    Raises:
        DatasetError: The data set has no contact forces, or no training row has any.
    """
    seen = train[np.unique(np.linspace(0, len(train) - 1, _FIT_ROWS).astype(int))]
    forces = spread_forces(data, seen).astype(np.float64)
    # By variance alone the few hard presses would have all the modes.
    newtons = np.linalg.norm(data.simulated_force[seen], axis=1)
    forces /= (FLOOR_N + newtons)[:, None, None]
    image = mirror_nodes(data.mesh)
    outer = data.mesh.outer_nodes.astype(np.int64)
    if image is None:
        parts = [(1.0, forces)]
    else:
        mirrored = forces[:, np.searchsorted(outer, image[outer])] * MIRROR_AXES
        # The sum and the difference with the mirror image have the even and the odd modes.
        parts = [(1.0, 0.5 * (forces + mirrored)), (-1.0, 0.5 * (forces - mirrored))]
    variances, found, signs = [], [], []
    for sign, part in parts:
        flat = part.reshape(len(part), -1)
        values, vectors = np.linalg.eigh(flat @ flat.T)
        kept = values > values[-1] * 1e-12 if values[-1] > 0 else np.zeros(len(values), bool)
        variances.append(values[kept])
        found.append((vectors[:, kept] / np.sqrt(values[kept])).T @ flat)
        signs.append(np.full(int(kept.sum()), sign))
    order = np.argsort(-np.concatenate(variances))[:modes]
    if not len(order):
        raise DatasetError(
            "no training row has a contact force",
            remedy="generate a data set in which the indenter touches the skin",
        )
    orthonormal = np.vstack(found)[order]
    scale = np.abs(orthonormal).max(axis=1)
    return ContactCode(
        outer=outer,
        nodes=len(data.mesh.nodes),
        modes=(orthonormal / scale[:, None]).astype(np.float16),
        scale=scale.astype(np.float32),
        signs=None if image is None else np.concatenate(signs)[order].astype(np.float32),
    )


def contact_coefficients(data: MixedDataset, code: ContactCode) -> FloatArray:
    """Coefficients of the spread forces of all rows [N], shape (N, K)."""
    parts = spread_forces_in_parts(data, np.arange(len(data)))
    return np.concatenate([code.encode(part) for part in parts])


def spread_forces_in_parts(data: MixedDataset, rows: Rows) -> Iterator[FloatArray]:
    """``spread_forces`` of each part of the rows (``in_parts``), one after the other."""
    weights = spreading(data.mesh)
    for part in in_parts(rows):
        yield spread_forces(data, part, weights)


def spread_forces(data: MixedDataset, rows: Rows, weights: Floats | None = None) -> FloatArray:
    """Contact forces of rows on the outer nodes, spread over the skin [N], shape (R, O, 3).

    Data sets hold forces as modes, which lose some of the net force; it is put back where the
    forces are, so that each row's sum is the force of the simulation.

    Args:
        data: The rows.
        rows: Which of them.
        weights: Where forces go, from ``spreading``; None = found here.

    Raises:
        DatasetError: The data set has no contact forces.
    """
    if data.contact is None:
        raise DatasetError(
            "the data set has no contact forces",
            remedy="generate it again with this version of palpate",
        )
    forces = data.contact.basis.decode(data.contact.coefficients[rows]).astype(np.float64)
    size = np.linalg.norm(forces, axis=2)
    share = size / np.maximum(size.sum(axis=1, keepdims=True), 1e-12)
    lost = data.simulated_force[rows] - forces.sum(axis=1)
    whole = forces + share[:, :, None] * lost[:, None]
    weights = spreading(data.mesh) if weights is None else weights
    spread = np.tensordot(whole, weights, axes=(1, 1))  # (R, 3, O)
    return np.asarray(spread.transpose(0, 2, 1), np.float32)


def spreading(mesh: SkinMesh) -> Floats:
    """Where the force of each outer node goes, shape (O, O): columns that sum to 1.

    A Gaussian of ``SPREAD_M`` of the distance, weighted by each node's share of the skin's area.
    """
    outer = mesh.outer_nodes
    place = mesh.nodes[outer]
    area = mesh.areas(mesh.outer_faces)[outer]
    weights = area[:, None] * np.exp(-0.5 * np.square(cdist(place, place) / SPREAD_M))
    return np.asarray(weights / weights.sum(axis=0), np.float64)
