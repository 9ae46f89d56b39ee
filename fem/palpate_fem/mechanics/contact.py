"""Constants of contact, and an indenter at a pose.

One surface of the mesh, with what contact leaves at its points.

Contact of the skin's two surfaces: outside with the indenter, inside with the core.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate.rigid import rotation_matrices
from palpate_fem.device import DEVICE, scalars, vec3s
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics import contact_kernels
from palpate_fem.mechanics.contact_kernels import ContactLaw
from palpate_fem.mechanics.reference_element import corner_element, face_element
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mesh.core import DistanceGrid

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ContactSettings:
    """Numbers of the contact laws, per unpressurised area.

    Attributes:
        stiffness: Of the normal law [Pa/m]; 1 MPa, a hard pinch, is 0.5 um deep.
        tangential_stiffness: Of a sticking point [Pa/m]; 0.1 MPa moves it by 2 um.
        complement: c that decides between sticking and sliding [Pa/m]; it does not touch the
            answer. At most the skin's own stiffness (mu over an element): with more, a point whose
            way changes sign from iteration to iteration slides for ever.
        margin_m: Points farther from a surface are not looked at [m].
    """

    stiffness: float = 2e12
    tangential_stiffness: float = 5e10
    complement: float = 3e8
    margin_m: float = 0.5e-3

    def scaled(self, factor: float) -> ContactSettings:
        """The same relative to a skin that is stiffer by a factor."""
        return replace(
            self,
            stiffness=factor * self.stiffness,
            tangential_stiffness=factor * self.tangential_stiffness,
            complement=factor * self.complement,
        )

    def law(self, friction: float) -> ContactLaw:
        """The same for the kernels."""
        law = ContactLaw()
        law.stiffness = wp.float64(self.stiffness)
        law.friction = wp.float64(friction)
        law.tangential_stiffness = wp.float64(self.tangential_stiffness)
        law.complement = wp.float64(self.complement)
        return law


class PosedIndenter:
    """An indenter at a pose (7,): position [m] and quaternion w x y z, sensor frame."""

    def __init__(self, indenter: Indenter, pose: Floats, friction: float) -> None:
        self.shape, self.friction = indenter, friction
        self.primitives = scalars(indenter.packed())
        self.tip = np.asarray(pose[:3], np.float64)
        self.rotation = rotation_matrices(pose[3:])

    def at(self, pose: Floats) -> PosedIndenter:
        """The same at another pose."""
        other = object.__new__(PosedIndenter)
        other.shape, other.friction, other.primitives = (
            self.shape,
            self.friction,
            self.primitives,
        )
        other.tip, other.rotation = np.asarray(pose[:3], np.float64), rotation_matrices(pose[3:])
        return other

    def to_local(self, points: Floats) -> Floats:
        """Points of the sensor frame in the indenter's."""
        return np.asarray((points - self.tip) @ self.rotation)


