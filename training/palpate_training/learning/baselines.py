"""What a network has to beat: zero, the training mean, a straight line, a ridge regression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.floating]


RIDGE_STRENGTHS = (1e-6, 1e-4, 1e-2, 1e-1, 1.0)
"""Penalties to choose from, relative to the number of rows; inputs are standardised."""


@dataclass(frozen=True, slots=True)
class AffineModel:
    """``y = x @ weight + offset``.

    Attributes:
        weight: Shape ``(I, O)``.
        offset: Shape ``(O,)``.
    """

    weight: npt.NDArray[np.float64]
    offset: npt.NDArray[np.float64]

    def predict(self, inputs: Float) -> npt.NDArray[np.float64]:
        """Estimates, shape ``(N, O)``, for inputs of shape ``(N, I)``."""
        return np.asarray(inputs @ self.weight + self.offset, dtype=np.float64)


def zero(inputs: Float, targets: Float) -> AffineModel:
    """Always zero: no force, no motion, no electrode changes."""
    width = targets.shape[1]
    return AffineModel(np.zeros((inputs.shape[1], width)), np.zeros(width))


def constant(inputs: Float, targets: Float) -> AffineModel:
    """Always the mean of the training targets."""
    mean = targets.mean(axis=0, dtype=np.float64)
    return AffineModel(np.zeros((inputs.shape[1], len(mean))), mean)


def linear(inputs: Float, targets: Float) -> AffineModel:
    """Least squares with intercept; inputs are centred first, for conditioning."""
    centre = inputs.mean(axis=0, dtype=np.float64)
    mean = targets.mean(axis=0, dtype=np.float64)
    weight = np.linalg.lstsq(inputs - centre, targets - mean, rcond=None)[0]
    return AffineModel(weight, mean - centre @ weight)


def ridge(
    inputs: Float, targets: Float, validation_inputs: Float, validation_targets: Float
) -> AffineModel:
    """Least squares with intercept and a penalty that is chosen on the validation rows."""
    centre, offset = inputs.mean(axis=0, dtype=float), targets.mean(axis=0, dtype=float)
    spread = inputs.std(axis=0, dtype=float)
    spread = np.where(spread > 0, spread, 1.0)
    scaled = (inputs - centre) / spread
    gram, moment = scaled.T @ scaled, scaled.T @ (targets - offset)
    best: tuple[float, AffineModel] | None = None
    for strength in RIDGE_STRENGTHS:
        penalty = strength * len(inputs) * np.eye(len(gram))
        weight = np.linalg.solve(gram + penalty, moment) / spread[:, None]
        line = AffineModel(weight, offset - centre @ weight)
        residual = line.predict(validation_inputs) - validation_targets
        score = float(np.mean(np.square(residual)))
        if best is None or score < best[0]:
            best = (score, line)
    assert best is not None  # there is at least one strength
    return best[1]
