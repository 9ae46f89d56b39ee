"""Cholesky factors of many matrices of one pattern at once: multifrontal, in tiles, on a GPU.

The elimination tree is that of the CPU's solver (``ordering``). Its fronts are worked on level by
level, leaves first, for all listed matrices together. Double precision, and no pivoting: a matrix
that is not positive definite is reported (ADR 0026).

A front whose entries, and whose children, are what they were at the last factorisation is left as
it is. Where only contact has changed, that is most of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.batched import factor_kernels as kernels
from palpate_fem.batched import solve_kernels
from palpate_fem.batched.dense_tiles import LANES, THREADS, TILE
from palpate_fem.batched.factor_kernels import GATHERED
from palpate_fem.batched.launches import Launches
from palpate_fem.sparse.ordering import EliminationTree, Ints, plan_elimination


class FrontTiles:
    """Where everything is in tiles; the same for every matrix.

    Attributes:
        tree: Order and fronts.
        level: Of each front; leaves have 0.
        panel_tiles: Tiles of all panels of one matrix.
        share_tiles: Tiles of all shares of one matrix.
        rows: Rows of all fronts, own and border, for one right-hand side.
        fronts: A row for each front: own unknowns, own tiles, begin and end of its children, begin
            of its shares, of its rows in its parent, of its rows in a vector, and of its panel,
            and how many rows of tiles it has.
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
        self.panel_tiles, self.share_tiles = int(panel.sum()), int(share.sum())
        self.rows = int(((o + b) * TILE).sum())
        self.level = np.zeros(count, np.int64)
        for k in range(count):  # children stand before parents
            if self.parent[k] >= 0:
                self.level[self.parent[k]] = max(self.level[self.parent[k]], self.level[k] + 1)
        self.levels = int(self.level.max(initial=-1)) + 1
        self.children = np.argsort(self.parent, kind="stable")
        begins = np.searchsorted(self.parent[self.children], np.arange(count + 1))
        self.fronts = np.zeros((count, 9), np.int64)
        self.fronts[:, 0], self.fronts[:, 1] = own, o
        self.fronts[:, 2], self.fronts[:, 3] = begins[:-1], begins[1:]
        self.fronts[:, 4] = np.cumsum(share) - share
        self.fronts[:, 6] = np.cumsum((o + b) * TILE) - (o + b) * TILE
        self.fronts[:, 7] = np.cumsum(panel) - panel
        self.fronts[:, 8] = o + b
        self._match_children(count)
        products = o * (o - 1) * (o + 1) // 6 + o * (o + 1) // 2  # of the own triangle
        products += b * o * (o + 1) // 2 + share * o
        self.gflop = float(products.sum()) * 2.0 * TILE**3 / 1e9

    def _match_children(self, count: int) -> None:
        """For each front, where each padded row of its parent is in its border; -1 = nowhere."""
        found, begin = [], 0
        for k, front in enumerate(self.tree.fronts):
            self.fronts[k, 5] = begin
            if front.parent < 0:
                continue
            rows = np.full((self.own_tiles + self.border_tiles)[front.parent] * TILE, -1, np.int64)
            rows[self.rows_in(front.parent, front.border)] = np.arange(len(front.border))
            found.append(rows)
            begin += len(rows)
        self.rows_in_child = np.concatenate(found or [np.zeros(0, np.int64)])

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
        return np.asarray(self.fronts[k, 7] + np.where(row < o, own, below))


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
    ) -> None:
        """Plan the elimination and make room.

        Args:
            indptr: Upper triangle in CSR, every diagonal entry present.
            indices: Its columns, sorted.
            groups: Node of each unknown, (n,).
            slots: Number of matrices.
            device: A Warp device.
        """
        tiles = FrontTiles(
            plan_elimination(np.asarray(indptr), np.asarray(indices), np.asarray(groups))
        )
        self.tiles, self.slots, self.size, self._device = tiles, slots, len(indptr) - 1, device
        self.values = wp.zeros((slots, len(indices)), dtype=wp.float64, device=device)
        # No number is what it was before the first factorisation.
        self._known = wp.full((slots, len(indices)), np.nan, dtype=wp.float64, device=device)
        self._launch = Launches(device)
        self.bad = wp.zeros(slots, dtype=wp.int32, device=device)
        self._loaded = wp.zeros((slots, len(tiles.fronts)), dtype=wp.int32, device=device)
        self.marked = wp.zeros((slots, len(tiles.fronts)), dtype=wp.int32, device=device)
        square = (TILE, TILE)
        self._panels = wp.zeros(
            (slots * tiles.panel_tiles, *square), dtype=wp.float64, device=device
        )
        self._shares = wp.zeros(
            (slots * tiles.share_tiles, *square), dtype=wp.float64, device=device
        )
        self._work = wp.zeros((slots * tiles.rows, LANES), dtype=wp.float64, device=device)
        self._fronts = self._ints(tiles.fronts)
        self._children = self._ints(tiles.children)
        self._rows_in_child = self._ints(tiles.rows_in_child)
        self._parent = self._ints(tiles.parent)
        self._plan_tiles()
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
            "mib_a_slot": 8.0 * (stored * TILE**2 + tiles.rows * LANES) / 2**20,
        }

    def factorise(self, slots: wp.array) -> None:
        """Factorise the matrices of the listed slots, (m,) int32; others keep their factors."""
        count, tiles = len(slots), self.tiles
        self._mark(slots)
        sizes = [tiles.panel_tiles, tiles.share_tiles]
        both = [self._panels, self._shares]
        for level in range(tiles.levels):
            first, last = self._tile_begins[level : level + 2]
            self._launch(
                kernels.gather_shares,
                (count, last - first, TILE * TILE // GATHERED),
                [slots, self.marked, *self._tile_arrays, self._fronts, self._rows_in_child, first,
                 *sizes],
                both,
            )  # fmt: skip
            first, last = self._entry_begins[level : level + 2]
            self._launch(
                kernels.add_entries,
                (count, last - first),
                [slots, self.marked, self._entry_front, self._source, self._place, first,
                 tiles.panel_tiles, self.values],
                [self._panels],
            )  # fmt: skip
            first, last = self._front_begins[level : level + 2]
            self._launch(
                kernels.factorise_panels,
                (count, last - first, THREADS),
                [slots, self.marked, self._by_level, self._fronts, first, tiles.panel_tiles,
                 THREADS],
                [self._panels, self.bad],
            )  # fmt: skip
            first, last = self._product_begins[level : level + 2]
            self._launch(
                kernels.subtract_products,
                (count, last - first, 2 * TILE),
                [slots, self.marked, self._products, first, *sizes],
                both,
            )

    def _mark(self, slots: wp.array) -> None:
        """Mark the fronts that have to be worked on."""
        count, tiles = len(slots), self.tiles
        self._launch(
            kernels.begin_marks, (count, len(tiles.fronts)), [slots, self.bad], [self.marked]
        )
        self._launch(kernels.clear, count, [slots], [self.bad])
        self._launch(
            kernels.mark_changed,
            (count, self.values.shape[1]),
            [slots, self._entry_front, self._parent, self.values],
            [self._known, self.marked],
        )

    def solve(self, slots: wp.array, vectors: wp.array, lanes: int) -> None:
        """Solve in place for the listed slots, (m,) int32.

        Args:
            slots: Which.
            vectors: Right-hand sides, then solutions, (slots, lanes or more, n).
            lanes: How many of them, at most `LANES`.
        """
        count, tiles = len(slots), self.tiles
        place = [tiles.panel_tiles, tiles.rows, THREADS]
        self._launch(
            solve_kernels.forget_loads, (count, len(tiles.fronts)), [slots], [self._loaded]
        )
        for level in range(tiles.levels):
            first, last = self._row_begins[level : level + 2]
            self._launch(
                solve_kernels.gather_right,
                (count, last - first, LANES),
                [slots, *self._row_arrays, self._fronts, self._children, self._rows_in_child,
                 first, tiles.rows, lanes, vectors],
                [self._work, self._loaded],
            )  # fmt: skip
            first, last = self._front_begins[level : level + 2]
            self._launch(
                solve_kernels.substitute_forward,
                (count, last - first, THREADS),
                [slots, self._by_level, self._fronts, first, *place, self._loaded],
                [self._panels, self._work],
            )
        for level in reversed(range(tiles.levels)):
            first, last = self._border_begins[level : level + 2]
            self._launch(
                solve_kernels.gather_border,
                (count, last - first, LANES),
                [slots, self._border_place, self._border_source, first, tiles.rows],
                [self._work],
            )
            first, last = self._front_begins[level : level + 2]
            self._launch(
                solve_kernels.substitute_backward,
                (count, last - first, THREADS),
                [slots, self._by_level, self._fronts, first, *place],
                [self._panels, self._work],
            )
        self._launch(
            solve_kernels.scatter_solution,
            (count, lanes, self.size),
            [slots, self._row_of, tiles.rows, self._work],
            [vectors],
        )

    def _plan_tiles(self) -> None:
        """All tiles of all fronts, level after level, and the children that share in each."""
        tiles = self.tiles
        parts, sharing = [], []
        for k in range(len(tiles.fronts)):
            o, b = int(tiles.own_tiles[k]), int(tiles.border_tiles[k])
            rows, columns = np.tril_indices(o + b)
            place = tiles.row_tile(k, rows) + columns
            share = columns >= o
            r, c = rows[share] - o, columns[share] - o
            place[share] = tiles.fronts[k, 4] + r * (r + 1) // 2 + c
            children = tiles.children[tiles.fronts[k, 2] : tiles.fronts[k, 3]]
            begins = tiles.fronts[children, 5, None] + np.arange((o + b) * TILE)
            known = (tiles.rows_in_child[begins] >= 0).reshape(len(children), o + b, TILE).any(2)
            tile, child = np.nonzero((known[:, rows] & known[:, columns]).T)
            parts.append(np.stack((np.full(len(rows), k), rows, columns, place)))
            sharing.append((np.bincount(tile, minlength=len(rows)), children[child]))
        found = np.concatenate(parts, axis=1)
        level = tiles.level[found[0]]
        order = np.argsort(level, kind="stable")
        self._tile_begins = np.searchsorted(level[order], np.arange(tiles.levels + 1)).tolist()
        counts = np.concatenate([count for count, _ in sharing])
        ends = np.cumsum(counts)
        begin = ends - counts
        numbers = [*found[:, order], begin[order], ends[order]]
        self._tile_arrays = [self._ints(row) for row in numbers]
        self._tile_arrays.append(self._ints(np.concatenate([child for _, child in sharing])))

    def _plan_entries(self, indptr: NDArray[Any], indices: NDArray[Any]) -> None:
        """Places of the matrix's entries, level after level; both sides of diagonal tiles."""
        tiles, tree = self.tiles, self.tiles.tree
        new = np.empty(self.size, np.int64)
        new[tree.order] = np.arange(self.size)
        rows = np.repeat(np.arange(self.size), np.diff(indptr))
        low, high = (
            np.minimum(new[rows], new[indices]),
            np.maximum(new[rows], new[indices]),
        )
        own = tiles.fronts[:, 0]
        front = np.repeat(np.arange(len(own)), own)[low]
        source, place, level = [], [], []
        order = np.argsort(front, kind="stable")
        begins = np.searchsorted(front[order], np.arange(len(own) + 1))
        for k, one in enumerate(tree.fronts):
            mine = order[begins[k] : begins[k + 1]]
            column, row = low[mine] - one.first, tiles.rows_in(k, high[mine])
            tile = tiles.row_tile(k, row // TILE) + column // TILE
            at = tile * TILE**2 + row % TILE * TILE + column % TILE
            twin = (row // TILE == column // TILE) & (row != column)
            mirrored = tile[twin] * TILE**2 + column[twin] % TILE * TILE + row[twin] % TILE
            source.append(np.concatenate((mine, mine[twin])))
            place.append(np.concatenate((at, mirrored)))
            level.append(np.full(len(source[-1]), tiles.level[k]))
        levels = np.concatenate(level)
        order = np.argsort(levels, kind="stable")
        self._entry_begins = np.searchsorted(levels[order], np.arange(tiles.levels + 1)).tolist()
        self._entry_front = self._ints(front)
        self._source = self._ints(np.concatenate(source)[order])
        self._place = self._ints(np.concatenate(place)[order])

    def _plan_factor(self) -> None:
        """Tiles of the shares, level after level."""
        tiles, products = self.tiles, []
        for k in np.argsort(tiles.level, kind="stable"):
            o, b = int(tiles.own_tiles[k]), int(tiles.border_tiles[k])
            first = tiles.row_tile(k, np.arange(o + b))
            row, column = np.tril_indices(b)
            # Neighbours share rows of the panel: eight tiles have six rows.
            near = np.lexsort((column, row, column // 2, row // 4))
            row, column = row[near], column[near]
            place = tiles.fronts[k, 4] + row * (row + 1) // 2 + column
            same = np.full(len(row), 1)
            rows = (
                k * same,
                place,
                first[o + row],
                first[o + column],
                o * same,
                tiles.level[k] * same,
            )
            products.append(np.stack(rows, axis=1))
        found = np.concatenate(products)
        levels = np.arange(tiles.levels + 1)
        self._product_begins = np.searchsorted(found[:, 5], levels).tolist()
        self._products = self._ints(found[:, :5])

    def _plan_solve(self) -> None:
        """Rows of the fronts, level after level, and where their solutions come from."""
        tiles, tree = self.tiles, self.tiles.tree
        own_row = np.empty(self.size, np.int64)  # of an unknown, in order of elimination
        for k, front in enumerate(tree.fronts):
            begin = tiles.fronts[k, 6]
            own_row[front.first : front.last] = begin + np.arange(front.last - front.first)
        row_of = np.empty(self.size, np.int64)
        row_of[tree.order] = own_row
        self._row_of = self._ints(row_of)
        order = np.argsort(tiles.level, kind="stable")
        self._by_level = self._ints(order)
        levels = np.arange(tiles.levels + 1)
        self._front_begins = np.searchsorted(tiles.level[order], levels).tolist()
        rows, borders = [], []
        for k in order:
            front = tree.fronts[k]
            level, o, b = int(tiles.level[k]), int(tiles.own_tiles[k]), int(tiles.border_tiles[k])
            begin, size = int(tiles.fronts[k, 6]), (o + b) * TILE
            unknown = np.full(size, -1, np.int64)
            unknown[: front.last - front.first] = tree.order[front.first : front.last]
            rows.append(
                np.stack((np.full(size, k), np.arange(size), unknown, np.full(size, level)))
            )
            source = np.full(b * TILE, -1, np.int64)
            source[: len(front.border)] = own_row[front.border]
            at = begin + o * TILE + np.arange(b * TILE)
            borders.append(np.stack((at, source, np.full(b * TILE, level))))
        found, far = np.concatenate(rows, axis=1), np.concatenate(borders, axis=1)
        self._row_begins = np.searchsorted(found[3], levels).tolist()
        self._row_arrays = [self._ints(row) for row in found[:3]]
        self._border_begins = np.searchsorted(far[2], levels).tolist()
        self._border_place, self._border_source = self._ints(far[0]), self._ints(far[1])

    def _ints(self, values: NDArray[Any]) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=self._device)
