# mypy: ignore-errors
"""Substitution with dense fronts in tiles: forward and backward, for two vectors at once.

A block of threads, or on a CPU and on older GPUs one thread, brings together what a front needs,
and solves with the front's own columns; how tensor cores are fed says `dense_tiles`.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched.dense_tiles import FRONT, TENSOR_CORES

_VECTORS = (
    TENSOR_CORES
    + FRONT
    + """
    double* slots_work = work.data + size_t(base) * 2;
    double* x = slots_work + size_t(begin) * 2;
    const int* links = row_links.data + begin;
#ifdef PALPATE_TENSOR_CORES
    const int start = thread, step = WP_TILE_BLOCK_DIM;
    constexpr int warps = WP_TILE_BLOCK_DIM / 32;
    const int lane = thread % 32, warp = thread / 32;
    const int row = lane / 4, column = 2 * (lane % 4);
    // The threads of columns 0 and 1 of B hold 32 rows of two numbers, the others zeros.
    auto number = [=](const double* known, int k) { return row < 2 ? known[2 * k + row] : 0.0; };
    // Add a tile times them: row 8 m + g at the threads with s = 0.
    auto add_tile = [=](double (&sum)[4][2], const double* tile, const double* known) {
        #pragma unroll
        for (int k = 0; k < 32; k += 8) {
            const double2 factor
                = make_double2(number(known, k + column), number(known, k + column + 1));
            #pragma unroll
            for (int m = 0; m < 4; m += 2) {
                const double* at = tile + (8 * m + row) * 32 + k + column;
                add_product(sum[m], sum[m + 1], pair_at(at), pair_at(at + 256), factor);
            }
        }
    };
    // Add a transposed tile times them: row 16 (m / 2) + 2 g + m % 2.
    auto add_transposed = [=](double (&sum)[4][2], const double* tile, const double* known) {
        #pragma unroll
        for (int i = 0; i < 32; i += 8) {
            const int k = i + lane % 4;
            const double2 factor = make_double2(number(known, k), number(known, k + 4));
            #pragma unroll
            for (int m = 0; m < 4; m += 2) {
                const double2 one = pair_at(tile + k * 32 + 8 * m + 2 * row);
                const double2 other = pair_at(tile + (k + 4) * 32 + 8 * m + 2 * row);
                add_product(
                    sum[m], sum[m + 1], make_double2(one.x, other.x), make_double2(one.y, other.y),
                    factor);
            }
        }
    };
#else
    const int start = 0, step = 1;
    if (thread != 0)
        return;
#endif
"""
)

_SUBSTITUTE_FORWARD = (
    _VECTORS
    + """
    // Right-hand sides, and what the children's borders add up to.
    bool loaded = false;
    for (int i = start; i < 64 * rows; i += step) {
        const int at = i / 2, vector = i % 2;
        double total = 0.0;
        if (vector < lanes) {
            if (at < 32 * own && links[at] >= 0)
                total = wp::index(vectors, slot, vector, links[at]);
            for (int k = child; k < last_child; ++k) {
                const int* one = children.data + 3 * k;
                const int there = rows_in_child.data[one[0] + at];
                if (there >= 0)
                    total += slots_work[2 * (one[2] + there) + vector];
            }
        }
        x[i] = total;
        loaded = loaded || total != 0.0;
    }
#ifdef PALPATE_TENSOR_CORES
    if (!__syncthreads_or(loaded))
        return;
    for (int c = 0; c < own; ++c) {
        double* known = x + 64 * c;
        if (warp == 0) {
            double sum[4][2] = {};
            add_tile(sum, tiles_of(c) + 1024 * c, known);
            __syncwarp();  // all have read what is overwritten now
            if (column == 0)
                for (int m = 0; m < 4; ++m)
                    for (int n = 0; n < 2; ++n)
                        known[2 * (8 * m + row) + n] = sum[m][n];
        }
        __syncthreads();
        for (int r = c + 1 + warp; r < rows; r += warps) {
            double sum[4][2] = {};
            add_tile(sum, tiles_of(r) + 1024 * c, known);
            if (column == 0)
                for (int m = 0; m < 4; ++m)
                    for (int n = 0; n < 2; ++n)
                        x[64 * r + 2 * (8 * m + row) + n] -= sum[m][n];
        }
        __syncthreads();
    }
