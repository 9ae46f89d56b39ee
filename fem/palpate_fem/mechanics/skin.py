"""The skin's elements and the fluid cavity inside: energy, arrays and launches of the kernels."""

from __future__ import annotations

import numpy as np
import warp as wp

from palpate_fem.arrays import Floats, Ints
from palpate_fem.device import DEVICE, indices, launch, mat33s, scalars, vec3s
from palpate_fem.mechanics import element_kernels
from palpate_fem.mechanics.contact import ContactSurface
from palpate_fem.mechanics.element_kernels import BARRIER_FROM, VOLUME_BARRIER
from palpate_fem.mechanics.reference_element import rest_gradients, volume_form
from palpate_fem.mesh.solid import SolidMesh


def energy_density(
    f: Floats, mu: float, barrier: float = VOLUME_BARRIER, stiffening: float = 0.0
) -> Floats:
    """W = mu/2 (m + stiffening/3 m^3 + barrier max(0, |ln J| - 0.25)^2) [J/m^3], shape (...).

    Per unit of undeformed volume, with m = J^(-2/3) tr(F^T F) - 3. For J = 1 and no stiffening this
    is the paper's equation "neo_hookean" up to a constant; the volumetric part belongs to the
    element and its pressure.

    Args:
        f: Deformation gradients, shape (..., 3, 3).
        mu: Shear modulus [Pa].
        barrier: Stiffness against a change of volume at a single point, in shear moduli; 0 = none.
        stiffening: See `FingertipParameters`.
    """
    j = np.linalg.det(f)
    isochoric = j ** (-2 / 3) * np.sum(f * f, axis=(-2, -1)) - 3
    beyond = np.maximum(0.0, np.abs(np.log(j)) - BARRIER_FROM)
    return np.asarray(mu / 2 * (isochoric + stiffening / 3 * isochoric**3 + barrier * beyond**2))


