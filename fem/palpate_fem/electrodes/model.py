"""The whole electrode model: a state of the skin in, counts of one specimen and gradients out."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from palpate_fem.arrays import Floats
from palpate_fem.electrodes.conduction import FilmConduction, FilmSolution
from palpate_fem.electrodes.electronics import counts_slope, ideal_counts
from palpate_fem.electrodes.film import EDGE_M, film_mesh
from palpate_fem.electrodes.gap import Gap, GapFinder, gap_adjustment, thickness
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.mesh.solid import FingertipGeometry


@dataclass(frozen=True)
class ElectrodeResponse:
    """Response of the electrodes to one state of the skin.

    Attributes:
        counts: Before noise, rounding and clipping by the converter, shape (19,).
        impedance: Of the film [Ohm], shape (19,).
        gap: Gap from core to skin.
        film: Thickness of the fluid [m], shape (N,).
        conduction: The film's solution.
    """

    counts: Floats
    impedance: Floats
    gap: Gap
    film: Floats
    conduction: FilmSolution
    _slope: Floats
    _by_gap: Floats
    _by_pressure: Floats

    def gradient_gap(self) -> Floats:
        """Derivative d counts_i / d gap_j at fixed contact pressure [1/m], shape (19, N)."""
        return self._by_film * self._by_gap

    def gradient_pressure(self) -> Floats:
        """Derivative d counts_i / d pressure_j at fixed gaps [1/Pa], shape (19, N)."""
        return self._by_film * self._by_pressure

    @property
    def _by_film(self) -> Floats:
        return np.asarray(self._slope[:, None] * self.conduction.gradient_film())

    def to_skin(self, gradient: Floats, count: int) -> Floats:
        """Gradient of a scalar by skin positions, shape (V, 3) [1/m], from that by counts, (19,).

        The transpose of the derivative, with the nodal forces of the core held. In contact these
        change with the positions, too: see `to_core_force`.
        """
        by_film = self.conduction.to_film(gradient * self._slope)
        return self.gap.to_skin(by_film * self._by_gap, count, by_film * self._by_pressure)

    def to_core_force(self, gradient: Floats, count: int) -> Floats:
        """Gradient of a scalar by nodal forces of the core, (V, 3) [1/N], from that by counts.

        With the positions held: it is the forces that squeeze the residual film.
        """
        by_film = self.conduction.to_film(gradient * self._slope)
        return self.gap.to_core_force(by_film * self._by_pressure, count)


class ElectrodeModel:
    """The electrodes of one geometry and one specimen."""

    def __init__(
        self,
        geometry: FingertipGeometry,
        specimen: SpecimenParameters | None = None,
        *,
        edge_m: float = EDGE_M,
    ) -> None:
        """Mesh the film and factorise its pattern; takes half a second.

        Args:
            geometry: Skin and core.
            specimen: Electrical parameters; None = nominal.
            edge_m: Edge of the film's triangles between the discs [m].

        Raises:
            ConfigError: The electrodes do not fit onto the core.
            SimulationError: Skin and core do not belong together.
        """
        specimen = specimen or SpecimenParameters()
        self.specimen, self.geometry, self._edge_m = specimen, geometry, edge_m
        self.film = film_mesh(
            geometry.core,
            edge_m=edge_m,
            disc_diameter_m=specimen.disc_diameter_m,
            recess_m=specimen.recess_m,
        )
        self.finder = GapFinder(self.film, geometry.mesh)
        self.conduction = FilmConduction(self.film, disc_radius_m=specimen.disc_diameter_m / 2)
        self._adjustment = gap_adjustment(self.film.nodes, self.film.normals, specimen)

    def with_specimen(self, specimen: SpecimenParameters) -> ElectrodeModel:
        """The model of another specimen; shares the film mesh if discs and core are the same."""
        old = self.specimen
        if (specimen.disc_diameter_m, specimen.recess_m) != (old.disc_diameter_m, old.recess_m):
            return ElectrodeModel(self.geometry, specimen, edge_m=self._edge_m)
        other = copy(self)
        other.specimen, other._adjustment = (
            specimen,
            gap_adjustment(self.film.nodes, self.film.normals, specimen),
        )
        return other

    def respond(
        self, position: Floats, core_force: Floats | None = None, *, log_sigma: float = 0.0
    ) -> ElectrodeResponse:
        """Response to a state of the skin.

        Args:
            position: Nodal positions of the skin [m], shape (V, 3), sensor frame.
            core_force: Nodal forces of the core on the skin [N], shape (V, 3); None = no contact.
            log_sigma: ln of the conductivity over the specimen's nominal one, from temperature.

        Raises:
            SimulationError: The skin is folded or torn.
        """
        return self.of_gap(self.finder.measure(position, core_force), log_sigma=log_sigma)

    def of_gap(self, gap: Gap, *, log_sigma: float = 0.0) -> ElectrodeResponse:
        """Response to known gaps."""
        specimen = self.specimen
        share, closer_m = self._adjustment
        film, by_gap, by_pressure = thickness(share * gap.gap - closer_m, gap.pressure, specimen)
        solved = self.conduction.solve(
            film,
            sigma_s_m=specimen.sigma_s_m * float(np.exp(log_sigma)),
            contact_ohm_m2=specimen.contact_ohm_m2,
        )
        return ElectrodeResponse(
            counts=ideal_counts(solved.impedance, specimen),
            impedance=solved.impedance,
            gap=gap,
            film=film,
            conduction=solved,
            _slope=counts_slope(solved.impedance, specimen),
            _by_gap=by_gap * share,
            _by_pressure=by_pressure,
        )
