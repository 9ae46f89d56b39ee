# mypy: ignore-errors
"""Kernels of the batched multifrontal factor: fronts in square tiles.

A front is a dense lower triangle of tiles: its own columns first, padded to whole tiles with ones
on the diagonal, then its border, padded with zeros. The tiles of its own columns are the *panel*,
those of border and border the *share* for its parent. Triangles on the diagonal of a factorised
panel, `INVERTED` tiles wide, hold the inverses of those of its Cholesky factor, so that their rows
do not wait for each other when it is solved with.

Only marked fronts of a slot are worked on: those of which an entry has changed since they were
factorised, and all above them. Nothing is added by atomics, so results depend neither on the order
of the threads nor on which fronts are marked.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched import dense_panels, dense_tiles
from palpate_fem.batched.dense_tiles import THREADS, WIDE
from palpate_fem.batched.kernels import ENTRIES, Entries, place_of

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
def mark_changed(
    slots: wp.array(dtype=wp.int32),
    front_of: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    values_in: wp.array2d(dtype=wp.float32),
    known: wp.array2d(dtype=wp.float32),
    marked: wp.array2d(dtype=wp.int32),
    bad_out: wp.array(dtype=wp.int32),
):
    """Mark the fronts of entries that are not what they were, and all above; remember the entries.

    Whoever finds a front marked may stop there: who marked it goes on upwards. All listed matrices
    are called good until they are factorised.
    """
    i, thread = wp.tid()
    slot = slots[i]
    if thread == 0:
        bad_out[slot] = 0
    count = values_in.shape[1]
    held = Entries()
    changed = wp.int32(0)
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            held[n] = wp.float64(values_in[slot, k])
            if values_in[slot, k] != known[slot, k]:
                changed |= 1 << n
    for n in range(wp.static(ENTRIES)):
        if (changed >> n) & 1 != 0:
            k = place_of(thread, n, count)
            known[slot, k] = wp.float32(held[n])
            front = front_of[k]
            while front >= 0 and marked[slot, front] == 0:
                marked[slot, front] = 1
                front = parent[front]


@wp.kernel(launch_bounds=(WIDE, 1))
def factorise_panels(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    sources_at: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    share_tiles: int,
    values_in: wp.array2d(dtype=wp.float32),
    shares_in: wp.array3d(dtype=wp.float32),
    panels: wp.array3d(dtype=wp.float32),
    bad: wp.array(dtype=wp.int32),
):
    """Gather and factorise the own columns of fronts: a block of threads for each.

    One front of all slots after another, so that they find the same numbers of places in caches.
    """
    number, i, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    if marked[slot, front] != 0:
        own = fronts[front, 0]
        rows = fronts[front, 1]
        child = fronts[front, 2]
        last_child = fronts[front, 3]
        first_tile = fronts[front, 4]
        panel = slot * panel_tiles + first_tile
        first_share = slot * share_tiles
        dense_panels.factorise_panel(
            children, rows_in_child, child, last_child, first_share, shares_in, sources_at,
            sources, first_tile, values_in, slot, panels, panel, own, rows, bad, thread,
        )  # fmt: skip


@wp.kernel(launch_bounds=(THREADS, 2))
def begin_panels(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    sources_at: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    first: int,
    width: int,
    panel_tiles: int,
    share_tiles: int,
    values_in: wp.array2d(dtype=wp.float32),
    shares_in: wp.array3d(dtype=wp.float32),
    panels_in: wp.array3d(dtype=wp.float32),
    room: int,
    unfinished: wp.array3d(dtype=wp.float64),
):
    """Gather the own columns of fronts, at most ``width`` of tiles: two warps for a tile."""
    number, i, tile, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    own = fronts[front, 0]
    r = tile // width
    c = tile % width
    if marked[slot, front] != 0 and c < own and c <= r and r < fronts[front, 1]:
        first_tile = fronts[front, 4]
        dense_panels.begin_tile(
            children, rows_in_child, fronts[front, 2], fronts[front, 3], slot * share_tiles,
            shares_in, sources_at, sources, first_tile, values_in, slot,
            panels_in, slot * panel_tiles + first_tile, own, r, c,
            unfinished, (number * slots.shape[0] + i) * room, thread,
        )  # fmt: skip


@wp.kernel(launch_bounds=(THREADS, 1))
def divide_columns(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    column: int,
    parts: int,
    panel_tiles: int,
    room: int,
    unfinished_in: wp.array3d(dtype=wp.float64),
    panels: wp.array3d(dtype=wp.float32),
    bad: wp.array(dtype=wp.int32),
):
    """Factorise the diagonal tile of a column of fronts, and divide by it what is below."""
    number, i, part, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    own = fronts[front, 0]
    if marked[slot, front] != 0 and column < own:
        panel = slot * panel_tiles + fronts[front, 4]
        dense_panels.divide_column(
            panels, panel, own, fronts[front, 1], column,
            unfinished_in, (number * slots.shape[0] + i) * room,
            part, parts, slot, bad, thread,
        )  # fmt: skip


@wp.kernel(launch_bounds=(THREADS, 2))
def subtract_columns(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    column: int,
    width: int,
    panel_tiles: int,
    panels_in: wp.array3d(dtype=wp.float32),
    room: int,
    unfinished: wp.array3d(dtype=wp.float64),
):
    """Subtract a column's products from the columns after it: two warps for a tile."""
    number, i, tile, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    own = fronts[front, 0]
    left = width - column - 1
    r = column + 1 + tile // left
    j = column + 1 + tile % left
    if marked[slot, front] != 0 and j < own and j <= r and r < fronts[front, 1]:
        dense_panels.subtract_column(
            panels_in, slot * panel_tiles + fronts[front, 4], own, column, r, j,
            unfinished, (number * slots.shape[0] + i) * room, thread,
        )  # fmt: skip


