# mypy: ignore-errors
"""Dense fronts in tiles of 32 x 32: factorise, substitute, multiply; CUDA and C++ (ADR 0026).

Double precision. On a GPU from compute capability 8.0 on a warp of threads works on a tile with the
tensor cores and loads what they take from memory straight into registers: `warp.tile_matmul` goes
through shared memory, whose banks conflict for rows of 256 bytes. On a CPU, and on older GPUs, a
front is worked on by one thread.

What the tensor cores add is C (16 x 8) += A (16 x 8) B (8 x 8). Thread t of the warp holds, with
g = t / 4 and s = t % 4: A in rows g and g + 8, B in column g, C in rows g and g + 8 and columns 2 s
and 2 s + 1. Which eight of the summed numbers meet in one product does not matter, so a thread
takes two neighbours of a row, which it loads at once. A GPU before 9.0 does it in four parts.
"""

from __future__ import annotations

import warp as wp

TILE = 32
"""Rows and columns of a tile."""

LANES = 2
"""Vectors that are multiplied together."""

THREADS = 256
"""Threads of a block, which share a front."""

_TENSOR_CORES = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
#define PALPATE_TENSOR_CORES
    // Rows g (upper) and g + 8 (lower) of C += A B.
    auto add_product = [](double (&upper)[2], double (&lower)[2], double2 a, double2 b, double2 k) {
#if __CUDA_ARCH__ >= 900
        asm("mma.sync.aligned.m16n8k8.row.col.f64.f64.f64.f64 "
            "{%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
            : "+d"(upper[0]), "+d"(upper[1]), "+d"(lower[0]), "+d"(lower[1])
            : "d"(a.x), "d"(b.x), "d"(a.y), "d"(b.y), "d"(k.x), "d"(k.y));
#else
        auto part = [](double (&c)[2], double x, double y) {
            asm("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0,%1}, {%2}, {%3}, {%0,%1};"
                : "+d"(c[0]), "+d"(c[1]) : "d"(x), "d"(y));
        };
        part(upper, a.x, k.x);
        part(upper, a.y, k.y);
        part(lower, b.x, k.x);
        part(lower, b.y, k.y);
#endif
    };
    auto pair_at = [](const double* p) { return *reinterpret_cast<const double2*>(p); };
#endif
"""

_PRODUCTS = (
    _TENSOR_CORES
    + """
#ifdef PALPATE_TENSOR_CORES
    const int row = lane / 4, column = 2 * (lane % 4);
    // A warp works on half a tile, 16 rows of it: the sums of a whole one take too many registers.
    auto add_tiles = [=](double (&sum)[2][4][2], const double* a, const double* b) {
        a += row * 32 + column;
        b += row * 32 + column;
        #pragma unroll 2
        for (int k = 0; k < 32; k += 8, a += 8, b += 8) {
            const double2 upper = pair_at(a), lower = pair_at(a + 256);
            #pragma unroll
            for (int n = 0; n < 4; ++n)
                add_product(sum[0][n], sum[1][n], upper, lower, pair_at(b + 256 * n));
        }
    };
    // Half of: target = target - sum over i of a_i times transposed b_i
    auto subtract = [=](double* target, const double* a, const double* b, int count, int half) {
        double sum[2][4][2] = {};
        for (int i = 0; i < count; ++i)
            add_tiles(sum, a + 1024 * i + 512 * half, b + 1024 * i);
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int n = 0; n < 4; ++n) {
                double* at = target + 512 * half + (8 * m + row) * 32 + 8 * n + column;
                const double2 value = pair_at(at);
                *reinterpret_cast<double2*>(at)
                    = make_double2(value.x - sum[m][n][0], value.y - sum[m][n][1]);
            }
    };
    // Half of: target = target times transposed b
    auto multiply = [=](double* target, const double* b, int half) {
        double sum[2][4][2] = {};
        add_tiles(sum, target + 512 * half, b);
        __syncwarp();  // all have read what is overwritten now
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int n = 0; n < 4; ++n)
                *reinterpret_cast<double2*>(
                    target + 512 * half + (8 * m + row) * 32 + 8 * n + column)
                    = make_double2(sum[m][n][0], sum[m][n][1]);
    };
