# mypy: ignore-errors
"""Kernels that solve with the batched multifrontal factor: a block of threads for each front.

A front has its own rows and those of its border in one stretch of ``work``; ``fronts`` and
``children`` are those of `FrontTiles`.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched import dense_vectors

wp.set_module_options({"enable_backward": False})


@wp.kernel
def substitute_forward(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    row_links: wp.array(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    lanes: int,
    vectors_in: wp.array3d(dtype=wp.float64),
    panels_in: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Solve with the lower triangles of loaded fronts, and subtract from their borders."""
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    own = fronts[front, 0]
    count = fronts[front, 1]
    child = fronts[front, 2]
    last_child = fronts[front, 3]
    panel = slot * panel_tiles + fronts[front, 4]
    base = slot * rows
    begin = fronts[front, 6]
    dense_vectors.substitute_forward(
        children, rows_in_child, child, last_child, row_links, vectors_in, slot, lanes,
        panels_in, panel, own, count, work, base, begin, thread,
    )  # fmt: skip


@wp.kernel
def substitute_backward(
    slots: wp.array(dtype=wp.int32),
    listed: wp.array(dtype=wp.int32),
    fronts: wp.array2d(dtype=wp.int32),
    row_links: wp.array(dtype=wp.int32),
    first: int,
    panel_tiles: int,
    rows: int,
    panels_in: wp.array3d(dtype=wp.float64),
    work: wp.array2d(dtype=wp.float64),
):
    """Solve with the transposed lower triangles of fronts; those above are solved."""
    i, number, thread = wp.tid()
    slot = slots[i]
    front = listed[first + number]
    own = fronts[front, 0]
    count = fronts[front, 1]
    panel = slot * panel_tiles + fronts[front, 4]
    base = slot * rows
    begin = fronts[front, 6]
    dense_vectors.substitute_backward(
        row_links, panels_in, panel, own, count, work, base, begin, thread
    )


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
