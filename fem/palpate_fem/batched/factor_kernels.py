# mypy: ignore-errors
"""Kernels of the batched multifrontal factor: square tiles, one block of threads each.

A front is a dense lower triangle of tiles: its own columns first, padded to whole tiles with ones
on the diagonal, then its border, padded with zeros. The tiles of its own columns are the *panel*,
those of border and border the *share* for its parent. A diagonal tile of a factorised panel holds
the inverse of its Cholesky factor.

Nothing is added by atomics, so results do not depend on the order of the threads.
"""

from __future__ import annotations

import warp as wp

TILE = 32
"""Rows and columns of a tile."""

LANES = 2
"""Right-hand sides that are solved for together."""

wp.set_module_options({"enable_backward": False})


@wp.func
def lower_tile(row: int, column: int):
    """Place of a tile in a lower triangle that is stored row by row."""
    return row * (row + 1) // 2 + column


@wp.kernel
def clear(slots: wp.array(dtype=wp.int32), bad_out: wp.array(dtype=wp.int32)):
    """Call the listed matrices good."""
    bad_out[slots[wp.tid()]] = 0


@wp.kernel
def gather_shares(
    slots: wp.array(dtype=wp.int32),
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

    ``sharing`` lists, tile after tile, the children with rows and columns in it.

    ``fronts`` has a row for each: own unknowns, own tiles, begin and end of its children, begin of
    its shares, begin of its rows in its parent (see `FrontTiles`).
    """
    i, number, entry = wp.tid()
    slot = slots[i]
    work = first + number
    front = tile_front[work]
    row = tile_row[work] * TILE + entry // TILE
    column = tile_column[work] * TILE + entry % TILE
    total = wp.float64(0.0)
    if row == column and row >= fronts[front, 0] and row < fronts[front, 1] * TILE:
        total = wp.float64(1.0)
    for k in range(sharing_begin[work], sharing_end[work]):
        child = sharing[k]
        a = rows_in_child[fronts[child, 5] + row]
        b = rows_in_child[fronts[child, 5] + column]
        if a >= 0 and b >= 0:
            low = wp.min(a, b)
            high = wp.max(a, b)
            tile = slot * share_tiles + fronts[child, 4] + lower_tile(high // TILE, low // TILE)
            total += shares[tile, high % TILE, low % TILE]
    place = tile_place[work]
    if tile_column[work] < fronts[front, 1]:
        panels[slot * panel_tiles + place, entry // TILE, entry % TILE] = total
    else:
        shares[slot * share_tiles + place, entry // TILE, entry % TILE] = total


@wp.kernel
def add_entries(
    slots: wp.array(dtype=wp.int32),
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
    at = place[first + number]
    tile = slot * panel_tiles + at // (TILE * TILE)
    within = at % (TILE * TILE)
    panels[tile, within // TILE, within % TILE] += values_in[slot, source[first + number]]


@wp.kernel
def factorise_diagonal(
    slots: wp.array(dtype=wp.int32),
    works: wp.array2d(dtype=wp.int32),
    first: int,
    column: int,
    panel_tiles: int,
    identity: wp.array2d(dtype=wp.float64),
    panels: wp.array3d(dtype=wp.float64),
    bad: wp.array(dtype=wp.int32),
):
    """Replace a diagonal tile by the inverse of its Cholesky factor.

    A row of ``works`` is a tile: place of its row's first tile and step to the next of them.
    """
    i, number = wp.tid()
    slot = slots[i]
    base = slot * panel_tiles
    work = first + number
    tile = base + works[work, 0]
    row = base + works[work, 1]
    total = wp.tile_load(panels[tile], shape=(TILE, TILE))
    for k in range(column):
        left = wp.tile_load(panels[row + k], shape=(TILE, TILE))
        wp.tile_matmul(left, wp.tile_transpose(left), total, alpha=wp.float64(-1.0))
    one = wp.tile_load(identity, shape=(TILE, TILE))
    lower = wp.tile_cholesky(total)
    good = wp.int32(1)
    sums = wp.tile_sum(wp.tile_map(wp.mul, lower, lower), axis=1)
    for k in range(TILE):
        pivot = lower[k, k]
        if not (pivot > wp.float64(0.0)) or not wp.isfinite(pivot):
            good = wp.int32(0)
        # What the row leaves of the diagonal: a Cholesky that has failed on CUDA may leave a
        # positive number there that is no pivot.
        rest = total[k, k] - sums[k] + wp.float64(0.5) * pivot * pivot
        if not (rest > wp.float64(0.0)):
            good = wp.int32(0)
    inverse = wp.tile_lower_solve(lower, one)
    if good == 1:
        wp.tile_store(panels[tile], inverse)
    else:
        wp.tile_store(panels[tile], wp.tile_load(identity, shape=(TILE, TILE)))
        bad[slot] = 1


@wp.kernel
def factorise_below(
    slots: wp.array(dtype=wp.int32),
    works: wp.array2d(dtype=wp.int32),
    first: int,
    column: int,
    panel_tiles: int,
    panels: wp.array3d(dtype=wp.float64),
):
    """Replace a tile below the diagonal by that of the factor.

    A row of ``works``: the tile, its row's first tile, the diagonal tile, the diagonal's row.
    """
    i, number = wp.tid()
    base = slots[i] * panel_tiles
    work = first + number
    tile = base + works[work, 0]
    row = base + works[work, 1]
    above = base + works[work, 3]
    total = wp.tile_load(panels[tile], shape=(TILE, TILE))
    for k in range(column):
        left = wp.tile_load(panels[row + k], shape=(TILE, TILE))
        right = wp.tile_load(panels[above + k], shape=(TILE, TILE))
        wp.tile_matmul(left, wp.tile_transpose(right), total, alpha=wp.float64(-1.0))
    inverse = wp.tile_load(panels[base + works[work, 2]], shape=(TILE, TILE))
    answer = wp.tile_zeros(shape=(TILE, TILE), dtype=wp.float64)
    wp.tile_matmul(total, wp.tile_transpose(inverse), answer)
    wp.tile_store(panels[tile], answer)


@wp.kernel
def subtract_products(
    slots: wp.array(dtype=wp.int32),
    works: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    share_tiles: int,
    panels: wp.array3d(dtype=wp.float64),
    shares: wp.array3d(dtype=wp.float64),
):
    """Subtract the product of two rows of the panel from a tile of the share.

    A row of ``works``: the tile, both rows' first tiles, the number of own tiles.
    """
    i, number = wp.tid()
    slot = slots[i]
    base = slot * panel_tiles
    work = first + number
    tile = slot * share_tiles + works[work, 0]
    total = wp.tile_load(shares[tile], shape=(TILE, TILE))
    for k in range(works[work, 3]):
        left = wp.tile_load(panels[base + works[work, 1] + k], shape=(TILE, TILE))
        right = wp.tile_load(panels[base + works[work, 2] + k], shape=(TILE, TILE))
        wp.tile_matmul(left, wp.tile_transpose(right), total, alpha=wp.float64(-1.0))
    wp.tile_store(shares[tile], total)


@wp.kernel
def gather_right(
    slots: wp.array(dtype=wp.int32),
    row_front: wp.array(dtype=wp.int32),
    row_in_front: wp.array(dtype=wp.int32),
    row_unknown: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    children: wp.array(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    first: int,
    rows: int,
    lanes: int,
    right_in: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Set the rows of fronts to their right-hand sides and what the children's borders add up to.

    A front has its own rows and those of its border in one stretch of ``work``, whose begin is the
    sixth of its numbers (``fronts``).
    """
    i, number, lane = wp.tid()
    slot = slots[i]
    at = first + number
    front = row_front[at]
    total = wp.float64(0.0)
    if lane < lanes:
        if row_unknown[at] >= 0:
            total = right_in[slot, lane, row_unknown[at]]
        for k in range(fronts[front, 2], fronts[front, 3]):
            child = children[k]
            a = rows_in_child[fronts[child, 5] + row_in_front[at]]
            if a >= 0:
                border = fronts[child, 6] + fronts[child, 1] * TILE
                total += work[slot * rows + border + a, lane]
    work[slot * rows + fronts[front, 6] + row_in_front[at], lane] = total


@wp.kernel
def substitute_forward(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    panels: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Solve with the lower triangle of a front's own columns."""
    i, number = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    begin = slot * rows + fronts[front, 6]
    row = slot * panel_tiles + fronts[front, 7]
    for c in range(fronts[front, 1]):
        total = wp.tile_load(work, shape=(TILE, LANES), offset=(begin + c * TILE, 0))
        for k in range(c):
            tile = wp.tile_load(panels[row + k], shape=(TILE, TILE))
            known = wp.tile_load(work, shape=(TILE, LANES), offset=(begin + k * TILE, 0))
            wp.tile_matmul(tile, known, total, alpha=wp.float64(-1.0))
        inverse = wp.tile_load(panels[row + c], shape=(TILE, TILE))
        answer = wp.tile_zeros(shape=(TILE, LANES), dtype=wp.float64)
        wp.tile_matmul(inverse, total, answer)
        wp.tile_store(work, answer, offset=(begin + c * TILE, 0))
        row += c + 1


@wp.kernel
def subtract_border(
    slots: wp.array(dtype=wp.int32),
    works: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    panels: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Subtract a border row's tiles times the own solution from that row.

    A row of ``works``: the row's first tile, number of own tiles, begin of the front's rows, begin
    of the border row.
    """
    i, number = wp.tid()
    slot = slots[i]
    at = first + number
    base = slot * panel_tiles + works[at, 0]
    begin = slot * rows + works[at, 2]
    total = wp.tile_load(work, shape=(TILE, LANES), offset=(slot * rows + works[at, 3], 0))
    for k in range(works[at, 1]):
        tile = wp.tile_load(panels[base + k], shape=(TILE, TILE))
        known = wp.tile_load(work, shape=(TILE, LANES), offset=(begin + k * TILE, 0))
        wp.tile_matmul(tile, known, total, alpha=wp.float64(-1.0))
    wp.tile_store(work, total, offset=(slot * rows + works[at, 3], 0))


@wp.kernel
def gather_border(
    slots: wp.array(dtype=wp.int32),
    row_place: wp.array(dtype=wp.int32),
    row_source: wp.array(dtype=wp.int32),
    first: int,
    rows: int,
    work: wp.array2d(dtype=wp.float64),
):
    """Copy the solution of the fronts above to the border rows of a level."""
    i, number, lane = wp.tid()
    base = slots[i] * rows
    source = row_source[first + number]
    value = wp.float64(0.0)
    if source >= 0:
        value = work[base + source, lane]
    work[base + row_place[first + number], lane] = value


@wp.kernel
def subtract_border_transposed(
    slots: wp.array(dtype=wp.int32),
    works: wp.array2d(dtype=wp.int32),
    places: wp.array(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    panels: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Subtract a column's border tiles, transposed, times the border's solution from own rows.

    A row of ``works``: the own rows, begin and end among ``places`` of the border tiles, begin of
    the border's rows.
    """
    i, number = wp.tid()
    slot = slots[i]
    at = first + number
    base = slot * panel_tiles
    begin = slot * rows + works[at, 3]
    total = wp.tile_load(work, shape=(TILE, LANES), offset=(slot * rows + works[at, 0], 0))
    for k in range(works[at, 2] - works[at, 1]):
        tile = wp.tile_load(panels[base + places[works[at, 1] + k]], shape=(TILE, TILE))
        known = wp.tile_load(work, shape=(TILE, LANES), offset=(begin + k * TILE, 0))
        wp.tile_matmul(wp.tile_transpose(tile), known, total, alpha=wp.float64(-1.0))
    wp.tile_store(work, total, offset=(slot * rows + works[at, 0], 0))


@wp.kernel
def substitute_backward(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    panels: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Solve with the transposed lower triangle of a front's own columns."""
    i, number = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    begin = slot * rows + fronts[front, 6]
    start = slot * panel_tiles + fronts[front, 7]
    count = fronts[front, 1]
    for back in range(count):
        c = count - 1 - back
        total = wp.tile_load(work, shape=(TILE, LANES), offset=(begin + c * TILE, 0))
        for k in range(c + 1, count):
            tile = wp.tile_load(panels[start + lower_tile(k, c)], shape=(TILE, TILE))
            known = wp.tile_load(work, shape=(TILE, LANES), offset=(begin + k * TILE, 0))
            wp.tile_matmul(wp.tile_transpose(tile), known, total, alpha=wp.float64(-1.0))
        inverse = wp.tile_load(panels[start + lower_tile(c, c)], shape=(TILE, TILE))
        answer = wp.tile_zeros(shape=(TILE, LANES), dtype=wp.float64)
        wp.tile_matmul(wp.tile_transpose(inverse), total, answer)
        wp.tile_store(work, answer, offset=(begin + c * TILE, 0))


@wp.kernel
def scatter_solution(
    slots: wp.array(dtype=wp.int32),
    row_of: wp.array(dtype=wp.int32),
    rows: int,
    work_in: wp.array2d(dtype=wp.float64),
    solution_out: wp.array3d(dtype=wp.float64),
):
    """Write the solution in the caller's order."""
    i, lane, k = wp.tid()
    slot = slots[i]
    solution_out[slot, lane, k] = work_in[slot * rows + row_of[k], lane]
