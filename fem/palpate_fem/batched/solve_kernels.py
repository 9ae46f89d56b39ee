# mypy: ignore-errors
"""Kernels that solve with the batched multifrontal factor: a block of threads for each front.

A front has its own rows and those of its border in one stretch of ``work``; ``fronts`` is that of
`FrontTiles`.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched import dense_tiles
from palpate_fem.batched.dense_tiles import TILE

wp.set_module_options({"enable_backward": False})


@wp.kernel
def forget_loads(slots: wp.array(dtype=wp.int32), loaded_out: wp.array2d(dtype=wp.int32)):
    """Call all fronts of the listed slots free of loads."""
    i, front = wp.tid()
    loaded_out[slots[i], front] = 0


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
    loaded_out: wp.array2d(dtype=wp.int32),
):
    """Set the rows of fronts to right-hand sides and what the children's borders add up to.

    Fronts with a row that is not zero are called loaded: the load of a correction, at the contact
    alone, loads few.
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
    if total != wp.float64(0.0):
        loaded_out[slot, front] = 1


@wp.kernel
def substitute_forward(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    threads: int,
    loaded: wp.array2d(dtype=wp.int32),
    panels: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Solve with the lower triangles of loaded fronts, and subtract from their borders."""
    i, number, thread = wp.tid()
    front = listed[first + number]
    if loaded[slots[i], front] != 0:
        panel = slots[i] * panel_tiles + fronts[front, 7]
        begin = slots[i] * rows + fronts[front, 6]
        own = fronts[front, 1]
        count = fronts[front, 8]
        dense_tiles.substitute_forward(panels, panel, own, count, work, begin, thread, threads)


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
def substitute_backward(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    threads: int,
    panels: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Solve with the transposed lower triangles of fronts whose borders are known."""
    i, number, thread = wp.tid()
    front = listed[first + number]
    panel = slots[i] * panel_tiles + fronts[front, 7]
    begin = slots[i] * rows + fronts[front, 6]
    own = fronts[front, 1]
    count = fronts[front, 8]
    dense_tiles.substitute_backward(panels, panel, own, count, work, begin, thread, threads)


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