#else
    auto subtract = [](double* target, const double* a, const double* b, int count) {
        for (int i = 0; i < 32; ++i)
            for (int j = 0; j < 32; ++j) {
                double sum = 0.0;
                for (int n = 0; n < count; ++n)
                    for (int k = 0; k < 32; ++k)
                        sum += a[1024 * n + 32 * i + k] * b[1024 * n + 32 * j + k];
                target[32 * i + j] -= sum;
            }
    };
#endif
"""
)

_SUBTRACT_PRODUCT = (
    """
    const int lane = thread % 32;
"""
    + _PRODUCTS
    + """
    double* target = out.data + size_t(tile) * 1024;
    const double* a = panels.data + size_t(left) * 1024;
    const double* b = panels.data + size_t(right) * 1024;
#ifdef PALPATE_TENSOR_CORES
    subtract(target, a, b, count, thread / 32);
#else
    if (thread == 0)
        subtract(target, a, b, count);
#endif
"""
)

_FRONT = """
    double* tiles = panels.data + size_t(panel) * 1024;
    // First tile of a row of tiles; below the triangle all rows are equally long.
    auto tiles_of = [=](int r) {
        const int above = r < own ? r * (r + 1) / 2 : own * (own + 1) / 2 + (r - own) * own;
        return tiles + size_t(above) * 1024;
    };
"""

_FACTORISE = (
    """
    const int lane = thread % 32;
"""
    + _PRODUCTS
    + _FRONT
    + """
#ifdef PALPATE_TENSOR_CORES
    __shared__ double exchange[2][2][32];
    const int warp = thread / 32, warps = threads / 32;  // eight
    bool all_good = true;
    for (int c = 0; c < own; ++c) {
        double* diagonal = tiles_of(c) + 1024 * c;
        if (c > 0)
            for (int half = 2 * c + warp; half < 2 * rows; half += warps) {
                double* first = tiles_of(half / 2);
                subtract(first + 1024 * c, first, tiles_of(c), c, half % 2);
            }
        __syncthreads();
        // Every thread has four numbers of a row. Up to column k they are the inverse factor's,
        // which needs no room before; beyond, what elimination has left of the matrix.
        double mine[4];
        #pragma unroll
        for (int t = 0; t < 4; ++t)
            mine[t] = diagonal[32 * lane + warp + 8 * t];
        bool good = true;
        for (int k = 0; k < 32; ++k) {
            double* of_column = exchange[k % 2][0];
            double* of_row = exchange[k % 2][1];
            #pragma unroll
            for (int t = 0; t < 4; ++t) {
                if (warp + 8 * t == k)
                    of_column[lane] = mine[t];
                if (lane == k)
                    of_row[warp + 8 * t] = mine[t];
            }
            __syncthreads();
            const double pivot = of_column[k];
            good = good && pivot > 0.0 && pivot < 1e300;
            double scale;  // 1 / sqrt(pivot): 20 bits, doubled twice
            asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(scale) : "d"(pivot));
            scale *= 1.5 - 0.5 * pivot * scale * scale;
            scale *= 1.5 - 0.5 * pivot * scale * scale;
            const double factor = of_column[lane] * scale;
            #pragma unroll
            for (int t = 0; t < 4; ++t) {
                const int j = warp + 8 * t;
                const double other = (j > k ? of_column[j] : j < k ? of_row[j] : 1.0) * scale;
                const double before = j == k ? 0.0 : mine[t];
                if (lane > k)
                    mine[t] = before - factor * other;
                else if (j <= k)
                    mine[t] = lane == k ? other : before;
            }
        }
        #pragma unroll
        for (int t = 0; t < 4; ++t) {
            const int j = warp + 8 * t;
            diagonal[32 * lane + j] = good ? mine[t] : (j == lane ? 1.0 : 0.0);
        }
        all_good = all_good && good;
        __syncthreads();
        for (int half = 2 * c + 2 + warp; half < 2 * rows; half += warps)
            multiply(tiles_of(half / 2) + 1024 * c, diagonal, half % 2);
        __syncthreads();
    }
    if (thread == 0 && !all_good)
        bad.data[slot] = 1;
