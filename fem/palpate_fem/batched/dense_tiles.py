# mypy: ignore-errors
"""Products of dense tiles with tiles and with vectors, in CUDA and in plain C++ (ADR 0026).

A warp of threads, or 32 threads one after the other on the CPU, works on a tile of 32 x 32 numbers
in double precision. On a GPU from compute capability 8.0 it uses the tensor cores, and loads what
they take from memory straight into registers: `warp.tile_matmul` goes through shared memory, whose
banks conflict for rows of 256 bytes, and is 1.6 times slower than even its own padded variant.

The tensor cores' product is C (8 x 8) += A (8 x 4) B (4 x 8). Of it thread t holds
A[t / 4][t % 4], B[t % 4][t / 4], and C[t / 4][2 (t % 4)] with its right neighbour. Which four of
the summed index's numbers meet in one product does not matter, so a thread loads two neighbours of
them at once, for two products. Column 0 and 1 of B hold the two vectors where a tile meets vectors.
"""

from __future__ import annotations

import warp as wp

TILE = 32
"""Rows and columns of a tile."""

LANES = 2
"""Vectors that are multiplied together."""

THREADS = 256
"""Threads of a block; those that work on a front share it."""

_HELPERS = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
#define PALPATE_TENSOR_CORES
    auto add_product = [](double (&c)[2], double a, double b) {
        asm("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0,%1}, {%2}, {%3}, {%0,%1};"
            : "+d"(c[0]), "+d"(c[1]) : "d"(a), "d"(b));
    };
#endif
"""

_SUBTRACT_PRODUCT = (
    _HELPERS
    + """
    double* target = out.data + size_t(tile) * 1024;
    const double* a = panels.data + size_t(left) * 1024;
    const double* b = panels.data + size_t(right) * 1024;
#ifdef PALPATE_TENSOR_CORES
    const int row = lane / 4, column = 2 * (lane % 4);
    double sum[4][4][2] = {};
    for (int i = 0; i < count; ++i, a += 1024, b += 1024) {
        #pragma unroll
        for (int k = 0; k < 32; k += 8) {
            double2 x[4], y[4];
            #pragma unroll
            for (int m = 0; m < 4; ++m) {
                x[m] = *reinterpret_cast<const double2*>(a + (8 * m + row) * 32 + k + column);
                y[m] = *reinterpret_cast<const double2*>(b + (8 * m + row) * 32 + k + column);
            }
            #pragma unroll
            for (int m = 0; m < 4; ++m)
                #pragma unroll
                for (int n = 0; n < 4; ++n) {
                    add_product(sum[m][n], x[m].x, y[n].x);
                    add_product(sum[m][n], x[m].y, y[n].y);
                }
        }
    }
    #pragma unroll
    for (int m = 0; m < 4; ++m)
        #pragma unroll
        for (int n = 0; n < 4; ++n) {
            double2* at = reinterpret_cast<double2*>(target + (8 * m + row) * 32 + 8 * n + column);
            double2 value = *at;
            value.x -= sum[m][n][0];
            value.y -= sum[m][n][1];
            *at = value;
        }
#else
    for (int j = 0; j < 32; ++j) {
        double sum = 0.0;
        for (int i = 0; i < count; ++i)
            for (int k = 0; k < 32; ++k)
                sum += a[i * 1024 + lane * 32 + k] * b[i * 1024 + j * 32 + k];
        target[lane * 32 + j] -= sum;
    }
#endif
"""
)

_MULTIPLY_TRANSPOSED = (
    _HELPERS
    + """
    double* a = panels.data + size_t(tile) * 1024;
    const double* b = panels.data + size_t(factor) * 1024;
#ifdef PALPATE_TENSOR_CORES
    const int row = lane / 4, column = 2 * (lane % 4);
    double sum[4][4][2] = {};
    #pragma unroll
    for (int k = 0; k < 32; k += 8) {
        double2 x[4], y[4];
        #pragma unroll
        for (int m = 0; m < 4; ++m) {
            x[m] = *reinterpret_cast<const double2*>(a + (8 * m + row) * 32 + k + column);
            y[m] = *reinterpret_cast<const double2*>(b + (8 * m + row) * 32 + k + column);
        }
        #pragma unroll
        for (int m = 0; m < 4; ++m)
            #pragma unroll
            for (int n = 0; n < 4; ++n) {
                add_product(sum[m][n], x[m].x, y[n].x);
                add_product(sum[m][n], x[m].y, y[n].y);
            }
    }
    __syncwarp();  // all have read what is overwritten now
    #pragma unroll
    for (int m = 0; m < 4; ++m)
        #pragma unroll
        for (int n = 0; n < 4; ++n)
            *reinterpret_cast<double2*>(a + (8 * m + row) * 32 + 8 * n + column)
                = make_double2(sum[m][n][0], sum[m][n][1]);
