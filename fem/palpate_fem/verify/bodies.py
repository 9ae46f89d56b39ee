"""Indenters, solids and fingertips of the verification.

`VerificationBody` is one solid with its equations and state, solved to tight tolerances, with its
energies and reactions. `TouchedFingertip` is one with a sealed fluid and an indenter that just
touches it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.errors import SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.indenter.shape import Indenter, Primitive, PrimitiveKind
from palpate_fem.mechanics.contact import ContactSettings, PosedIndenter
from palpate_fem.mechanics.iteration import NewtonReport, NewtonSettings
from palpate_fem.mechanics.load_stepping import SolverSettings
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.skin import energy_density
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mechanics.state import ForceBalance, SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.core import DistanceGrid
from palpate_fem.mesh.parametric import biotac
from palpate_fem.mesh.solid import FingertipGeometry, SolidMesh
from palpate_fem.sparse.factor import make_factor
from palpate_fem.verify.meshes import hollow_sphere

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def plane(half_m: float = 0.1) -> Indenter:
    """A box so large that its top is a plane."""
    edge = 1e-4
    inner = half_m - edge
    box = Primitive(PrimitiveKind.BOX, (0.0, 0.0, -half_m), (inner, inner, inner, 0.0), edge)
    return Indenter("plane", (box,))


def ball(radius_m: float) -> Indenter:
    """A sphere."""
    at = (0.0, 0.0, -radius_m)
    return Indenter(
        "ball", (Primitive(PrimitiveKind.REVOLVED, at, (0.0, 0.0, 0.0, 0.0), radius_m),)
    )


def roll(radius_m: float, half_length_m: float) -> Indenter:
    """A cylinder along y."""
    at, sizes = (0.0, 0.0, -radius_m), (0.0, 0.0, -half_length_m, half_length_m)
    return Indenter("roll", (Primitive(PrimitiveKind.REVOLVED, at, sizes, radius_m, axis=1),))


def punch(radius_m: float, edge_m: float) -> Indenter:
    """A flat-ended cylinder along z with a rounded rim."""
    sizes = (0.0, radius_m - edge_m, -4 * radius_m, -edge_m)
    return Indenter("punch", (Primitive(PrimitiveKind.REVOLVED, (0.0, 0.0, 0.0), sizes, edge_m),))


def pose(position: ArrayLike, quaternion: ArrayLike = UPRIGHT) -> Floats:
    """Position [m] and unit quaternion w x y z as one row, (7,)."""
    return np.concatenate([np.asarray(position, np.float64), np.asarray(quaternion, np.float64)])


def about_y(angle: float) -> Floats:
    """Quaternion of a turn about y by an angle [rad]."""
    return np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])


MU = 2.8e5  # [Pa], the paper's optimum
BULK_RATIO = 1e4

# Far tighter than in production, so that errors are those of the discretisation.
TIGHT = NewtonSettings(
    tolerance=1e-11,
    volume_tolerance=1e-11,
    gap_tolerance_m=1e-14,
    traction_tolerance=1e-7,
    iterations=100,
    patience=100,
    mortar_updates=60,
    linear_tolerance=1e-8,
    largest_move_m=1.0,
    keep_factor=0.0,
    keep_elastic=0.0,
)


class VerificationBody:
    """One solid; each solution starts from the last one, ``state``."""

    def __init__(
        self,
        mesh: SolidMesh,
        *,
        held: NDArray[np.bool_] | None = None,
        core: DistanceGrid | None = None,
        mu: float = MU,
        bulk_ratio: float = BULK_RATIO,
        stiffening: float = 0.0,
        contact: ContactSettings | None = None,
        settings: NewtonSettings = TIGHT,
    ) -> None:
        """Prepare the equations of a solid at rest.

        ``held`` are prescribed components (V, 3); None = the mesh's fixed nodes.
        """
        self.mesh, self.mu, self.bulk = mesh, mu, bulk_ratio * mu
        self.contact = contact or ContactSettings()
        self.system = EquilibriumSystem(
            mesh,
            core,
            shear_modulus_pa=mu,
            bulk_ratio=bulk_ratio,
            contact=self.contact,
            strain_stiffening=stiffening,
            held=held,
        )
        self.settings = settings
        self.held = np.ones(mesh.nodes.shape, bool)
        self.held.reshape(-1)[self.system.pattern.free] = False
        self.state = SolutionState.at_rest(mesh)
        self.report = NewtonReport()

    @cached_property
    def newton(self) -> NewtonSolver:
        """The solver, made when first used: half of the bodies are only evaluated."""
        pattern = self.system.pattern
        return NewtonSolver(
            self.system,
            make_factor(
                pattern.indptr, pattern.indices, groups=pattern.free // 3, solver="fronts-double"
            ),
            self.settings,
        )

    def solve(
        self, press: PosedIndenter | None = None, *, volume: float | None = None
    ) -> ForceBalance:
        """Solve for the equilibrium, starting from the present state; then update the anchors.

        Raises:
            SimulationError: Newton's method did not converge.
        """
        self.report, balance = self.newton.solve(self.state, press, volume=volume)
        if not self.report.converged:
            raise SimulationError(
                f"{self.report.reason}; last error {self.report.residuals[-1]:.1e}",
                remedy="use smaller increments",
            )
        if press is not None:
            self.update_anchors(press)
        return balance

    def update_anchors(self, press: PosedIndenter) -> None:
        """See `EquilibriumSystem.update_anchors`."""
        self.system.update_anchors(self.state, press)

    def contact_points(self) -> Floats:
        """See `Surface.points_at`."""
        return self.system.outer.points_at(self.state.position)

    def reactions(self, balance: ForceBalance) -> Floats:
        """Forces of the supports on held components [N], 0 elsewhere, (V, 3)."""
        fluid = self.state.fluid_pressure * balance.volume_gradient
        total = balance.internal + balance.indenter + balance.core - fluid
        return np.where(self.held, total, 0.0)

    def strain_energy(self) -> float:
        """Energy stored in the skin [J]; the error is of second order in the residuals."""
        return self.energy_at(self.state.position, self.state.pressure)

    def energy_at(self, position: Floats, pressure: Floats) -> float:
        """Mixed energy: sum w W + sum p (v - v0) - v0 p^2 / (2 kappa) [J]."""
        skin = self.system.skin
        f = np.einsum("eai,eqaj->eqij", position[self.mesh.elements], skin.gradient_values)
        isochoric = (skin.weight_values * energy_density(f, self.mu)).sum()
        volume = (skin.weight_values * np.linalg.det(f)).sum(axis=1)
        swelling = pressure * (volume - skin.rest_volume)
        return float(isochoric + (swelling - skin.rest_volume * pressure**2 / 2 / self.bulk).sum())

    def contact_energy(self) -> float:
        """Energy stored in the springs of contact with indenter and core [J]."""
        state, contact = self.state, self.contact
        outer, inner = self.system.outer.area_values, self.system.inner.area_values
        normal = (outer * state.indenter_pressure**2).sum() + (inner * state.core_pressure**2).sum()
        stick = (outer * (state.traction**2).sum(axis=2)).sum()
        return float(normal / 2 / contact.stiffness + stick / 2 / contact.tangential_stiffness)


INNER_M, OUTER_M, CORE_M, BALL_M = 3.0e-3, 4.5e-3, 2.95e-3, 2.0e-3
FILLED = 1.06  # volume of the cavity over the unpressurised one
ASIDE_M = (0.31e-3, 0.17e-3)  # offset of the indenter, which breaks the symmetry
EDGE_M = 1.4e-3  # of the coarse BioTac
TOUCH_ITERATIONS = 8  # of the height where an indenter touches; each leaves a tenth of the error


@dataclass
class TouchedFingertip:
    """A pressurised fingertip and an indenter that just touches it.

    Attributes:
        body: Skin, fluid and core.
        volume: Of the sealed cavity [m^3].
        press: The indenter.
        start: Position of the indenter where it touches [m], (3,).
    """

    body: VerificationBody
    volume: float
    press: PosedIndenter
    start: Floats

    def at(self, move: Floats) -> ForceBalance:
        """Equilibrium with the indenter moved from where it touches [m]."""
        return self.body.solve(self.placed(move), volume=self.volume)

    def placed(self, move: Floats) -> PosedIndenter:
        """The indenter, moved from where it touches [m]."""
        return self.press.at(pose(self.start + move))


def round_core(radius: float, spacing: float) -> DistanceGrid:
    """Distance to a ball around the origin, tabulated with a margin of at least 1 mm."""
    half = int(np.ceil((radius + 1e-3) / spacing)) + 2
    line = spacing * np.arange(-half, half + 1)
    at = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    return DistanceGrid.sampled(at[0, 0, 0], spacing, np.linalg.norm(at, axis=-1) - radius)


def round_finger(
    *,
    friction: float,
    scale: float = 1.0,
    mu: float = MU,
    stiffness: float = 1.0,
    mortar: bool = True,
) -> TouchedFingertip:
    """A hollow ball of skin around a ball, its upper part held, filled with fluid.

    ``scale`` is a factor on all lengths, ``stiffness`` one on the constants of contact.
    """
    mesh = hollow_sphere(6, INNER_M, OUTER_M, 1)
    fixed = np.flatnonzero(mesh.nodes[:, 2] > 0.2e-3).astype(np.int32)
    mesh = replace(mesh, nodes=mesh.nodes * scale, fixed=fixed)
    grid = round_core(CORE_M, 0.25e-3)
    core = DistanceGrid(grid.origin * scale, grid.spacing * scale, grid.coefficients * scale)
    usual = ContactSettings()
    contact = replace(usual.scaled(stiffness), margin_m=usual.margin_m * scale, mortar=mortar)
    body = VerificationBody(mesh, core=core, mu=mu, contact=contact)
    rest = body.system.balance(body.state, None).volume
    for share in (0.5, 1.0):
        body.solve(volume=rest * (1 + share * (FILLED - 1)))
    return _touched(body, rest * FILLED, ball(BALL_M * scale), np.array(ASIDE_M) * scale, friction)


@cache
def _coarse() -> tuple[FingertipGeometry, Fingertip]:
    geometry = biotac(edge_m=EDGE_M, layers=1)
    return geometry, Fingertip.pressurised(
        geometry, settings=SolverSettings(newton=TIGHT, solver="fronts-double")
    )


def biotac_finger(*, friction: float, aside: tuple[float, float]) -> TouchedFingertip:
    """The parametric BioTac, coarse, and a ball of radius 3.5 mm under the pad at x, y [m]."""
    geometry, tip = _coarse()
    body = VerificationBody(geometry.mesh, core=geometry.core.grid)
    body.state = tip.state.copy()
    return _touched(body, tip.cavity_m3, ball(3.5e-3), np.array(aside), friction)


def _touched(
    body: VerificationBody, volume: float, indenter: Indenter, aside: Floats, friction: float
) -> TouchedFingertip:
    """Raise the indenter until the skin touches it."""
    press = PosedIndenter(indenter, pose((0.0, 0.0, 0.0)), friction)
    radius = indenter.primitives[0].rounding
    x, y, z = np.moveaxis(body.contact_points(), -1, 0)
    off = (x - aside[0]) ** 2 + (y - aside[1]) ** 2
    below = (off < radius**2) & (z < 0)
    # Where it touches the first contact point; by the gap over whole faces it is there too high.
    height = (z[below] + radius - np.sqrt(radius**2 - off[below])).min()
    for _ in range(TOUCH_ITERATIONS):
        placed = press.at(pose((*aside, height)))
        body.system.correct_contact(body.state, placed)
        body.system.balance(body.state, placed)
        height += body.system.outer.smallest_gap
    finger = TouchedFingertip(body, volume, press, np.array([*aside, height]))
    body.update_anchors(finger.placed(np.zeros(3)))
    return finger
