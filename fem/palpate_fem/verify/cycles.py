"""Loading and unloading: work equals what is stored plus what friction takes, step by step."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from palpate_fem.verify.check import Case, Measured
from palpate_fem.verify.finger import round_finger

Floats = NDArray[np.float64]

FRICTION = 0.186
COARSE, FINE, FINEST = 4, 16, 32  # steps a leg
# Press, drag, drag back, lift [m]: corners of the indenter's way.
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
class Cycle:
    """Energies [J] of one time around.

    Attributes:
        work: Of the indenter on the finger: force times way, by the trapezoidal rule.
        stored: At the end less at the start.
        lost: In friction: traction times the way of the sliding points' anchors, the same rule.
        most: Largest stored energy.
        least_lost: Of any increment, with the traction at its end.
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
        """Work that is neither stored nor lost, over the largest stored energy."""
        return (self.work - self.stored - self.lost) / self.most


@cache
def cycle(friction: float, steps: int) -> Cycle:
    """Once around in ``steps`` increments for each leg."""
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
            # The indenter does not turn, so its frame's axes are the sensor's.
            slid = body.system.outer.area_values[..., None] * (body.state.anchor - anchor)
            lost += float(((traction + body.state.traction) / 2 * slid).sum())
            least = min(least, float((body.state.traction * slid).sum()))
            stored = body.strain_energy() + body.contact_energy() - rest
            before, most = move, max(most, stored)
    apart = float(np.linalg.norm(body.state.position - start, axis=1).max())
    return Cycle(work, stored, lost, most, least, apart)


def closed_cycle() -> Measured:
    """Without friction all work comes back."""
    around = cycle(0.0, COARSE)
    return Measured(max(abs(around.work), abs(around.stored)) / around.most, note="over the most")


def same_shape() -> Measured:
    """Without friction every node comes back."""
    return Measured(cycle(0.0, COARSE).apart_m * 1e9)


def work_balance(steps: int) -> Measured:
    """Work = stored + lost in friction."""
    around = cycle(FRICTION, steps)
    note = f"{around.lost * 1e6:.2f} uJ lost of {around.most * 1e6:.2f} uJ, {steps} steps a leg"
    return Measured(around.miss, note=note)


def work_order() -> Measured:
    """Slope of log miss over log step from coarse to fine steps; kinks at stick and slip cost."""
    misses = [abs(cycle(FRICTION, steps).miss) for steps in (COARSE, FINE)]
    order = np.log(misses[0] / misses[1]) / np.log(FINE / COARSE)
    return Measured(order, 1.0, ", ".join(f"{miss:.1e}" for miss in misses))


def dissipation() -> Measured:
    """In no increment does friction give energy: least of all over the most stored."""
    around = cycle(FRICTION, FINE)
    return Measured(around.least_lost / around.most)


CHECKS = (
    Case("work/closed cycle without friction", closed_cycle, 1e-8),
    Case("work/shape after it", same_shape, 1.0, "nm"),
    Case(f"work/stored and lost, {FINE} steps a leg", partial(work_balance, FINE), 1e-3),
    Case(
        f"work/stored and lost, {FINEST} steps a leg",
        partial(work_balance, FINEST),
        3e-4,
        slow=True,
    ),
    Case("work/order in the step", work_order, 1e-12, at_least=True),
    Case("work/friction gives nothing back", dissipation, 1e-12, at_least=True),
)
