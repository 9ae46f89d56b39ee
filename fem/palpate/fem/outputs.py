"""From a converged state to what a step reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from palpate.fem.laws import Press
from palpate.fem.result import Convergence, Step
from palpate.fem.state import State
from palpate.fem.system import Balance

if TYPE_CHECKING:
    from palpate.fem.solver import Fingertip

Floats = NDArray[np.float64]

CONTACT_SHARE = 1e-3
"""A surface point touches if its pressure exceeds this share of the largest."""


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
        stress=cauchy_stress(tip, state),
        convergence=cost,
    )


def cauchy_stress(tip: Fingertip, state: State) -> Floats:
    """Cauchy stress, mean over each element: xx yy zz yz xz xy [Pa], (E, 6)."""
    mesh = tip.geometry.mesh
    skin = tip.system.skin
    gradient, weight = skin.gradient_values, skin.weight_values
    f = np.einsum("eai,eqaj->eqij", state.position[mesh.elements], gradient)
    j = np.linalg.det(f)
    b = np.einsum("eqij,eqkj->eqik", f, f)
    trace = np.trace(b, axis1=2, axis2=3)
    deviator = b - trace[..., None, None] / 3 * np.eye(3)
    isochoric = skin.mu * (j ** (-5 / 3))[..., None, None] * deviator
    current = weight * j
    mean = np.einsum("eq,eqij->eij", current, isochoric) / current.sum(axis=1)[:, None, None]
    mean += state.pressure[:, None, None] * np.eye(3)
    return np.stack(
        [mean[:, 0, 0], mean[:, 1, 1], mean[:, 2, 2], mean[:, 1, 2], mean[:, 0, 2], mean[:, 0, 1]],
        axis=1,
    )