#else
    double answer[32];
    for (int j = 0; j < 32; ++j) {
        answer[j] = 0.0;
        for (int k = 0; k < 32; ++k)
            answer[j] += a[lane * 32 + k] * b[j * 32 + k];
    }
    for (int j = 0; j < 32; ++j)
        a[lane * 32 + j] = answer[j];
#endif
"""
)

_VECTORS = (
    _HELPERS
    + """
    const double* tiles = panels.data + size_t(panel) * 1024;
    double* x = work.data + size_t(begin) * 2;
    // First tile of a row of tiles; below the triangle all rows are equally long.
    auto tiles_of = [=](int r) {
        const int above = r < own ? r * (r + 1) / 2 : own * (own + 1) / 2 + (r - own) * own;
        return tiles + size_t(above) * 1024;
    };
#ifdef PALPATE_TENSOR_CORES
    const int lane = thread % 32, warp = thread / 32, warps = threads / 32;
    const int row = lane / 4, column = 2 * (lane % 4);
    // Add a tile times 32 rows of two numbers: row 8 m + t / 4 at the threads with t % 4 = 0.
    auto add_tile = [=](double (&sum)[4][2], const double* tile, const double* known) {
        #pragma unroll
        for (int k = 0; k < 32; k += 8) {
            const double* from = known + 2 * (k + column) + row;
            const double first = row < 2 ? from[0] : 0.0;
            const double second = row < 2 ? from[2] : 0.0;
            #pragma unroll
            for (int m = 0; m < 4; ++m) {
                const double2 t
                    = *reinterpret_cast<const double2*>(tile + (8 * m + row) * 32 + k + column);
                add_product(sum[m], t.x, first);
                add_product(sum[m], t.y, second);
            }
        }
    };
    // Add a transposed tile times them: row 16 (m / 2) + 2 (t / 4) + m % 2.
    auto add_transposed = [=](double (&sum)[4][2], const double* tile, const double* known) {
        #pragma unroll
        for (int i = 0; i < 8; ++i) {
            const int k = 4 * i + lane % 4;
            const double value = row < 2 ? known[2 * k + row] : 0.0;
            #pragma unroll
            for (int m = 0; m < 4; m += 2) {
                const double2 t
                    = *reinterpret_cast<const double2*>(tile + k * 32 + 8 * m + 2 * row);
                add_product(sum[m], t.x, value);
                add_product(sum[m + 1], t.y, value);
            }
        }
    };
#endif
"""
)

_SUBSTITUTE_FORWARD = (
    _VECTORS
    + """
#ifdef PALPATE_TENSOR_CORES
    for (int c = 0; c < own; ++c) {
        double* known = x + 64 * c;
        if (warp == 0) {
            double sum[4][2] = {};
            const double* tile = tiles_of(c) + 1024 * c;
            add_tile(sum, tile, known);
            __syncwarp();  // all have read what is overwritten now
            if (column == 0)
                for (int m = 0; m < 4; ++m) {
                    known[2 * (8 * m + row)] = sum[m][0];
                    known[2 * (8 * m + row) + 1] = sum[m][1];
                }
        }
        __syncthreads();
        for (int r = c + 1 + warp; r < rows; r += warps) {
            double sum[4][2] = {};
            const double* tile = tiles_of(r) + 1024 * c;
            add_tile(sum, tile, known);
            if (column == 0)
                for (int m = 0; m < 4; ++m) {
                    x[64 * r + 2 * (8 * m + row)] -= sum[m][0];
                    x[64 * r + 2 * (8 * m + row) + 1] -= sum[m][1];
                }
        }
        __syncthreads();
    }
