# mypy: ignore-errors
"""Products of a panel's tiles with vectors, two at once: a row of tiles, or a column transposed.

How tensor cores are fed says `dense_tiles`. A row or a column is shared by ``PARTS`` warps; on a
CPU, and on older GPUs, one thread does it.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched.dense_tiles import FRONT, TENSOR_CORES

PARTS = 2
"""Warps that share a row or a column of tiles. Sums do not depend on anything else."""

_VECTORS = (
    TENSOR_CORES
    + FRONT
    + """
    stored* result = out.data + size_t(out_row) * 2;
    const stored* known = source.data + size_t(source_row) * 2;
#ifdef PALPATE_TENSOR_CORES
    constexpr int parts = PARTS;
    const int lane = thread % 32, part = thread / 32;
    const int row = lane / 4, column = 2 * (lane % 4), four = 4 * (lane % 4);
    // The threads of columns 0 and 1 of B hold 32 rows of two numbers, the others zeros.
    auto number = [=](const stored* from, int k) { return row < 2 ? from[2 * k + row] : 0.f; };
    // Write what the warps have found: their sums stand at the threads with column 0.
    auto finish = [=](const double (&sum)[4][2], auto place_of) {
        __shared__ double shared[WP_TILE_BLOCK_DIM / 32][64];
        double(*mine)[64] = shared + threadIdx.x / 32 - part;
        if (column == 0)
            for (int m = 0; m < 4; ++m)
                for (int n = 0; n < 2; ++n)
                    mine[part][place_of(m) + n] = sum[m][n];
        __syncthreads();
        for (int i = thread; i < 64; i += 32 * parts) {
            double total = 0.0;
            for (int p = 0; p < parts; ++p)
                total += mine[p][i];
            result[i] = subtract ? result[i] - total : total;
        }
    };
#endif
"""
).replace("PARTS", str(PARTS))

_MULTIPLY_ROW = (
    _VECTORS
    + """
    const stored* tile = tiles_of(r);
#ifdef PALPATE_TENSOR_CORES
    double sum[4][2] = {};
    #pragma unroll 2
    for (int c = first + part; c < last; c += parts)
        #pragma unroll
        for (int k = four; k < 32; k += 16) {
            const stored* from = known + 64 * c;
            const double2 factor = make_double2(number(from, k), number(from, k + 1));
            const double2 next = make_double2(number(from, k + 2), number(from, k + 3));
            #pragma unroll
            for (int m = 0; m < 4; m += 2) {
                const stored* at = tile + 1024 * c + (8 * m + row) * 32 + k;
                const Four upper = four_at(at), lower = four_at(at + 256);
                add_product(sum[m], sum[m + 1], upper.first, lower.first, factor);
                add_product(sum[m], sum[m + 1], upper.second, lower.second, next);
            }
        }
    finish(sum, [=](int m) { return 2 * (8 * m + row); });
#else
    if (thread != 0)
        return;
    for (int i = 0; i < 64; ++i) {
        double sum = 0.0;
        for (int c = first; c < last; ++c)
            for (int k = 0; k < 32; ++k)
                sum += tile[1024 * c + 32 * (i / 2) + k] * known[64 * c + 2 * k + i % 2];
        result[i] = subtract ? result[i] - sum : sum;
    }
#endif
"""
)

_MULTIPLY_COLUMN = (
    _VECTORS
    + """
#ifdef PALPATE_TENSOR_CORES
    double sum[4][2] = {};
    #pragma unroll 2
    for (int r = first + part; r < last; r += parts) {
        const stored* tile = tiles_of(r) + 1024 * c;
        const stored* from = known + 64 * r;
        #pragma unroll
        for (int i = 0; i < 32; i += 8) {
            const int k = i + lane % 4;
            const double2 factor = make_double2(number(from, k), number(from, k + 4));
            const Four one = four_at(tile + k * 32 + 4 * row);
            const Four other = four_at(tile + (k + 4) * 32 + 4 * row);
            add_product(
                sum[0], sum[1], make_double2(one.first.x, other.first.x),
                make_double2(one.first.y, other.first.y), factor);
            add_product(
                sum[2], sum[3], make_double2(one.second.x, other.second.x),
                make_double2(one.second.y, other.second.y), factor);
        }
    }
    // The four numbers of a load are neighbours of the column.
    finish(sum, [=](int m) { return 2 * (4 * row + m); });
#else
    if (thread != 0)
        return;
    for (int i = 0; i < 64; ++i) {
        double sum = 0.0;
        for (int r = first; r < last; ++r)
            for (int k = 0; k < 32; ++k)
                sum += (tiles_of(r) + 1024 * c)[32 * k + i / 2] * known[64 * r + 2 * k + i % 2];
        result[i] = subtract ? result[i] - sum : sum;
    }
#endif
"""
)


@wp.func_native(_MULTIPLY_ROW)
def multiply_row(
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    r: int,
    first: int,
    last: int,
    source: wp.array2d(dtype=wp.float32),
    source_row: int,
    out: wp.array2d(dtype=wp.float32),
    out_row: int,
    subtract: int,
    thread: int,
):
    """Set rows of ``out`` to tiles of row r times ``source``, or subtract that from them.

    These tiles are columns ``first`` up to ``last``, which is not one of them. ``panel`` is the
    front's first tile in ``panels`` and ``own`` the tiles of its own columns; the rows of vectors
    begin at ``source_row`` for column 0, and at ``out_row``. All ``PARTS`` warps call it.
    """
    ...


@wp.func_native(_MULTIPLY_COLUMN)
def multiply_column(
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    c: int,
    first: int,
    last: int,
    source: wp.array2d(dtype=wp.float32),
    source_row: int,
    out: wp.array2d(dtype=wp.float32),
    out_row: int,
    subtract: int,
    thread: int,
):
    """The same with the transposed tiles of column c, in rows ``first`` up to ``last``.

    The rows of ``source`` begin at ``source_row`` for row 0.
    """
    ...
