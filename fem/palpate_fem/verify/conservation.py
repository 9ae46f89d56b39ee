"""Laws that hold without a closed form: volume, balance, energy, symmetry, scaling, work.

First the sealed fluid: its volume is conserved, and volume and pressure control agree. Then balance
of forces and moments, the force as derivative of the energy, symmetry and scaling. Last, cycles of
loading and unloading: the work equals the stored energy plus the loss by friction.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from palpate_fem.arrays import Floats
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.verify.bodies import (
    MU,
    TouchedFingertip,
    VerificationBody,
    ball,
    biotac_finger,
    pose,
    round_finger,
)
from palpate_fem.verify.check import Measurement, check, checks
from palpate_fem.verify.element import order_of
from palpate_fem.verify.meshes import hollow_sphere

INNER_M, OUTER_M, BALL_M, DENT_M = 3.0e-3, 4.5e-3, 2.0e-3, 0.4e-3


def _skin() -> VerificationBody:
    """A ball of skin whose upper half is held."""
    mesh = hollow_sphere(6, INNER_M, OUTER_M, 1)
    held = np.zeros(mesh.nodes.shape, bool)
    held[mesh.nodes[:, 2] > 0] = True
    return VerificationBody(mesh, held=held)


@check("fluid/sealed volume while pressed", 1e-10)
def sealed() -> Measurement:
    """Largest deviation from the sealed volume while a finger is pressed, over it."""
    worst = 0.0
    for finger in (round_finger(friction=0.186), biotac_finger(friction=0.186, aside=(-6e-3, 0.0))):
        for k in range(1, 5):
            balance = finger.at(np.array([0.05e-3 * k, 0.0, 0.15e-3 * k]))
            worst = max(worst, abs(balance.volume / finger.volume - 1))
    return Measurement(worst)


@checks(
    ("fluid/no pressure at the free volume", 1e-10, ""), ("fluid/no force of it either", 1e-8, "")
)
def unsealed() -> tuple[Measurement, ...]:
    """An empty skin that an indenter dents, and the same skin sealed at that volume.

    The sealed one has no fluid pressure, and the nodal forces are those of the empty one.
    """
    press = PosedIndenter(ball(BALL_M), pose((0.0, 0.0, -OUTER_M + DENT_M)), 0.0)
    empty, shut = _skin(), _skin()
    rest = empty.system.balance(empty.state, None).volume
    free = empty.solve(press)
    again = shut.solve(press, volume=free.volume)
    note = f"p / mu; the dent takes {1 - free.volume / rest:.2%} of the volume"
    return (
        Measurement(shut.state.fluid_pressure / MU, note=note),
        Measurement(np.abs(again.indenter - free.indenter).max() / np.abs(free.indenter).max()),
    )


@check("fluid/pressure and volume control agree", 1e-10)
def two_controls() -> Measurement:
    """The pressure found by volume control leads to the same volume by pressure control."""
    by_volume = _skin()
    volume = 1.1 * by_volume.system.balance(by_volume.state, None).volume
    by_volume.solve(volume=volume)
    by_pressure = _skin()
    by_pressure.state.fluid_pressure = by_volume.state.fluid_pressure
    note = f"{by_volume.state.fluid_pressure * 1e-3:.3f} kPa"
    return Measurement(by_pressure.solve().volume / volume, 1.0, note)


FRICTION = 0.186
ASIDE_M = (-6e-3, 1e-3)  # under the BioTac's pad, off its middle
RUB_M, DEEP_M = 0.6e-3, 3.6e-3
UP = np.array([0.0, 0.0, 1.0])


@checks(
    ("balance/forces on a pressed BioTac", 1e-8, ""),
    ("balance/moments on a pressed BioTac", 1e-8, ""),
    ("contact/penetration on a pressed BioTac", 5.0, "um"),
)
def pressed_biotac() -> tuple[Measurement, ...]:
    """A fingertip that is rubbed and pinched on its core.

    The forces of indenter, core, fluid and supports on the skin add up to zero, and so do their
    moments about the origin, because the stress is symmetric. Last, the deepest penetration of a
    point into indenter or core.
    """
    finger = biotac_finger(friction=FRICTION, aside=ASIDE_M)
    for share in np.linspace(0.0, 1.0, 13)[1:]:
        balance = finger.at(share * np.array([RUB_M, 0.0, DEEP_M]))
    body, position = finger.body, finger.body.state.position
    forces = {  # nodal forces on the skin by their source [N], (V, 3)
        "indenter": -balance.indenter,
        "core": -balance.core,
        "fluid": body.state.fluid_pressure * balance.volume_gradient,
        "supports": body.reactions(balance),
    }
    push = {who: float(np.linalg.norm(force.sum(axis=0))) for who, force in forces.items()}
    force = sum(forces.values(), np.zeros((1, 3)))
    turn = np.linalg.norm(np.cross(position, forces["indenter"]).sum(axis=0))
    note = ", ".join(f"{who} {size:.3g} N" for who, size in push.items())
    deepest = -float(min(body.system.outer.gap.min(), body.system.inner.gap.min()))
    return (
        Measurement(float(np.linalg.norm(force.sum(axis=0))) / push["indenter"], note=note),
        Measurement(float(np.linalg.norm(np.cross(position, force).sum(axis=0)) / turn)),
        Measurement(deepest * 1e6),
    )


def potential(finger: TouchedFingertip, move: Floats) -> float:
    """Energy whose stationary point is the equilibrium with the indenter there [J].

    Mixed in all pressures, so that the error is of second order in Newton's residual: energy of the
    skin, minus p_f (V - V_0), minus w (p g + p^2 / (2 e)) of each contact point.
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