class SkinElements:
    """Elements of one mesh with one material; see `element_kernels`."""

    def __init__(
        self,
        mesh: SolidMesh,
        pairs: Ints,
        *,
        shear_modulus_pa: float,
        bulk_ratio: float,
        volume_barrier: float,
        strain_stiffening: float,
    ) -> None:
        """Prepare the elements; see `EquilibriumSystem`.

        ``pairs`` are the blocks of the node pairs of each element in the tangent, (E, n, n).
        """
        self.mu, self.volume_barrier = shear_modulus_pa, volume_barrier
        self.strain_stiffening = strain_stiffening
        self.gradient_values, self.weight_values = rest_gradients(mesh)
        self.rest_volume = self.weight_values.sum(axis=1)
        self.count, nodes = mesh.elements.shape
        points = self.weight_values.shape[1]
        self.items = indices(np.arange(self.count, dtype=np.int32))
        self._nodes = len(mesh.nodes)
        self._elements = wp.array(mesh.elements, dtype=wp.int32, device=DEVICE)
        self._pairs = wp.array(pairs, dtype=wp.int32, device=DEVICE)
        self._gradient, self._weight = vec3s(self.gradient_values), scalars(self.weight_values)
        self._rest_volume = scalars(self.rest_volume)
        self.bulk_over_volume = bulk_ratio * shear_modulus_pa / self.rest_volume
        self._bulk_over_volume = scalars(self.bulk_over_volume)
        self._volume, self._jacobian = scalars(np.zeros(self.count)), scalars(np.zeros(self.count))
        self._volume_gradient = vec3s(np.zeros((self.count, nodes, 3)))
        self._frozen_gradient = vec3s(np.zeros((self.count, nodes, 3)))
        # Results of `point_state`, of which the tangent is made.
        self._parts = [vec3s(np.zeros((self.count, points, nodes, 3))) for _ in range(3)]
        self._parts.append(
            wp.zeros((self.count, points), dtype=element_kernels.Scales, device=DEVICE)
        )

    def add_forces(
        self, items: wp.array, position: wp.array, pressure: wp.array, force: wp.array
    ) -> None:
        """Add the internal nodal forces of the listed elements."""
        launch(
            element_kernels.element_state,
            len(items),
            [*self._model, items, position, pressure],
            [self._volume, self._jacobian, self._volume_gradient, force],
        )

    def add_tangent(
        self, items: wp.array, position: wp.array, pressure: wp.array, blocks: wp.array
    ) -> None:
        """Add the tangent of the listed elements; `add_forces` comes first, at the same state."""
        points = self._parts[3].shape[1]
        launch(
            element_kernels.point_state,
            (len(items), points),
            [*self._model, items, position, pressure],
            self._parts,
        )
        launch(
            element_kernels.element_tangent,
            len(items),
            [
                self._pairs,
                self._gradient,
                self._bulk_over_volume,
                len(blocks),
                items,
                *self._parts,
                self._volume_gradient,
            ],
            [blocks],
        )

    def freeze(self) -> None:
        """Keep the volume gradients of the tangent that is being factorised."""
        wp.copy(self._frozen_gradient, self._volume_gradient)

    def updated_pressure(self, moved: wp.array) -> Floats:
        """Element pressures after a change of the nodes, to first order [Pa], (E,)."""
        pressure = np.zeros(self.count)
        launch(
            element_kernels.pressure_update,
            self.count,
            [*self._condensed, moved],
            [scalars(pressure)],
        )
        return pressure

    def add_misfit(self, pressure: Floats, force: wp.array) -> None:
        """Add the load on the nodes by static condensation of the element pressures."""
        launch(
            element_kernels.pressure_misfit,
            self._volume_gradient.shape,
            [*self._condensed, scalars(pressure)],
            [force],
        )

    def stress(self, position: Floats, pressure: Floats) -> Floats:
        """Cauchy stress, mean over each element [Pa], (E, 3, 3)."""
        stress = np.zeros((self.count, 3, 3))
        launch(
            element_kernels.element_stress,
            self.count,
            [*self._model, self.items, vec3s(position), scalars(pressure)],
            [mat33s(stress)],
        )
        return stress

    def strain_error(self, pressure: Floats) -> float:
        """Largest |v - v0 - v0 p / kappa| / v0."""
        excess = self._volume.numpy() - self.rest_volume
        return float(np.max(np.abs(excess - pressure / self.bulk_over_volume) / self.rest_volume))

    def smallest_jacobian(self) -> float:
        """Smallest determinant of the deformation gradient at any quadrature point."""
        return float(self._jacobian.numpy().min())

    @property
    def constants(self) -> list[wp.float64]:
        """Those of the law, as kernels take them."""
        return [*map(wp.float64, (self.mu, self.volume_barrier, self.strain_stiffening))]

    @property
    def _model(self) -> list[object]:
        return [self._elements, self._gradient, self._weight, *self.constants, self._nodes]

    @property
    def _condensed(self) -> list[object]:
        return [
            self._elements,
            self._rest_volume,
            self._bulk_over_volume,
            self._nodes,
            self.items,
            self._volume,
            self._frozen_gradient,
        ]


class FluidCavity:
    """The volume that the inner surface encloses; without such a surface it is zero."""

    def __init__(self, surface: ContactSurface, nodes: int) -> None:
        self.surface = surface
        self.gradient = np.zeros((nodes, 3))
        self._gradient = vec3s(self.gradient)
        self._form = scalars(volume_form(surface.points if surface.count else 3))
        self._volumes = scalars(np.zeros(max(surface.count, 1)))

    @property
    def volume(self) -> float:
        """Volume at the last evaluation [m^3]."""
        return float(self._volumes.numpy().sum())

    def evaluate(self, position: wp.array) -> None:
        """Evaluate the volume and its gradient by the nodal positions."""
        self.gradient[:] = 0.0
        surface = self.surface
        launch(
            element_kernels.cavity_volume,
            surface.count,
            [surface.faces, self._form, surface.nodes, surface.items, position],
            [self._volumes, self._gradient],
        )

    def add_tangent(self, position: wp.array, pressure: float, blocks: wp.array) -> None:
        """Add the tangent of a fluid pressure [Pa], a follower load."""
        surface = self.surface
        launch(
            element_kernels.cavity_tangent,
            surface.count,
            [
                surface.faces,
                self._form,
                surface.pairs,
                surface.nodes,
                len(blocks),
                surface.items,
                scalars(np.array([pressure])),
                position,
            ],
            [blocks],
        )
