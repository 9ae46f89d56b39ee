"""Multifrontal factorisation that repeats only the fronts whose entries have changed.

A front is a dense block of the factor: the unknowns that are eliminated together, and the later
ones that they are coupled with (``ordering``). What its elimination leaves at the later ones, the
Schur complement, is added to its parent ("extend-add"). From one Newton iteration to the next only
the fronts near the contact change, so most of the factor is kept (ADR 0015).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, no_type_check

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.arrays import Floats
from palpate_fem.device import DEVICE
from palpate_fem.sparse import blas
from palpate_fem.sparse.ordering import plan_elimination

wp.set_module_options({"enable_backward": False})

Array = NDArray[Any]
Ints = NDArray[np.int64]


LOST = {np.dtype(np.float32): 1e-6, np.dtype(np.float64): 2e-14}
"""Share of a diagonal entry below which its remainder after elimination may be rounding error."""


class UnsafePivotError(ArithmeticError):
    """A pivot cannot be told from rounding errors in this precision."""


@wp.kernel
@no_type_check  # Warp's annotations are not types
def extend_add(
    # Child: its complement, ``size`` columns one after the other, and their places in the parent.
    size: int,
    share: wp.array(dtype=Any),
    place: wp.array(dtype=wp.int32),
    # Parent: unknowns that it eliminates, unknowns of its border.
    own: int,
    border: int,
    # Out, column after column; only lower triangles are read and written:
    lower_out: wp.array(dtype=Any),
    below_out: wp.array(dtype=Any),
    share_out: wp.array(dtype=Any),
) -> None:
    """Add one column of a child's Schur complement to its parent's front."""
    j = wp.tid()
    q = place[j]
    for i in range(j, size):
        p = place[i]
        value = share[j * size + i]
        if q < own:
            if p < own:
                lower_out[q * own + p] = lower_out[q * own + p] + value
            else:
                k = q * border + p - own
                below_out[k] = below_out[k] + value
        else:
            k = (q - own) * border + p - own
            share_out[k] = share_out[k] + value


for _kind in (wp.float32, wp.float64):
    wp.overload(
        extend_add,
        {
            "share": wp.array(dtype=_kind),
            "lower_out": wp.array(dtype=_kind),
            "below_out": wp.array(dtype=_kind),
            "share_out": wp.array(dtype=_kind),
        },
    )


class DenseFront:
    """Storage and elimination of one front.

    The front's own unknowns are eliminated: ``A11 = L L^T``, ``B = A21 L^-T``, and the Schur
    complement ``A22 - B B^T`` is its share for the parent. Where A11 is not positive definite, its
    eigenvectors give ``A11^-1 = W D W^T`` with a diagonal D of signs: W takes the place of L^-T,
    and the signs are the inertia that pseudo-transient continuation asks for.
    """

    def __init__(self, answers: list[Array], border: Ints) -> None:
        """Prepare an empty front.

        Args:
            answers: Views of the front's own unknowns in each solution vector, (own,).
            border: Numbers of its other unknowns, (border,).
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
        """Prepare the extend-add of a child's share, whose columns have these places here."""
        arrays = [_flat(a) for a in (child.share, self.lower, self.below, self.share)]
        self._additions.append(
            wp.launch(
                extend_add,
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
        """Enter the entries of the matrix by flat place, then add the shares of the children."""
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
        # The diagonal of L is the square root of the pivots: a small pivot relative to the entry
        # that it was eliminated from has lost its digits by cancellation.
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
        """Forward substitution of the own part of a right-hand side; updates the ``later`` part."""
        on = self._lanes[lane]
        if self._signs is None:
            on.down()
        else:
            on.answer[:] = self._signs * (self.lower.T @ on.answer)
        if len(self.border):
            on.spread()
            later[self.border] -= on.far

    def backward(self, lane: int, later: Array) -> None:
        """Backward substitution: the own part of a solution from its ``later`` part."""
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
    """The substitutions of a front in one of the solution vectors, ready to be called."""

    def __init__(self, lower: Array, below: Array, answer: Array) -> None:
        self.answer, self.far = answer, np.zeros(len(below), answer.dtype)
        self.down = blas.solve_left(lower, answer, transposed=False)
        self.up = blas.solve_left(lower, answer, transposed=True)
        self.spread = blas.multiply(below, answer, 1.0, 0.0, self.far, transposed=False)
        self.gather = blas.multiply(below, self.far, -1.0, 1.0, answer, transposed=True)


def _flat(array: Array) -> wp.array:
    kind = wp.float32 if array.dtype == np.float32 else wp.float64
    return wp.array(array.reshape(-1, order="F"), dtype=kind, device=DEVICE, copy=False)


LANES = 2
"""Right-hand sides that are solved for together."""

POOL = ThreadPoolExecutor(1, thread_name_prefix="palpate-fronts")


class FrontAssembly:
    """Where each entry of the matrix goes in the fronts; the same for each precision."""

    def __init__(self, indptr: NDArray[Any], indices: NDArray[Any], groups: NDArray[Any]) -> None:
        self.elimination = plan_elimination(indptr, indices, groups)
        count, fronts = len(indptr) - 1, self.elimination.fronts
        new = np.empty(count, np.int64)
        new[self.elimination.order] = np.arange(count)
        rows = np.repeat(np.arange(count), np.diff(indptr))
        low = np.minimum(new[rows], new[indices])
        high = np.maximum(new[rows], new[indices])
        front_of = np.repeat(np.arange(len(fronts)), [f.last - f.first for f in fronts])[low]
        own = high < np.array([f.last for f in fronts], np.int64)[front_of]
        # Entries front after front; in each, those between own unknowns first.
        self.sorted = np.lexsort((~own, front_of))
        self.begins = np.searchsorted(front_of[self.sorted], np.arange(len(fronts) + 1))
        self.own: list[Ints] = []
        self.below: list[Ints] = []
        for i, front in enumerate(fronts):
            mine = self.sorted[self.begins[i] : self.begins[i + 1]]
            split = int(own[mine].sum())
            size = front.last - front.first
            inside, outside = mine[:split], mine[split:]
            self.own.append((low[inside] - front.first) * size + high[inside] - front.first)
            row = np.searchsorted(front.border, high[outside])
            self.below.append((low[outside] - front.first) * len(front.border) + row)

    def in_parent(self, child: int) -> Ints:
        """Place of each unknown of a child's border in its parent: own unknowns, then border."""
        fronts = self.elimination.fronts
        border, parent = fronts[child].border, fronts[fronts[child].parent]
        size = parent.last - parent.first
        far = size + np.searchsorted(parent.border, border)
        return np.where(border < parent.last, border - parent.first, far)


class FrontalFactor:
    """Factor of one matrix in one precision; two host threads work on two halves of the tree."""

    def __init__(self, places: FrontAssembly, kind: type[np.floating[Any]]) -> None:
        self.places = places
        tree = places.elimination
        middle, top = tree.first, tree.first + tree.second
        self._halves = (range(middle), range(middle, top))
        self._top = range(top, len(tree.fronts))
        # Right-hand sides and solutions in order of elimination, LANES of them at a time. The
        # second half has vectors of its own, because both halves add to the fronts above them.
        self._vectors = [np.zeros((LANES, len(tree.order)), kind) for _ in range(2)]
        self._begin_of_top = tree.fronts[top].first if top < len(tree.fronts) else len(tree.order)
        self._dense = [
            DenseFront(
                [lane[front.first : front.last] for lane in self._vectors[middle <= i < top]],
                front.border,
            )
            for i, front in enumerate(tree.fronts)
        ]
        for child, front in enumerate(tree.fronts):
            if front.parent >= 0:
                self._dense[front.parent].take(self._dense[child], places.in_parent(child))
        self._values: NDArray[Any] | None = None  # of the present factor, front after front
        self.redone = 0  # fronts of the last factorisation

    @property
    def negative(self) -> int:
        """Negative eigenvalues of the matrix."""
        return sum(front.negative for front in self._dense)

    def factorise(self, values: Floats) -> None:
        """Factorise, or update the factor: fronts whose entries have not changed are kept.

        Args:
            values: Entries of the upper triangle.

        Raises:
            UnsafePivotError: In this precision a pivot cannot be told from zero.
        """
        places = self.places
        arranged = values[places.sorted].astype(self._vectors[0].dtype)
        changed = self._changed(arranged)
        self._values = None  # invalid if this fails half-way

        def redo(fronts: range) -> None:
            for i in fronts:
                if changed[i]:
                    mine = arranged[places.begins[i] : places.begins[i + 1]]
                    own = len(places.own[i])
                    self._dense[i].fill((places.own[i], mine[:own]), (places.below[i], mine[own:]))
                    self._dense[i].eliminate()

        self._both(redo)  # independent halves of the tree, then what both contribute to
        redo(self._top)
        self._values = arranged
        self.redone = int(changed.sum())

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""
        columns = right.reshape(len(right), -1)
        answer = np.empty(columns.shape)
        for begin in range(0, columns.shape[1], LANES):
            some = slice(begin, begin + LANES)
            answer[:, some] = self._solve_few(columns[:, some])
        return answer.reshape(right.shape)

    def _solve_few(self, right: Floats) -> Floats:
        """Solve for at most LANES columns: each block of the factor is read once for all."""
        tree, (first, second) = self.places.elimination, self._vectors
        lanes, top, halves = range(right.shape[1]), self._begin_of_top, self._halves
        first[: len(lanes)] = right[tree.order].T
        second[:] = first
        second[:, top:] = 0.0
        touched = self._touched(first[: len(lanes)])

        def forward(fronts: range) -> None:
            vectors = self._vectors[fronts == halves[1]]
            for i in fronts:
                if touched[i]:
                    for lane in lanes:
                        self._dense[i].forward(lane, vectors[lane])

        def backward(fronts: range) -> None:
            vectors = self._vectors[fronts == halves[1]]
            for i in reversed(fronts):
                for lane in lanes:
                    self._dense[i].backward(lane, vectors[lane])

        self._both(forward)
        first[:, top:] += second[:, top:]
        forward(self._top)
        backward(self._top)
        second[:, top:] = first[:, top:]
        self._both(backward)
        first[:, self._second_half] = second[:, self._second_half]
        answer = np.empty((len(tree.order), len(lanes)))
        answer[tree.order] = first[: len(lanes)].T
        return answer

    def _touched(self, right: NDArray[Any]) -> NDArray[np.bool_]:
        """Fronts with a non-zero right-hand side, and those above them."""
        marks = np.concatenate(([0], np.cumsum(right.any(axis=0))))
        fronts = self.places.elimination.fronts
        ends = np.array([front.last for front in fronts])
        return self._with_parents(marks[ends] > marks[[front.first for front in fronts]])

    @property
    def _second_half(self) -> slice:
        fronts, begin = self.places.elimination.fronts, self._halves[1].start
        start = fronts[begin].first if begin < len(fronts) else self._begin_of_top
        return slice(start, self._begin_of_top)

    def _both(self, work: Callable[[range], None]) -> None:
        """Work on both halves at once."""
        other = POOL.submit(work, self._halves[1])
        work(self._halves[0])
        other.result()

    def _changed(self, arranged: NDArray[Any]) -> NDArray[np.bool_]:
        """Fronts with changed entries, and those above them."""
        places, fronts = self.places, self.places.elimination.fronts
        if self._values is None:
            return np.ones(len(fronts), np.bool_)
        different = np.concatenate(([0], np.cumsum(arranged != self._values)))
        return self._with_parents(np.diff(different[places.begins]) > 0)

    def _with_parents(self, marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Marks and those of all ancestors; children stand before their parents."""
        for i, front in enumerate(self.places.elimination.fronts):
            if marked[i] and front.parent >= 0:
                marked[front.parent] = True
        return marked