@check("balance/force is the energy's derivative", 1e-8)
def energy_derivative() -> Measurement:
    """Without friction the force is the derivative of the energy by the indenter's position."""
    finger, depth, step = round_finger(friction=0.0), 0.75e-3, 1e-7
    for share in (0.25, 0.5, 0.75, 1.0):
        force = -finger.at(share * depth * UP).indenter.sum(axis=0)[2]
    near = [potential(finger, (depth + k * step) * UP) for k in (-2, -1, 1, 2)]
    slope = (near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * step)
    return Measurement(force / slope - 1, note=f"{force:.4g} N")


@check("symmetry/mesh", 1e-10)
def mirror_mesh() -> Measurement:
    """Nodes of the parametric mesh against their mirror images, over the finger's size."""
    mesh = biotac_finger(friction=0.0, aside=ASIDE_M).body.mesh
    off = mesh.nodes[mesh.mirror] * [1.0, -1.0, 1.0] - mesh.nodes
    return Measurement(np.abs(off).max() / np.ptp(mesh.nodes))


@checks(("symmetry/displacements", 1e-10, ""), ("symmetry/force across", 1e-10, ""))
def mirror_displacement() -> tuple[Measurement, ...]:
    """Pressed and rubbed in its plane of symmetry, the skin deforms symmetrically.

    The force has no component across the plane.
    """
    finger = biotac_finger(friction=FRICTION, aside=(ASIDE_M[0], 0.0))
    start = finger.body.state.position.copy()
    for k in range(1, 5):
        balance = finger.at(np.array([0.02e-3 * k, 0.0, 0.3e-3 * k]))
    moved = finger.body.state.position - start
    off = moved[finger.body.mesh.mirror] * [1.0, -1.0, 1.0] - moved
    force = balance.indenter.sum(axis=0)
    return (
        Measurement(np.abs(off).max() / np.abs(moved).max()),
        Measurement(abs(force[1] / force[2])),
    )


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


@check(
    "scaling/{by}",
    1e-8,
    by={"modulus x 3": (1.0, 3.0, 3.0), "lengths x 1.7": (1.7, 1.0, 1 / 1.7)},
)
def scaling(by: tuple[float, float, float]) -> Measurement:
    """Largest relative deviation of displacements and of forces from those of the original.

    Forces are proportional to the modulus and to the square of lengths; the constants of contact,
    which are pressures per length, are scaled accordingly.

    Args:
        by: Factors of lengths, modulus and contact constants.
    """
    scale, modulus, stiffness = by
    moved, force = _answer(1.0, MU, 1.0)
    other, other_force = _answer(scale, modulus * MU, stiffness)
    # Each force over the size of its own kind: indenter, core, fluid.
    sizes = np.repeat([np.linalg.norm(force[:3]), np.linalg.norm(force[3:6]), force[6]], (3, 3, 1))
    shape = np.abs(other - moved).max() / np.abs(moved).max()
    off = (np.abs(other_force - force) / sizes).max()
    return Measurement(np.max([shape, off]), note=f"shape {shape:.1e}, forces {off:.1e}")


def _pressed_in_steps(*, mortar: bool) -> list[float]:
    """Errors of Newton's method without friction in the last of five increments of 0.1 mm."""
    finger = round_finger(friction=0.0, mortar=mortar)
    for k in range(1, 6):
        finger.at(0.1e-3 * k * UP)
    return finger.body.report.residuals


@check("newton/order in contact at nodes", 0.1, at_least=True)
def newton_in_contact() -> Measurement:
    """Order of Newton's method, once the set of touching points is found."""
    residuals = _pressed_in_steps(mortar=False)
    return Measurement(order_of(residuals), 2.0, " ".join(f"{r:.0e}" for r in residuals))


