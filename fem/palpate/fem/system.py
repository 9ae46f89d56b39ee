"""The discrete equilibrium of skin, fluid, core and indenter: residual and tangent."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate.fem import contact_kernels, core_kernels, element_kernels, fluid_kernels
from palpate.fem.device import DEVICE, mat33s, scalars, vec3s
from palpate.fem.laws import ContactSettings, Press
from palpate.fem.mesh.core import DistanceGrid
from palpate.fem.mesh.solid import SolidMesh
from palpate.fem.pattern import make_pattern
from palpate.fem.reference_element import volume_form
from palpate.fem.skin import Skin
from palpate.fem.state import State
from palpate.fem.surface import Surface

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
        # Compiled now: two threads that meet a new kernel would both compile it.
        for module in (contact_kernels, core_kernels, element_kernels, fluid_kernels):
            wp.load_module(module, device=DEVICE)
        self.mesh, self.core, self.contact = mesh, core, contact
        if held is None:
            held = np.zeros(mesh.nodes.shape, bool)
            held[mesh.fixed] = True
        self.pattern = make_pattern(held, mesh.elements, mesh.outer_faces, mesh.inner_faces)
        self._held = np.flatnonzero(held)
        self.load = np.zeros(mesh.nodes.shape)  # dead nodal forces [N]; tests set them
        self.skin = Skin(
            mesh,
            self.pattern.element_pairs,
            shear_modulus_pa=shear_modulus_pa,
            bulk_ratio=bulk_ratio,
        )
        self.outer = Surface(mesh.nodes, mesh.outer_faces, self.pattern.outer_pairs)
        self.inner = Surface(mesh.nodes, mesh.inner_faces, self.pattern.inner_pairs)
        self._form = scalars(volume_form(mesh.inner_faces.shape[1] if self.inner.count else 3))
        self._core_table = scalars(core.coefficients if core else np.full((4, 4, 4), 1.0))

        self._sliding = wp.zeros(0, dtype=wp.int32, device=DEVICE)
        self._fluid_volume = scalars(np.zeros(max(self.inner.count, 1)))
        # One row of nodal forces for each of: skin (per thread), indenter, core, volume gradient.
        self._forces = [np.zeros((len(mesh.nodes), 3)) for _ in range(THREADS + 3)]
        self._force_arrays = [vec3s(force) for force in self._forces]
        self._blocks = [np.zeros((self.pattern.blocks, 9)) for _ in range(THREADS)]
        self._block_arrays = [mat33s(block.reshape(-1, 3, 3)) for block in self._blocks]
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="palpate-fem")

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
        half = self.skin.count // 2

        def first_half() -> None:
            self._skin(0, 0, half, position, pressure, tangent)
            self._indenter(state, press, position, tangent)

        def second_half() -> None:
            self._skin(1, half, self.skin.count - half, position, pressure, tangent)
            self._inside(state, position, tangent)

        self._both(first_half, second_half)
        return self._sum_up(state)

    def tangent_values(self) -> Floats:
        """Upper triangle of the symmetric tangent at the last ``balance(..., tangent=True)``.

        What belongs to this tangent (volume gradients, friction's rest) is kept until the next.
        """
        self._blocks[0] += self._blocks[1]
        self.skin.freeze()
        for surface in (self.outer, self.inner):
            surface.freeze()
        rest = self.outer.rest.numpy().reshape(self.outer.count, 9 * self.outer.points)
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
        moved = vec3s(change)
        core, _ = self.inner.updated_pressure(moved)
        return self.skin.updated_pressure(moved), core, *self.outer.updated_pressure(moved)

    def misfit_force(self, state: State) -> Floats:
        """Load that condensing the pressures puts on the free unknowns [N], (n,)."""
        force = np.zeros_like(self.mesh.nodes)
        array = vec3s(force)
        self.skin.add_misfit(state.pressure, array)
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

    def settle(self, state: State, press: Press) -> None:
        """After an increment: anchors such that each point's spring carries its traction.

        Those of points that slid thereby move along; all others stay, or start where they are.
        """
        stretch = state.traction / self.contact.tangential_stiffness
        state.anchor[:] = press.to_local(self.outer.points_at(state.position) - stretch)

    def _both(self, first: Callable[[], None], second: Callable[[], None]) -> None:
        """Run two halves at once; Warp launches release the interpreter."""
        other = self._pool.submit(second)
        first()
        other.result()

    def _skin(
        self,
        thread: int,
        first: int,
        count: int,
        position: wp.array,
        pressure: wp.array,
        tangent: bool,
    ) -> None:
        force, blocks = self._force_arrays[thread], self._block_arrays[thread]
        self.skin.add_forces(first, count, position, pressure, force)
        if tangent:
            self.skin.add_tangent(first, count, position, pressure, blocks)

    def _indenter(
        self, state: State, press: Press | None, position: wp.array, tangent: bool
    ) -> None:
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
            core_kernels.core_contact,
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
                + np.linalg.norm(internal.reshape(-1)[self._held])
            ),
            strain_error=self.skin.strain_error(state.pressure),
            gap_error_m=max(
                self.inner.misfit_of(state.core_pressure) / self.contact.stiffness,
                self.outer.misfit_of(state.indenter_pressure) / self.contact.stiffness,
                self.outer.traction_misfit(state.traction) / self.contact.tangential_stiffness,
            ),
            smallest_jacobian=self.skin.smallest_jacobian(),
        )