#else
    if (!loaded)
        return;
    for (int c = 0; c < own; ++c) {
        double known[64];
        for (int r = c; r < rows; ++r) {
            const double* tile = tiles_of(r) + 1024 * c;
            const double* from = r == c ? x + 64 * c : known;
            double sum[64] = {};
            for (int i = 0; i < 32; ++i)
                for (int k = 0; k < 32; ++k)
                    for (int n = 0; n < 2; ++n)
                        sum[2 * i + n] += tile[32 * i + k] * from[2 * k + n];
            for (int i = 0; i < 64; ++i)
                if (r == c)
                    known[i] = sum[i];
                else
                    x[64 * r + i] -= sum[i];
        }
        for (int i = 0; i < 64; ++i)
            x[64 * c + i] = known[i];
    }
#endif
"""
)

_SUBSTITUTE_BACKWARD = (
    _VECTORS
    + """
    for (int i = 64 * own + start; i < 64 * rows; i += step) {
        const int from = links[i / 2];
        x[i] = from >= 0 ? slots_work[2 * from + i % 2] : 0.0;
    }
#ifdef PALPATE_TENSOR_CORES
    __syncthreads();
    constexpr int parts = 16;  // so that sums do not depend on the number of warps
    __shared__ double part[parts][64];
    auto place = [=](int m) { return 2 * (8 * (m - m % 2) + 2 * row + m % 2); };
    for (int c = own - 1; c >= 0; --c) {
        for (int p = warp; p < parts; p += warps) {
            double sum[4][2] = {};
            for (int r = c + 1 + p; r < rows; r += parts)
                add_transposed(sum, tiles_of(r) + 1024 * c, x + 64 * r);
            if (column == 0)
                for (int m = 0; m < 4; ++m)
                    for (int n = 0; n < 2; ++n)
                        part[p][place(m) + n] = sum[m][n];
        }
        __syncthreads();
        if (warp == 0) {
            double* answer = x + 64 * c;
            for (int i = lane; i < 64; i += 32) {
                double value = answer[i];
                for (int p = 0; p < parts; ++p)
                    value -= part[p][i];
                part[0][i] = value;  // nobody else has read this one
            }
            __syncwarp();
            double known[4][2] = {};
            add_transposed(known, tiles_of(c) + 1024 * c, part[0]);
            if (column == 0)
                for (int m = 0; m < 4; ++m)
                    for (int n = 0; n < 2; ++n)
                        answer[place(m) + n] = known[m][n];
        }
        __syncthreads();
    }
#else
    for (int c = own - 1; c >= 0; --c) {
        double known[64], sum[64] = {};
        for (int i = 0; i < 64; ++i)
            known[i] = x[64 * c + i];
        for (int r = rows - 1; r >= c; --r) {
            const double* tile = tiles_of(r) + 1024 * c;
            for (int k = 0; k < 32; ++k)
                for (int i = 0; i < 32; ++i)
                    for (int n = 0; n < 2; ++n)
                        if (r > c)
                            known[2 * i + n] -= tile[32 * k + i] * x[64 * r + 2 * k + n];
                        else
                            sum[2 * i + n] += tile[32 * k + i] * known[2 * k + n];
        }
        for (int i = 0; i < 64; ++i)
            x[64 * c + i] = sum[i];
    }
#endif
"""
)


@wp.func_native(_SUBSTITUTE_FORWARD)
def substitute_forward(
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    child: int,
    last_child: int,
    row_links: wp.array(dtype=wp.int32),
    vectors: wp.array3d(dtype=wp.float64),
    slot: int,
    lanes: int,
    panels: wp.array3d(dtype=wp.float64),
    panel: int,
    own: int,
    rows: int,
    work: wp.array2d(dtype=wp.float64),
    base: int,
    begin: int,
    thread: int,
):
    """Solve with the lower triangle of a front's own columns, and subtract from its border.

    Its rows begin with right-hand sides and what the children's borders add up to. Where that is
    nothing, it stays so: the load of a correction, at the contact alone, loads few fronts.

    ``base`` is the slot's first row in ``work`` and ``begin`` the front's first one after it.
    ``row_links`` has the unknowns of own rows, and for those of borders where, after ``base``,
    they are own rows; -1 = padding. The rest is as for `dense_tiles.factorise_panel`.
    """
    ...


@wp.func_native(_SUBSTITUTE_BACKWARD)
def substitute_backward(
    row_links: wp.array(dtype=wp.int32),
    panels: wp.array3d(dtype=wp.float64),
    panel: int,
    own: int,
    rows: int,
    work: wp.array2d(dtype=wp.float64),
    base: int,
    begin: int,
    thread: int,
):
    """Solve with the transposed lower triangle; the border's rows take what is solved above."""
    ...
