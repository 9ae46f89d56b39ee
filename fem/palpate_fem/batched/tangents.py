"""Tangents of many copies of one fingertip, from shares of elements and of the fluid's faces.

Skin and fluid give a share to each block of a node pair, which is kept while it is not evaluated
anew. A block adds its shares up in the same order each time: no atomic operations, and the same
bits. Contact adds to the sums.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from palpate_fem.batched import kernels, point_kernels
from palpate_fem.batched.launches import Launches, Listed
from palpate_fem.batched.state import BatchedState, flat, on_device
from palpate_fem.batched.surface import BatchedSurface
from palpate_fem.mechanics.element_kernels import Scales
from palpate_fem.mechanics.system import EquilibriumSystem


class BatchedTangents:
    """Upper triangles of the tangents of all slots.

    Attributes:
        blocks: Sums of the listed slots' shares, after `begin`, (slots * blocks,) matrices.
        blocks_each: Blocks of a slot.
    """

    def __init__(self, system: EquilibriumSystem, slots: int, device: str) -> None:
        """Plan which shares a block adds up, and make room.

        On a GPU shares are in single precision, as the factor is.
        """
        pattern, skin, inner = system.pattern, system.skin, system.inner
        self._launch, self.blocks_each = Launches(device), pattern.blocks
        first, second = np.triu_indices(skin.gradient_values.shape[2])

        def ints(values: Any, kind: type = wp.int32) -> wp.array:
            return on_device(np.asarray(values, np.int32), kind, device)

        pairs = pattern.element_pairs
        of_elements = np.maximum(pairs[:, first, second], pairs[:, second, first])
        of = np.concatenate((of_elements.ravel(), inner.pairs.numpy().ravel()))
        order = np.argsort(of, kind="stable")
        begins = np.searchsorted(of[order], np.arange(pattern.blocks + 1))  # below: of no block
        self._begins, self._shares = ints(begins - begins[0]), ints(order[begins[0] :])
        self._first_of_fluid, self._shares_each = of_elements.size, len(of)
        self._pairs, self._couples = ints(pairs), ints(np.stack((first, second), 1), wp.vec2i)
        self._gather, self._starts = ints(pattern.gather), ints(pattern.indptr[:-1])
        self._node_viscosity = on_device(system.viscosity, wp.float64, device)
        # Of quadrature points: F, F^-T and scales, of which tangents are made.
        elements, points = skin.weight_values.shape
        total = slots * elements * points
        matrices = [wp.zeros((9, total), dtype=wp.float64, device=device) for _ in range(2)]
        scales = wp.zeros((slots * elements, points), dtype=Scales, device=device)
        self._deformations = [*matrices, scales]
        kind = wp.float32 if wp.get_device(device).is_cuda else wp.float64
        self._elastic = wp.zeros((slots * self._shares_each, 9), dtype=kind, device=device)
        self.blocks = wp.zeros(slots * pattern.blocks, dtype=wp.mat33d, device=device)
        self._flat_blocks = flat(self.blocks)

    def evaluate(
        self,
        state: BatchedState,
        elastic: Listed,
        model: list[Any],
        element: list[wp.array],
        volume_gradient: wp.array,
        inner: BatchedSurface,
        form: wp.array,
    ) -> None:
        """Evaluate the shares of skin and fluid.

        Args:
            state: That of the last balance.
            elastic: Slots.
            model: First arguments of `element_state_by_point`.
            element: Shape gradients and bulk over volume of the elements.
            volume_gradient: Of the elements at the state.
            inner: The fluid's faces.
            form: See `volume_form`.
        """
        elements, scales = elastic.elements, self._deformations[-1]
        self._launch(
            point_kernels.point_deformation,
            (len(elements), scales.shape[1]),
            [*model, elements, state.position, state.pressure],
            self._deformations,
        )
        self._launch(
            point_kernels.element_tangent_by_pair,
            (len(elements), len(self._couples)),
            [self._pairs, self._couples, *element, elements, *self._deformations, volume_gradient,
             self._shares_each],
            [self._elastic],
        )  # fmt: skip
        self._launch(
            point_kernels.cavity_tangent_by_pair,
            (len(elastic.inner), inner.points**2),
            [inner.faces, form, len(state.position) // len(state.fluid_pressure), elastic.inner,
             state.fluid_pressure, state.position, self._first_of_fluid, self._shares_each],
            [self._elastic],
        )  # fmt: skip

    def begin(self, listed: Listed) -> None:
        """Set the blocks of the listed slots to the sums of their shares."""
        self._launch(
            kernels.sum_shares,
            (len(listed.slots), 9 * self.blocks_each),
            [listed.slots, self._begins, self._shares, self._shares_each, self._elastic],
            [self._flat_blocks],
        )

    def write(self, listed: Listed, viscosity: wp.array, values: wp.array) -> None:
        """Write the entries of the listed slots, (slots, nnz), and add a viscosity, (slots,)."""
        slots, count = listed.slots, len(listed.slots)
        self._launch(
            kernels.gather_values,
            (count, kernels.threads_for(len(self._gather))),
            [slots, self._gather, self.blocks_each, self._flat_blocks],
            [values],
        )
        self._launch(
            kernels.add_viscosity,
            (count, len(self._starts)),
            [slots, self._starts, self._node_viscosity, viscosity],
            [values],
        )
