"""The discrete equilibrium of skin, fluid, core and indenter: residual and tangent."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate.fem import contact_kernels, element_kernels, fluid_kernels
from palpate.fem.device import DEVICE, mat33s, scalars, vec3s
from palpate.fem.laws import ContactSettings, Press
from palpate.fem.mesh.core import DistanceGrid
from palpate.fem.mesh.solid import SolidMesh
from palpate.fem.pattern import make_pattern
from palpate.fem.reference_element import corner_element, solid_element, volume_form
from palpate.fem.state import State

Floats = NDArray[np.float64]

THREADS = 2


@dataclass(slots=True)
class Balance:
    """The equations at one state.

    Attributes:
        internal: Nodal forces of the skin's stress (a residual: sum of all four is zero), (V, 3).
        indenter: Minus the nodal forces of the indenter on the skin, (V, 3).
        core: Minus those of the core.
        volume_gradient: Derivative of the cavity's volume by the nodes [m^2], (V, 3).
        volume: Of the cavity [m^3].
        unbalanced: The sum over the free unknowns, fluid pressure included [N], (n,).
        scale: Norm of the nodal forces that have to cancel [N].
        strain_error: Largest |v - v0 - v0 p / kappa| / v0.
        gap_error_m: By how much gap or way the worst contact point misses its law [m].
        smallest_jacobian: Of all quadrature points.
    """

    internal: Floats
    indenter: Floats
    core: Floats
    volume_gradient: Floats
    volume: float
    unbalanced: Floats
    scale: float
    strain_error: float
    gap_error_m: float
    smallest_jacobian: float


class System:
    """Equations of one mesh; the unknowns come and go as `State`."""

    def __init__(
        self,
        mesh: SolidMesh,
        core: DistanceGrid | None,
        *,
        shear_modulus_pa: float,
        bulk_ratio: float,
        contact: ContactSettings,
        held: NDArray[np.bool_] | None = None,
    ) -> None:
        """Prepare the equations.

        Args:
            mesh: The skin.
            core: Distance to the core; None = no core.
            shear_modulus_pa: Neo-Hookean modulus [Pa].
            bulk_ratio: Bulk over shear modulus.
            contact: Constants of the contact laws.
            held: Prescribed components (V, 3); None = the mesh's fixed nodes. Their positions are
                those in the state.
        """
        self.mesh, self.core, self.contact = mesh, core, contact
        self.mu = shear_modulus_pa
        if held is None:
            held = np.zeros(mesh.nodes.shape, bool)
            held[mesh.fixed] = True
        self.pattern = make_pattern(held, mesh.elements, mesh.outer_faces, mesh.inner_faces)
        self.load = np.zeros(mesh.nodes.shape)
        self._elements = wp.array(mesh.elements, dtype=wp.int32, device=DEVICE)
        gradient, weight = self.rest_gradient_values = rest_gradients(mesh)
        self._gradient = vec3s(gradient)
        self._weight = scalars(weight)
        self.rest_volume = weight.sum(axis=1)
        self._rest_volume = scalars(self.rest_volume)
        self._bulk_over_volume = scalars(bulk_ratio * shear_modulus_pa / self.rest_volume)
        self._element_pairs = wp.array(self.pattern.element_pairs, dtype=wp.int32, device=DEVICE)
        self.outer = Surface(mesh.nodes, mesh.outer_faces, self.pattern.outer_pairs)
        self.inner = Surface(mesh.nodes, mesh.inner_faces, self.pattern.inner_pairs)
        self._form = scalars(volume_form(mesh.inner_faces.shape[1] if self.inner.count else 3))
        self._core_table = scalars(core.coefficients if core else np.full((4, 4, 4), 1.0))

        elements, nodes = mesh.elements.shape
        points = weight.shape[1]
        self._volume = scalars(np.zeros(elements))
        self._jacobian = scalars(np.zeros(elements))
        self._volume_gradient = vec3s(np.zeros((elements, nodes, 3)))
        self._frozen_gradient = vec3s(np.zeros((elements, nodes, 3)))
        self._sliding = wp.zeros(0, dtype=wp.int32, device=DEVICE)
        self._spatial = vec3s(np.zeros((elements, points, nodes, 3)))
        self._left = vec3s(np.zeros((elements, points, nodes, 3)))
        self._right = vec3s(np.zeros((elements, points, nodes, 3)))
        self._scale = wp.zeros((elements, points), dtype=wp.vec2d, device=DEVICE)
        self._fluid_volume = scalars(np.zeros(max(self.inner.count, 1)))
        # One row of nodal forces for each of: skin (per thread), indenter, core, volume gradient.
        self._forces = [np.zeros((len(mesh.nodes), 3)) for _ in range(THREADS + 3)]
        self._force_arrays = [vec3s(force) for force in self._forces]
        self._blocks = [np.zeros((self.pattern.blocks, 9)) for _ in range(THREADS)]
        self._block_arrays = [mat33s(block.reshape(-1, 3, 3)) for block in self._blocks]
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="palpate-fem")

    # load: dead nodal forces [N], (V, 3); zero unless a test sets it.

    def balance(self, state: State, press: Press | None, *, tangent: bool = False) -> Balance:
        """Evaluate the equations; with ``tangent`` also prepare `tangent_values`.

        Args:
            state: Where.
            press: Indenter and its pose; None = none.
            tangent: Whether `tangent_values` will be called for this state.
        """
        position, pressure = vec3s(state.position), scalars(state.pressure)
        for force in self._forces:
            force[:] = 0.0
        if tangent:
            for block in self._blocks:
                block[:] = 0.0
        split = len(self.mesh.elements) // 2

        def first_half() -> None:
            self._skin(0, split, 0, position, pressure, tangent)
            self._indenter(state, press, position, tangent)

        def second_half() -> None:
            self._skin(1, len(self.mesh.elements) - split, split, position, pressure, tangent)
            self._inside(state, position, tangent)

        self._both(first_half, second_half)
        return self._sum_up(state)

    def tangent_values(self) -> Floats:
        """Upper triangle of the symmetric tangent at the last ``balance(..., tangent=True)``.

        What belongs to this tangent (volume gradients, friction's rest) is kept until the next call.
        """
        self._blocks[0] += self._blocks[1]
        wp.copy(self._frozen_gradient, self._volume_gradient)
        for surface in (self.outer, self.inner):
            surface.freeze()
        rest = self.outer.rest.numpy().reshape(self.outer.count, -1)
        sliding = np.flatnonzero(np.any(rest != 0.0, axis=1)).astype(np.int32)
        self._sliding = wp.array(sliding, dtype=wp.int32, device=DEVICE)
        return self._blocks[0].reshape(-1)[self.pattern.gather]

    @property
    def slides(self) -> bool:
        """Whether the last tangent has an unsymmetric share."""
        return len(self._sliding) > 0

    def rest_product(self, change: Floats) -> Floats:
        """(Tangent - its symmetric approximation) times a change of the free unknowns, (n,)."""
        full = np.zeros_like(self.mesh.nodes)
        full.reshape(-1)[self.pattern.free] = change
        product = np.zeros_like(full)
        wp.launch(
            contact_kernels.rest_product,
            dim=len(self._sliding),
            inputs=[self.outer.faces, self.outer.shape, self._sliding, self.outer.rest],
            outputs=[vec3s(full), vec3s(product)],
            device=DEVICE,
        )
        return product.reshape(-1)[self.pattern.free]

    @property
    def sets_changed(self) -> bool:
        """Whether a point touches, sticks or slides that did not when the tangent was made."""
        return self.outer.changed or self.inner.changed

    def updated_pressures(self, change: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Pressures that go with a change (V, 3) from the last evaluated state, to first order.

        Returns:
            Those of the elements (E,), on the core and on the indenter (faces, points), and the
            tractions on the indenter (faces, points, 3).
        """
        pressure = np.zeros(len(self.mesh.elements))
        moved = vec3s(change)
        wp.launch(
            element_kernels.pressure_update,
            dim=len(pressure),
            inputs=[*self._condensed, moved],
            outputs=[scalars(pressure)],
            device=DEVICE,
        )
        core, _ = self.inner.updated_pressure(moved)
        return pressure, core, *self.outer.updated_pressure(moved)

    def misfit_force(self, state: State) -> Floats:
        """Load that condensing the pressures puts on the free unknowns [N], (n,)."""
        force = np.zeros_like(self.mesh.nodes)
        array = vec3s(force)
        wp.launch(
            element_kernels.pressure_misfit,
            dim=len(self.mesh.elements),
            inputs=[*self._condensed, scalars(state.pressure)],
            outputs=[array],
            device=DEVICE,
        )
        for surface in (self.inner, self.outer):
            surface.add_load(surface.misfit, array)
        return force.reshape(-1)[self.pattern.free]

    def coupled_force(self) -> Floats:
        """Part of `misfit_force` that comes with the friction of grown pressures, (n,).

        Kept apart: a new point's pressure is its depth times an enormous stiffness until the linear
        solve has answered, and friction must follow the answer, not the question.
        """
        force = np.zeros_like(self.mesh.nodes)
        self.outer.add_load(self.outer.coupled, vec3s(force))
        return force.reshape(-1)[self.pattern.free]

    @property
    def _condensed(self) -> list[wp.array]:
        return [
            self._elements,
            self._rest_volume,
            self._bulk_over_volume,
            self._volume,
            self._frozen_gradient,
        ]

    def _both(self, first: Callable[[], None], second: Callable[[], None]) -> None:
        """Run two halves at once; Warp launches release the interpreter."""
        other = self._pool.submit(second)
        first()
        other.result()

    def _skin(
        self, thread: int, count: int, first: int, position: wp.array, pressure: wp.array, tangent: bool
    ) -> None:
        model = [self._elements, self._gradient, self._weight, wp.float64(self.mu)]
        state = [first, position, pressure]
        wp.launch(
            element_kernels.element_state,
            dim=count,
            inputs=[*model, *state],
            outputs=[
                self._volume,
                self._jacobian,
                self._volume_gradient,
                self._force_arrays[thread],
            ],
            device=DEVICE,
        )
        if not tangent:
            return
        made_of = [self._spatial, self._left, self._right, self._scale]
        wp.launch(
            element_kernels.point_state,
            dim=count,
            inputs=[*model, *state],
            outputs=made_of,
            device=DEVICE,
        )
        wp.launch(
            element_kernels.element_tangent,
            dim=count,
            inputs=[
                self._element_pairs,
                self._gradient,
                self._bulk_over_volume,
                first,
                *made_of,
                self._volume_gradient,
            ],
            outputs=[self._block_arrays[thread]],
            device=DEVICE,
        )

    def _indenter(self, state: State, press: Press | None, position: wp.array, tangent: bool) -> None:
        surface = self.outer
        if press is None or not surface.count:
            surface.forget()
            return
        wp.launch(
            contact_kernels.indenter_contact,
            dim=surface.count,
            inputs=[
                surface.faces,
                surface.shape,
                surface.area,
                surface.pairs,
                press.primitives,
                self.contact.law(press.friction),
                wp.float64(self.contact.margin_m),
                wp.vec3d(*press.tip),
                wp.mat33d(*press.rotation.ravel()),
                position,
                scalars(state.indenter_pressure),
                vec3s(state.traction),
                vec3s(state.anchor),
                int(tangent),
            ],
            outputs=[
                surface.status,
                surface.gap_array,
                surface.wanted_array,
                surface.slope,
                surface.misfit,
                surface.wanted_traction_array,
                surface.traction_slope,
                surface.coupled,
                surface.rest,
                self._force_arrays[THREADS],
                self._block_arrays[0],
            ],
            device=DEVICE,
        )

    def _inside(self, state: State, position: wp.array, tangent: bool) -> None:
        """Core and fluid: both act on the inner surface."""
        surface = self.inner
        if not surface.count:
            return
        wp.launch(
            fluid_kernels.cavity_volume,
            dim=surface.count,
            inputs=[surface.faces, self._form, position],
            outputs=[self._fluid_volume, self._force_arrays[THREADS + 2]],
            device=DEVICE,
        )
        if tangent:
            wp.launch(
                fluid_kernels.cavity_tangent,
                dim=surface.count,
                inputs=[
                    surface.faces,
                    self._form,
                    surface.pairs,
                    wp.float64(-state.fluid_pressure),
                    position,
                ],
                outputs=[self._block_arrays[1]],
                device=DEVICE,
            )
        if self.core is None:
            return
        wp.launch(
            contact_kernels.core_contact,
            dim=surface.count,
            inputs=[
                surface.faces,
                surface.shape,
                surface.area,
                surface.pairs,
                self._core_table,
                wp.vec3d(*self.core.origin),
                wp.float64(self.core.spacing),
                self.contact.law(0.0),
                wp.float64(self.contact.margin_m + 2 * self.core.spacing),
                position,
                scalars(state.core_pressure),
                int(tangent),
            ],
            outputs=[
                surface.status,
                surface.gap_array,
                surface.wanted_array,
                surface.slope,
                surface.misfit,
                self._force_arrays[THREADS + 1],
                self._block_arrays[1],
            ],
            device=DEVICE,
        )

    def _sum_up(self, state: State) -> Balance:
        internal = self._forces[0] + self._forces[1]
        indenter, core = self._forces[THREADS].copy(), self._forces[THREADS + 1].copy()
        gradient = self._forces[THREADS + 2].copy()
        fluid = state.fluid_pressure * gradient
        free = self.pattern.free
        external = (indenter + core - fluid - self.load).reshape(-1)[free]
        volume = self._volume.numpy()
        bulk = self._bulk_over_volume.numpy()
        strain = (volume - self.rest_volume) - state.pressure / bulk
        return Balance(
            internal=internal,
            indenter=indenter,
            core=core,
            volume_gradient=gradient,
            volume=float(self._fluid_volume.numpy().sum()),
            unbalanced=internal.reshape(-1)[free] + external,
            scale=float(
                np.linalg.norm(fluid.reshape(-1)[free])
                + np.linalg.norm(indenter.reshape(-1)[free])
                + np.linalg.norm(core.reshape(-1)[free])
                + np.linalg.norm(self.load)
            ),
            strain_error=float(np.max(np.abs(strain) / self.rest_volume)),
            gap_error_m=max(
                self.inner.misfit_of(state.core_pressure) / self.contact.stiffness,
                self.outer.misfit_of(state.indenter_pressure) / self.contact.stiffness,
                self.outer.traction_misfit(state.traction) / self.contact.tangential_stiffness,
            ),
            smallest_jacobian=float(self._jacobian.numpy().min()),
        )


class Surface:
    """One surface of the mesh, with what contact leaves at its quadrature points."""

    def __init__(self, nodes: Floats, faces: NDArray[np.int32], pairs: NDArray[np.int32]) -> None:
        self.count = len(faces)
        corners = faces.shape[1] if self.count else 3
        element = corner_element(corners)
        self.shape_values = element.shape
        edges = np.einsum("qad,fai->fqdi", element.gradient, nodes[faces.reshape(-1, corners)])
        normal = np.cross(edges[:, :, 0], edges[:, :, 1])
        self.area_values = element.weight * np.linalg.norm(normal, axis=2)
        size = self.area_values.shape
        self._corners, self._element = faces, element
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
        self.coupled = wp.zeros(size, dtype=wp.vec3d, device=DEVICE)
        self.rest = wp.zeros(size, dtype=wp.mat33d, device=DEVICE)
        self._frozen = [wp.clone(a) for a in (self.slope, self.traction_slope, self.status)]

    def freeze(self) -> None:
        """Keep what belongs to the tangent that is being factorised."""
        for kept, now in zip(
            self._frozen, (self.slope, self.traction_slope, self.status), strict=True
        ):
            wp.copy(kept, now)

    @property
    def changed(self) -> bool:
        """Whether any point's status differs from the frozen one."""
        return not np.array_equal(self._frozen[2].numpy(), self.status.numpy())

    def forget(self) -> None:
        """Nothing is near."""
        self.gap[:] = np.inf
        self._wanted[:] = 0.0
        self._wanted_traction[:] = 0.0
        for array in (self.status, self.slope, self.traction_slope, self.misfit, self.coupled, self.rest):
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

    def current_area(self, position: Floats) -> Floats:
        """Area that belongs to each point now [m^2], (F, Q)."""
        edges = np.einsum("qad,fai->fqdi", self._element.gradient, position[self._corners])
        normal = np.cross(edges[:, :, 0], edges[:, :, 1])
        return np.asarray(self._element.weight * np.linalg.norm(normal, axis=2))


def rest_gradients(mesh: SolidMesh) -> tuple[Floats, Floats]:
    """Gradients of the shape functions on the undeformed mesh, (E, Q, n, 3), and w detJ, (E, Q)."""
    element = solid_element(mesh.elements.shape[1])
    corners = mesh.nodes[mesh.elements]
    jacobian = np.einsum("eai,qad->eqid", corners, element.gradient)
    determinant = np.linalg.det(jacobian)
    gradient = np.einsum("qad,eqdi->eqai", element.gradient, np.linalg.inv(jacobian))
    return np.ascontiguousarray(gradient), element.weight * determinant
