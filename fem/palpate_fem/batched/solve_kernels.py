# mypy: ignore-errors
"""Kernels that solve with the batched multifrontal factor, level by level.

A front has its own rows and those of its border in one stretch of a vector; ``fronts`` and
``children`` are those of `FrontTiles`. Two vectors of work pass numbers on: *begun* has what the
right-hand side and the children give to a front, and at last the solution; *half* has what the
lower triangle is solved for. Triangles along the diagonal are inverted, so their rows do not wait
for each other: a step of a level is one such triangle of each front, and what stands below it.
Levels whose fronts are small have a block of threads for each front instead.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched import dense_vectors
from palpate_fem.batched.dense_tiles import LANES, TILE, end_of

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gather_loads(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    row_links: wp.array(dtype=wp.int32),
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    first: int,
    rows: int,
    lanes: int,
    vectors_in: wp.array3d(dtype=wp.float64),
    begun: wp.array2d(dtype=wp.float32),
    loaded: wp.array2d(dtype=wp.int32),
):
    """Begin the rows of fronts with right-hand sides and what the children's borders add up to.

    ``row_links`` has the unknowns of own rows, and for those of borders where they are own rows;
    -1 = padding. ``loaded`` tells of fronts whose own rows are not all zero: the load of a
    correction, at the contact alone, loads few.
    """
    i, number, at = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    own = at < wp.static(TILE) * fronts[front, 0]
    if at < wp.static(TILE) * fronts[front, 1]:
        base = slot * rows
        row = fronts[front, 6] + at
        for lane in range(wp.static(LANES)):
            total = wp.float64(0.0)
            if lane < lanes:
                if own and row_links[row] >= 0:
                    total = vectors_in[slot, lane, row_links[row]]
                for child in range(fronts[front, 2], fronts[front, 3]):
                    there = rows_in_child[children[child, 0] + at]
                    if there >= 0:
                        total += wp.float64(begun[base + children[child, 2] + there, lane])
            begun[base + row, lane] = wp.float32(total)
            if own and total != wp.float64(0.0):
                loaded[slot, front] = 1


@wp.kernel
def solve_rows(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array2d(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    loaded: wp.array2d(dtype=wp.int32),
    first: int,
    corner: int,
    subtract: int,
    panel_tiles: int,
    rows: int,
    panels_in: wp.array3d(dtype=wp.float32),
    source: wp.array2d(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
):
    """Solve with inverse triangles that begin at tile ``corner``: a row of tiles each.

    Or subtract what they are solved for from the rows below them.
    """
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number, 0]
    r = listed[first + number, 1]
    own = fronts[front, 0]
    begin = slot * rows + fronts[front, 6]
    last = corner
    if loaded[slot, front] != 0:
        last = wp.where(subtract != 0, end_of(corner, own), r + 1)
    dense_vectors.multiply_row(
        panels_in, slot * panel_tiles + fronts[front, 4], own, r, corner, last,
        source, begin, out, begin + wp.static(TILE) * r, subtract, thread,
    )  # fmt: skip


@wp.kernel
def gather_answers(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    row_links: wp.array(dtype=wp.int32),
    first: int,
    rows: int,
    begun: wp.array2d(dtype=wp.float32),
):
    """Bring what is solved above to the borders of fronts."""
    i, number, at = wp.tid()
    front = listed[first + number]
    if at >= wp.static(TILE) * fronts[front, 0] and at < wp.static(TILE) * fronts[front, 1]:
        base = slots[i] * rows
        row = fronts[front, 6] + at
        for lane in range(wp.static(LANES)):
            value = wp.float32(0.0)
            if row_links[row] >= 0:
                value = begun[base + row_links[row], lane]
            begun[base + row, lane] = value


@wp.kernel
def solve_columns(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array2d(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    corner: int,
    subtract: int,
    panel_tiles: int,
    rows: int,
    panels_in: wp.array3d(dtype=wp.float32),
    source: wp.array2d(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
):
    """Solve with transposed inverse triangles: a column of tiles each.

    Or subtract, before, what the rows below a triangle give from its own.
    """
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number, 0]
    c = listed[first + number, 1]
    own = fronts[front, 0]
    begin = slot * rows + fronts[front, 6]
    end = end_of(corner, own)
    dense_vectors.multiply_column(
        panels_in, slot * panel_tiles + fronts[front, 4], own, c,
        wp.where(subtract != 0, end, c), wp.where(subtract != 0, fronts[front, 1], end),
        source, begin, out, begin + wp.static(TILE) * c, subtract, thread,
    )  # fmt: skip


@wp.kernel
def solve_small_fronts(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    row_links: wp.array(dtype=wp.int32),
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    first: int,
    rows: int,
    panel_tiles: int,
    lanes: int,
    vectors_in: wp.array3d(dtype=wp.float64),
    panels_in: wp.array3d(dtype=wp.float32),
    begun: wp.array2d(dtype=wp.float32),
    half_out: wp.array2d(dtype=wp.float32),
):
    """The way up through the fronts of a level: a block of threads for each.

    One front of all slots after another, so that they find the same numbers of places in caches.
    """
    number, i, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    dense_vectors.solve_small_rows(
        row_links, children, rows_in_child, fronts[front, 2], fronts[front, 3], fronts[front, 6],
        vectors_in, slot, lanes, panels_in, slot * panel_tiles + fronts[front, 4],
        fronts[front, 0], fronts[front, 1], slot * rows, begun, half_out, thread,
    )  # fmt: skip


@wp.kernel
def answer_small_fronts(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    row_links: wp.array(dtype=wp.int32),
    first: int,
    rows: int,
    panel_tiles: int,
    panels_in: wp.array3d(dtype=wp.float32),
    half_in: wp.array2d(dtype=wp.float32),
    begun: wp.array2d(dtype=wp.float32),
):
    """The way down again."""
    number, i, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    dense_vectors.solve_small_columns(
        row_links, fronts[front, 6], panels_in, slot * panel_tiles + fronts[front, 4],
        fronts[front, 0], fronts[front, 1], slot * rows, begun, half_in, thread,
    )  # fmt: skip


@wp.kernel
def scatter_solution(
    slots: wp.array(dtype=wp.int32),
    row_of: wp.array(dtype=wp.int32),
    rows: int,
    begun_in: wp.array2d(dtype=wp.float32),
    solution_out: wp.array3d(dtype=wp.float64),
):
    """Write the solution in the caller's order."""
    i, lane, k = wp.tid()
    slot = slots[i]
    solution_out[slot, lane, k] = wp.float64(begun_in[slot * rows + row_of[k], lane])
