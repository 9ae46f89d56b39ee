"""Cholesky factors of many matrices of one pattern at once: multifrontal, in tiles, on a GPU.

The elimination tree is that of the CPU's solver (``ordering``). Its fronts are worked on level by
level, leaves first, for all listed matrices together. Matrices, factors, and the vectors of a solve
are kept in single precision; sums of a factorisation are added up in double. There is no pivoting:
a matrix that is not positive definite is reported (ADR 0026).

A front whose entries, and whose children, are what they were at the last factorisation is left as
it is. Where only contact has changed, that is most of them.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.batched import factor_kernels as kernels
from palpate_fem.batched import solve_kernels
from palpate_fem.batched.dense_tiles import INVERTED, LANES, THREADS, TILE, WIDE
from palpate_fem.batched.dense_vectors import PARTS, SMALL
from palpate_fem.batched.kernels import threads_for
from palpate_fem.batched.launches import Launches, Sequences
from palpate_fem.sparse.ordering import EliminationTree, Ints, plan_elimination

FILLED = 1024
"""Threads that keep a processor busy."""


class FrontTiles:
    """Where everything is in tiles; the same for every matrix.

    Attributes:
        tree: Order and fronts.
        level: Of each front; leaves have 0.
        panels: Tiles of each front's panel.
        panel_tiles: Tiles of all panels of one matrix.
        share_tiles: Tiles of all shares of one matrix.
        rows: Rows of all fronts, own and border, for one right-hand side.
        fronts: A row for each front: its own tiles, its rows of tiles, begin and end of its
            children, and begin of its panel, of its share, and of its rows in a vector.
        children: A row for each front, those with the same parent one after another: begin of its
            parent's rows in ``rows_in_child``, of its share, and of its border in a vector.
        rows_in_child: For each front, where each padded row of its parent is in its border; -1 =
            nowhere. They rise where they are not -1.
        gflop: Operations of one factorisation with the padding [GFlop].
    """

    def __init__(self, tree: EliminationTree) -> None:
        self.tree = tree
        fronts, count = tree.fronts, len(tree.fronts)
        self.parent = np.array([front.parent for front in fronts], np.int64)
        own = np.array([front.last - front.first for front in fronts], np.int64)
        border = np.array([len(front.border) for front in fronts], np.int64)
        self.own_tiles, self.border_tiles = -(-own // TILE), -(-border // TILE)
        o, b = self.own_tiles, self.border_tiles
        panel, share = o * (o + 1) // 2 + b * o, b * (b + 1) // 2
        self.panels, self.panel_tiles, self.share_tiles = panel, int(panel.sum()), int(share.sum())
        self.rows = int(((o + b) * TILE).sum())
        self.level = np.zeros(count, np.int64)
        for k in range(count):  # children stand before parents
            if self.parent[k] >= 0:
                self.level[self.parent[k]] = max(self.level[self.parent[k]], self.level[k] + 1)
        self.levels = int(self.level.max(initial=-1)) + 1
        children = np.argsort(self.parent, kind="stable")
        begins = np.searchsorted(self.parent[children], np.arange(count + 1))
        self.fronts = np.zeros((count, 7), np.int64)
        self.fronts[:, 0], self.fronts[:, 1] = o, o + b
        self.fronts[:, 2], self.fronts[:, 3] = begins[:-1], begins[1:]
        self.fronts[:, 4] = np.cumsum(panel) - panel
        self.fronts[:, 5] = np.cumsum(share) - share
        self.fronts[:, 6] = np.cumsum((o + b) * TILE) - (o + b) * TILE
        border_begins = self.fronts[:, 6] + o * TILE
        columns = (self._match_children(), self.fronts[:, 5], border_begins)
        self.children = np.stack(columns, axis=1)[children]
        products = o * (o - 1) * (o + 1) // 6 + o * (o + 1) // 2  # of the own triangle
        products += b * o * (o + 1) // 2 + share * o
        self.gflop = float(products.sum()) * 2.0 * TILE**3 / 1e9

    def _match_children(self) -> Ints:
        """Make ``rows_in_child``; begins of the rows of each front's parent."""
        sizes = np.where(self.parent >= 0, self.fronts[self.parent, 1] * TILE, 0)
        begins = np.cumsum(sizes) - sizes
        self.rows_in_child = np.full(sizes.sum(), -1, np.int64)
        for k in np.flatnonzero(sizes):
            border = self.tree.fronts[k].border
            rows = begins[k] + self.rows_in(self.parent[k], border)
            self.rows_in_child[rows] = np.arange(len(border))
        return begins

    def rows_in(self, k: int, unknowns: Ints) -> Ints:
        """Padded rows of unknowns, in order of elimination, in a front that holds them."""
        front = self.tree.fronts[k]
        at = TILE * self.own_tiles[k] + np.searchsorted(front.border, unknowns)
        return np.where(unknowns < front.last, unknowns - front.first, at)

    def row_tile(self, k: int, row: Any) -> Ints:
        """Place of the first tile of a row of tiles in the panels."""
        o = self.own_tiles[k]
        row = np.asarray(row)
        own, below = row * (row + 1) // 2, o * (o + 1) // 2 + (row - o) * o
        return np.asarray(self.fronts[k, 4] + np.where(row < o, own, below))