@check("newton/left by an iteration in mortar contact", 0.5)
def newton_in_mortar_contact() -> Measurement:
    """Largest error over that before, once below 1 %: the correction has no part in the tangent."""
    residuals = _pressed_in_steps(mortar=True)
    last = [(a, b) for a, b in itertools.pairwise(residuals) if a < 1e-2 and b > 1e-13]
    note = " ".join(f"{r:.0e}" for r in residuals)
    return Measurement(max((b / a for a, b in last), default=math.nan), 0.0, note)


COARSE, FINE, FINEST = 4, 16, 32  # increments for each leg of a cycle
# Press, drag, drag back, lift [m]: corners of the indenter's path.
CORNERS_M = np.array(
    [
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.5e-3),
        (0.4e-3, 0.0, 0.5e-3),
        (0.0, 0.0, 0.5e-3),
        (0.0, 0.0, 0.0),
    ]
)


@dataclass(frozen=True, slots=True)
class LoadCycle:
    """Energies [J] of one cycle.

    Attributes:
        work: Of the indenter on the skin: force times displacement, by the trapezoidal rule.
        stored: Stored energy at the end less that at the start.
        lost: To friction: traction times displacement of the sliding points' anchors, same rule.
        most: Largest stored energy.
        least_lost: Smallest loss of any increment, with the traction at its end.
        apart_m: Largest distance of a node from where it started [m].
    """

    work: float
    stored: float
    lost: float
    most: float
    least_lost: float
    apart_m: float

    @property
    def miss(self) -> float:
        """Error of the energy balance over the largest stored energy."""
        return (self.work - self.stored - self.lost) / self.most


@cache
def cycle(friction: float, steps: int) -> LoadCycle:
    """One cycle in ``steps`` increments for each leg."""
    finger = round_finger(friction=friction)
    body, start = finger.body, finger.body.state.position.copy()
    rest = body.strain_energy() + body.contact_energy()
    work = lost = most = stored = 0.0
    least = np.inf
    force, before = np.zeros(3), CORNERS_M[0]
    for a, b in itertools.pairwise(CORNERS_M):
        for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
            move = a + share * (b - a)
            traction, anchor = body.state.traction.copy(), body.state.anchor.copy()
            last, force = force, -finger.at(move).indenter.sum(axis=0)
            work += float((force + last) @ (move - before)) / 2
            # The indenter does not turn, so the axes of its frame are those of the sensor frame.
            slid = body.system.outer.area_values[..., None] * (body.state.anchor - anchor)
            lost += float(((traction + body.state.traction) / 2 * slid).sum())
            least = min(least, float((body.state.traction * slid).sum()))
            stored = body.strain_energy() + body.contact_energy() - rest
            before, most = move, max(most, stored)
    apart = float(np.linalg.norm(body.state.position - start, axis=1).max())
    return LoadCycle(work, stored, lost, most, least, apart)


@checks(("work/closed cycle without friction", 1e-8, ""), ("work/shape after it", 1.0, "nm"))
def closed_cycle() -> tuple[Measurement, ...]:
    """Without friction the work of a cycle is zero, and every node returns to its place."""
    around = cycle(0.0, COARSE)
    work = max(abs(around.work), abs(around.stored)) / around.most
    return Measurement(work, note="over the most"), Measurement(around.apart_m * 1e9)


@check("work/stored and lost, {steps} steps a leg", 3e-4, slow=True, steps=(FINEST,))
@check("work/stored and lost, {steps} steps a leg", 1e-3, steps=(FINE,))
def work_balance(steps: int) -> Measurement:
    """Work = stored energy + loss by friction."""
    around = cycle(FRICTION, steps)
    note = f"{around.lost * 1e6:.2f} uJ lost of {around.most * 1e6:.2f} uJ, {steps} steps a leg"
    return Measurement(around.miss, note=note)


@check("work/order in the step", 1e-12, at_least=True)
def work_order() -> Measurement:
    """Order of convergence of the work balance; lower than 2 by the kinks at stick and slip."""
    misses = [abs(cycle(FRICTION, steps).miss) for steps in (COARSE, FINE)]
    order = np.log(misses[0] / misses[1]) / np.log(FINE / COARSE)
    return Measurement(order, 1.0, ", ".join(f"{miss:.1e}" for miss in misses))


@check("work/friction gives nothing back", 1e-12, at_least=True)
def dissipation() -> Measurement:
    """Friction never gives energy: smallest loss of an increment over the largest stored energy."""
    around = cycle(FRICTION, FINE)
    return Measurement(around.least_lost / around.most)
