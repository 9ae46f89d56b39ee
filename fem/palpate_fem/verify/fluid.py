"""The sealed fluid: its volume stays, and volume control and pressure control are one law."""

from __future__ import annotations

from functools import cache

import numpy as np

from palpate_fem.mechanics.laws import Press
from palpate_fem.verify.body import MU, Body
from palpate_fem.verify.check import Case, Measured
from palpate_fem.verify.finger import biotac_finger, round_finger
from palpate_fem.verify.meshes import hollow_sphere
from palpate_fem.verify.rigid import ball, pose

INNER_M, OUTER_M, BALL_M, DENT_M = 3.0e-3, 4.5e-3, 2.0e-3, 0.4e-3


def _skin() -> Body:
    """A ball of skin whose upper half is held."""
    mesh = hollow_sphere(6, INNER_M, OUTER_M, 1)
    held = np.zeros(mesh.nodes.shape, bool)
    held[mesh.nodes[:, 2] > 0] = True
    return Body(mesh, held=held)


def sealed() -> Measured:
    """Largest deviation from the sealed volume while a finger is pressed, over it."""
    worst = 0.0
    for finger in (round_finger(friction=0.186), biotac_finger(friction=0.186, aside=(-6e-3, 0.0))):
        for k in range(1, 5):
            balance = finger.at(np.array([0.05e-3 * k, 0.0, 0.15e-3 * k]))
            worst = max(worst, abs(balance.volume / finger.volume - 1))
    return Measured(worst)


@cache
def _dented() -> tuple[float, float, float]:
    """Empty skin under an indenter: volume lost, and then, sealed there, p / mu and force."""
    press = Press(ball(BALL_M), pose((0.0, 0.0, -OUTER_M + DENT_M)), 0.0)
    empty = _skin()
    rest = empty.system.balance(empty.state, None).volume
    free = empty.solve(press)
    shut = _skin()
    again = shut.solve(press, volume=free.volume)
    same = np.abs(again.indenter - free.indenter).max() / np.abs(free.indenter).max()
    return 1 - free.volume / rest, shut.state.fluid_pressure / MU, float(same)


def unsealed() -> Measured:
    """Sealed at the volume that an empty skin takes by itself, a dented skin has no pressure."""
    lost, pressure, _ = _dented()
    return Measured(pressure, note=f"p / mu; the dent takes {lost:.2%} of the volume")


def unsealed_force() -> Measured:
    """And the same nodal forces."""
    return Measured(_dented()[2])


def two_controls() -> Measured:
    """Filled to a volume it finds a pressure; at that pressure, from rest, the same volume."""
    by_volume = _skin()
    volume = 1.1 * by_volume.system.balance(by_volume.state, None).volume
    by_volume.solve(volume=volume)
    by_pressure = _skin()
    by_pressure.state.fluid_pressure = by_volume.state.fluid_pressure
    note = f"{by_volume.state.fluid_pressure * 1e-3:.3f} kPa"
    return Measured(by_pressure.solve().volume / volume, 1.0, note)


CHECKS = (
    Case("fluid/sealed volume while pressed", sealed, 1e-10),
    Case("fluid/no pressure at the free volume", unsealed, 1e-10),
    Case("fluid/no force of it either", unsealed_force, 1e-8),
    Case("fluid/pressure and volume control agree", two_controls, 1e-10),
)
