"""The sealed fluid on the device: the volume inside the skin, and its derivatives."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.device import DEVICE, scalars, vec3s
from palpate_fem.mechanics import fluid_kernels
from palpate_fem.mechanics.reference_element import volume_form
from palpate_fem.mechanics.surface import Surface

Floats = NDArray[np.float64]


class Cavity:
    """What the inner surface encloses; without one the volume is zero."""

    def __init__(self, surface: Surface, nodes: int) -> None:
        self.surface = surface
        self.gradient = np.zeros((nodes, 3))
        self._gradient = vec3s(self.gradient)
        self._form = scalars(volume_form(surface.points if surface.count else 3))
        self._volumes = scalars(np.zeros(max(surface.count, 1)))

    @property
    def volume(self) -> float:
        """At the last evaluation [m^3]."""
        return float(self._volumes.numpy().sum())

    def evaluate(self, position: wp.array) -> None:
        """Volume, and its gradient by the nodes."""
        self.gradient[:] = 0.0
        surface = self.surface
        if surface.count:
            wp.launch(
                fluid_kernels.cavity_volume,
                dim=surface.count,
                inputs=[surface.faces, self._form, position],
                outputs=[self._volumes, self._gradient],
                device=DEVICE,
            )

    def add_tangent(self, position: wp.array, pressure: float, blocks: wp.array) -> None:
        """Add what a fluid pressure [Pa] that follows the surface does to the tangent."""
        surface = self.surface
        if surface.count:
            wp.launch(
                fluid_kernels.cavity_tangent,
                dim=surface.count,
                inputs=[surface.faces, self._form, surface.pairs, wp.float64(-pressure), position],
                outputs=[blocks],
                device=DEVICE,
            )
