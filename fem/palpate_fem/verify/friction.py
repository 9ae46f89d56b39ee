"""Coulomb friction of a block on a plane: stick, slip, ramp, reversal, and no drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate.errors import SimulationError
from palpate.rigid import rotation_matrices
from palpate_fem.arrays import Floats
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.newton import NewtonSettings
from palpate_fem.verify.bodies import BULK_RATIO, TIGHT, VerificationBody, about_y, plane, pose
from palpate_fem.verify.check import Measurement, check, checks
from palpate_fem.verify.meshes import rectangle, slab

FRICTION = 0.186
SIDE_M, HEIGHT_M = 4e-3, 1e-3
WEIGHT_N = 0.05
PRESS_M, SLIDE_M = 3e-5, 1e-3  # by the plane
# Near the slip angle little stiffness is left. A block that does not converge soon, slides.
NEAR_SLIP = replace(TIGHT, tolerance=1e-11, gap_tolerance_m=1e-15, iterations=25)


class SlidingBlock:
    """A flat block whose lower side lies on a plane, all of it turned about y by an angle [rad].

    Its upper side is clamped, tied along x and y, or free.
    """

    def __init__(
        self,
        *,
        clamped: bool = False,
        tied: bool = False,
        angle: float = 0.0,
        edges: int = 4,
        bulk_ratio: float = BULK_RATIO,
        settings: NewtonSettings = TIGHT,
    ) -> None:
        line = np.linspace(-SIDE_M / 2, SIDE_M / 2, edges + 1)
        mesh = slab(*rectangle(line, line), np.linspace(0.0, HEIGHT_M, 3), name="block")
        self.top = mesh.nodes[:, 2] == HEIGHT_M
        self.turn = rotation_matrices(about_y(angle))
        mesh = replace(mesh, nodes=mesh.nodes @ self.turn.T)
        held = np.zeros(mesh.nodes.shape, bool)
        held[self.top] = (clamped or tied, clamped or tied, clamped)
        self.angle = angle
        self.body = VerificationBody(mesh, held=held, bulk_ratio=bulk_ratio, settings=settings)
        self.press = PosedIndenter(plane(), self.pose(0.0, 0.0), FRICTION)
        self.body.update_anchors(self.press)

    def pose(self, along: float, up: float) -> Floats:
        """Pose of the plane, moved along itself and towards the block [m]."""
        return pose(self.turn @ [along, 0.0, up], about_y(self.angle))

    def slide(self, along: float, up: float) -> tuple[float, float]:
        """Move the plane and solve; its force on the block along and across the plane [N]."""
        balance = self.body.solve(self.press.at(self.pose(along, up)))
        push = -balance.indenter.sum(axis=0) @ self.turn
        self.balance = balance
        return float(push[0]), float(push[2])

    def weigh(self, slope: float) -> None:
        """Load the block with its weight, as on a ramp that falls towards +x [rad]."""
        mesh, volume = self.body.mesh, self.body.system.skin.rest_volume
        share = np.zeros(len(mesh.nodes))
        np.add.at(share, mesh.elements, (volume / volume.sum() / 8)[:, None])
        down = np.array([np.sin(slope), 0.0, -np.cos(slope)])
        self.body.system.load[:] = WEIGHT_N * share[:, None] * down


@check("friction/stick below the limit", 1e-6, "nm")
def stick() -> Measurement:
    """Half way to its slip angle a block is held by the springs of sticking: u = T / (k area).

    Of a material that does not bulge under its weight (nu = 0), so that no point slides.
    """
    block, slope = SlidingBlock(bulk_ratio=2 / 3), np.arctan(FRICTION) / 2
    block.weigh(0.0)
    block.slide(0.0, 1e-6)
    before = block.body.contact_points()
    block.weigh(slope)
    along, _ = block.slide(0.0, 1e-6)
    moved = (block.body.contact_points() - before)[..., 0]
    way = (block.body.system.outer.area_values * moved).sum() / SIDE_M**2
    expected = -along / block.body.contact.tangential_stiffness / SIDE_M**2
    return Measurement(way * 1e9, expected * 1e9, "mean of the sole")


@checks(
    ("friction/slip at T = mu N, plane at {angle} degrees", 1e-6, ""),
    ("friction/reversal, plane at {angle} degrees", 1e-6, ""),
    angle={0: 0.0, 30: np.radians(30)},
)
def dragged(angle: float) -> tuple[Measurement, ...]:
    """A clamped block that is pressed and dragged along and back on a plane turned by an angle.

    Steady sliding: T = mu N. Dragged back the force turns round: T = -mu N.
    """
    block = SlidingBlock(clamped=True, angle=angle)
    for along, up in ((0.0, 1e-5), (0.0, PRESS_M), (1e-5, PRESS_M)):
        block.slide(along, up)
    for k in range(1, 8):
        along, across = block.slide(SLIDE_M * k / 7, PRESS_M)
    forth = along / across
    for share in (0.99, 0.95, 0.9, 0.75, 0.6, 0.45, 0.3, 0.15, 0.0):
        along, across = block.slide(share * SLIDE_M, PRESS_M)
    return (
        Measurement(forth, FRICTION, "T / N"),
        Measurement(along / across, -FRICTION, "T / N"),
    )


@check("friction/slip angle of a ramp", 1e-6, "degrees")
def slip_angle() -> Measurement:
    """The steepest ramp on which a free block sticks: atan(mu); found by bisection."""
    block = SlidingBlock(settings=NEAR_SLIP)
    block.weigh(0.0)
    block.slide(0.0, 1e-6)
    still, slides = 0.0, np.radians(30.0)
    while slides - still > 1e-8:
        middle = (still + slides) / 2
        block.weigh(middle)
        kept = block.body.state.copy()
        try:
            block.slide(0.0, 1e-6)
            still = middle
        except SimulationError:
            block.body.state, slides = kept, middle
    return Measurement(np.degrees(still), np.degrees(np.arctan(FRICTION)))


@check("friction/tether on a ramp of 30 degrees", 1e-6, "N")
def tether() -> Measurement:
    """Force that holds a tied block on a slipping ramp of 30 degrees: W (sin - mu cos)."""
    slope = np.radians(30.0)
    block = SlidingBlock(tied=True)
    block.weigh(slope)
    for k in range(8):
        block.slide(-1e-4 * k, 1e-6)
    # The weight of the tied nodes goes into the tether directly, not through the contact.
    load = block.body.system.load[block.top].sum(axis=0)
    pull = load[0] - block.body.reactions(block.balance)[:, 0].sum()
    return Measurement(pull, WEIGHT_N * (np.sin(slope) - FRICTION * np.cos(slope)))


@check("friction/no creep under load", 1.0, "nm")
def no_drift() -> Measurement:
    """A block at 95 % of its slip angle, solved again and again from a disturbed state."""
    block = SlidingBlock(edges=2, settings=replace(TIGHT, tolerance=1e-10, gap_tolerance_m=1e-13))
    for share in (0.0, 0.5, 0.95):
        block.weigh(np.arctan(FRICTION) * share)
        block.slide(0.0, 1e-6)
    random, start = np.random.default_rng(7), block.body.state.position.copy()
    increments = 1000
    for _ in range(increments):
        block.body.state.position += random.normal(scale=1e-8, size=start.shape)
        block.slide(0.0, 1e-6)
    way = float(np.abs(block.body.state.position - start).max())
    return Measurement(way * 1e9, 0.0, f"{increments} increments")
