"""A displacement field as the few numbers a network estimates: modes of the training rows.

The data set's own basis was fitted to all its rows, held-out ones included. Its modes are
orthonormal, so the principal components of the *training* rows' coefficients are exactly the POD
modes of the training rows' fields; nothing of a held-out trajectory shapes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.splits import Rows
from palpate_training.twin.content import MixedDataset

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
    seen = validation[np.linspace(0, len(validation) - 1, _CHOICE_ROWS).astype(int)]
    seen = np.unique(seen)
    lost: dict[int, float] = {}
    for count in sorted({min(count, rotation.shape[1]) for count in mode_counts}):
        shorter = _first(code, count, lost)
        lost[count] = _truncation(data, shorter, seen)
        if lost[count] <= limit_m:
            break
    return _first(code, max(lost), lost)


def _first(code: FieldCode, count: int, lost: dict[int, float]) -> FieldCode:
    return FieldCode(
        code.mean,
        code.modes[:count],
        code.scale[:count],
        code.centre,
        code.rotation[:, :count],
        lost,
    )


def _truncation(data: MixedDataset, code: FieldCode, rows: Rows) -> float:
    total = 0.0
    for start in range(0, len(rows), _CHUNK_ROWS):
        part = rows[start : start + _CHUNK_ROWS]
        lost = code.decode(code.encode(data.coefficients[part])) - data.displacement(part)
        total += float(np.linalg.norm(lost, axis=2).mean(axis=1).sum())
    return total / len(rows)
