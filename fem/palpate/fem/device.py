"""Where kernels run, and NumPy arrays as Warp sees them, without a copy."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

# Warp announces itself, its devices and each kernel it loads on standard output; errors still come.
wp.config.log_level = wp.LOG_ERROR

DEVICE = "cpu"


def scalars(array: NDArray[np.float64]) -> wp.array:
    """A float64 array of any shape."""
    return wp.array(array, dtype=wp.float64, device=DEVICE, copy=False)


def vec3s(array: NDArray[np.float64]) -> wp.array:
    """An array of 3-vectors; the last axis is the vector."""
    return wp.array(array, dtype=wp.vec3d, device=DEVICE, copy=False)


def mat33s(array: NDArray[np.float64]) -> wp.array:
    """An array of 3 x 3 matrices; the last two axes are the matrix."""
    return wp.array(array, dtype=wp.mat33d, device=DEVICE, copy=False)
