"""A solid on the test stand: equations, state and tight solution, with energies and reactions."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from palpate.errors import SimulationError
from palpate_fem.mechanics.balance import Balance
from palpate_fem.mechanics.laws import ContactSettings, Press
from palpate_fem.mechanics.material import NeoHooke
from palpate_fem.mechanics.newton import Newton, NewtonSettings, Report
from palpate_fem.mechanics.state import State
from palpate_fem.mechanics.system import System
from palpate_fem.mesh.core import DistanceGrid
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.sparse.factor import make_factor

Floats = NDArray[np.float64]

MU = 2.8e5  # [Pa], the paper's optimum
BULK_RATIO = 1e4

# Far tighter than production, so that what is seen is the discretisation.
TIGHT = NewtonSettings(
    tolerance=1e-11,
    volume_tolerance=1e-11,
    gap_tolerance_m=1e-14,
    traction_tolerance=1e-7,
    iterations=40,
    largest_move_m=1.0,
    keep_factor=0.0,
    keep_elastic=0.0,
)


class Body:
    """One solid; ``state`` goes on from solution to solution."""

    def __init__(
        self,
        mesh: SolidMesh,
        *,
        held: NDArray[np.bool_] | None = None,
        core: DistanceGrid | None = None,
        mu: float = MU,
        bulk_ratio: float = BULK_RATIO,
        contact: ContactSettings | None = None,
        settings: NewtonSettings = TIGHT,
    ) -> None:
        """Put it up.

        Args:
            mesh: The solid.
            held: Prescribed components (V, 3); None = the mesh's fixed nodes.
            core: Inside, or None.
            mu: Shear modulus [Pa].
            bulk_ratio: Bulk over shear modulus.
            contact: Constants of the contact laws.
            settings: When an increment is solved.
        """
        self.mesh, self.mu, self.bulk = mesh, mu, bulk_ratio * mu
        self.contact = contact or ContactSettings()
        self.system = System(
            mesh, core, shear_modulus_pa=mu, bulk_ratio=bulk_ratio, contact=self.contact, held=held
        )
        self.settings = settings
        self.held = np.ones(mesh.nodes.shape, bool)
        self.held.reshape(-1)[self.system.pattern.free] = False
        self.state = State.at_rest(mesh)
        self.report = Report()

    @cached_property
    def newton(self) -> Newton:
        """Made when first needed: half of the bodies are only looked at."""
        pattern = self.system.pattern
        return Newton(
            self.system,
            make_factor(
                pattern.indptr, pattern.indices, groups=pattern.free // 3, solver="fronts-double"
            ),
            self.settings,
        )

    def solve(self, press: Press | None = None, *, volume: float | None = None) -> Balance:
        """Equilibrium from where it is; then anchors follow what slid.

        Raises:
            SimulationError: There is none, or it was not found.
        """
        self.report, balance = self.newton.solve(self.state, press, volume=volume)
        if not self.report.converged:
            raise SimulationError(
                f"{self.report.reason}; last error {self.report.residuals[-1]:.1e}",
                remedy="use smaller increments",
            )
        if press is not None:
            self.settle(press)
        return balance

    def settle(self, press: Press) -> None:
        """See `System.settle`."""
        self.system.settle(self.state, press)

    def contact_points(self) -> Floats:
        """See `Surface.points_at`."""
        return self.system.outer.points_at(self.state.position)

    def reactions(self, balance: Balance) -> Floats:
        """Forces of the supports on held components [N], 0 elsewhere, (V, 3)."""
        fluid = self.state.fluid_pressure * balance.volume_gradient
        total = balance.internal + balance.indenter + balance.core - fluid
        return np.where(self.held, total, 0.0)

    def strain_energy(self) -> float:
        """Stored in the skin, to second order in what is left of the residuals [J]."""
        return self.energy_at(self.state.position, self.state.pressure)

    def energy_at(self, position: Floats, pressure: Floats) -> float:
        """Mixed energy: sum w W + sum p (v - v0) - v0 p^2 / (2 kappa) [J]."""
        skin = self.system.skin
        f = np.einsum("eai,eqaj->eqij", position[self.mesh.elements], skin.gradient_values)
        isochoric = (skin.weight_values * NeoHooke(self.mu).function(f)).sum()
        volume = (skin.weight_values * np.linalg.det(f)).sum(axis=1)
        swelling = pressure * (volume - skin.rest_volume)
        return float(isochoric + (swelling - skin.rest_volume * pressure**2 / 2 / self.bulk).sum())

    def contact_energy(self) -> float:
        """Stored in the springs of contact, indenter and core [J]."""
        state, contact = self.state, self.contact
        outer, inner = self.system.outer.area_values, self.system.inner.area_values
        normal = (outer * state.indenter_pressure**2).sum() + (inner * state.core_pressure**2).sum()
        stick = (outer * (state.traction**2).sum(axis=2)).sum()
        return float(normal / 2 / contact.stiffness + stick / 2 / contact.tangential_stiffness)
