"""The discrete equilibrium of skin, fluid, core and indenter: residual and tangent.

The tangent is symmetric and sparse; it is assembled as 3 x 3 blocks, one for each pair of nodes
that share an element. The fluid's pressure, which couples all inner nodes, is not in it: Newton's
method borders the matrix with it (``newton``).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.arrays import Floats, Ints
from palpate_fem.device import DEVICE, mat33s, scalars, vec3s
from palpate_fem.mechanics import contact_kernels, element_kernels
from palpate_fem.mechanics.contact import (
    ContactSettings,
    ContactSurface,
    CoreContact,
    IndenterContact,
    PosedIndenter,
)
from palpate_fem.mechanics.element_kernels import VOLUME_BARRIER
from palpate_fem.mechanics.skin import FluidCavity, SkinElements
from palpate_fem.mechanics.state import (
    TRACTION_FLOOR_PA,
    ForceBalance,
    MortarCorrection,
    SolutionState,
)
from palpate_fem.mesh.core import DistanceGrid
from palpate_fem.mesh.solid import SolidMesh

A = TypeVar("A")
B = TypeVar("B")

OffsetChanges = tuple[Floats, Floats]
"""How the offsets of the gaps of the nodes change [m], to the indenter and to the core, (V,)."""


@dataclass(frozen=True, slots=True)
class TangentPattern:
    """Upper node-pair blocks of a symmetric matrix, and its upper triangle over free unknowns.

    Attributes:
        blocks: Number of blocks (i <= j).
        element_pairs: Block of each node pair of each element, (E, n, n); -1 where i > j.
        outer_pairs: The same for the faces of the outer surface.
        inner_pairs: The same for the faces of the inner surface.
        free: Free unknowns among all 3 V, ascending.
        indptr: Upper triangle in CSR format: begin of each row.
        indices: Upper triangle in CSR format: columns, sorted.
        gather: Place of each value of the triangle in the flattened blocks.
    """

    blocks: int
    element_pairs: Ints
    outer_pairs: Ints
    inner_pairs: Ints
    free: Ints
    indptr: Ints
    indices: Ints
    gather: Ints


def make_pattern(
    held: NDArray[np.bool_], elements: Ints, outer: Ints, inner: Ints
) -> TangentPattern:
    """Sparsity pattern of a mesh.

    Args:
        held: Prescribed components of the nodes, (V, 3).
        elements: Node ids (E, n).
        outer: Faces of the outer surface, each part of an element.
        inner: Faces of the inner surface, each part of an element.
    """
    nodes = len(held)
    keys = np.unique(_keys(elements, nodes))
    keys = keys[keys >= 0]
    free = np.flatnonzero(~held.reshape(-1))
    renumber = np.full(3 * nodes, -1, np.int64)
    renumber[free] = np.arange(len(free))

    r, c = np.divmod(np.arange(9), 3)
    rows = renumber[(3 * (keys // nodes)[:, None] + r).ravel()]
    columns = renumber[(3 * (keys % nodes)[:, None] + c).ravel()]
    source = np.flatnonzero((rows >= 0) & (columns >= rows))
    rows, columns = rows[source], columns[source]
    order = np.lexsort((columns, rows))
    indptr = np.zeros(len(free) + 1, np.int64)
    np.cumsum(np.bincount(rows, minlength=len(free)), out=indptr[1:])
    return TangentPattern(
        blocks=len(keys),
        element_pairs=_find(keys, elements, nodes),
        outer_pairs=_find(keys, outer, nodes),
        inner_pairs=_find(keys, inner, nodes),
        free=free.astype(np.int32),
        indptr=indptr.astype(np.int32),
        indices=columns[order].astype(np.int32),
        gather=source[order].astype(np.int32),
    )


def _keys(cells: Ints, nodes: int) -> NDArray[np.int64]:
    """Number of each ordered pair of nodes of each cell; -1 below the diagonal."""
    low, high = cells[:, :, None].astype(np.int64), cells[:, None, :].astype(np.int64)
    return np.asarray(np.where(low <= high, low * nodes + high, -1))


def _find(keys: NDArray[np.int64], cells: Ints, nodes: int) -> Ints:
    """Block of each pair of nodes of each cell; -1 below the diagonal."""
    wanted = _keys(cells, nodes)
    return np.where(wanted >= 0, np.searchsorted(keys, wanted), -1).astype(np.int32)


THREADS = 2
"""Host threads that work on the two halves of the elements: a Warp launch on the CPU uses one."""


class EquilibriumSystem:
    """Equations of one mesh: constant; the unknowns are passed in as a `SolutionState`."""

    def __init__(
        self,
        mesh: SolidMesh,
        core: DistanceGrid | None,
        *,
        shear_modulus_pa: float,
        bulk_ratio: float,
        contact: ContactSettings,
        volume_barrier: float = VOLUME_BARRIER,
        strain_stiffening: float = 0.0,
        held: NDArray[np.bool_] | None = None,
    ) -> None:
        """Prepare the equations.

        Args:
            mesh: The skin.
            core: Distance to the core; None = no core.
            shear_modulus_pa: Neo-Hookean modulus [Pa].
            bulk_ratio: Bulk over shear modulus.
            contact: Constants of the contact laws.
            volume_barrier: See `energy_density`.
            strain_stiffening: See `FingertipParameters`.
            held: Prescribed components (V, 3); None = the mesh's fixed nodes. They keep the
                positions that they have in the state.
        """
        # Loaded before the threads start: two that use a new kernel at once would both compile it.
        for module in (contact_kernels, element_kernels):
            wp.load_module(module, device=DEVICE)
        self.mesh, self.contact = mesh, contact
        if held is None:
            held = np.zeros(mesh.nodes.shape, bool)
            held[mesh.fixed] = True
        self.pattern = make_pattern(held, mesh.elements, mesh.outer_faces, mesh.inner_faces)
        self._held = np.flatnonzero(held)
        self.load = np.zeros(mesh.nodes.shape)  # dead nodal forces [N], for verification
        self.skin = SkinElements(
            mesh,
            self.pattern.element_pairs,
            shear_modulus_pa=shear_modulus_pa,
            bulk_ratio=bulk_ratio,
            volume_barrier=volume_barrier,
            strain_stiffening=strain_stiffening,
        )
        half, nodes = self.skin.count // 2, len(mesh.nodes)
        self._halves = self.skin.items[:half], self.skin.items[half:]
        self.outer = ContactSurface(mesh.nodes, mesh.outer_faces, self.pattern.outer_pairs)
        self.inner = ContactSurface(mesh.nodes, mesh.inner_faces, self.pattern.inner_pairs)
        self.on_indenter = IndenterContact(self.outer, nodes, contact)
        self.on_core = CoreContact(self.inner, nodes, contact, core)
        self._cavity = FluidCavity(self.inner, nodes)
        # For each thread: nodal forces of the skin, and blocks of the tangent of skin and fluid.
        # The tangent of contact, which changes more often, is added to a copy of their sum.
        self._forces = [np.zeros((nodes, 3)) for _ in range(THREADS)]
        self._force_arrays = [vec3s(force) for force in self._forces]
        self._blocks = [np.zeros((self.pattern.blocks, 9)) for _ in range(THREADS)]
        self._block_arrays = [mat33s(block.reshape(-1, 3, 3)) for block in self._blocks]
        self._sum = np.zeros((self.pattern.blocks, 9))
        self._sum_array = mat33s(self._sum.reshape(-1, 3, 3))
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="palpate-fem")
        # Pseudo-viscosity of a node (see `PseudoTransient`): mu times the edge of the cube that is
        # its share of the skin's volume, which is of the size of its elastic stiffness.
        share = np.zeros(nodes)
        corners = mesh.elements.shape[1]
        np.add.at(share, mesh.elements, (self.skin.rest_volume / corners)[:, None])
        self.viscosity = shear_modulus_pa * np.cbrt(np.repeat(share, 3)[self.pattern.free])
        self._at: tuple[wp.array, wp.array, float] | None = None

    def balance(self, state: SolutionState, indenter: PosedIndenter | None) -> ForceBalance:
        """Evaluate the equations.

        Args:
            state: Where. `tangent_values` reads it again; it must not change in between.
            indenter: Indenter at its pose; None = none.
        """
        position, pressure = vec3s(state.position), scalars(state.pressure)
        self._at = (position, pressure, state.fluid_pressure)

        def first_half() -> None:
            self._forces[0][:] = 0.0
            self.skin.add_forces(self._halves[0], position, pressure, self._force_arrays[0])
            self._cavity.evaluate(position)
            self.on_indenter.evaluate(state, indenter, position)

        def second_half() -> None:
            self._forces[1][:] = 0.0
            self.skin.add_forces(self._halves[1], position, pressure, self._force_arrays[1])
            self.on_core.evaluate(state, position)

        self._both(first_half, second_half)
        return self._sum_up(state)

    def corrected_balance(
        self, state: SolutionState, indenter: PosedIndenter | None
    ) -> ForceBalance:
        """Evaluate the mortar corrections of the last `balance`'s state, and its balance with them.

        Skin and fluid are as they were, so contact alone is evaluated.
        """
        assert self._at is not None
        position, _, _ = self._at
        self.correct_contact(state, indenter)
        self._both(
            lambda: self.on_indenter.evaluate(state, indenter, position),
            lambda: self.on_core.evaluate(state, position),
        )
        return self._sum_up(state)

    def correct_contact(self, state: SolutionState, indenter: PosedIndenter | None) -> None:
        """Evaluate the mortar corrections of a state and keep them in it."""
        state.on_indenter, state.on_core = self._corrections(state, indenter)

    def renew_spread(self, state: SolutionState, indenter: PosedIndenter | None) -> None:
        """Let linear solutions tell how forces follow the pressures at the last `balance`.

        The gaps' offsets and held directions stay: they belong to the equations, not to their
        derivative.
        """
        on_indenter, on_core = self._corrections(state, indenter)
        state.on_indenter = replace(state.on_indenter, spread=on_indenter.spread)
        state.on_core = replace(state.on_core, spread=on_core.spread)
        self.outer.keep(state.on_indenter, state.indenter_pressure)
        self.inner.keep(state.on_core, state.core_pressure)

    def tangent_values(self, *, elastic: bool = True, viscosity: float = 0.0) -> Floats:
        """Upper triangle of the symmetric tangent at the last `balance`.

        What belongs to this tangent (volume gradients, contact normals, the unsymmetric share of
        friction) is kept until the next one: with the stiff bulk modulus and contact laws, a
        difference between it and the factorised matrix would be magnified.

        Args:
            elastic: Whether the tangent of skin and fluid is evaluated; else the last one is used
                again, and only that of contact is new.
            viscosity: Pseudo-viscosity over the pseudo-time step, in units of the skin's own
                stiffness; it is added to the diagonal.
        """
        if elastic:
            assert self._at is not None
            position, pressure, fluid_pressure = self._at

            def first_half() -> None:
                self._blocks[0][:] = 0.0
                self.skin.add_tangent(self._halves[0], position, pressure, self._block_arrays[0])

            def second_half() -> None:
                self._blocks[1][:] = 0.0
                self.skin.add_tangent(self._halves[1], position, pressure, self._block_arrays[1])
                self._cavity.add_tangent(position, fluid_pressure, self._block_arrays[1])

            self._both(first_half, second_half)
            self._blocks[0] += self._blocks[1]
            self.skin.freeze()
        self._sum[:] = self._blocks[0]
        for surface in (self.outer, self.inner):
            surface.add_tangent(self._sum_array)
            surface.freeze()
        values = self._sum.reshape(-1)[self.pattern.gather]
        # Each row of the triangle begins with its diagonal.
        values[self.pattern.indptr[:-1]] += viscosity * self.viscosity
        return values

    @property
    def is_unsymmetric(self) -> bool:
        """Whether the last tangent has an unsymmetric share."""
        return self.outer.is_unsymmetric or self.inner.is_unsymmetric

    def as_field(self, change: Floats) -> Floats:
        """A change (n,) of the free unknowns as one of the nodes, (V, 3)."""
        full = np.zeros_like(self.mesh.nodes)
        full.reshape(-1)[self.pattern.free] = change
        return full

    def unsymmetric_product(self, change: Floats) -> Floats:
        """(Tangent - its symmetric approximation) times a change of the free unknowns, (n,)."""
        full = self.as_field(change)
        product = np.zeros_like(full)
        for surface in (self.outer, self.inner):
            surface.add_unsymmetric_product(vec3s(full), vec3s(product))
        return product.reshape(-1)[self.pattern.free]

    @property
    def sets_changed(self) -> bool:
        """Whether the active set has changed since the tangent: who touches, sticks or slides."""
        return self.outer.changed or self.inner.changed

    def updated_pressures(
        self, change: Floats, offsets: OffsetChanges | None = None
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Recover the condensed unknowns after a change (V, 3) of the last evaluated state.

        Args:
            change: Of the nodal positions [m].
            offsets: Of the gaps' offsets; None = none.

        Returns:
            Pressures of the elements (E,), on the core and on the indenter (faces, points), and the
            tractions on the indenter (faces, points, 3).
        """
        outer, inner = offsets or (None, None)
        skin, (core, indenter) = self._both(
            lambda: self.skin.updated_pressure(vec3s(change)),
            lambda: (
                self.inner.updated_pressure(change, inner)[0],
                self.outer.updated_pressure(change, outer),
            ),
        )
        return skin, core, *indenter

    def offset_changes(self, change: Floats) -> OffsetChanges:
        """How a change (n,) of the free unknowns changes the gaps' offsets, to first order."""
        moved = self.as_field(change)
        return self.outer.offset_change(moved), self.inner.offset_change(moved)

    def offset_force(self, offsets: OffsetChanges) -> Floats:
        """Forces by which contact resists changes of the gaps' offsets [N], (n,)."""
        force = np.zeros_like(self.mesh.nodes)
        for surface, offset in zip((self.outer, self.inner), offsets, strict=True):
            surface.add_offset_load(offset, force)
        return force.reshape(-1)[self.pattern.free]

    def misfit_force(self, state: SolutionState) -> Floats:
        """Load on the free unknowns by static condensation of the pressures [N], (n,)."""
        force = np.zeros_like(self.mesh.nodes)
        array = vec3s(force)
        self.skin.add_misfit(state.pressure, array)
        for surface in (self.inner, self.outer):
            surface.subtract_load(surface.misfit, array)
        return force.reshape(-1)[self.pattern.free]

    def coupled_force(self) -> Floats:
        """Load by what follows a change of the contact pressures [N], (n,).

        That is friction, and mortar's loads at the neighbours. It is not part of `misfit_force`:
        the demanded pressure of a new point is its penetration times an enormous stiffness. These
        loads have to follow the pressure after the linear solve.
        """
        force = np.zeros_like(self.mesh.nodes)
        for surface in (self.outer, self.inner):
            surface.subtract_coupled(vec3s(force))
        return force.reshape(-1)[self.pattern.free]

    def update_anchors(self, state: SolutionState, indenter: PosedIndenter) -> None:
        """Place the anchors after an increment, so that each point's spring carries its traction.

        Anchors of points that slid move along; those of points without contact follow the skin.
        """
        stretch = state.traction / self.contact.tangential_stiffness
        state.anchor[:] = indenter.to_local(self.outer.points_at(state.position) - stretch)

    def _corrections(
        self, state: SolutionState, indenter: PosedIndenter | None
    ) -> tuple[MortarCorrection, MortarCorrection]:
        """The mortar corrections of a state: on the indenter and on the core."""
        return self._both(
            lambda: self.on_indenter.correction(state, indenter),
            lambda: self.on_core.correction(state),
        )

    def _both(self, first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
        """Run two halves at once; Warp launches release the interpreter lock."""
        other = self._pool.submit(second)
        return first(), other.result()

    def _sum_up(self, state: SolutionState) -> ForceBalance:
        internal = self._forces[0] + self._forces[1]
        indenter, core = self.on_indenter.force.copy(), self.on_core.force.copy()
        gradient = self._cavity.gradient.copy()
        fluid = state.fluid_pressure * gradient
        free = self.pattern.free
        external = (indenter + core - fluid - self.load).reshape(-1)[free]
        return ForceBalance(
            internal=internal,
            indenter=indenter,
            core=core,
            volume_gradient=gradient,
            volume=self._cavity.volume,
            unbalanced=internal.reshape(-1)[free] + external,
            # All forces that have to cancel, reactions of the supports included: without them the
            # scale of a body that only its supports deform would be rounding error.
            scale=float(
                np.linalg.norm(fluid.reshape(-1)[free])
                + np.linalg.norm(indenter.reshape(-1)[free])
                + np.linalg.norm(core.reshape(-1)[free])
                + np.linalg.norm(self.load)
                + np.linalg.norm(internal.reshape(-1)[self._held])
            ),
            strain_error=self.skin.strain_error(state.pressure),
            gap_error_m=max(
                self.inner.pressure_misfit(state.core_pressure) / self.contact.stiffness,
                self.outer.pressure_misfit(state.indenter_pressure) / self.contact.stiffness,
            ),
            traction_error=self.outer.traction_misfit(state.traction)
            / max(float(np.abs(state.traction).max(initial=0.0)), TRACTION_FLOOR_PA),
            smallest_jacobian=self.skin.smallest_jacobian(),
        )
