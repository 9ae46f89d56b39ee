"""A state of the skin in, the counts of one sensor out, with gradients."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_fem.electrodes.circuit import counts_slope, ideal_counts
from palpate_fem.electrodes.conduction import Conduction, FilmConduction
from palpate_fem.electrodes.film import EDGE_M, film_mesh
from palpate_fem.electrodes.gap import Gap, GapFinder
from palpate_fem.electrodes.residual import fit_of, thickness
from palpate_fem.electrodes.unit import UnitParameters
from palpate_fem.mesh.solid import FingertipGeometry
from palpate_fem.result import IndentationStep

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Response:
    """What the electrodes say to one state.

    Attributes:
        counts: Before noise, rounding and the converter's ends, shape (19,).
        impedance: Of the film [Ohm], shape (19,).
        gap: From core to skin.
        film: Thickness of the fluid [m], shape (N,).
        conduction: The film's solution.
    """

    counts: Floats
    impedance: Floats
    gap: Gap
    film: Floats
    conduction: Conduction
    _slope: Floats
    _by_gap: Floats

    def gradient_gap(self) -> Floats:
        """Derivative d counts_i / d gap_j at fixed contact pressure [1/m], shape (19, N)."""
        return np.asarray(
            self._slope[:, None] * self.conduction.gradient_film() * self._by_gap[None]
        )

    def to_skin(self, gradient: Floats, count: int) -> Floats:
        """Transpose of the derivative: of a scalar by counts (19,) to by positions, (V, 3) [1/m].

        Contact pressures are held fixed.
        """
        return self.gap.to_skin(gradient @ self.gradient_gap(), count)


class Electrodes:
    """The electrodes of one geometry and one unit."""

    def __init__(
        self,
        geometry: FingertipGeometry,
        unit: UnitParameters | None = None,
        *,
        edge_m: float = EDGE_M,
    ) -> None:
        """Mesh the film and make it ready; half a second.

        Args:
            geometry: Skin and core.
            unit: Electrical parameters; None = nominal.
            edge_m: Edge of the film's triangles between the discs [m].

        Raises:
            ConfigError: The electrodes do not fit onto the core.
            SimulationError: Skin and core do not belong together.
        """
        unit = unit or UnitParameters()
        self.unit, self.geometry, self._edge_m = unit, geometry, edge_m
        self.film = film_mesh(
            geometry.core,
            edge_m=edge_m,
            disc_diameter_m=unit.disc_diameter_m,
            recess_m=unit.recess_m,
        )
        self.finder = GapFinder(self.film, geometry.mesh)
        self.conduction = FilmConduction(self.film, disc_radius_m=unit.disc_diameter_m / 2)
        self._fit = fit_of(self.film.nodes, unit)

    def with_unit(self, unit: UnitParameters) -> Electrodes:
        """The same geometry with another unit; at once where its discs and core are the same."""
        old = self.unit
        if (unit.disc_diameter_m, unit.recess_m) != (old.disc_diameter_m, old.recess_m):
            return Electrodes(self.geometry, unit, edge_m=self._edge_m)
        other = copy(self)
        other.unit, other._fit = unit, fit_of(self.film.nodes, unit)
        return other

    def respond(
        self, position: Floats, core_force: Floats | None = None, *, log_sigma: float = 0.0
    ) -> Response:
        """Answer to a state.

        Args:
            position: Nodal positions of the skin [m], shape (V, 3), sensor frame.
            core_force: Nodal forces of the core on the skin [N], shape (V, 3); None = no contact.
            log_sigma: ln of the conductivity over the unit's nominal one: temperature.

        Raises:
            SimulationError: The skin is folded or torn.
        """
        return self.of_gap(self.finder.measure(position, core_force), log_sigma=log_sigma)

    def of_step(self, rest: Floats, step: IndentationStep, *, log_sigma: float = 0.0) -> Response:
        """Answer to a simulated step of a finger whose untouched nodes are at `rest` (V, 3) [m]."""
        return self.respond(rest + step.displacement, step.core_force, log_sigma=log_sigma)

    def of_gap(self, gap: Gap, *, log_sigma: float = 0.0) -> Response:
        """Answer to known gaps."""
        unit = self.unit
        film, by_gap, _ = thickness(self._fit.gap(gap.gap), gap.pressure, unit)
        solved = self.conduction.solve(
            film,
            sigma_s_m=unit.sigma_s_m * float(np.exp(log_sigma)),
            contact_ohm_m2=unit.contact_ohm_m2,
        )
        return Response(
            counts=ideal_counts(solved.impedance, unit),
            impedance=solved.impedance,
            gap=gap,
            film=film,
            conduction=solved,
            _slope=counts_slope(solved.impedance, unit),
            _by_gap=by_gap * self._fit.share,
        )

    def counts(
        self,
        positions: Floats | Sequence[Floats],
        core_forces: Floats | Sequence[Floats] | None = None,
        *,
        log_sigma: float = 0.0,
    ) -> Floats:
        """Ideal counts of many states, shape (B, 19): the same numbers as one by one.

        Args:
            positions: Nodal positions [m], shape (B, V, 3).
            core_forces: Nodal forces of the core on the skin [N], shape (B, V, 3), or None.
            log_sigma: As in `respond`.
        """
        forces = core_forces if core_forces is not None else [None] * len(positions)
        return np.array(
            [
                self.respond(position, force, log_sigma=log_sigma).counts
                for position, force in zip(positions, forces, strict=True)
            ]
        ).reshape(-1, self.conduction.terminals - 1)
