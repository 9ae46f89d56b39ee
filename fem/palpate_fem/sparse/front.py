"""One front in numbers: dense, filled, eliminated, and applied to a right-hand side."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.device import DEVICE
from palpate_fem.sparse import blas, kernels

Array = NDArray[Any]
Ints = NDArray[np.int64]


LOST = {np.dtype(np.float32): 1e-6, np.dtype(np.float64): 2e-14}
"""Share of a diagonal entry below which what elimination leaves of it may be rounding alone."""


class UnsafePivotError(ArithmeticError):
    """A pivot is lost in the rounding of this precision."""


class DenseFront:
    """Storage and elimination of one front.

    The unknowns of its own are eliminated: ``A11 = L L^T``, ``B = A21 L^-T``, and ``A22 - B B^T``
    is its share for the parent. Where A11 is not positive definite, ``A11^-1 = W D W^T`` from its
    eigenvectors, with D of signs, takes the place of L.
    """

    def __init__(self, answers: list[Array], border: Ints) -> None:
        """Prepare an empty front.

        Args:
            answers: Where the front's own unknowns stand in each vector that is solved for, (own,).
            border: Its other unknowns, (border,).
        """
        kind, own = answers[0].dtype, len(answers[0])
        self.border = border
        self.lower = np.zeros((own, own), kind, order="F")
        self.below = np.zeros((len(border), own), kind, order="F")
        self.share = np.zeros((len(border), len(border)), kind, order="F")
        self.negative = 0  # eigenvalues below zero
        self._flat_lower = self.lower.reshape(-1, order="F")
        self._flat_below = self.below.reshape(-1, order="F")
        self._diagonal = self._flat_lower[:: own + 1]
        self._signs: Array | None = None
        self._additions: list[Any] = []
        self._cholesky = blas.Cholesky(self.lower)
        self._divide = blas.solve_right(self.lower, self.below)
        self._subtract = blas.subtract_square(self.below, self.share)
        self._lanes = [_Lane(self.lower, self.below, answer) for answer in answers]

    def take(self, child: DenseFront, place: Ints) -> None:
        """Prepare the addition of a child's share, whose columns have these places here."""
        arrays = [_flat(a) for a in (child.share, self.lower, self.below, self.share)]
        self._additions.append(
            wp.launch(
                kernels.extend_add,
                dim=len(place),
                inputs=[
                    len(place),
                    arrays[0],
                    wp.array(place.astype(np.int32), dtype=wp.int32, device=DEVICE),
                    len(self.lower),
                    len(self.share),
                ],
                outputs=arrays[1:],
                device=DEVICE,
                record_cmd=True,
            )
        )

    def fill(self, own: tuple[Ints, Array], below: tuple[Ints, Array]) -> None:
        """Entries of the matrix by flat place, then what the children add."""
        self.lower.fill(0.0)
        self.below.fill(0.0)
        self.share.fill(0.0)
        self._flat_lower[own[0]] = own[1]
        self._flat_below[below[0]] = below[1]
        for addition in self._additions:
            addition.launch()

    def eliminate(self) -> None:
        """Eliminate the front's own unknowns.

        Raises:
            UnsafePivotError: A pivot cannot be told from zero.
        """
        self._signs, self.negative = None, 0
        scale, lost = np.abs(self._diagonal), LOST[self.lower.dtype]
        matrix = self.lower.copy(order="F") if self.lower.dtype == np.float64 else None
        definite = self._cholesky()
        if not definite or (self._diagonal**2 < lost * scale).any():
            if matrix is None:
                raise UnsafePivotError
            self._diagonalise(matrix, lost)
        elif len(self.border):
            self._divide()
        if len(self.border):
            if self._signs is None:
                self._subtract()
            else:
                self.share -= (self.below * self._signs) @ self.below.T

    def _diagonalise(self, matrix: Array, lost: float) -> None:
        # Scaled to a diagonal of ones, else stiff directions would drown soft ones in rounding.
        diagonal = np.abs(matrix.diagonal())
        scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale, UPLO="L")
        if np.abs(values).min() <= lost * np.abs(values).max():
            raise UnsafePivotError
        self._signs, self.negative = np.sign(values), int((values < 0.0).sum())
        self.lower[:] = scale[:, None] * vectors / np.sqrt(np.abs(values))
        if len(self.border):
            self.below[:] = self.below @ self.lower

    def forward(self, lane: int, later: Array) -> None:
        """Divide the own part of the right-hand side by L, and take it off the ``later`` ones."""
        on = self._lanes[lane]
        if self._signs is None:
            on.down()
        else:
            on.answer[:] = self._signs * (self.lower.T @ on.answer)
        if len(self.border):
            on.spread()
            later[self.border] -= on.far

    def backward(self, lane: int, later: Array) -> None:
        """The own part of the answer, from what the ``later`` unknowns are."""
        on = self._lanes[lane]
        if self._signs is None:
            if len(self.border):
                on.far[:] = later[self.border]
                on.gather()
            on.up()
            return
        # After `forward` the own part is D W^T b; B belongs to W without the signs.
        own = on.answer
        if len(self.border):
            own = own - self._signs * (self.below.T @ later[self.border])
        on.answer[:] = self.lower @ own


class _Lane:
    """What a front does to one of the vectors."""

    def __init__(self, lower: Array, below: Array, answer: Array) -> None:
        self.answer, self.far = answer, np.zeros(len(below), answer.dtype)
        self.down = blas.solve_left(lower, answer, transposed=False)
        self.up = blas.solve_left(lower, answer, transposed=True)
        self.spread = blas.multiply(below, answer, 1.0, 0.0, self.far, transposed=False)
        self.gather = blas.multiply(below, self.far, -1.0, 1.0, answer, transposed=True)


def _flat(array: Array) -> wp.array:
    kind = wp.float32 if array.dtype == np.float32 else wp.float64
    return wp.array(array.reshape(-1, order="F"), dtype=kind, device=DEVICE, copy=False)
