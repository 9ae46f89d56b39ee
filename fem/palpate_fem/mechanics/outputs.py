"""From a converged state to what a step reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mechanics.balance import Balance
from palpate_fem.mechanics.laws import Press
from palpate_fem.mechanics.state import State
from palpate_fem.result import Convergence, Step

if TYPE_CHECKING:
    from palpate_fem.mechanics.solver import Fingertip

Floats = NDArray[np.float64]

CONTACT_SHARE = 1e-3
"""A surface point touches if its pressure exceeds this share of the largest."""

VOIGT = [0, 4, 8, 5, 2, 1]
"""Places of xx yy zz yz xz xy in a flattened tensor."""


def make_step(
    tip: Fingertip, state: State, press: Press, pose: Floats, balance: Balance, cost: Convergence
) -> Step:
    """Quantities of a converged state; see `Step`."""
    surface = tip.system.outer
    on_skin = -balance.indenter
    weight = state.indenter_pressure * surface.area_values
    points = surface.points_at(state.position)
    touching = state.indenter_pressure > CONTACT_SHARE * max(
        float(state.indenter_pressure.max()), 1.0
    )
    centre = np.full(3, np.nan)
    if touching.any():
        centre = (weight[..., None] * points).sum(axis=(0, 1)) / weight.sum()
    stress = tip.system.skin.stress(state.position, state.pressure)
    return Step(
        pose=np.array(pose),
        displacement=state.position - tip.nodes,
        fluid_pressure_pa=state.fluid_pressure,
        force=on_skin.sum(axis=0),
        torque=np.cross(state.position, on_skin).sum(axis=0),
        indenter_force=on_skin,
        core_force=-balance.core,
        contact_area_m2=float(surface.current_area(state.position)[touching].sum()),
        centre_of_pressure=centre,
        stress=stress.reshape(-1, 9)[:, VOIGT],
        convergence=cost,
    )
