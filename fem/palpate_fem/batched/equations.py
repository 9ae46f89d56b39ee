"""The discrete equilibrium of many copies of one fingertip: residuals, tangents, moves.

What ``system``, ``skin`` and ``contact`` do for one state, with the same kernels on arrays of all
copies; a method works on the listed slots and leaves the others alone. Nothing is read back but by
`BatchedEquations.numbers` and where it is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.arrays import Floats, Ints
from palpate_fem.batched import kernels, mortar_kernels, point_kernels, reductions
from palpate_fem.batched.launches import Launches, Listed, Sequences
from palpate_fem.batched.state import (
    BatchedState,
    SlotNumbers,
    flat,
    on_device,
    rows_of_three,
)
from palpate_fem.batched.surface import BatchedSurface
from palpate_fem.batched.tangents import BatchedTangents
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics import contact_kernels, element_kernels
from palpate_fem.mechanics.mortar import HANGING_M
from palpate_fem.mechanics.reference_element import volume_form
from palpate_fem.mechanics.state import FORCE_FLOOR_N, TRACTION_FLOOR_PA
from palpate_fem.mechanics.system import EquilibriumSystem

FAR_BELOW_M = -1.0
"""Height of the primitives that fill the rows of simpler indenters [m]: beyond any margin."""

KEPT_LISTS = 16
"""Lists of slots that are kept: more than a sweep asks for."""


class BatchedEquations:
    """The equations of ``slots`` copies of one fingertip."""

    def __init__(
        self,
        system: EquilibriumSystem,
        indenters: Sequence[Indenter],
        *,
        slots: int,
        device: str,
        friction: float,
    ) -> None:
        """Put what is constant on the device, and make room.

        Args:
            system: The equations of one fingertip.
            indenters: All kinds of indenters.
            slots: Number of copies.
            device: A Warp device.
            friction: Coulomb coefficient of the skin on the indenters.
        """
        self.system, self.slots, self.device = system, slots, device
        self._lists: dict[bytes, Listed] = {}
        self._flattened: dict[int, wp.array] = {}
        self._launch, self._sequences = Launches(device), Sequences(device)
        mesh, pattern, skin = system.mesh, system.pattern, system.skin
        self._law, self._core_law = system.contact.law(friction), system.contact.law(0.0)
        self._nodes, self._elements_each = len(mesh.nodes), len(mesh.elements)
        self.size = len(pattern.free)

        def ints(values: Ints) -> wp.array:
            return on_device(np.asarray(values, np.int32), wp.int32, device)

        def numbers(values: Floats) -> wp.array:
            return on_device(values, wp.float64, device)

        self._elements = ints(mesh.elements)
        self._gradient = on_device(skin.gradient_values, wp.vec3d, device)
        # The same, where neighbouring threads have neighbouring quadrature points.
        by_corner = np.swapaxes(skin.gradient_values, 1, 2)
        self._gradient_at_points = on_device(by_corner, wp.vec3d, device).transpose((0, 2, 1))
        self._weight, self._rest_volume = numbers(skin.weight_values), numbers(skin.rest_volume)
        self._bulk = numbers(skin.bulk_over_volume)
        self._free = ints(pattern.free)
        held = np.ones(3 * self._nodes, np.int32)
        held[pattern.free] = 0
        self._held = ints(held)
        total, corners = slots * self._elements_each, mesh.elements.shape[1]

        def room(kind: type, *shape: int) -> wp.array:
            return wp.zeros(shape, dtype=kind, device=device)

        self._volume, self._jacobian = room(wp.float64, total), room(wp.float64, total)
        self._volume_gradient = room(wp.vec3d, total, corners)
        self._frozen_gradient = room(wp.vec3d, total, corners)
        self._target = room(wp.float64, total)
        points = skin.weight_values.shape[1]
        self._by_point = wp.get_device(device).is_cuda and corners == points == 8
        self.tangents = BatchedTangents(system, slots, device)
        self._internal, self._gradient_of_volume, self._unbalanced = (
            room(wp.vec3d, slots * self._nodes) for _ in range(3)
        )
        self._field, self._product = (room(wp.vec3d, slots * self._nodes) for _ in range(2))
        self.outer = BatchedSurface(system.outer, self._nodes, slots, device, rubs=True)
        self.inner = BatchedSurface(system.inner, self._nodes, slots, device, rubs=False)
        self._form = numbers(volume_form(system.inner.points))
        self._face_volume = room(wp.float64, slots * self.inner.count)
        self._kinds(indenters)
        self._kind, self._tip = room(wp.int32, slots), room(wp.vec3d, slots)
        self._rotation = room(wp.mat33d, slots)
        self._posed: list[NDArray[Any]] = [
            np.zeros(slots, np.int32), np.zeros((slots, 3)), np.zeros((slots, 3, 3))
        ]  # fmt: skip
        core = system.on_core.core
        self._core: list[Any] = []
        if core is not None:
            self._core = [
                numbers(core.coefficients), wp.vec3d(*core.origin), wp.float64(core.spacing)
            ]  # fmt: skip
        self._margin = wp.float64(system.contact.margin_m)
        self._numbers = room(wp.float64, slots, reductions.NUMBERS)
        self._longest = room(wp.float64, slots, 1)

    def _kinds(self, indenters: Sequence[Indenter]) -> None:
        """Rows of all indenters, and from which gap on each holds directions."""
        packed = [one.packed() for one in indenters]
        most = max(len(rows) for rows in packed)
        table = np.zeros((len(packed), most, packed[0].shape[1]))
        for k, rows in enumerate(packed):
            table[k, : len(rows)] = rows
            table[k, len(rows) :] = rows[0]
            table[k, len(rows) :, 4] = FAR_BELOW_M  # z of the centre
        self._primitives = on_device(table, wp.float64, self.device)
        hanging = [HANGING_M if one.fillet_m > 0.0 else np.inf for one in indenters]
        self._hanging = on_device(np.array(hanging), wp.float64, self.device)

    def listed(self, numbers: Ints) -> Listed:
        """The lists of some slots; kept, as the same slots often ask for several things in turn."""
        key = np.asarray(numbers, np.int32).tobytes()
        if key not in self._lists:
            if len(self._lists) == KEPT_LISTS:
                self._lists.pop(next(iter(self._lists)))
            each = self._elements_each, self.outer.count, self.inner.count
            self._lists[key] = Listed(numbers, each, self._launch)
        return self._lists[key]

    def clear(self, listed: Listed, each: int, array: wp.array) -> None:
        """Set ``each`` numbers of every listed slot to zero."""
        dim = (len(listed.slots), kernels.threads_for(each))
        self._launch(kernels.clear_rows, dim, [listed.slots, each], [self._flat(array)])

    def pose(self, slots: Ints, kind: Ints, tip: Floats, rotation: Floats) -> None:
        """Put indenters: their kinds (m,), tips [m], (m, 3), and rotations (m, 3, 3)."""
        arrays = self._kind, self._tip, self._rotation
        for array, now, values in zip(arrays, self._posed, (kind, tip, rotation), strict=True):
            now[slots] = values
            array.assign(now)

    def correct_contact(self, state: BatchedState, listed: Listed) -> None:
        """Evaluate the mortar corrections of both surfaces and keep them."""
        if not self.system.contact.mortar:
            return
        posed = [self._primitives, self._kind, self._tip, self._rotation]
        surface = self.outer
        nodal = [surface.node_gap, surface.node_normal, surface.node_mean]
        self._launch(
            mortar_kernels.near_indenter,
            (len(listed.slots), len(surface.nodes)),
            [listed.slots, surface.nodes, self._nodes, *posed, self._margin, state.position],
            nodal,
        )
        means = [surface.faces, surface.mortar_shape, surface.weight]
        self._launch(
            mortar_kernels.mean_gaps_to_indenter,
            (len(listed.outer), surface.points),
            [*means, *posed, self._nodes, listed.outer, self._margin, self._hanging,
             state.position, surface.node_gap],
            [surface.outward, surface.held, surface.node_mean],
        )  # fmt: skip
        surface.offset_gaps(listed.outer, self._margin)
        if not self._core:
            return
        surface = self.inner
        nodal = [surface.node_gap, surface.node_normal, surface.node_mean]
        self._launch(
            mortar_kernels.near_core,
            (len(listed.slots), len(surface.nodes)),
            [listed.slots, surface.nodes, self._nodes, *self._core, self._margin, state.position],
            nodal,
        )
        self._launch(
            mortar_kernels.mean_gaps_to_core,
            (len(listed.inner), surface.points),
            [surface.faces, surface.mortar_shape, surface.weight, *self._core, self._nodes,
             listed.inner, self._margin, state.position, surface.node_gap],
            [surface.outward, surface.node_mean],
        )  # fmt: skip
        surface.offset_gaps(listed.inner, self._margin)

    def balance(self, state: BatchedState, listed: Listed, *, moved: Listed | None = None) -> None:
        """Evaluate forces and all that `numbers` tells; see `EquilibriumSystem.balance`.

        Args:
            state: Where.
            listed: Slots.
            moved: Those of them that are not where the last balance was; None = all. The others
                keep the forces of skin and fluid.
        """
        self._skin_forces(state, listed if moved is None else moved)
        self._contact_forces(state, listed)
        self._reduce(state, listed)

    def _skin_forces(self, state: BatchedState, listed: Listed) -> None:
        """Evaluate the forces of the skin, and the cavity's volume."""
        for field in (self._internal, self._gradient_of_volume):
            self.clear(listed, 3 * self._nodes, field)
        inner = self.inner
        results = [self._volume, self._jacobian, self._volume_gradient, self._internal]
        place = [listed.elements, state.position, state.pressure]
        count = len(listed.elements)
        if self._by_point:
            self._launch(
                point_kernels.element_state_by_point,
                (count, 8),
                [*self._at_points, *place],
                results,
            )
        else:
            self._launch(element_kernels.element_state, count, [*self._model, *place], results)
        self._launch(
            element_kernels.cavity_volume,
            len(listed.inner),
            [inner.faces, self._form, self._nodes, listed.inner, state.position],
            [self._face_volume, self._gradient_of_volume],
        )

    def _contact_forces(self, state: BatchedState, listed: Listed) -> None:
        """Evaluate the forces of indenter and core."""
        outer, inner = self.outer, self.inner
        for field in (outer.force, inner.force):
            self.clear(listed, 3 * self._nodes, field)
        posed = [self._primitives, self._kind]
        place = [self._tip, self._rotation, self._nodes, listed.outer]
        self._launch(
            contact_kernels.indenter_contact,
            (len(listed.outer), outer.points),
            [outer.faces, outer.shape, outer.area, *posed, self._law, self._margin, *place,
             state.position, outer.offset, state.indenter_pressure, state.traction, state.anchor],
            [*outer.results, outer.wanted_traction, outer.traction_slope, outer.coupled,
             outer.unsymmetric, outer.force],
        )  # fmt: skip
        mortar = self.system.contact.mortar
        if mortar:
            self._launch(
                contact_kernels.mortar_on_indenter,
                (len(listed.outer), outer.points),
                [outer.faces, outer.mortar_shape, outer.weight, *posed, *place,
                 state.position, state.indenter_pressure, outer.held],
                [outer.mortar_status, outer.mortar_tangent, outer.force],
            )  # fmt: skip
        if self._core:
            place = [*self._core, self._nodes, listed.inner]
            self._launch(
                contact_kernels.core_contact,
                (len(listed.inner), inner.points),
                [inner.faces, inner.shape, inner.area, *place, self._core_law,
                 state.position, inner.offset, state.core_pressure],
                [*inner.results, inner.force],
            )  # fmt: skip
            if mortar:
                self._launch(
                    contact_kernels.mortar_on_core,
                    (len(listed.inner), inner.points),
                    [inner.faces, inner.mortar_shape, inner.weight, *place,
                     state.position, state.core_pressure],
                    [inner.mortar_status, inner.mortar_tangent, inner.force],
                )  # fmt: skip

    def _reduce(self, state: BatchedState, listed: Listed) -> None:
        """Sums and maxima of the listed slots."""
        outer, inner = self.outer, self.inner

        def reduce(kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any]) -> None:
            dim = (len(listed.slots), reductions.padded(count))
            self._launch(kernel, dim, [listed.slots, *inputs], [*outputs, self._numbers])

        dim = (len(listed.slots), reductions.NUMBERS)
        self._launch(reductions.clear_numbers, dim, [listed.slots], [self._numbers])
        reduce(
            reductions.sum_nodes,
            self._nodes,
            [self._held, self._nodes, self._internal, outer.force, inner.force,
             self._gradient_of_volume, state.fluid_pressure],
            [self._unbalanced],
        )  # fmt: skip
        reduce(
            reductions.sum_elements,
            self._elements_each,
            [self._elements_each, self._rest_volume, self._bulk, self._volume, self._jacobian,
             state.pressure],
            [],
        )  # fmt: skip
        reduce(reductions.sum_cavity, inner.count, [inner.count, self._face_volume], [])
        for surface, pressure in ((outer, state.indenter_pressure), (inner, state.core_pressure)):
            traction = state.traction if surface is outer else surface.wanted_traction
            reduce(
                reductions.compare_contact,
                surface.count,
                [surface.count, surface.wanted, pressure, surface.wanted_traction, traction,
                 surface.status, surface.frozen_status],
                [],
            )  # fmt: skip

    def numbers(self, state: BatchedState, listed: Listed) -> list[SlotNumbers]:
        """Numbers of the last `balance`, read back, for each listed slot."""
        rows = self._numbers.numpy()[listed.numbers]
        fluid = state.fluid_pressure.numpy()[listed.numbers].tolist()
        sizes = rows[:, reductions.INTERNAL : reductions.CORE + 1]
        scale = np.maximum(np.sqrt(sizes).sum(axis=1), FORCE_FLOOR_N)
        residual = (np.sqrt(rows[:, reductions.UNBALANCED]) / scale).tolist()
        largest = np.maximum(rows[:, reductions.LARGEST], TRACTION_FLOOR_PA)
        traction = (rows[:, reductions.TRACTION] / largest).tolist()
        gap = (rows[:, reductions.GAP] / self.system.contact.stiffness).tolist()
        forces = -rows[:, reductions.NET : reductions.NET + 3]
        return [
            SlotNumbers(
                residual=residual[k],
                volume=row[reductions.VOLUME],
                strain_error=row[reductions.STRAIN],
                gap_error_m=gap[k],
                traction_error=traction[k],
                smallest_jacobian=row[reductions.JACOBIAN],
                net_force=forces[k],
                fluid_pressure=fluid[k],
                sets_changed=bool(row[reductions.CHANGED]),
            )
            for k, row in enumerate(rows.tolist())
        ]

    def stress(self, state: BatchedState, listed: Listed, stress: wp.array) -> None:
        """Cauchy stresses of the elements [Pa], (slots * E,) matrices; see `Skin.stress`."""
        self._launch(
            element_kernels.element_stress,
            len(listed.elements),
            [*self._model, listed.elements, state.position, state.pressure],
            [stress],
        )

    def tangent(
        self,
        state: BatchedState,
        listed: Listed,
        values: wp.array,
        *,
        elastic: Listed | None,
        viscosity: wp.array,
    ) -> None:
        """Upper triangles of the listed slots; see `EquilibriumSystem.tangent_values`.

        Args:
            state: That of the last `balance`.
            listed: Slots.
            values: Takes the entries, (slots, nnz).
            elastic: Those whose tangent of skin and fluid is evaluated anew; None = none.
            viscosity: See `PseudoTransient`, (slots,).
        """
        inner, tangents = self.inner, self.tangents
        if elastic is not None:
            tangents.evaluate(
                state, elastic, self._at_points, [self._gradient, self._bulk],
                self._volume_gradient, inner, self._form,
            )  # fmt: skip
            each = 3 * self._volume_gradient.shape[1] * self._elements_each
            self._copy(elastic, each, self._volume_gradient, self._frozen_gradient)
        tangents.begin(listed)
        for surface, items in ((self.outer, listed.outer), (inner, listed.inner)):
            surface.add_tangent(items, tangents.blocks_each, tangents.blocks)
            for now, kept, each in surface.frozen:
                self._copy(listed, each * surface.count, now, kept)
        tangents.write(listed, viscosity, values)

    def right_hand_side(
        self, state: BatchedState, listed: Listed, vectors: wp.array, lane: int
    ) -> None:
        """Minus the unbalanced force and the misfits' load of the free unknowns [N]."""
        field = self._cleared_field(listed)
        self._launch(
            element_kernels.pressure_misfit,
            (len(listed.elements), self._elements.shape[1]),
            [*self._condensed, listed.elements, self._volume, self._frozen_gradient,
             state.pressure],
            [field],
        )  # fmt: skip
        for surface, items in ((self.inner, listed.inner), (self.outer, listed.outer)):
            surface.subtract_load(items, surface.misfit, field)
        self._gather_load(listed, -1.0, self._unbalanced, vectors, lane)
        self._gather_load(listed, -1.0, field, vectors, lane, add=True)

    def volume_gradient(self, listed: Listed, vectors: wp.array, lane: int) -> None:
        """Derivative of the cavity's volume by the free unknowns [m^2]."""
        self._gather_load(listed, 1.0, self._gradient_of_volume, vectors, lane)

    def coupled(self, state: BatchedState, listed: Listed, vectors: wp.array, lane: int) -> None:
        """Minus `EquilibriumSystem.coupled_force` [N]."""
        field, outer = self._cleared_field(listed), self.outer
        outer.subtract_load(listed.outer, outer.coupled, field)
        self._spread(state, listed, field, change=None)
        self._gather_load(listed, -1.0, field, vectors, lane)

    def subtract_unsymmetric_product(
        self, state: BatchedState, listed: Listed, change: wp.array, of: int, vectors: wp.array,
        lane: int,
    ) -> None:  # fmt: skip
        """Subtract `EquilibriumSystem.unsymmetric_product` of a change of the free unknowns."""
        moved = self._as_field(listed, change, of)
        field, outer = self._product, self.outer
        self.clear(listed, 3 * self._nodes, field)
        self._launch(
            contact_kernels.unsymmetric_product,
            len(listed.outer),
            [
                outer.faces,
                outer.shape,
                self._nodes,
                listed.outer,
                outer.frozen_status,
                outer.frozen_unsymmetric,
                moved,
            ],
            [field],
        )
        self._spread(state, listed, field, change=moved)
        self._gather_load(listed, -1.0, field, vectors, lane, add=True)

    def subtract_offset_force(
        self, listed: Listed, change: wp.array, of: int, vectors: wp.array, lane: int
    ) -> None:
        """Subtract `EquilibriumSystem.offset_force` of a change of the free unknowns.

        How the offsets change is kept for `targets`.
        """
        moved, field = self._as_field(listed, change, of), self._product
        self.clear(listed, 3 * self._nodes, field)
        for surface, items in self._mortar_surfaces(listed):
            self.clear(listed, self._nodes, surface.offset_change)
            surface.add_offset_changes(items, self._margin, moved)
            surface.add_offset_load(items, field)
        self._gather_load(listed, -1.0, field, vectors, lane, add=True)

    def _mortar_surfaces(self, listed: Listed) -> list[tuple[BatchedSurface, wp.array]]:
        """Surfaces whose gaps have offsets, and their listed faces."""
        if not self.system.contact.mortar:
            return []
        outer = [(self.outer, listed.outer)]
        return [*outer, (self.inner, listed.inner)] if self._core else outer

    def _spread(
        self, state: BatchedState, listed: Listed, field: wp.array, change: wp.array | None
    ) -> None:
        """Add mortar's loads at neighbours, by a change of the nodes or what they lack."""
        for surface, items in self._mortar_surfaces(listed):
            on_indenter = surface is self.outer
            pressure = state.indenter_pressure if on_indenter else state.core_pressure
            surface.add_spread(items, self._margin, pressure, change, field)

    def longest_move(self, listed: Listed, change: wp.array, lane: int) -> Floats:
        """Longest move of a node of each listed slot [m], (m,); infinite if one is no number."""
        self._sequences(self._find_longest, listed, change, lane)
        square = self._longest.numpy()[listed.numbers, 0]
        return np.asarray(np.where(square < 1e299, np.sqrt(square), np.inf))

    def _find_longest(self, listed: Listed, change: wp.array, lane: int) -> None:
        moved = self._as_field(listed, change, lane)
        self._longest.zero_()
        self._launch(
            reductions.longest_moves,
            (len(listed.slots), reductions.padded(self._nodes)),
            [listed.slots, self._nodes, moved],
            [self._longest],
        )

    def targets(
        self, listed: Listed, change: wp.array, lane: int, *, following: Listed | None = None
    ) -> None:
        """Recover the condensed unknowns; see `EquilibriumSystem.updated_pressures`.

        Args:
            listed: Slots.
            change: Of the free unknowns [m].
            lane: Of ``change``.
            following: Those of them whose offsets follow, as `subtract_offset_force` found.
        """
        moved = self._as_field(listed, change, lane)
        self._launch(
            element_kernels.pressure_update,
            len(listed.elements),
            [*self._condensed, listed.elements, self._volume, self._frozen_gradient, moved],
            [self._target],
        )
        for surface, items in ((self.inner, listed.inner), (self.outer, listed.outer)):
            surface.set_targets(items, moved)
        if following is None:
            return
        self._copy(following, 3 * self._nodes, moved, self._product)
        for surface, items in self._mortar_surfaces(following):
            surface.move_along_normals(items, moved, self._product)
            surface.set_targets(items, self._product)

    def move(
        self,
        state: BatchedState,
        start: BatchedState,
        listed: Listed,
        change: wp.array,
        lane: int,
        fraction: wp.array,
        pressure_change: wp.array,
    ) -> None:
        """Go a share, (slots,), of the way from a state to its targets."""
        slots, count = listed.slots, len(listed.slots)
        self._launch(
            kernels.move_nodes,
            (count, self.size),
            [slots, self._free, self._nodes, fraction, change, lane,
             rows_of_three(start.position)],
            [rows_of_three(state.position)],
        )  # fmt: skip
        self._launch(
            kernels.move_fluid,
            count,
            [slots, fraction, start.fluid_pressure, pressure_change],
            [state.fluid_pressure],
        )
        self._launch(
            kernels.go_towards,
            (count, self._elements_each),
            [slots, self._elements_each, fraction, start.pressure, self._target],
            [state.pressure],
        )
        outer, inner = self.outer, self.inner
        self._launch(
            kernels.move_contact,
            len(listed.outer),
            [listed.outer, outer.count, fraction, start.indenter_pressure, outer.target,
             start.traction, outer.target_traction],
            [state.indenter_pressure, state.traction],
        )  # fmt: skip
        self._launch(
            kernels.move_contact,
            len(listed.inner),
            [listed.inner, inner.count, fraction, start.core_pressure, inner.target,
             inner.wanted_traction, inner.wanted_traction],
            [state.core_pressure, inner.target_traction],
        )  # fmt: skip

    def update_anchors(self, state: BatchedState, listed: Listed) -> None:
        """See `EquilibriumSystem.update_anchors`."""
        outer = self.outer
        softness = wp.float64(1.0 / self.system.contact.tangential_stiffness)
        self._launch(
            mortar_kernels.place_anchors,
            len(listed.outer),
            [listed.outer, outer.faces, outer.shape, self._nodes, softness, self._tip,
             self._rotation, state.position, state.traction],
            [state.anchor],
        )  # fmt: skip

    @property
    def _model(self) -> list[Any]:
        constants = self.system.skin.constants
        return [self._elements, self._gradient, self._weight, *constants, self._nodes]

    @property
    def _at_points(self) -> list[Any]:
        elements, _, *others = self._model
        return [elements, self._gradient_at_points, *others]

    @property
    def _condensed(self) -> list[Any]:
        return [self._elements, self._rest_volume, self._bulk, self._nodes]

    def _flat(self, array: wp.array) -> wp.array:
        """`flat`, kept for each array."""
        if array.ptr not in self._flattened:
            self._flattened[array.ptr] = array.flatten() if array.dtype is wp.int32 else flat(array)
        return self._flattened[array.ptr]

    def _cleared_field(self, listed: Listed) -> wp.array:
        self.clear(listed, 3 * self._nodes, self._field)
        return self._field

    def _as_field(self, listed: Listed, vectors: wp.array, lane: int) -> wp.array:
        """A vector of the free unknowns as a nodal field."""
        field = self._cleared_field(listed)
        self._launch(
            kernels.spread_change,
            (len(listed.slots), self.size),
            [listed.slots, self._free, self._nodes, vectors, lane],
            [rows_of_three(field)],
        )
        return field

    def _gather_load(
        self, listed: Listed, sign: float, field: wp.array, vectors: wp.array, lane: int,
        *, add: bool = False,
    ) -> None:  # fmt: skip
        self._launch(
            kernels.add_load if add else kernels.gather_load,
            (len(listed.slots), self.size),
            [listed.slots, self._free, self._nodes, wp.float64(sign), rows_of_three(field)],
            [vectors, lane],
        )

    def _copy(self, listed: Listed, each: int, source: wp.array, copy: wp.array) -> None:
        """Copy ``each`` numbers of every listed slot between arrays of one kind."""
        integers = source.dtype is wp.int32
        self._launch(
            kernels.copy_integers if integers else kernels.copy_rows,
            (len(listed.slots), kernels.threads_for(each)),
            [listed.slots, each, self._flat(source)],
            [self._flat(copy)],
        )
