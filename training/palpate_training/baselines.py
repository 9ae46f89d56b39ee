"""What a network has to beat: nothing, a constant, a straight line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.floating]


@dataclass(frozen=True, slots=True)
class Affine:
    """``y = x @ weight + offset``.

    Attributes:
        weight: Shape ``(C, 3)``.
        offset: Shape ``(3,)``.
    """

    weight: npt.NDArray[np.float64]
    offset: npt.NDArray[np.float64]

    def predict(self, inputs: Float) -> npt.NDArray[np.float64]:
        """Estimates, shape ``(N, 3)``, for inputs of shape ``(N, C)``."""
        return np.asarray(inputs @ self.weight + self.offset, dtype=np.float64)


def zero(inputs: Float) -> Affine:
    """Always zero: for a force, "nothing touches"."""
    return Affine(np.zeros((inputs.shape[1], 3)), np.zeros(3))


def constant(inputs: Float, targets: Float) -> Affine:
    """Always the mean of the training targets."""
    return Affine(np.zeros((inputs.shape[1], 3)), targets.mean(axis=0, dtype=np.float64))


def linear(inputs: Float, targets: Float) -> Affine:
    """Least squares with intercept; inputs are centred first, for conditioning."""
    centre = inputs.mean(axis=0, dtype=np.float64)
    mean = targets.mean(axis=0, dtype=np.float64)
    weight = np.linalg.lstsq(inputs - centre, targets - mean, rcond=None)[0]
    return Affine(weight, mean - centre @ weight)
