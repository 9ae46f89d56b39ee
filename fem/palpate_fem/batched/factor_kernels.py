# mypy: ignore-errors
"""Kernels of the batched multifrontal factor: fronts in square tiles.

A front is a dense lower triangle of tiles: its own columns first, padded to whole tiles with ones
on the diagonal, then its border, padded with zeros. The tiles of its own columns are the *panel*,
those of border and border the *share* for its parent. A diagonal tile of a factorised panel holds
the inverse of its Cholesky factor.

Only marked fronts of a slot are worked on: those of which an entry has changed since they were
factorised, and all above them. Nothing is added by atomics, so results depend neither on the order
of the threads nor on which fronts are marked.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched import dense_tiles
from palpate_fem.batched.dense_tiles import THREADS, TILE

GATHERED = 8
"""Entries of a tile that one thread gathers: all at once, so that none waits for another."""

EVERY = wp.constant(TILE // GATHERED)

Entries = wp.types.vector(length=GATHERED, dtype=wp.float64)

wp.set_module_options({"enable_backward": False})


@wp.func
def lower_tile(row: int, column: int):
    """Place of a tile in a lower triangle that is stored row by row."""
    return row * (row + 1) // 2 + column


@wp.kernel
def begin_marks(
    slots: wp.array(dtype=wp.int32),
    bad: wp.array(dtype=wp.int32),
    marked_out: wp.array2d(dtype=wp.int32),
):
    """Mark all fronts of the listed slots whose last factorisation failed, and none of others."""
    i, front = wp.tid()
    marked_out[slots[i], front] = bad[slots[i]]


@wp.kernel
def clear(slots: wp.array(dtype=wp.int32), bad_out: wp.array(dtype=wp.int32)):
    """Call the listed matrices good."""
    bad_out[slots[wp.tid()]] = 0


@wp.kernel
def mark_changed(
    slots: wp.array(dtype=wp.int32),
    front_of: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    values_in: wp.array2d(dtype=wp.float64),
    known: wp.array2d(dtype=wp.float64),
    marked: wp.array2d(dtype=wp.int32),
):
    """Mark the fronts of entries that are not what they were, and all above; remember the entries.

    Whoever finds a front marked may stop there: who marked it goes on upwards.
    """
    i, k = wp.tid()
    slot = slots[i]
    value = values_in[slot, k]
    if value != known[slot, k]:
        known[slot, k] = value
        front = front_of[k]
        while front >= 0 and marked[slot, front] == 0:
            marked[slot, front] = 1
            front = parent[front]


@wp.kernel
def gather_shares(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    tile_front: wp.array(dtype=wp.int32),
    tile_row: wp.array(dtype=wp.int32),
    tile_column: wp.array(dtype=wp.int32),
    tile_place: wp.array(dtype=wp.int32),
    sharing_begin: wp.array(dtype=wp.int32),
    sharing_end: wp.array(dtype=wp.int32),
    sharing: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    share_tiles: int,
    panels: wp.array3d(dtype=wp.float64),
    shares: wp.array3d(dtype=wp.float64),
):
    """Set tiles to what the children's shares add up to, and ones where columns are padding.

    ``sharing`` lists, tile after tile, the children with rows and columns in it. A thread has one
    column of a tile, and every `EVERY`-th row of it. ``fronts`` is that of `FrontTiles`.
    """
    i, number, thread = wp.tid()
    slot = slots[i]
    work = first + number
    front = tile_front[work]
    if marked[slot, front] != 0:
        top = tile_row[work] * TILE + thread // TILE
        column = tile_column[work] * TILE + thread % TILE
        total = Entries()
        for j in range(GATHERED):
            row = top + j * EVERY
            if row == column and row >= fronts[front, 0] and row < fronts[front, 1] * TILE:
                total[j] = wp.float64(1.0)
        for k in range(sharing_begin[work], sharing_end[work]):
            child = sharing[k]
            place = fronts[child, 5]
            tile = slot * share_tiles + fronts[child, 4]
            b = rows_in_child[place + column]
            if b >= 0:
                for j in range(GATHERED):
                    a = rows_in_child[place + top + j * EVERY]
                    low = wp.min(wp.max(a, 0), b)
                    high = wp.max(a, b)
                    at = tile + lower_tile(high // TILE, low // TILE)
                    value = shares[at, high % TILE, low % TILE]
                    if a >= 0:
                        total[j] += value
        at = slot * panel_tiles + tile_place[work]
        if tile_column[work] < fronts[front, 1]:
            for j in range(GATHERED):
                panels[at, thread // TILE + j * EVERY, thread % TILE] = total[j]
        else:
            at = slot * share_tiles + tile_place[work]
            for j in range(GATHERED):
                shares[at, thread // TILE + j * EVERY, thread % TILE] = total[j]


@wp.kernel
def add_entries(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    front: wp.array(dtype=wp.int32),
    source: wp.array(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    values_in: wp.array2d(dtype=wp.float64),
    panels: wp.array3d(dtype=wp.float64),
):
    """Add the matrix's entries; each place of a panel takes one."""
    i, number = wp.tid()
    slot = slots[i]
    entry = source[first + number]
    if marked[slot, front[entry]] != 0:
        at = place[first + number]
        tile = slot * panel_tiles + at // (TILE * TILE)
        within = at % (TILE * TILE)
        panels[tile, within // TILE, within % TILE] += values_in[slot, entry]


@wp.kernel(launch_bounds=(THREADS, 2))
def factorise_panels(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    threads: int,
    panels: wp.array3d(dtype=wp.float64),
    bad: wp.array(dtype=wp.int32),
):
    """Factorise the own columns of fronts: a block of threads for each."""
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    if marked[slot, front] != 0:
        panel = slot * panel_tiles + fronts[front, 7]
        own = fronts[front, 1]
        rows = fronts[front, 8]
        dense_tiles.factorise_panel(panels, panel, own, rows, slot, bad, thread, threads)


@wp.kernel(launch_bounds=(THREADS, 2))
def subtract_products(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    works: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    share_tiles: int,
    panels: wp.array3d(dtype=wp.float64),
    shares: wp.array3d(dtype=wp.float64),
):
    """Subtract the product of two rows of the panel from a tile of the share: two warps for each.

    A row of ``works``: the front, the tile, both rows' first tiles, and how many tiles they have.
    """
    i, number, thread = wp.tid()
    slot = slots[i]
    work = first + number
    if marked[slot, works[work, 0]] != 0:
        tile = slot * share_tiles + works[work, 1]
        left = slot * panel_tiles + works[work, 2]
        right = slot * panel_tiles + works[work, 3]
        own = works[work, 4]
        dense_tiles.subtract_product(panels, left, right, own, shares, tile, thread)