@wp.kernel(launch_bounds=(THREADS, 3))
def subtract_products(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    works: wp.array2d(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    share_tiles: int,
    panels_in: wp.array3d(dtype=wp.float32),
    shares: wp.array3d(dtype=wp.float32),
):
    """Set tiles of shares to what the children's shares add up to, less the product of two rows.

    Two warps for each. A row of ``works``: the front, and the tile's row and column in the share.
    """
    i, number, thread = wp.tid()
    slot = slots[i]
    front = works[first + number, 0]
    if marked[slot, front] != 0:
        row = works[first + number, 1]
        column = works[first + number, 2]
        own = fronts[front, 0]
        child = fronts[front, 2]
        last_child = fronts[front, 3]
        border = slot * panel_tiles + fronts[front, 4] + lower_tile(own, 0)
        first_share = slot * share_tiles
        tile = first_share + fronts[front, 5] + lower_tile(row, column)
        dense_tiles.subtract_product(
            children, rows_in_child, child, last_child, first_share,
            panels_in, border + row * own, border + column * own, own,
            shares, tile, own + row, own + column, thread,
        )  # fmt: skip


@wp.kernel(launch_bounds=(THREADS, 2))
def invert_triangles(
    slots: wp.array(dtype=wp.int32),
    marked: wp.array2d(dtype=wp.int32),
    listed: wp.array2d(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    panel_tiles: int,
    panels: wp.array3d(dtype=wp.float32),
):
    """Invert triangles on the diagonals of fronts; ``listed`` has the front and the first tile."""
    number, i, thread = wp.tid()
    slot = slots[i]
    front = listed[number, 0]
    corner = listed[number, 1]
    if marked[slot, front] != 0:
        own = fronts[front, 0]
        dense_panels.invert_triangle(
            panels, slot * panel_tiles + fronts[front, 4], own, corner,
            dense_tiles.end_of(corner, own), thread,
        )  # fmt: skip