class ContactSurface:
    """One surface of the mesh, with what contact leaves at its quadrature points."""

    def __init__(self, nodes: Floats, faces: NDArray[np.int32], pairs: NDArray[np.int32]) -> None:
        self.count = len(faces)
        corners = faces.shape[1] if faces.ndim == 2 else 3
        self.points = corners
        element = corner_element(corners)
        self.shape_values = element.shape
        self._corners = faces.reshape(-1, corners)
        self.area_values = self.current_area(nodes)
        size = self.area_values.shape
        self.gap, self._wanted = np.full(size, np.inf), np.zeros(size)
        self._wanted_traction = np.zeros((*size, 3))
        self.faces = wp.array(faces.reshape(-1, corners), dtype=wp.int32, device=DEVICE)
        self.pairs = wp.array(pairs.reshape(-1, corners, corners), dtype=wp.int32, device=DEVICE)
        self.shape, self.area = scalars(element.shape), scalars(self.area_values)
        self.status = wp.zeros(size, dtype=wp.int32, device=DEVICE)
        self.gap_array, self.wanted_array = scalars(self.gap), scalars(self._wanted)
        self.wanted_traction_array = vec3s(self._wanted_traction)
        self.slope = wp.zeros(size, dtype=wp.vec3d, device=DEVICE)
        self.traction_slope = wp.zeros(size, dtype=wp.mat33d, device=DEVICE)
        self.misfit = wp.zeros(size, dtype=wp.vec3d, device=DEVICE)
        self.tangent = wp.zeros(size, dtype=wp.mat33d, device=DEVICE)
        self.coupled = wp.zeros(size, dtype=wp.vec3d, device=DEVICE)
        self.rest = wp.zeros(size, dtype=wp.mat33d, device=DEVICE)
        self._freezing = (self.slope, self.traction_slope, self.status, self.rest)
        self._frozen = [wp.clone(array) for array in self._freezing]
        self._sliding = wp.zeros(0, dtype=wp.int32, device=DEVICE)

    @property
    def model(self) -> list[wp.array]:
        """What every contact kernel takes first."""
        return [self.faces, self.shape, self.area]

    @property
    def results(self) -> list[wp.array]:
        """What every contact kernel fills."""
        return [
            self.status,
            self.gap_array,
            self.wanted_array,
            self.slope,
            self.misfit,
            self.tangent,
        ]

    def freeze(self) -> None:
        """Keep what belongs to the tangent that is being factorised."""
        for kept, now in zip(self._frozen, self._freezing, strict=True):
            wp.copy(kept, now)
        rest = self.rest.numpy().reshape(self.count, 9 * self.points)
        sliding = np.flatnonzero(np.any(rest != 0.0, axis=1)).astype(np.int32)
        self._sliding = wp.array(sliding, dtype=wp.int32, device=DEVICE)

    @property
    def slides(self) -> bool:
        """Whether the frozen tangent has an unsymmetric share."""
        return len(self._sliding) > 0

    def add_tangent(self, blocks: wp.array) -> None:
        """Add the symmetric tangents of the points that touch."""
        if self.count:
            wp.launch(
                contact_kernels.point_tangent,
                dim=self.count,
                inputs=[self.shape, self.pairs, self.status, self.tangent],
                outputs=[blocks],
                device=DEVICE,
            )

    def add_rest_product(self, change: wp.array, product: wp.array) -> None:
        """Add the frozen unsymmetric share times a change of the nodes."""
        wp.launch(
            contact_kernels.rest_product,
            dim=len(self._sliding),
            inputs=[self.faces, self.shape, self._sliding, self._frozen[3]],
            outputs=[change, product],
            device=DEVICE,
        )

    @property
    def changed(self) -> bool:
        """Whether any point's status differs from the frozen one."""
        return not np.array_equal(self._frozen[2].numpy(), self.status.numpy())

    def forget(self) -> None:
        """Nothing is near."""
        self.gap[:] = np.inf
        self._wanted[:] = 0.0
        self._wanted_traction[:] = 0.0
        for array in (
            self.status,
            self.slope,
            self.traction_slope,
            self.misfit,
            self.tangent,
            self.coupled,
            self.rest,
        ):
            array.zero_()

    def misfit_of(self, pressure: Floats) -> float:
        """Largest difference of pressures from what the law wants [Pa]."""
        return float(np.abs(self._wanted - pressure).max()) if self.count else 0.0

    def traction_misfit(self, traction: Floats) -> float:
        """Largest difference of tractions from what friction wants [Pa]."""
        return float(np.abs(self._wanted_traction - traction).max()) if self.count else 0.0

    def updated_pressure(self, moved: wp.array) -> tuple[Floats, Floats]:
        """Pressures (F, Q) and tractions (F, Q, 3) after a change of the nodal positions [Pa]."""
        pressure = np.zeros(self.area_values.shape)
        traction = np.zeros((*pressure.shape, 3))
        if self.count:
            wp.launch(
                contact_kernels.pressure_update,
                dim=self.count,
                inputs=[
                    self.faces,
                    self.shape,
                    self.status,
                    self.wanted_array,
                    self._frozen[0],
                    self.wanted_traction_array,
                    self._frozen[1],
                    moved,
                ],
                outputs=[scalars(pressure), vec3s(traction)],
                device=DEVICE,
            )
        return pressure, traction

    def add_load(self, load: wp.array, force: wp.array) -> None:
        """Subtract a load at the points (F, Q) from nodal forces."""
        if self.count:
            wp.launch(
                contact_kernels.misfit_force,
                dim=self.count,
                inputs=[self.faces, self.shape, load],
                outputs=[force],
                device=DEVICE,
            )

    def points_at(self, position: Floats) -> Floats:
        """Where the contact points are [m], (F, Q, 3)."""
        return np.asarray(np.einsum("qa,fai->fqi", self.shape_values, position[self._corners]))

    def current_area(self, position: Floats) -> Floats:
        """Area that belongs to each corner, the integral of its shape function [m^2], (F, Q).

        The Jacobian at the corner itself would do on squares only: on distorted faces it is not the
        corner's share, and an even pressure would push unevenly.
        """
        element = face_element(self.points)
        edges = np.einsum("qad,fai->fqdi", element.gradient, position[self._corners])
        size = np.linalg.norm(np.cross(edges[:, :, 0], edges[:, :, 1]), axis=2)
        return np.asarray(np.einsum("q,fq,qa->fa", element.weight, size, element.shape))


