"""Multifrontal factorisation that repeats only the fronts whose entries have changed.

A front is a dense block of the factor: the unknowns that are eliminated together, and the later
ones that they are coupled with (``ordering``). What its elimination leaves at the later ones, the
Schur complement, is its share for its parent ("extend-add"). From one Newton iteration to the next
only the fronts near the contact change, so most of the factor is kept (ADR 0015).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_fem.arrays import Floats
from palpate_fem.sparse import blas
from palpate_fem.sparse.ordering import Front, plan_elimination

Array = NDArray[Any]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]


class UnsafePivotError(ArithmeticError):
    """A pivot cannot be told from rounding errors in this precision."""


LANES = 2
"""Right-hand sides that are solved for together."""

LINE = 64
"""Columns begin at multiples of so many bytes."""

PAGE = 4096
"""Columns at a distance of a multiple of this would compete for one place in the cache [B]."""

POOL = ThreadPoolExecutor(1, thread_name_prefix="palpate-fronts")


class FrontAssembly:
    """Where each entry of the matrix and of the shares goes; the same for each precision.

    Attributes:
        elimination: Order and fronts.
        table: A row for each front (`blas.FIELDS`), without the places of its memory.
        sources: Number of each entry in the matrix, front after front, (E,).
        places: Place of each entry in its panel, (E,).
        children: Numbers of the children, parent after parent.
        runs: Runs of border unknowns that are neighbours in the parent, too: place in the
            front's border, row in the parent's panel, and length, front after front, (R, 3).
        far: Borders of all fronts.
    """

    def __init__(self, indptr: NDArray[Any], indices: NDArray[Any], groups: NDArray[Any]) -> None:
        self.elimination = plan_elimination(indptr, indices, groups)
        count, fronts = len(indptr) - 1, self.elimination.fronts
        new = np.empty(count, np.int64)
        new[self.elimination.order] = np.arange(count)
        rows = np.repeat(np.arange(count), np.diff(indptr))
        low = np.minimum(new[rows], new[indices])
        high = np.maximum(new[rows], new[indices])
        front_of = np.repeat(np.arange(len(fronts)), [f.last - f.first for f in fronts])[low]
        order = np.argsort(front_of, kind="stable")
        self.sources = order.astype(np.int32)
        begins = np.searchsorted(front_of[order], np.arange(len(fronts) + 1))
        self.places = np.empty(len(order), np.int64)
        for i, front in enumerate(fronts):
            mine = slice(begins[i], begins[i + 1])
            column, row = low[order[mine]] - front.first, _rows_in(front, high[order[mine]])
            block, within = np.divmod(row, blas.BLOCK)
            self.places[mine] = (block * _columns(front) + column) * blas.BLOCK + within
        parents = np.array([front.parent for front in fronts], np.int64)
        self.children = np.argsort(parents, kind="stable").astype(np.int32)
        first_child = np.searchsorted(np.sort(parents), np.arange(len(fronts) + 1))
        runs = [self._runs(front) for front in fronts]
        self.runs = np.concatenate(runs or [np.zeros((0, 3), np.int32)])
        runs_begin = np.concatenate(([0], np.cumsum([len(r) for r in runs])))
        borders = np.array([len(front.border) for front in fronts], np.int64)
        self.far = np.concatenate([f.border for f in fronts] or [np.zeros(0, np.int64)]).astype(
            np.int32
        )
        self.table = np.zeros(len(fronts), [(name, np.int64) for name in blas.FIELDS])
        for name, column in {
            "own": [front.last - front.first for front in fronts],
            "border": borders,
            "columns": [_columns(front) for front in fronts],
            "first": [front.first for front in fronts],
            "parent": parents,
            "far": np.cumsum(borders) - borders,
            "entries": begins[:-1],
            "entries_end": begins[1:],
            "children": first_child[:-1],
            "children_end": first_child[1:],
            "runs": runs_begin[:-1],
            "runs_end": runs_begin[1:],
        }.items():
            self.table[name] = column

    def _runs(self, front: Front) -> Int32s:
        if front.parent < 0:
            return np.zeros((0, 3), np.int32)
        rows = _rows_in(self.elimination.fronts[front.parent], front.border)
        begins = np.concatenate(([0], np.flatnonzero(np.diff(rows) != 1) + 1))
        lengths = np.diff(np.concatenate((begins, [len(rows)])))
        return np.stack((begins, rows[begins], lengths), axis=1).astype(np.int32)


def _columns(front: Front) -> int:
    return int(_rounded_up(np.int64(front.last - front.first), blas.BLOCK))


def _rows_in(front: Front, unknowns: Ints) -> Ints:
    """Row of each unknown in a front's panel: own unknowns, then border."""
    far = _columns(front) + np.searchsorted(front.border, unknowns)
    return np.where(unknowns < front.last, unknowns - front.first, far)


