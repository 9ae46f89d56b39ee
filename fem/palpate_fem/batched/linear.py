"""The linear system of a Newton iteration for many slots: factor, border, unsymmetric share.

What `NewtonSolver` does for one state, in the same order: the symmetric tangent is factorised, the
fluid pressure is its border, and one more solve corrects for sliding friction and for mortar's
loads at the neighbours.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.arrays import Floats
from palpate_fem.batched import kernels
from palpate_fem.batched.dense_tiles import THREADS
from palpate_fem.batched.equations import BatchedEquations
from palpate_fem.batched.factor import BatchedFactor
from palpate_fem.batched.launches import Launches, Listed, Sequences
from palpate_fem.batched.state import BatchedState

Flags = NDArray[np.bool_]

CHANGE, MORE = 0, 1
"""Lanes of the vectors: the solution, and the border or the correction."""

GRADIENT, ANSWER = 0, 1
"""Lanes of the border: the volume gradient b at the last tangent, and K^-1 b."""


class BatchedLinearSystem:
    """Factors of the listed slots, and what is solved with them.

    Attributes:
        change: Solutions, (slots, 2, n); lane `CHANGE` is the change of the free unknowns.
        pressure_change: Change of the fluid pressure [Pa], (slots,).
    """

    def __init__(self, equations: BatchedEquations) -> None:
        """Make room for all slots."""
        pattern, device = equations.system.pattern, equations.device
        slots = equations.slots
        self.equations = equations
        self._launch, self._sequences = Launches(device), Sequences(device)
        self._size = len(pattern.free)
        self.factor = BatchedFactor(
            pattern.indptr, pattern.indices, pattern.free // 3, slots=slots, device=device
        )
        shape = (slots, 2, self._size)
        self.change = wp.zeros(shape, dtype=wp.float64, device=device)
        self._border = wp.zeros(shape, dtype=wp.float64, device=device)
        self._load = wp.zeros(shape, dtype=wp.float64, device=device)
        self.pressure_change = wp.zeros(slots, dtype=wp.float64, device=device)
        self._ones = wp.full(slots, 1.0, dtype=wp.float64, device=device)
        self._further = wp.zeros(slots, dtype=wp.float64, device=device)
        self._missing = wp.zeros(slots, dtype=wp.float64, device=device)
        self._stiffness = wp.zeros(slots, dtype=wp.float64, device=device)
        self._moved = wp.zeros(slots, dtype=wp.float64, device=device)
        self._has_border = np.zeros(slots, bool)

    def factorise(
        self, state: BatchedState, listed: Listed, elastic: Listed | None, viscosity: wp.array
    ) -> Flags:
        """Factorise the tangents of the present states.

        Args:
            state: Present states, just evaluated.
            listed: Slots to factorise.
            elastic: Those of them whose tangent of skin and fluid is evaluated anew; None = none.
            viscosity: See `PseudoTransient`, (slots,).

        Returns:
            Whether each is positive definite, (m,).
        """
        self._sequences(self._factorise, state, listed, elastic, viscosity)
        self._has_border[listed.numbers] = False
        return np.asarray(self.factor.bad.numpy()[listed.numbers] == 0)

    def _factorise(
        self, state: BatchedState, listed: Listed, elastic: Listed | None, viscosity: wp.array
    ) -> None:
        values = self.factor.values
        self.equations.tangent(state, listed, values, elastic=elastic, viscosity=viscosity)
        self.factor.factorise(listed.slots)

    def solve(
        self,
        state: BatchedState,
        listed: Listed,
        missing_m3: Floats,
        *,
        following: Listed | None = None,
    ) -> None:
        """Change of the free unknowns and of the fluid pressure; see `NewtonSolver`.

        Args:
            state: Present states, just evaluated.
            listed: Slots.
            missing_m3: Volume that each cavity lacks [m^3], (m,).
            following: Those of the slots whose gaps' offsets follow the change.
        """
        new = listed.numbers[~self._has_border[listed.numbers]]
        fresh = listed if len(new) == len(listed.numbers) else self.equations.listed(new)
        self._has_border[new] = True
        missing = np.zeros(self.equations.slots)
        missing[listed.numbers] = missing_m3
        self._missing.assign(missing)
        self._sequences(self._solve, state, listed, fresh, following)

    def _solve(
        self, state: BatchedState, listed: Listed, fresh: Listed, following: Listed | None
    ) -> None:
        """Solve; ``fresh`` are those whose border has to be solved for."""
        equations, slots = self.equations, listed.slots
        equations.right_hand_side(state, listed, self.change, CHANGE)
        if len(fresh.numbers):
            # With those whose border's solution is known, too: one factor's tiles serve two lanes.
            equations.volume_gradient(listed, self.change, MORE)
            self._copy(fresh, self.change, MORE, self._border, GRADIENT)
            self.factor.solve(slots, self.change, 2)
            self._copy(fresh, self.change, MORE, self._border, ANSWER)
            self._product(fresh, self._border, GRADIENT, self._border, ANSWER, self._stiffness)
        else:
            self.factor.solve(slots, self.change, 1)
        self.pressure_change.zero_()
        self._seal(listed)
        # (S + U) x = S answer + coupled, by one correction.
        equations.coupled(state, listed, self._load, 0)
        equations.subtract_unsymmetric_product(state, listed, self.change, CHANGE, self._load, 0)
        if following is not None:
            equations.subtract_offset_force(following, self.change, CHANGE, self._load, 0)
        self.factor.solve(slots, self._load, 1)
        self._add(listed, self._load, 0, self._ones, self.change, CHANGE)
        self._seal(listed)

    def _seal(self, listed: Listed) -> None:
        """Change the fluid pressures so that the cavities get what they lack."""
        self._product(listed, self._border, GRADIENT, self.change, CHANGE, self._moved)
        self._launch(
            kernels.fluid_pressure_change,
            len(listed.numbers),
            [listed.slots, self._missing, self._moved, self._stiffness],
            [self._further, self.pressure_change],
        )
        self._add(listed, self._border, ANSWER, self._further, self.change, CHANGE)

    def _product(
        self,
        listed: Listed,
        first: wp.array,
        lane: int,
        second: wp.array,
        other: int,
        out: wp.array,
    ) -> None:
        count, device = len(listed.numbers), self.equations.device
        self.equations.clear(listed, 1, out)
        parts = -(-self._size // kernels.STRETCH)
        wp.launch_tiled(
            kernels.add_products,
            dim=[count, parts],
            inputs=[listed.slots, first, lane, second, other],
            outputs=[out],
            block_dim=THREADS,
            device=device,
        )

    def _copy(self, listed: Listed, source: wp.array, lane: int, out: wp.array, to: int) -> None:
        self._launch(
            kernels.copy_lane,
            (len(listed.numbers), self._size),
            [listed.slots, source, lane],
            [out, to],
        )

    def _add(
        self, listed: Listed, source: wp.array, lane: int, factor: wp.array, out: wp.array, to: int
    ) -> None:
        self._launch(
            kernels.add_scaled_lane,
            (len(listed.numbers), self._size),
            [listed.slots, source, lane, factor],
            [out, to],
        )