class IndenterContact:
    """Frictional contact of the outer surface with an indenter."""

    def __init__(self, surface: ContactSurface, nodes: int, settings: ContactSettings) -> None:
        self.surface, self.settings = surface, settings
        self.force = np.zeros((nodes, 3))
        self._force = vec3s(self.force)

    def evaluate(
        self, state: SolutionState, press: PosedIndenter | None, position: wp.array
    ) -> None:
        """Minus the nodal forces on the skin, and what each point has to say."""
        self.force[:] = 0.0
        surface = self.surface
        if press is None or not surface.count:
            surface.forget()
            return
        wp.launch(
            contact_kernels.indenter_contact,
            dim=surface.count,
            inputs=[
                *surface.model,
                press.primitives,
                self.settings.law(press.friction),
                wp.float64(self.settings.margin_m),
                wp.vec3d(*press.tip),
                wp.mat33d(*press.rotation.ravel()),
                position,
                scalars(state.indenter_pressure),
                vec3s(state.traction),
                vec3s(state.anchor),
            ],
            outputs=[
                *surface.results,
                surface.wanted_traction_array,
                surface.traction_slope,
                surface.coupled,
                surface.rest,
                self._force,
            ],
            device=DEVICE,
        )


class CoreContact:
    """Frictionless contact of the inner surface with the core, if there is one."""

    def __init__(
        self,
        surface: ContactSurface,
        nodes: int,
        settings: ContactSettings,
        core: DistanceGrid | None,
    ) -> None:
        self.surface, self.settings, self.core = surface, settings, core
        self.force = np.zeros((nodes, 3))
        self._force = vec3s(self.force)
        self._table = scalars(core.coefficients if core else np.zeros((4, 4, 4)))

    def evaluate(self, state: SolutionState, position: wp.array) -> None:
        """Minus the nodal forces on the skin, and what each point has to say."""
        self.force[:] = 0.0
        surface, core = self.surface, self.core
        if core is None or not surface.count:
            surface.forget()
            return
        wp.launch(
            contact_kernels.core_contact,
            dim=surface.count,
            inputs=[
                *surface.model,
                self._table,
                wp.vec3d(*core.origin),
                wp.float64(core.spacing),
                self.settings.law(0.0),
                wp.float64(self.settings.margin_m + 2 * core.spacing),
                position,
                scalars(state.core_pressure),
            ],
            outputs=[*surface.results, self._force],
            device=DEVICE,
        )
