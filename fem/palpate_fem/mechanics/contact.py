"""Contact of the skin's two surfaces: outside with the indenter, inside with the core.

The laws, and why pressures and tractions of contact are unknowns of their own, are in
``contact_kernels``; this module holds the constants, the arrays and the launches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate.rigid import rotation_matrices
from palpate_fem.arrays import Floats, Ints
from palpate_fem.device import DEVICE, indices, launch, mat33s, scalars, vec3s
from palpate_fem.indenter.distance import distance, signed_distance
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics import contact_kernels
from palpate_fem.mechanics.contact_kernels import ContactLaw
from palpate_fem.mechanics.mortar import HANGING_M, MortarWeights
from palpate_fem.mechanics.reference_element import corner_element, face_element, point_areas
from palpate_fem.mechanics.state import MortarCorrection, SolutionState
from palpate_fem.mesh.core import DistanceGrid


@dataclass(frozen=True, slots=True)
class ContactSettings:
    """Constants of the contact laws, per unpressurised area.

    Attributes:
        stiffness: Of the normal law [Pa/m]; at 1 MPa, a hard pinch, the penetration is 0.5 um.
        tangential_stiffness: Of a sticking point [Pa/m]; 0.1 MPa moves it by 2 um.
        complement: c of the complementarity function that decides between sticking and sliding
            [Pa/m]. The solution does not depend on it. It must not exceed the skin's own stiffness
            (mu over the size of an element): with more, a point whose displacement changes sign
            from iteration to iteration slides for ever (ADR 0013).
        margin_m: Points farther than this from a surface are not evaluated [m].
        mortar: Whether gaps are weighted means over the faces around a node (``mortar``), or those
            of the nodes alone, which is softer.
    """

    stiffness: float = 2e12
    tangential_stiffness: float = 5e10
    complement: float = 3e8
    margin_m: float = 0.5e-3
    mortar: bool = True

    def scaled(self, factor: float) -> ContactSettings:
        """The same relative to a skin that is stiffer by a factor."""
        return replace(
            self,
            stiffness=factor * self.stiffness,
            tangential_stiffness=factor * self.tangential_stiffness,
            complement=factor * self.complement,
        )

    def law(self, friction: float) -> ContactLaw:
        """The constants as the kernels take them, with a Coulomb coefficient."""
        law = ContactLaw()
        law.stiffness = wp.float64(self.stiffness)
        law.friction = wp.float64(friction)
        law.tangential_stiffness = wp.float64(self.tangential_stiffness)
        law.complement = wp.float64(self.complement)
        law.at_nodes = wp.float64(0.0 if self.mortar else 1.0)
        return law


class PosedIndenter:
    """An indenter at a pose (7,): position [m] and quaternion w x y z, sensor frame."""

    def __init__(
        self, shape: Indenter, pose: Floats, friction: float, primitives: wp.array | None = None
    ) -> None:
        self.shape, self.friction = shape, friction
        self.primitives = scalars(shape.packed()[None]) if primitives is None else primitives
        self.tip = np.asarray(pose[:3], np.float64)
        self.rotation = rotation_matrices(pose[3:])

    @property
    def model(self) -> list[wp.array]:
        """Arguments of the contact kernels: kinds of indenters, the kind, tip, rotation."""
        kind = indices(np.zeros(1, np.int32))
        return [
            self.primitives,
            kind,
            vec3s(self.tip[None].copy()),
            mat33s(self.rotation[None].copy()),
        ]

    def at(self, pose: Floats) -> PosedIndenter:
        """The same indenter at another pose."""
        return PosedIndenter(self.shape, pose, self.friction, self.primitives)

    def to_local(self, points: Floats) -> Floats:
        """Points of the sensor frame in the indenter frame."""
        return np.asarray((points - self.tip) @ self.rotation)

    def distance(self, points: Floats, margin_m: float = np.inf) -> tuple[Floats, Floats]:
        """Gaps [m], (N,), and their gradients, (N, 3), at points (N, 3) of the sensor frame [m].

        Above the margin [m] a gap may be any value above it, and has no gradient.
        """
        gap, normal, _ = distance(self.shape, self.to_local(points), margin_m)
        return gap, normal @ self.rotation.T

    def bound(self, points: Floats, margin_m: float) -> Floats:
        """Gaps [m], (N,), at points (N, 3) of the sensor frame [m]; see `signed_distance`."""
        return signed_distance(self.shape, self.to_local(points), margin_m)

    def curved(self, points: Floats) -> tuple[Floats, Floats]:
        """Gradients (N, 3) and second derivatives (N, 3, 3) [1/m] of the gaps at points (N, 3)."""
        _, normal, hessian = distance(self.shape, self.to_local(points))
        return normal @ self.rotation.T, self.rotation @ hessian @ self.rotation.T


class ContactSurface:
    """One surface of the mesh, and the results of the contact kernels at its points.

    The contact points are the corners of the faces; arrays have the shape (faces, corners).
    """

    def __init__(self, nodes: Floats, faces: Ints, pairs: Ints) -> None:
        """Prepare the arrays.

        Args:
            nodes: Undeformed positions [m], (V, 3).
            faces: Node ids (F, k); may be empty.
            pairs: Block of each node pair of each face in the tangent, (F, k, k).
        """
        self.count, self.nodes = len(faces), len(nodes)
        self.items = indices(np.arange(self.count, dtype=np.int32))
        corners = faces.shape[1] if faces.ndim == 2 else 3
        self.points = corners
        element = corner_element(corners)
        self.shape_values = element.shape
        self._corners = faces.reshape(-1, corners)
        self.area_values = self.current_area(nodes)
        self.mortar = MortarWeights(nodes, self._corners)
        size = self.area_values.shape
        self.no_correction = MortarCorrection.none(self._corners, len(nodes))
        self._correction, self._pressure = self.no_correction, np.zeros(size)
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
        self.unsymmetric = wp.zeros(size, dtype=wp.mat33d, device=DEVICE)
        # First arguments and first outputs of each contact kernel; further ones of friction.
        self.model = [self.faces, self.shape, self.area]
        self.results = [
            self.status, self.gap_array, self.wanted_array, self.slope, self.misfit, self.tangent,
        ]  # fmt: skip
        self.of_friction = [
            self.wanted_traction_array, self.traction_slope, self.coupled, self.unsymmetric,
        ]  # fmt: skip
        # The same of the pressure at the faces' quadrature points.
        self.mortar_status = wp.zeros_like(self.status)
        self.mortar_tangent = wp.zeros_like(self.tangent)
        self.mortar_shape = scalars(self.mortar.shape)
        self.quadrature = [self.faces, self.mortar_shape, scalars(self.mortar.weight)]
        self.loaded = [self.mortar_status, self.mortar_tangent]
        self._freezing = (self.slope, self.traction_slope, self.status, self.unsymmetric)
        self._frozen = [wp.clone(array) for array in self._freezing]
        self._sliding = wp.zeros(0, dtype=wp.int32, device=DEVICE)

    def freeze(self) -> None:
        """Keep what belongs to the tangent that is being factorised."""
        for kept, now in zip(self._frozen, self._freezing, strict=True):
            wp.copy(kept, now)
        unsymmetric = self.unsymmetric.numpy().reshape(self.count, 9 * self.points)
        self._sliding = _numbers(np.any(unsymmetric != 0.0, axis=1))

    def keep(self, correction: MortarCorrection, pressure: Floats) -> None:
        """Keep the mortar correction and the pressures [Pa], (F, Q), of an evaluation."""
        self._correction, self._pressure = correction, pressure

    @property
    def is_unsymmetric(self) -> bool:
        """Whether the frozen tangent has an unsymmetric share: friction, and mortar's loads."""
        return len(self._sliding) > 0 or self._correction.spread.nnz > 0

    def add_tangent(self, blocks: wp.array) -> None:
        """Add the symmetric tangents of the touching points."""
        launch(
            contact_kernels.point_tangent,
            self.count,
            [self.shape, self.pairs, len(blocks), self.items, self.status, self.tangent],
            [blocks],
        )
        launch(
            contact_kernels.point_tangent,
            self.count,
            [
                self.mortar_shape,
                self.pairs,
                len(blocks),
                self.items,
                self.mortar_status,
                self.mortar_tangent,
            ],
            [blocks],
        )

    def add_unsymmetric_product(self, change: wp.array, product: wp.array) -> None:
        """Add the frozen unsymmetric share of the tangent times a change of the nodes."""
        launch(
            contact_kernels.unsymmetric_product,
            len(self._sliding),
            [self.faces, self.shape, self.nodes, self._sliding, *self._frozen[2:]],
            [change, product],
        )
        if self._correction.spread.nnz:
            # The change of pressure is minus the slope times that of the position.
            moved = change.numpy()[self._corners]
            slope = np.einsum("fqi,fqi->fq", self._frozen[0].numpy(), moved)
            product.numpy()[:] += self._correction.load(slope)

    def subtract_coupled(self, force: wp.array) -> None:
        """Subtract what nodal forces lack: friction and mortar's loads follow wanted pressures."""
        self.subtract_load(self.coupled, force)
        if self._correction.spread.nnz:
            touching = self.status.numpy() > 0
            lacking = np.where(touching, self._wanted - self._pressure, 0.0)
            force.numpy()[:] -= self._correction.load(lacking)

    def offset_change(self, moved: Floats) -> Floats:
        """How a change (V, 3) of the nodes changes the offsets of their gaps [m], (V,)."""
        each = self._correction.spread.T @ moved.ravel()
        sums = np.bincount(self._corners.ravel(), each, minlength=self.nodes)
        return np.asarray(sums / np.where(self.mortar.area > 0.0, self.mortar.area, np.inf))

    def add_offset_load(self, offset: Floats, force: Floats) -> None:
        """Add the forces (V, 3) by which touching points resist changes (V,) of their offsets."""
        slope = self._frozen[0].numpy()
        touching = np.flatnonzero(slope.any(axis=(1, 2)))
        corners = self._corners[touching]
        size = self.area_values[touching] * offset[corners]
        np.add.at(force, corners, size[..., None] * slope[touching])

    @property
    def changed(self) -> bool:
        """Whether the status of any point differs from the frozen one."""
        return not np.array_equal(self._frozen[2].numpy(), self.status.numpy())

    @property
    def smallest_gap(self) -> float:
        """Smallest gap of the last evaluation [m], mortar correction included."""
        return float(self.gap.min(initial=np.inf))

    def clear(self) -> None:
        """Set the results of a surface that nothing is near to."""
        for array in (*self.results, *self.of_friction, *self.loaded):
            array.zero_()
        self.keep(self.no_correction, np.zeros(self.area_values.shape))
        self.gap[:] = np.inf

    def near(self, bound: Floats, margin_m: float) -> wp.array:
        """Faces of which a node may touch, or touched at the last evaluation.

        Args:
            bound: Gaps of the surface's nodes [m]; above the margin any value above it. The gaps of
                all faces are set to these.
            margin_m: Gap from which on a node cannot touch [m].
        """
        gap = np.empty(self.nodes)
        gap[self.mortar.nodes] = bound
        self.gap[:] = gap[self._corners]
        touched = self.status.numpy() > 0
        return _numbers(((self.gap < margin_m) | touched).T.any(axis=0))

    def pressed(self, pressure: Floats) -> wp.array:
        """Faces with pressure; no other is `loaded` until the next evaluation."""
        self.mortar_status.zero_()
        return _numbers((pressure.T != 0.0).any(axis=0))

    def pressure_misfit(self, pressure: Floats) -> float:
        """Largest difference between pressures and what the normal law demands [Pa]."""
        return float(np.abs(self._wanted - pressure).max()) if self.count else 0.0

    def traction_misfit(self, traction: Floats) -> float:
        """Largest difference between tractions and what the friction law demands [Pa]."""
        return float(np.abs(self._wanted_traction - traction).max()) if self.count else 0.0

    def updated_pressure(
        self, moved: Floats, offset: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Pressures (F, Q) and tractions (F, Q, 3) after a change of the nodal positions [Pa].

        Args:
            moved: The change [m], (V, 3).
            offset: That of the offsets of the nodes' gaps [m], (V,), which is as a move along the
                normal; None = none.
        """
        if offset is not None:
            slope = self._frozen[0].numpy()
            touching = slope.any(axis=2)
            nodes, normal, moved = self._corners[touching], slope[touching], moved.copy()
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            # Corners of several faces are one node, with one normal.
            moved[nodes] = moved[nodes] + offset[nodes][:, None] * normal
        pressure = np.zeros(self.area_values.shape)
        traction = np.zeros((*pressure.shape, 3))
        launch(
            contact_kernels.pressure_update,
            self.count,
            [
                self.faces,
                self.shape,
                self.nodes,
                self.items,
                self.status,
                self.wanted_array,
                self._frozen[0],
                self.wanted_traction_array,
                self._frozen[1],
                vec3s(moved),
            ],
            [scalars(pressure), vec3s(traction)],
        )
        return pressure, traction

    def subtract_load(self, load: wp.array, force: wp.array) -> None:
        """Subtract a load at the points (F, Q) from nodal forces."""
        launch(
            contact_kernels.subtract_load,
            self.count,
            [self.faces, self.shape, self.nodes, self.items, load],
            [force],
        )

    def points_at(self, position: Floats) -> Floats:
        """Positions of the contact points [m], (F, Q, 3)."""
        return np.asarray(np.einsum("qa,fai->fqi", self.shape_values, position[self._corners]))

    def current_area(self, position: Floats) -> Floats:
        """Area of each corner, the integral of its shape function over the face [m^2], (F, Q).

        The Jacobian at the corner itself is its share of the area on parallelograms only. On a
        distorted face an even pressure with such weights would push unevenly.
        """
        size, shape = point_areas(position, self._corners), face_element(self.points).shape
        return np.asarray(np.einsum("fq,qa->fa", size, shape))


class IndenterContact:
    """Frictional contact of the outer surface with an indenter."""

    def __init__(self, surface: ContactSurface, nodes: int, settings: ContactSettings) -> None:
        self.surface, self.settings = surface, settings
        self.force = np.zeros((nodes, 3))
        self._force = vec3s(self.force)

    def evaluate(
        self, state: SolutionState, indenter: PosedIndenter | None, position: wp.array
    ) -> None:
        """Evaluate minus the nodal forces on the skin, and the results at each point."""
        self.force[:] = 0.0
        surface = self.surface
        if indenter is None or not surface.count:
            surface.clear()
            return
        primitives, kind, tip, rotation = indenter.model
        margin_m = self.settings.margin_m
        near = surface.near(
            indenter.bound(state.position[surface.mortar.nodes], margin_m), margin_m
        )
        launch(
            contact_kernels.indenter_contact,
            (len(near), surface.points),
            [
                *surface.model,
                primitives,
                kind,
                self.settings.law(indenter.friction),
                wp.float64(margin_m),
                tip,
                rotation,
                surface.nodes,
                near,
                position,
                scalars(state.on_indenter.gap),
                scalars(state.indenter_pressure),
                vec3s(state.traction),
                vec3s(state.anchor),
            ],
            [
                *surface.results,
                *surface.of_friction,
                self._force,
            ],
        )
        surface.keep(state.on_indenter, state.indenter_pressure)
        if self.settings.mortar:
            pressed = surface.pressed(state.indenter_pressure)
            launch(
                contact_kernels.mortar_on_indenter,
                (len(pressed), surface.points),
                [
                    *surface.quadrature,
                    primitives,
                    kind,
                    tip,
                    rotation,
                    surface.nodes,
                    pressed,
                    position,
                    scalars(state.indenter_pressure),
                    vec3s(state.on_indenter.held),
                ],
                [*surface.loaded, self._force],
            )

    def correction(self, state: SolutionState, indenter: PosedIndenter | None) -> MortarCorrection:
        """The mortar correction at a state."""
        surface = self.surface
        if indenter is None or not surface.count or not self.settings.mortar:
            return surface.no_correction
        # An indenter whose creases skin reaches has fillets.
        hanging_m = HANGING_M if indenter.shape.fillet_m > 0.0 else np.inf
        return surface.mortar.correction(
            state.position, indenter.distance, self.settings.margin_m, hanging_m
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
        """Evaluate minus the nodal forces on the skin, and the results at each point."""
        self.force[:] = 0.0
        surface, core = self.surface, self.core
        if core is None or not surface.count:
            surface.clear()
            return
        launch(
            contact_kernels.core_contact,
            (surface.count, surface.points),
            [
                *surface.model,
                self._table,
                wp.vec3d(*core.origin),
                wp.float64(core.spacing),
                surface.nodes,
                surface.items,
                self.settings.law(0.0),
                position,
                scalars(state.on_core.gap),
                scalars(state.core_pressure),
            ],
            [*surface.results, self._force],
        )
        surface.keep(state.on_core, state.core_pressure)
        if self.settings.mortar:
            pressed = surface.pressed(state.core_pressure)
            launch(
                contact_kernels.mortar_on_core,
                (len(pressed), surface.points),
                [
                    *surface.quadrature,
                    self._table,
                    wp.vec3d(*core.origin),
                    wp.float64(core.spacing),
                    surface.nodes,
                    pressed,
                    position,
                    scalars(state.core_pressure),
                ],
                [*surface.loaded, self._force],
            )

    def correction(self, state: SolutionState) -> MortarCorrection:
        """The mortar correction at a state."""
        surface, core = self.surface, self.core
        if core is None or not surface.count or not self.settings.mortar:
            return surface.no_correction
        return surface.mortar.correction(state.position, self._distance, self.settings.margin_m)

    def _distance(self, points: Floats, margin_m: float) -> tuple[Floats, Floats]:
        """Distance to the core [m], (N,), and its gradient, (N, 3); see `DistanceGrid.evaluate`.

        Above the margin [m] it may be any value above it. The means of gaps need it wherever a
        touching face's points are, as the forces at these points do, so far away, too.
        """
        assert self.core is not None
        gap, normal = np.empty(len(points)), np.empty((len(points), 3))
        launch(
            contact_kernels.core_distances,
            len(points),
            [
                self._table,
                wp.vec3d(*self.core.origin),
                wp.float64(self.core.spacing),
                wp.float64(margin_m),
                vec3s(np.ascontiguousarray(points)),
            ],
            [scalars(gap), vec3s(normal)],
        )
        return gap, normal


def _numbers(chosen: NDArray[np.bool_]) -> wp.array:
    """Numbers of the faces that are chosen, (F,), as kernels take them."""
    return indices(np.flatnonzero(chosen).astype(np.int32))