#else
    if (thread != 0)
        return;
    for (int c = 0; c < own; ++c) {
        double known[64];
        for (int r = c; r < rows; ++r) {
            const double* tile = tiles_of(r) + 1024 * c;
            for (int i = 0; i < 32; ++i) {
                double first = 0.0, second = 0.0;
                const double* from = r == c ? x + 64 * c : known;
                for (int k = 0; k < 32; ++k) {
                    first += tile[32 * i + k] * from[2 * k];
                    second += tile[32 * i + k] * from[2 * k + 1];
                }
                if (r == c) {
                    known[2 * i] = first;
                    known[2 * i + 1] = second;
                } else {
                    x[64 * r + 2 * i] -= first;
                    x[64 * r + 2 * i + 1] -= second;
                }
            }
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
#ifdef PALPATE_TENSOR_CORES
    __shared__ double part[8][64];
    for (int c = own - 1; c >= 0; --c) {
        double sum[4][2] = {};
        for (int r = c + 1 + warp; r < rows; r += warps) {
            const double* tile = tiles_of(r) + 1024 * c;
            const double* known = x + 64 * r;
            add_transposed(sum, tile, known);
        }
        if (column == 0)
            for (int m = 0; m < 4; ++m) {
                const int at = 2 * (8 * (m - m % 2) + 2 * row + m % 2);
                part[warp][at] = sum[m][0];
                part[warp][at + 1] = sum[m][1];
            }
        __syncthreads();
        if (warp == 0) {
            double* answer = x + 64 * c;
            for (int i = lane; i < 64; i += 32) {
                double value = answer[i];
                for (int w = 0; w < warps; ++w)
                    value -= part[w][i];
                part[0][i] = value;  // its only reader so far
            }
            __syncwarp();
            double known[4][2] = {};
            const double* tile = tiles_of(c) + 1024 * c;
            add_transposed(known, tile, part[0]);
            if (column == 0)
                for (int m = 0; m < 4; ++m) {
                    const int at = 2 * (8 * (m - m % 2) + 2 * row + m % 2);
                    answer[at] = known[m][0];
                    answer[at + 1] = known[m][1];
                }
        }
        __syncthreads();
    }
#else
    if (thread != 0)
        return;
    for (int c = own - 1; c >= 0; --c) {
        double known[64];
        for (int i = 0; i < 64; ++i)
            known[i] = x[64 * c + i];
        for (int r = c + 1; r < rows; ++r) {
            const double* tile = tiles_of(r) + 1024 * c;
            for (int k = 0; k < 32; ++k)
                for (int i = 0; i < 32; ++i) {
                    known[2 * i] -= tile[32 * k + i] * x[64 * r + 2 * k];
                    known[2 * i + 1] -= tile[32 * k + i] * x[64 * r + 2 * k + 1];
                }
        }
        const double* tile = tiles_of(c) + 1024 * c;
        for (int i = 0; i < 32; ++i) {
            double first = 0.0, second = 0.0;
            for (int k = 0; k < 32; ++k) {
                first += tile[32 * k + i] * known[2 * k];
                second += tile[32 * k + i] * known[2 * k + 1];
            }
            x[64 * c + 2 * i] = first;
            x[64 * c + 2 * i + 1] = second;
        }
    }
#endif
"""
)


@wp.func_native(_SUBTRACT_PRODUCT)
def subtract_product(
    panels: wp.array3d(dtype=wp.float64),
    left: int,
    right: int,
    count: int,
    out: wp.array3d(dtype=wp.float64),
    tile: int,
    lane: int,
):
    """Subtract a row of ``count`` tiles times another row, transposed, from a tile of ``out``."""
    ...


@wp.func_native(_MULTIPLY_TRANSPOSED)
def multiply_transposed(panels: wp.array3d(dtype=wp.float64), tile: int, factor: int, lane: int):
    """Multiply a tile by another one, transposed, in place."""
    ...


@wp.func_native(_SUBSTITUTE_FORWARD)
def substitute_forward(
    panels: wp.array3d(dtype=wp.float64),
    panel: int,
    own: int,
    rows: int,
    work: wp.array2d(dtype=wp.float64),
    begin: int,
    thread: int,
    threads: int,
):
    """Solve with the lower triangle of a front's own columns, and subtract from its border.

    ``panel`` is the front's first tile, ``rows`` its rows of tiles, ``begin`` its first row in
    ``work``. All threads of a block call it.
    """
    ...


@wp.func_native(_SUBSTITUTE_BACKWARD)
def substitute_backward(
    panels: wp.array3d(dtype=wp.float64),
    panel: int,
    own: int,
    rows: int,
    work: wp.array2d(dtype=wp.float64),
    begin: int,
    thread: int,
    threads: int,
):
    """Solve with the transposed lower triangle, once the border's solution is in ``work``."""
    ...