#else
    if (thread != 0)
        return;
    for (int c = 0; c < own; ++c) {
        double* diagonal = tiles_of(c) + 1024 * c;
        double factor[1024] = {}, inverse[1024] = {};
        bool good = true;
        for (int r = c; r < rows && c > 0; ++r)
            subtract(tiles_of(r) + 1024 * c, tiles_of(r), tiles_of(c), c);
        for (int j = 0; j < 32; ++j)
            for (int i = j; i < 32; ++i) {
                double sum = diagonal[32 * i + j];
                for (int k = 0; k < j; ++k)
                    sum -= factor[32 * i + k] * factor[32 * j + k];
                if (i == j)
                    good = good && sum > 0.0 && sum < 1e300;
                factor[32 * i + j] = i == j ? sqrt(sum) : sum / factor[32 * j + j];
            }
        for (int j = 0; j < 32; ++j)
            for (int i = j; i < 32; ++i) {
                double sum = i == j ? 1.0 : 0.0;
                for (int k = j; k < i; ++k)
                    sum -= factor[32 * i + k] * inverse[32 * k + j];
                inverse[32 * i + j] = sum / factor[32 * i + i];
            }
        for (int i = 0; i < 1024; ++i)
            diagonal[i] = good ? inverse[i] : (i % 33 == 0 ? 1.0 : 0.0);
        if (!good)
            bad.data[slot] = 1;
        for (int r = c + 1; r < rows; ++r) {
            double* tile = tiles_of(r) + 1024 * c;
            for (int i = 0; i < 32; ++i) {
                double answer[32] = {};
                for (int j = 0; j < 32; ++j)
                    for (int k = 0; k <= j; ++k)
                        answer[j] += tile[32 * i + k] * diagonal[32 * j + k];
                for (int j = 0; j < 32; ++j)
                    tile[32 * i + j] = answer[j];
            }
        }
    }
#endif
"""
)

_VECTORS = (
    _TENSOR_CORES
    + _FRONT
    + """
    double* x = work.data + size_t(begin) * 2;
#ifdef PALPATE_TENSOR_CORES
    const int lane = thread % 32, warp = thread / 32, warps = threads / 32;
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
    if (thread != 0)
        return;
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
#ifdef PALPATE_TENSOR_CORES
    __shared__ double part[8][64];
    auto place = [=](int m) { return 2 * (8 * (m - m % 2) + 2 * row + m % 2); };
    for (int c = own - 1; c >= 0; --c) {
        double sum[4][2] = {};
        for (int r = c + 1 + warp; r < rows; r += warps)
            add_transposed(sum, tiles_of(r) + 1024 * c, x + 64 * r);
        if (column == 0)
            for (int m = 0; m < 4; ++m)
                for (int n = 0; n < 2; ++n)
                    part[warp][place(m) + n] = sum[m][n];
        __syncthreads();
        if (warp == 0) {
            double* answer = x + 64 * c;
            for (int i = lane; i < 64; i += 32) {
                double value = answer[i];
                for (int w = 0; w < warps; ++w)
                    value -= part[w][i];
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


@wp.func_native(_SUBTRACT_PRODUCT)
def subtract_product(
    panels: wp.array3d(dtype=wp.float64),
    left: int,
    right: int,
    count: int,
    out: wp.array3d(dtype=wp.float64),
    tile: int,
    thread: int,
):
    """Subtract a row of ``count`` tiles times another row, transposed, from a tile of ``out``.

    All threads of two warps call it.
    """
    ...


@wp.func_native(_FACTORISE)
def factorise_panel(
    panels: wp.array3d(dtype=wp.float64),
    panel: int,
    own: int,
    rows: int,
    slot: int,
    bad: wp.array(dtype=wp.int32),
    thread: int,
    threads: int,
):
    """Factorise the own columns of a front, and divide the rows of its border.

    ``panel`` is the front's first tile, ``rows`` its rows of tiles. A diagonal tile becomes the
    inverse of its Cholesky factor; ``bad`` is set where a pivot is not positive, and a tile of ones
    on the diagonal takes its place. All threads of a block call it.
    """
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

    ``begin`` is the front's first row in ``work``, the rest as for `factorise_panel`.
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