class FrontalFactor:
    """Factor of one matrix in one precision; two host threads work on two halves of the tree."""

    def __init__(self, places: FrontAssembly, kind: type[np.floating[Any]]) -> None:
        self.places, self._kind = places, np.dtype(kind)
        tree = places.elimination
        middle, top = tree.first, tree.first + tree.second
        self._parts = (range(middle), range(middle, top), range(top, len(tree.fronts)))
        starts = [*(front.first for front in tree.fronts), len(tree.order)]
        self._begin_of_second, self._begin_of_top = starts[middle], starts[top]
        table = self._table = places.table.copy()
        rows = table["columns"] + _rounded_up(table["border"], blas.BLOCK)
        size = LINE // self._kind.itemsize
        stride = _rounded_up(table["border"], size)
        table["stride"] = stride + size * (stride * self._kind.itemsize % PAGE == 0)
        panels = np.cumsum(_rounded_up(rows * table["columns"], size))
        # Between the shares room for a block, since the last of a column may be read beyond it.
        shares = size + np.cumsum(_rounded_up(table["border"], blas.BLOCK) * table["stride"] + size)
        table["panel"][1:], table["share"][1:] = panels[:-1], shares[:-1]
        table["share"][:1] = size
        self._panels, self._shares = self._room(panels[-1]), self._room(shares[-1])
        place = np.repeat(table["panel"], table["entries_end"] - table["entries"]) + places.places
        # Right-hand sides and solutions in order of elimination, LANES of them at a time. The
        # second half has vectors of its own, because both halves add to the fronts above them.
        self._vectors = [np.zeros((LANES, len(tree.order)), kind) for _ in range(2)]
        self._changed = np.zeros(len(table), np.uint8)
        # Fronts that are not positive definite, the signs and the number of negative eigenvalues.
        self._diagonal = np.zeros(len(table), np.uint8)
        self._signs = np.zeros(len(tree.order), kind)
        self._negative = np.zeros(len(table), np.int64)
        self._valid = False
        flat = table.view(np.int64)
        entries, scales = np.zeros(len(place), kind), np.zeros(len(tree.order), kind)
        room = int((rows + table["columns"]).max())
        self._factorise, self._substitute = [], []
        for vectors in (self._vectors[0], self._vectors[1], self._vectors[0]):
            tasks = np.zeros(3, np.int64), np.zeros(4, np.int64)
            scratch = self._room(LANES * (1 + blas.BLOCK) * room).reshape(-1, room)
            self._factorise.append(
                blas.Call(
                    blas.factorise, tasks[0], flat, self._changed, self._diagonal, places.sources,
                    place, places.children, places.runs.ravel(), entries, scales, self._panels,
                    self._shares,
                )
            )  # fmt: skip
            self._substitute.append(
                blas.Call(
                    blas.substitute, tasks[1], flat, places.far, self._diagonal, self._signs,
                    self._panels, scratch, vectors,
                )
            )  # fmt: skip

    def _room(self, count: Any) -> Array:
        """Zeros that begin at a cache line."""
        size = LINE // self._kind.itemsize
        room = np.zeros(count + size, self._kind)
        return room[-(room.ctypes.data // self._kind.itemsize) % size :][:count]

    @property
    def negative(self) -> int:
        """Negative eigenvalues of the matrix."""
        return int(self._negative[self._diagonal != 0].sum())

    @property
    def redone(self) -> int:
        """Fronts of the last factorisation."""
        return int(self._changed.sum())

    def factorise(self, values: Floats) -> None:
        """Factorise, or update the factor: fronts whose entries have not changed are kept.

        Args:
            values: Entries of the upper triangle.

        Raises:
            UnsafePivotError: In this precision a pivot cannot be told from zero.
        """
        values = np.ascontiguousarray(values, np.float64)
        self._changed.fill(not self._valid)
        self._valid = False  # unless this gets to its end

        def redo(part: int) -> None:
            call, fronts = self._factorise[part], self._parts[part]
            call.task[:] = fronts.start, fronts.stop, values.ctypes.data
            call()
            while call.task[0] < fronts.stop:
                self._diagonalise(int(call.task[0]))
                call.task[0] += 1
                call()

        self._both(redo)  # independent halves of the tree, then what both contribute to
        redo(2)
        self._valid = True

    def _diagonalise(self, number: int) -> None:
        """Factorise a front that is not positive definite, or has pivots that are not safe.

        The front is ``A11``, ``A21`` and ``A22``. Its eigenvectors give ``A11^-1 = W D W^T`` with
        a diagonal D of signs: W takes the place of ``L^-T`` of a Cholesky factor, and the signs
        are the inertia that pseudo-transient continuation asks for.
        """
        if self._kind == np.float32:
            raise UnsafePivotError
        front = self._table[number]
        own, border = int(front["own"]), int(front["border"])
        columns, stride = int(front["columns"]), int(front["stride"])
        rows = columns + int(_rounded_up(front["border"], blas.BLOCK))
        blocks = self._panels[front["panel"] :][: rows * columns].reshape(-1, columns, blas.BLOCK)
        panel = blocks.transpose(0, 2, 1).reshape(rows, columns)
        matrix, below = panel[:own, :own], panel[columns:, :own]
        share = self._shares[front["share"] :][: border * stride].reshape(border, stride)
        # Scaled to a diagonal of ones, else stiff directions would drown soft ones in rounding.
        diagonal = np.abs(matrix.diagonal())
        scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale, UPLO="L")
        if np.abs(values).min() <= blas.LOST[self._kind] * np.abs(values).max():
            raise UnsafePivotError
        signs = np.sign(values)
        matrix[:] = scale[:, None] * vectors / np.sqrt(np.abs(values))
        below[:] = below @ matrix
        blocks[:] = panel.reshape(-1, blas.BLOCK, columns).transpose(0, 2, 1)
        share[:, :border] -= ((below * signs) @ below.T)[:border, :border]
        self._diagonal[number], self._negative[number] = 1, (values < 0.0).sum()
        self._signs[front["first"] :][:own] = signs

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
        order, (first, second) = self.places.elimination.order, self._vectors
        lanes, middle, top = right.shape[1], self._begin_of_second, self._begin_of_top
        first[:lanes] = right[order].T
        second[:lanes, middle:top] = first[:lanes, middle:top]
        second[:lanes, top:] = 0.0

        def substitute(part: int, *, forward: bool) -> None:
            call, fronts = self._substitute[part], self._parts[part]
            call.task[:] = fronts.start, fronts.stop, lanes, forward
            call()

        self._both(partial(substitute, forward=True))
        first[:lanes, top:] += second[:lanes, top:]
        substitute(2, forward=True)
        substitute(2, forward=False)
        second[:lanes, top:] = first[:lanes, top:]
        self._both(partial(substitute, forward=False))
        first[:lanes, middle:top] = second[:lanes, middle:top]
        answer = np.empty(right.shape)
        answer[order] = first[:lanes].T
        return answer

    def _both(self, work: Callable[[int], None]) -> None:
        """Work on both halves at once."""
        other = POOL.submit(work, 1)
        try:
            work(0)
        finally:
            other.result()


def _rounded_up(sizes: Any, step: int) -> Any:
    return (sizes + step - 1) // step * step