class _Step(NamedTuple):
    """A triangle of each front of a level: its first tile, and the listed rows of tiles."""

    corner: int
    own: tuple[int, int]
    below: tuple[int, int]


class BatchedFactor:
    """Factors of matrices with one pattern, one for each slot.

    Attributes:
        values: Upper triangles (slots, nnz), in the pattern's order; the caller writes them.
        bad: 1 where the last factorisation of a slot met a pivot that is not positive, (slots,).
        marked: 1 for the fronts that the last factorisation of a slot worked on, (slots, fronts).
    """

    def __init__(
        self,
        indptr: NDArray[Any],
        indices: NDArray[Any],
        groups: NDArray[Any],
        *,
        slots: int,
        device: str,
        few: int | None = None,
        columns: int = 8,
    ) -> None:
        """Plan the elimination and make room.

        Args:
            indptr: Upper triangle in CSR, every diagonal entry present.
            indices: Its columns, sorted.
            groups: Node of each unknown, (n,).
            slots: Number of matrices.
            device: A Warp device.
            few: Of levels with at most so many fronts in all slots, wide ones are factorised
                column by column; None = a quarter of the device's processors. Changes no bit.
            columns: From so many tiles on a front is wide.
        """
        tiles = FrontTiles(
            plan_elimination(np.asarray(indptr), np.asarray(indices), np.asarray(groups))
        )
        self.tiles, self.slots, self.size, self._device = tiles, slots, len(indptr) - 1, device
        self.values = wp.zeros((slots, len(indices)), dtype=wp.float32, device=device)
        # No number is what it was before the first factorisation.
        self._known = wp.full((slots, len(indices)), np.nan, dtype=wp.float32, device=device)
        self._launch = Launches(device)
        self._sequences = Sequences(device)
        self._processors = wp.get_device(device).sm_count if self.values.device.is_cuda else 0
        self.few = self._processors // 4 if few is None else few
        # Of each level: the widest front, and the most rows, in tiles.
        self._largest = [
            tiles.fronts[tiles.level == level, :2].max(axis=0).tolist()
            for level in range(tiles.levels)
        ]
        self._wide = [k for k, (own, _) in enumerate(self._largest) if own >= columns]
        self._small = [
            k for k, (own, rows) in enumerate(self._largest) if own <= INVERTED and rows <= SMALL
        ]
        self.bad = wp.zeros(slots, dtype=wp.int32, device=device)
        self.marked = wp.zeros((slots, len(tiles.fronts)), dtype=wp.int32, device=device)
        square = (TILE, TILE)
        self._panels = wp.zeros(
            (slots * tiles.panel_tiles, *square), dtype=wp.float32, device=device
        )
        self._shares = wp.zeros(
            (slots * tiles.share_tiles, *square), dtype=wp.float32, device=device
        )
        # Tiles of fronts that are factorised by columns, until their column is divided.
        wide = [tiles.panels[tiles.level == level] for level in self._wide]
        self._room = int(max((panels.max() for panels in wide), default=0))
        fronts = min(self.few, slots * max((len(panels) for panels in wide), default=0))
        self._unfinished = wp.zeros((fronts * self._room, *square), dtype=wp.float64, device=device)
        shape = (slots * tiles.rows, LANES)
        self._begun = wp.zeros(shape, dtype=wp.float32, device=device)
        self._half = wp.zeros(shape, dtype=wp.float32, device=device)
        self._loaded = wp.zeros_like(self.marked)
        self._fronts = self._ints(tiles.fronts)
        self._children = self._ints(tiles.children)
        self._rows_in_child = self._ints(tiles.rows_in_child)
        self._parent = self._ints(tiles.parent)
        self._plan_entries(np.asarray(indptr), np.asarray(indices))
        self._plan_factor()
        self._plan_solve()

    @property
    def statistics(self) -> dict[str, float]:
        """Sizes: fronts, levels, operations without and with padding [GFlop], memory [MiB]."""
        tiles = self.tiles
        stored = tiles.panel_tiles + tiles.share_tiles
        return {
            "fronts": float(len(tiles.fronts)),
            "levels": float(tiles.levels),
            "gflop": tiles.tree.flop / 1e9,
            "padded_gflop": tiles.gflop,
            "mib_a_slot": 4.0 * (stored * TILE**2 + 2 * tiles.rows * LANES) / 2**20,
        }

    def factorise(self, slots: wp.array) -> None:
        """Factorise the matrices of the listed slots, (m,) int32; others keep their factors."""
        self._sequences(self._factorise, slots)

    def _factorise(self, slots: wp.array) -> None:
        count, tiles = len(slots), self.tiles
        self._mark(slots)
        sizes = [tiles.panel_tiles, tiles.share_tiles]
        plan = [self._fronts, self._children, self._rows_in_child]
        for level in range(tiles.levels):
            first, last = self._front_begins[level : level + 2]
            begin = [slots, self.marked, self._by_level, *plan, self._sources_at, self._sources,
                     first]  # fmt: skip
            known = [*sizes, self.values, self._shares]
            if level in self._wide and (last - first) * count <= self.few:
                self._factorise_by_columns(level, slots, begin, known)
            else:
                self._launch(
                    kernels.factorise_panels,
                    (last - first, count, block := self._block((last - first) * count)),
                    [*begin, *known],
                    [self._panels, self.bad],
                    block=block,
                )
            first, last = self._product_begins[level : level + 2]
            self._launch(
                kernels.subtract_products,
                (count, last - first, 2 * TILE),
                [slots, self.marked, self._products, *plan, first, *sizes, self._panels],
                [self._shares],
            )
        self._launch(
            kernels.invert_triangles,
            (len(self._triangles), count, THREADS),
            [slots, self.marked, self._triangles, self._fronts, tiles.panel_tiles],
            [self._panels],
        )

    def _factorise_by_columns(
        self, level: int, slots: wp.array, begin: list[Any], known: list[Any]
    ) -> None:
        """Factorise panels column by column, each by as many blocks of threads as it can use."""
        first, last = self._front_begins[level : level + 2]
        width, height = self._largest[level]
        shape, panel_tiles = (last - first, len(slots)), self.tiles.panel_tiles
        fronts = [slots, self.marked, self._by_level, self._fronts, first]
        self._launch(
            kernels.begin_panels,
            (*shape, width * height, 2 * TILE),
            [*begin, width, *known, self._panels, self._room],
            [self._unfinished],
        )
        for column in range(width):
            below = height - column - 1
            parts = max(1, -(-2 * below * TILE // THREADS))
            self._launch(
                kernels.divide_columns,
                (*shape, parts, THREADS),
                [*fronts, column, parts, panel_tiles, self._room, self._unfinished],
                [self._panels, self.bad],
            )
            self._launch(
                kernels.subtract_columns,
                (*shape, (width - column - 1) * below, 2 * TILE),
                [*fronts, column, width, panel_tiles, self._panels, self._room],
                [self._unfinished],
            )

    def _block(self, fronts: int) -> int:
        """Threads for each of so many fronts: more if each has a processor to itself."""
        return WIDE if fronts <= self._processors else THREADS

    def _mark(self, slots: wp.array) -> None:
        """Mark the fronts that have to be worked on."""
        count, tiles = len(slots), self.tiles
        self._launch(
            kernels.begin_marks, (count, len(tiles.fronts)), [slots, self.bad], [self.marked]
        )
        self._launch(
            kernels.mark_changed,
            (count, threads_for(self.values.shape[1])),
            [slots, self._entry_front, self._parent, self.values],
            [self._known, self.marked, self.bad],
        )

    def solve(self, slots: wp.array, vectors: wp.array, lanes: int) -> None:
        """Solve in place for the listed slots, (m,) int32.

        Args:
            slots: Which.
            vectors: Right-hand sides, then solutions, (slots, lanes or more, n).
            lanes: How many of them, at most `LANES`.
        """
        self._sequences(self._solve, slots, vectors, lanes)

    def _solve(self, slots: wp.array, vectors: wp.array, lanes: int) -> None:
        tiles = self.tiles
        self._loaded.zero_()
        plan = [self._row_links, self._children, self._rows_in_child]
        for level in range(tiles.levels):
            if level in self._small:
                self._over_small_fronts(
                    solve_kernels.solve_small_fronts, level, slots, plan,
                    [lanes, vectors, self._panels], [self._begun, self._half],
                )  # fmt: skip
                continue
            self._over_fronts(
                solve_kernels.gather_loads, level, slots, plan, [lanes, vectors],
                [self._begun, self._loaded],
            )  # fmt: skip
            for step in self._steps[level]:
                place = [self._fronts, self._loaded]
                for listed, subtract, between in (
                    (step.own, 0, (self._begun, self._half)),
                    (step.below, 1, (self._half, self._begun)),
                ):
                    self._over_tiles(
                        solve_kernels.solve_rows, slots, listed, place, step.corner, subtract,
                        *between,
                    )  # fmt: skip
        for level in reversed(range(tiles.levels)):
            if level in self._small:
                self._over_small_fronts(
                    solve_kernels.answer_small_fronts, level, slots, [self._row_links],
                    [self._panels, self._half], [self._begun],
                )  # fmt: skip
                continue
            self._over_fronts(
                solve_kernels.gather_answers, level, slots, [self._row_links], [], [self._begun]
            )
            for step in reversed(self._steps[level]):
                for subtract, between in (
                    (1, (self._begun, self._half)),
                    (0, (self._half, self._begun)),
                ):
                    self._over_tiles(
                        solve_kernels.solve_columns, slots, step.own, [self._fronts], step.corner,
                        subtract, *between,
                    )  # fmt: skip
        self._launch(
            solve_kernels.scatter_solution,
            (len(slots), lanes, self.size),
            [slots, self._row_of, tiles.rows, self._begun],
            [vectors],
        )

    def _over_fronts(
        self,
        kernel: wp.Kernel,
        level: int,
        slots: wp.array,
        plan: list[Any],
        known: list[Any],
        out: list[Any],
    ) -> None:
        """Launch a kernel for every row of the fronts of a level."""
        first, last = self._front_begins[level : level + 2]
        self._launch(
            kernel,
            (len(slots), last - first, self._largest[level][1] * TILE),
            [slots, self._by_level, self._fronts, *plan, first, self.tiles.rows, *known],
            out,
        )

    def _over_small_fronts(
        self,
        kernel: wp.Kernel,
        level: int,
        slots: wp.array,
        plan: list[Any],
        known: list[Any],
        out: list[Any],
    ) -> None:
        """Launch a kernel with a block of threads for each front of a level."""
        first, last = self._front_begins[level : level + 2]
        count = (last - first) * len(slots)
        # As few for each as keep all processors busy: in a small block none waits for long.
        block = next((few for few in (64, 128) if few * count > FILLED * self._processors), THREADS)
        self._launch(
            kernel,
            (last - first, len(slots), block),
            [slots, self._by_level, self._fronts, *plan, first, self.tiles.rows,
             self.tiles.panel_tiles, *known],
            out,
            block=block,
        )  # fmt: skip

    def _over_tiles(
        self,
        kernel: wp.Kernel,
        slots: wp.array,
        listed: tuple[int, int],
        plan: list[Any],
        corner: int,
        subtract: int,
        source: wp.array,
        out: wp.array,
    ) -> None:
        """Launch a kernel for listed rows or columns of tiles."""
        tiles, (first, last) = self.tiles, listed
        self._launch(
            kernel,
            (len(slots), last - first, TILE * PARTS),
            [slots, self._tile_rows, *plan, first, corner, subtract, tiles.panel_tiles,
             tiles.rows, self._panels, source],
            [out],
        )  # fmt: skip

    def _plan_entries(self, indptr: NDArray[Any], indices: NDArray[Any]) -> None:
        """Which of the matrix's entries stands at which place of the tiles that have any.

        A place takes one entry, or none (-1), or a one (-2): on the diagonal where it is padding.
        """
        tiles, tree = self.tiles, self.tiles.tree
        new = np.empty(self.size, np.int64)
        new[tree.order] = np.arange(self.size)
        rows = np.repeat(np.arange(self.size), np.diff(indptr))
        low, high = np.minimum(new[rows], new[indices]), np.maximum(new[rows], new[indices])
        own = np.array([front.last - front.first for front in tree.fronts], np.int64)
        front = np.repeat(np.arange(len(own)), own)[low]
        tile, within = np.empty(len(low), np.int64), np.empty(len(low), np.int64)
        order = np.argsort(front, kind="stable")
        begins = np.searchsorted(front[order], np.arange(len(own) + 1))
        for k, one in enumerate(tree.fronts):
            mine = order[begins[k] : begins[k + 1]]
            column, row = low[mine] - one.first, tiles.rows_in(k, high[mine])
            tile[mine] = tiles.row_tile(k, row // TILE) + column // TILE
            within[mine] = row % TILE * TILE + column % TILE
        some, number = np.unique(tile, return_inverse=True)
        sources_at = np.full(tiles.panel_tiles, -1, np.int64)
        sources_at[some] = np.arange(len(some))
        sources = np.full((len(some), TILE**2), -1, np.int32)
        sources[number, within] = np.arange(len(low))
        for k, o in enumerate(tiles.own_tiles):
            last = sources[sources_at[tiles.row_tile(k, o - 1) + o - 1]]
            last[(TILE + 1) * np.arange(own[k] - (o - 1) * TILE, TILE)] = -2
        self._entry_front = self._ints(front)
        self._sources_at, self._sources = self._ints(sources_at), self._ints(sources.ravel())

    def _plan_factor(self) -> None:
        """Tiles of the shares, level after level."""
        tiles, products = self.tiles, []
        for k in np.argsort(tiles.level, kind="stable"):
            row, column = np.tril_indices(int(tiles.border_tiles[k]))
            # Neighbours share rows of the panel: eight tiles have six rows.
            near = np.lexsort((column, row, column // 2, row // 4))
            same = np.full(len(row), 1)
            rows = (k * same, row[near], column[near], tiles.level[k] * same)
            products.append(np.stack(rows, axis=1))
        found = np.concatenate(products)
        levels = np.arange(tiles.levels + 1)
        self._product_begins = np.searchsorted(found[:, 3], levels).tolist()
        self._products = self._ints(found[:, :3])

    def _plan_solve(self) -> None:
        """Fronts, level after level, and what their rows stand for."""
        tiles, tree = self.tiles, self.tiles.tree
        # In a level fronts with many tiles come first, so that none of them ends alone.
        order = np.lexsort((-tiles.fronts[:, 0] * tiles.fronts[:, 1], tiles.level))
        self._by_level = self._ints(order)
        levels = np.arange(tiles.levels + 1)
        self._front_begins = np.searchsorted(tiles.level[order], levels).tolist()
        self._plan_steps(order)
        own_row = np.empty(self.size, np.int64)  # of an unknown, in order of elimination
        links = np.full(tiles.rows, -1, np.int64)
        for k, front in enumerate(tree.fronts):
            rows = tiles.fronts[k, 6] + np.arange(front.last - front.first)
            own_row[front.first : front.last] = rows
            links[rows] = tree.order[front.first : front.last]
        for k, front in enumerate(tree.fronts):
            begin = tiles.fronts[k, 6] + tiles.own_tiles[k] * TILE
            links[begin : begin + len(front.border)] = own_row[front.border]
        row_of = np.empty(self.size, np.int64)
        row_of[tree.order] = own_row
        self._row_links, self._row_of = self._ints(links), self._ints(row_of)

    def _plan_steps(self, order: Ints) -> None:
        """Rows of tiles of each step, of all fronts of its level: its triangle's, and below."""
        tiles, found, triangles, end = self.tiles, [], [], 0
        own, rows = tiles.fronts[order, 0], tiles.fronts[order, 1]

        def rows_of(begins: Ints, ends: Ints, fronts: Ints) -> tuple[int, int]:
            nonlocal end
            counts = ends - begins
            within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            row = np.repeat(begins, counts) + within
            found.append(np.stack((np.repeat(fronts, counts), row), axis=1))
            end += len(row)
            return end - len(row), end

        self._steps: list[list[_Step]] = []
        for first, last in pairwise(self._front_begins):
            steps = []
            for corner in range(0, own[first:last].max(), INVERTED):
                some = np.arange(first, last)[own[first:last] > corner]
                after = np.minimum(corner + INVERTED, own[some])
                begins = np.full(len(some), corner)
                more = after - corner > 1  # a single tile is inverted as it is
                triangles.append(np.stack((order[some], begins), axis=1)[more])
                steps.append(
                    _Step(
                        corner,
                        rows_of(begins, after, order[some]),
                        rows_of(after, rows[some], order[some]),
                    )
                )
            self._steps.append(steps)
        self._tile_rows = self._ints(np.concatenate(found))
        self._triangles = self._ints(np.concatenate(triangles))

    def _ints(self, values: NDArray[Any]) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=self._device)
