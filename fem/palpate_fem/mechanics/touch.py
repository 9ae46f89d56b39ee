"""Contact of the skin's two surfaces: outside with the indenter, inside with the core."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.device import DEVICE, scalars, vec3s
from palpate_fem.mechanics import contact_kernels, core_kernels
from palpate_fem.mechanics.laws import ContactSettings, Press
from palpate_fem.mechanics.state import State
from palpate_fem.mechanics.surface import Surface
from palpate_fem.mesh.core import DistanceGrid

Floats = NDArray[np.float64]


class IndenterContact:
    """Frictional contact of the outer surface with an indenter."""

    def __init__(self, surface: Surface, nodes: int, settings: ContactSettings) -> None:
        self.surface, self.settings = surface, settings
        self.force = np.zeros((nodes, 3))
        self._force = vec3s(self.force)

    def evaluate(self, state: State, press: Press | None, position: wp.array) -> None:
        """Minus the nodal forces on the skin, and what each point has to say."""
        self.force[:] = 0.0
        surface = self.surface
        if press is None or not surface.count:
            surface.forget()
            return
        wp.launch(
            contact_kernels.indenter_contact,
            dim=surface.count,
            inputs=[
                *surface.model,
                press.primitives,
                self.settings.law(press.friction),
                wp.float64(self.settings.margin_m),
                wp.vec3d(*press.tip),
                wp.mat33d(*press.rotation.ravel()),
                position,
                scalars(state.indenter_pressure),
                vec3s(state.traction),
                vec3s(state.anchor),
            ],
            outputs=[
                *surface.results,
                surface.wanted_traction_array,
                surface.traction_slope,
                surface.coupled,
                surface.rest,
                self._force,
            ],
            device=DEVICE,
        )


class CoreContact:
    """Frictionless contact of the inner surface with the core, if there is one."""

    def __init__(
        self, surface: Surface, nodes: int, settings: ContactSettings, core: DistanceGrid | None
    ) -> None:
        self.surface, self.settings, self.core = surface, settings, core
        self.force = np.zeros((nodes, 3))
        self._force = vec3s(self.force)
        self._table = scalars(core.coefficients if core else np.zeros((4, 4, 4)))

    def evaluate(self, state: State, position: wp.array) -> None:
        """Minus the nodal forces on the skin, and what each point has to say."""
        self.force[:] = 0.0
        surface, core = self.surface, self.core
        if core is None or not surface.count:
            surface.forget()
            return
        wp.launch(
            core_kernels.core_contact,
            dim=surface.count,
            inputs=[
                *surface.model,
                self._table,
                wp.vec3d(*core.origin),
                wp.float64(core.spacing),
                self.settings.law(0.0),
                wp.float64(self.settings.margin_m + 2 * core.spacing),
                position,
                scalars(state.core_pressure),
            ],
            outputs=[*surface.results, self._force],
            device=DEVICE,
        )
