"""What holds without a closed form: balance, energy, symmetry and scaling."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mechanics.balance import Balance
from palpate_fem.verify.body import MU
from palpate_fem.verify.check import Case, Measured
from palpate_fem.verify.element import order_of
from palpate_fem.verify.finger import Finger, biotac_finger, round_finger

Floats = NDArray[np.float64]

FRICTION = 0.186
ASIDE_M = (-6e-3, 1e-3)  # under the BioTac's pad, off its middle
RUB_M, DEEP_M = 0.6e-3, 3.6e-3
UP = np.array([0.0, 0.0, 1.0])


def _forces(finger: Finger, balance: Balance) -> dict[str, Floats]:
    """Nodal forces on the skin by their source [N], (V, 3)."""
    return {
        "indenter": -balance.indenter,
        "core": -balance.core,
        "fluid": finger.body.state.fluid_pressure * balance.volume_gradient,
        "supports": finger.body.reactions(balance),
    }


@cache
def _pressed_biotac() -> tuple[float, float, float, str]:
    """A finger rubbed and pinched on its core.

    Returns:
        Imbalance of force and of moment over the indenter's, deepest penetration [m], and the
        sizes of the forces in words.
    """
    finger = biotac_finger(friction=FRICTION, aside=ASIDE_M)
    for share in np.linspace(0.0, 1.0, 13)[1:]:
        balance = finger.at(share * np.array([RUB_M, 0.0, DEEP_M]))
    forces = _forces(finger, balance)
    position = finger.body.state.position
    push = {who: float(np.linalg.norm(force.sum(axis=0))) for who, force in forces.items()}
    force = sum(forces.values(), np.zeros((1, 3)))
    turn = np.linalg.norm(np.cross(position, forces["indenter"]).sum(axis=0))
    note = ", ".join(f"{who} {size:.3g} N" for who, size in push.items())
    system = finger.body.system
    return (
        float(np.linalg.norm(force.sum(axis=0))) / push["indenter"],
        float(np.linalg.norm(np.cross(position, force).sum(axis=0)) / turn),
        -float(min(system.outer.gap.min(), system.inner.gap.min())),
        note,
    )


def force_balance() -> Measured:
    """Indenter, core, fluid and supports: their forces on the skin add up to nothing."""
    return Measured(_pressed_biotac()[0], note=_pressed_biotac()[3])


def moment_balance() -> Measured:
    """So do their moments about the origin, because the stress is symmetric."""
    return Measured(_pressed_biotac()[1])


def penetration() -> Measured:
    """How deep the worst point is in indenter or core."""
    return Measured(_pressed_biotac()[2] * 1e6)


def potential(finger: Finger, move: Floats) -> float:
    """Energy whose stationary point is the equilibrium with the indenter there [J].

    Mixed in all pressures, so that what Newton leaves over counts in the second order only:
    skin, minus p_f (V - V_0), and of each contact point -w (p g + p^2 / (2 e)).
    """
    body = finger.body
    balance, state = finger.at(move), body.state
    contact = 0.0
    for surface, pressure in (
        (body.system.outer, state.indenter_pressure),
        (body.system.inner, state.core_pressure),
    ):
        gap = np.where(pressure > 0, surface.gap, 0.0)
        point = pressure * gap + pressure**2 / 2 / body.contact.stiffness
        contact -= float((surface.area_values * point).sum())
    fluid = state.fluid_pressure * (balance.volume - finger.volume)
    return body.strain_energy() - fluid + contact


def energy_derivative() -> Measured:
    """The force is the energy's derivative by the indenter's way (five points, frictionless)."""
    finger, depth, step = round_finger(friction=0.0), 0.75e-3, 1e-7
    for share in (0.25, 0.5, 0.75, 1.0):
        force = -finger.at(share * depth * UP).indenter.sum(axis=0)[2]
    near = [potential(finger, (depth + k * step) * UP) for k in (-2, -1, 1, 2)]
    slope = (near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * step)
    return Measured(force / slope - 1, note=f"{force:.4g} N")


def mirror_mesh() -> Measured:
    """Nodes of the parametric mesh against their mirror images, over the finger's size."""
    mesh = biotac_finger(friction=0.0, aside=ASIDE_M).body.mesh
    off = mesh.nodes[mesh.mirror] * [1.0, -1.0, 1.0] - mesh.nodes
    return Measured(np.abs(off).max() / np.ptp(mesh.nodes))


