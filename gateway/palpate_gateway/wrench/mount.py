"""Where a force/torque sensor sits: from what it measures to the wrench on the BioTac.

A sensor under the BioTac feels what presses the BioTac; one that carries the indenter feels the
reaction. Either way the frames that leave the gateway hold the wrench *on the BioTac*, in the
sensor frame, about the sensor frame's origin (docs/conventions.md).
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import model_validator

from palpate.config import StrictConfig
from palpate.messages import FloatArray

Floats = npt.NDArray[np.float64]


class MountOptions(StrictConfig):
    """How a force/torque sensor is mounted.

    Attributes:
        carries: What is fixed to its measuring side; ``indenter`` turns the wrench's sign.
        orientation_wxyz: Unit quaternion of the force/torque sensor's frame in the sensor frame.
        origin_m: Origin of the force/torque sensor's frame in the sensor frame [m].
    """

    carries: Literal["biotac", "indenter"] = "biotac"
    orientation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _is_rotation(self) -> MountOptions:
        size = math.sqrt(sum(part * part for part in self.orientation_wxyz))
        if not abs(size - 1.0) < 1e-3:
            raise ValueError(
                f"orientation_wxyz {self.orientation_wxyz} has length {size:.4g}, not 1: give a "
                "unit quaternion w x y z"
            )
        if not all(math.isfinite(part) for part in self.origin_m):
            raise ValueError(f"origin_m {self.origin_m} is not finite")
        return self


class Mount:
    """The transformation that `MountOptions` describe."""

    def __init__(self, options: MountOptions) -> None:
        w, x, y, z = np.array(options.orientation_wxyz) / np.linalg.norm(options.orientation_wxyz)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        x, y, z = options.origin_m
        arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        sign = 1.0 if options.carries == "biotac" else -1.0
        zero = np.zeros((3, 3))
        # One product a sample: some sensors send 7000 of them a second.
        self._matrix = sign * np.block([[rotation, zero], [arm @ rotation, rotation]])
        self._plain = bool((self._matrix == np.eye(6)).all())

    def on_biotac(self, wrench: Floats) -> tuple[FloatArray, FloatArray]:
        """Wrench on the BioTac in the sensor frame.

        Args:
            wrench: As measured: force [N], torque about the force/torque sensor's own origin [N m],
                shape (6,).

        Returns:
            Force [N] and torque about the sensor frame's origin [N m], float32, shape (3,).
        """
        turned = (wrench if self._plain else self._matrix @ wrench).astype(np.float32)
        return turned[:3], turned[3:]
