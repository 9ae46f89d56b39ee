"""Types of the arrays that functions of this package take and return."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
"""Ids of nodes, elements and faces."""