@cache
def _pressed_in_the_middle() -> tuple[float, float]:
    finger = biotac_finger(friction=FRICTION, aside=(ASIDE_M[0], 0.0))
    start = finger.body.state.position.copy()
    for k in range(1, 5):
        balance = finger.at(np.array([0.02e-3 * k, 0.0, 0.3e-3 * k]))
    moved = finger.body.state.position - start
    off = moved[finger.body.mesh.mirror] * [1.0, -1.0, 1.0] - moved
    force = balance.indenter.sum(axis=0)
    return float(np.abs(off).max() / np.abs(moved).max()), abs(force[1] / force[2])


def mirror_displacement() -> Measured:
    """Pressed and rubbed in the middle plane it moves as its mirror image does."""
    return Measured(_pressed_in_the_middle()[0])


def mirror_force() -> Measured:
    """The force has no component across the plane."""
    return Measured(_pressed_in_the_middle()[1])


def _answer(scale: float, mu: float, stiffness: float) -> tuple[Floats, Floats]:
    """Displacements over scale, and forces and pressures: of indenter, core, fluid."""
    finger = round_finger(friction=FRICTION, scale=scale, mu=mu, stiffness=stiffness)
    start = finger.body.state.position.copy()
    for k in range(1, 6):
        balance = finger.at(scale * np.array([0.05e-3 * k, 0.0, 0.16e-3 * k]))
    moved = (finger.body.state.position - start) / scale
    force, core = -balance.indenter.sum(axis=0), -balance.core.sum(axis=0)
    pressure = finger.body.state.fluid_pressure * scale**2
    return moved, np.array([*force, *core, pressure]) / scale**2 / (mu / MU)


@cache
def scaling(scale: float, modulus: float, stiffness: float) -> Measured:
    """Largest relative deviation of displacements and of forces from those of the original.

    Forces go with modulus and with the square of lengths; contact's constants, which are pressures
    per length, go along.
    """
    moved, force = _answer(1.0, MU, 1.0)
    other, other_force = _answer(scale, modulus * MU, stiffness)
    # Each force over the size of its own kind: indenter, core, fluid.
    sizes = np.repeat([np.linalg.norm(force[:3]), np.linalg.norm(force[3:6]), force[6]], (3, 3, 1))
    shape = np.abs(other - moved).max() / np.abs(moved).max()
    off = (np.abs(other_force - force) / sizes).max()
    return Measured(np.max([shape, off]), note=f"shape {shape:.1e}, forces {off:.1e}")


def newton_in_contact() -> Measured:
    """Residuals of an increment without friction, once the set of touching points is found."""
    finger = round_finger(friction=0.0)
    for k in range(1, 6):
        finger.at(0.1e-3 * k * UP)
    residuals = finger.body.report.residuals
    return Measured(order_of(residuals), 2.0, " ".join(f"{r:.0e}" for r in residuals))


CHECKS = (
    Case("balance/forces on a pressed BioTac", force_balance, 1e-8),
    Case("balance/moments on a pressed BioTac", moment_balance, 1e-8),
    Case("contact/penetration on a pressed BioTac", penetration, 5.0, "um"),
    Case("balance/force is the energy's derivative", energy_derivative, 1e-8),
    Case("symmetry/mesh", mirror_mesh, 1e-10),
    Case("symmetry/displacements", mirror_displacement, 1e-10),
    Case("symmetry/force across", mirror_force, 1e-10),
    Case("scaling/modulus x 3", partial(scaling, 1.0, 3.0, 3.0), 1e-8),
    Case("scaling/lengths x 1.7", partial(scaling, 1.7, 1.0, 1 / 1.7), 1e-8),
    Case("newton/order in contact", newton_in_contact, 0.1, at_least=True),
)
