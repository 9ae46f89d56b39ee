"""A displacement field as the few numbers a network estimates: modes of the training rows.

The data set's own basis was fitted to all its rows, held-out ones included. Its modes are
orthonormal, so the principal components of the *training* rows' coefficients are exactly the POD
modes of the training rows' fields; nothing of a held-out trajectory shapes them.

Where the mesh is its own mirror image, so are the modes, but for a sign each: they are those of the
training rows and of their mirror images together. A mirrored field then has the same coefficients,
those of the odd modes with the other sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from palpate.errors import DatasetError
from palpate_training.datasets.experiment import MixedDataset, SkinMesh
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.splits import Rows

FloatArray = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

MODE_COUNTS = (8, 16, 24, 32, 48, 64, 96)
"""Numbers of modes to choose from; 96 of a skin of 6870 nodes are 4.0 MB in half precision."""

MIRROR_TOLERANCE_M = 1e-6
"""A node further from the mirror image of every other has none [m]."""

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
        signs: What a mirror image makes of each coefficient, 1 or -1, shape (K,); None = the mesh
            is not its own mirror image.
    """

    mean: FloatArray
    modes: npt.NDArray[np.float16]
    scale: FloatArray
    centre: FloatArray
    rotation: FloatArray
    truncation_m: dict[int, float]
    signs: FloatArray | None

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
    flat = data.basis.modes.reshape(known.shape[1], -1).astype(np.float64)
    offset = data.basis.mean.reshape(-1).astype(np.float64)
    centre = known.mean(axis=0)
    mean = centre @ flat + offset
    if not np.ptp(known, axis=0).any():
        raise DatasetError(
            "the fields of all training rows are the same",
            remedy="generate a data set in which the skin moves",
        )
    order = mirror_nodes(data.mesh)
    if order is None:
        values, rotation = np.linalg.eigh(_scatter(known - centre))
        signs = None
    else:
        mean = 0.5 * (mean + mirrored(mean[None], order)[0])
        centre = (mean - offset) @ flat.T
        values, rotation, signs = _modes_by_sign(known - centre, flat, order)
    largest_first = np.argsort(-values)
    values, rotation = values[largest_first], rotation[:, largest_first]
    rank = min(int(np.sum(values > values[0] * 1e-12)), max(mode_counts))
    rotation = rotation[:, :rank]
    modes = rotation.T @ flat
    scale = np.abs(modes).max(axis=1)
    code = FieldCode(
        mean=mean.astype(np.float32),
        modes=(modes / scale[:, None]).astype(np.float16),
        scale=scale.astype(np.float32),
        centre=centre.astype(np.float32),
        rotation=rotation.astype(np.float32),
        truncation_m={},
        signs=None if signs is None else signs[largest_first][:rank].astype(np.float32),
    )
    seen = np.unique(validation[np.linspace(0, len(validation) - 1, _CHOICE_ROWS).astype(int)])
    lost: dict[int, float] = {}
    for count in sorted({min(count, rank) for count in mode_counts}):
        shorter = _first(code, count, lost)
        lost[count] = _truncation(data, shorter, seen)
        if lost[count] <= limit_m:
            break
    return _first(code, max(lost), lost)


def _scatter(values: Floats) -> Floats:
    """Mean outer product of rows (N, C), shape (C, C)."""
    return np.asarray(values.T @ values / len(values), np.float64)


def _modes_by_sign(known: Floats, flat: Floats, order: Rows) -> tuple[Floats, Floats, Floats]:
    """Principal directions of rows and their mirror images; each keeps or changes its sign.

    Args:
        known: Coefficients of the rows less those of the mean, shape (N, C).
        flat: Orthonormal modes that they belong to, shape (C, 3V).
        order: Node that is the mirror image of each node, shape (V,).

    Returns:
        Variances (C,), directions (C, C) in columns, and their signs (C,).
    """
    reflection = mirrored(flat, order) @ flat.T
    turned, basis = np.linalg.eigh(0.5 * (reflection + reflection.T))
    values, directions, signs = [], [], []
    for sign in (1.0, -1.0):
        part = basis[:, turned * sign > 0]
        variances, vectors = np.linalg.eigh(_scatter(known @ part))
        values.append(variances)
        directions.append(part @ vectors)
        signs.append(np.full(len(variances), sign))
    return np.concatenate(values), np.hstack(directions), np.concatenate(signs)


def mirror_nodes(mesh: SkinMesh) -> Rows | None:
    """The node that is the mirror image of each node, shape (V,); None if one has none."""
    image = mesh.nodes * MIRROR_AXES
    distance, nearest = cKDTree(mesh.nodes).query(image)
    one_to_one = len(np.unique(nearest)) == len(nearest)
    return nearest if one_to_one and distance.max() <= MIRROR_TOLERANCE_M else None


def mirrored(fields: Floats, order: Rows) -> Floats:
    """Mirror images of fields of vectors (N, 3V), by ``mirror_nodes``."""
    vectors = fields.reshape(len(fields), -1, 3)
    return np.asarray((vectors[:, order] * MIRROR_AXES).reshape(fields.shape), np.float64)


def in_parts(rows: Rows) -> list[Rows]:
    """Rows in parts that are so small that the fields of one fit into memory."""
    return np.split(rows, range(_CHUNK_ROWS, len(rows), _CHUNK_ROWS))


def _first(code: FieldCode, count: int, lost: dict[int, float]) -> FieldCode:
    return replace(
        code,
        modes=code.modes[:count],
        scale=code.scale[:count],
        rotation=code.rotation[:, :count],
        truncation_m=lost,
        signs=None if code.signs is None else code.signs[:count],
    )


def _truncation(data: MixedDataset, code: FieldCode, rows: Rows) -> float:
    total = 0.0
    for part in in_parts(rows):
        lost = code.decode(code.encode(data.coefficients[part])) - data.displacement(part)
        total += float(np.linalg.norm(lost, axis=2).mean(axis=1).sum())
    return total / len(rows)
