# mypy: ignore-errors
"""Kernels that solve with the batched multifrontal factor, level by level.

A front has its own rows and those of its border in one stretch of a vector; ``fronts`` and
``children`` are those of `FrontTiles`. Two vectors of work pass numbers on: *begun* has what the
children and the right-hand side give to a front, and at last the solution; *half* is what a
triangle has been solved with. A triangle is kept inverted, so that rows do not wait for each other.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched import dense_vectors

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gather_loads(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    row_links: wp.array(dtype=wp.int32),
    first: int,
    rows: int,
    tile: int,
    lanes: int,
    vectors_in: wp.array3d(dtype=wp.float64),
    begun: wp.array2d(dtype=wp.float64),
    loaded: wp.array2d(dtype=wp.int32),
):
    """Begin the rows of fronts with right-hand sides and what the children's borders add up to.

    ``row_links`` has the unknowns of own rows, and for those of borders where they are own rows;
    -1 = padding. ``loaded`` tells of fronts whose own rows are not all zero.
    """
    i, number, at, lane = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    own = fronts[front, 0]
    if at < tile * fronts[front, 1]:
        base = slot * rows
        row = fronts[front, 6] + at
        total = wp.float64(0.0)
        if lane < lanes:
            if at < tile * own and row_links[row] >= 0:
                total = vectors_in[slot, lane, row_links[row]]
            for child in range(fronts[front, 2], fronts[front, 3]):
                there = rows_in_child[children[child, 0] + at]
                if there >= 0:
                    total += begun[base + children[child, 2] + there, lane]
        begun[base + row, lane] = total
        if at < tile * own and total != wp.float64(0.0):
            loaded[slot, front] = 1


@wp.kernel
def multiply_own_rows(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array2d(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    loaded: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    tile: int,
    panels_in: wp.array3d(dtype=wp.float64),
    begun_in: wp.array2d(dtype=wp.float64),
    half: wp.array2d(dtype=wp.float64),
):
    """Multiply the own rows of fronts with the inverse triangle, a row of tiles each."""
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number, 0]
    r = listed[first + number, 1]
    begin = slot * rows + fronts[front, 6]
    count = wp.where(loaded[slot, front] != 0, r + 1, 0)
    dense_vectors.multiply_row(
        panels_in, slot * panel_tiles + fronts[front, 4], fronts[front, 0], r, count,
        begun_in, begin, half, begin + tile * r, 0, thread,
    )  # fmt: skip


@wp.kernel
def subtract_border_rows(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array2d(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    loaded: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    tile: int,
    panels_in: wp.array3d(dtype=wp.float64),
    half_in: wp.array2d(dtype=wp.float64),
    begun: wp.array2d(dtype=wp.float64),
):
    """Subtract from the borders of loaded fronts, a row of tiles each."""
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number, 0]
    r = listed[first + number, 1]
    own = fronts[front, 0]
    begin = slot * rows + fronts[front, 6]
    count = wp.where(loaded[slot, front] != 0, own, 0)
    dense_vectors.multiply_row(
        panels_in, slot * panel_tiles + fronts[front, 4], own, r, count,
        half_in, begin, begun, begin + tile * r, 1, thread,
    )  # fmt: skip


@wp.kernel
def gather_answers(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    row_links: wp.array(dtype=wp.int32),
    first: int,
    rows: int,
    tile: int,
    begun_in: wp.array2d(dtype=wp.float64),
    half: wp.array2d(dtype=wp.float64),
):
    """Bring what is solved above to the borders of fronts."""
    i, number, at, lane = wp.tid()
    front = listed[first + number]
    if at >= tile * fronts[front, 0] and at < tile * fronts[front, 1]:
        base = slots[i] * rows
        row = fronts[front, 6] + at
        value = wp.float64(0.0)
        if row_links[row] >= 0:
            value = begun_in[base + row_links[row], lane]
        half[base + row, lane] = value


@wp.kernel
def subtract_border_columns(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array2d(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    tile: int,
    panels_in: wp.array3d(dtype=wp.float64),
    half: wp.array2d(dtype=wp.float64),
):
    """Subtract what the border gives from the own rows of fronts, a column of tiles each."""
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number, 0]
    c = listed[first + number, 1]
    own = fronts[front, 0]
    begin = slot * rows + fronts[front, 6]
    dense_vectors.multiply_column(
        panels_in, slot * panel_tiles + fronts[front, 4], own, c, own, fronts[front, 1],
        half, begin, half, begin + tile * c, 1, thread,
    )  # fmt: skip


@wp.kernel
def multiply_own_columns(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array2d(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    tile: int,
    panels_in: wp.array3d(dtype=wp.float64),
    half_in: wp.array2d(dtype=wp.float64),
    begun: wp.array2d(dtype=wp.float64),
):
    """Multiply with the transposed inverse triangle, a column of tiles each: the solution."""
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number, 0]
    c = listed[first + number, 1]
    own = fronts[front, 0]
    begin = slot * rows + fronts[front, 6]
    dense_vectors.multiply_column(
        panels_in, slot * panel_tiles + fronts[front, 4], own, c, c, own,
        half_in, begin, begun, begin + tile * c, 0, thread,
    )  # fmt: skip


@wp.kernel
def scatter_solution(
    slots: wp.array(dtype=wp.int32),
    row_of: wp.array(dtype=wp.int32),
    rows: int,
    begun_in: wp.array2d(dtype=wp.float64),
    solution_out: wp.array3d(dtype=wp.float64),
):
    """Write the solution in the caller's order."""
    i, lane, k = wp.tid()
    slot = slots[i]
    solution_out[slot, lane, k] = begun_in[slot * rows + row_of[k], lane]
