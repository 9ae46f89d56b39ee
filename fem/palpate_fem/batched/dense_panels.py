# mypy: ignore-errors
"""Panels of dense fronts: gather, factorise, invert triangles; CUDA and C++ (ADR 0026).

A panel is factorised by one block of threads, or column by column by as many as there are, with the
same bits. A diagonal tile becomes the inverse of its Cholesky factor, so that all else is products.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched.dense_tiles import CHILDREN, FRONT, PRODUCTS

_PANEL = (
    PRODUCTS
    + CHILDREN
    + FRONT
    + """
    // Which of the matrix's entries stand in a tile, if any do: -1 = none, -2 = a one.
    const stored* known = &wp::index(values, slot, 0);
    auto sources_of = [=](int r, int c) {
        const int at = sources_at.data[first_tile + above(r) + c];
        return at < 0 ? nullptr : sources.data + size_t(at) * 1024;
    };
    auto value_of = [=](int source) {
        const double value = known[source < 0 ? 0 : source];
        return source >= 0 ? value : source == -2 ? 1.0 : 0.0;
    };
#ifdef PALPATE_TENSOR_CORES
    auto add_entries = [=](double (&sum)[2][4][2], int r, int c, int half) {
        const int* from = sources_of(r, c);
        if (from == nullptr)
            return;
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int n = 0; n < 4; ++n) {
                const int2 source
                    = int_pair_at(from + 512 * half + (8 * m + row) * 32 + 8 * n + column);
                sum[m][n][0] -= value_of(source.x);
                sum[m][n][1] -= value_of(source.y);
            }
    };
    // Half of: target = what tile (r, c) begins with, less the products of its row with row c
    auto begin = [=](auto* target, int r, int c, int half, int count) {
        double sum[2][4][2] = {};
        gather(sum, r, c, half);
        add_entries(sum, r, c, half);
        subtract(sum, target, tiles_of(r), tiles_of(c), count, half);
    };
#else
    auto begin = [=](auto* target, int r, int c, int count) {
        const int* from = sources_of(r, c);
        subtract(target, tiles_of(r), tiles_of(c), count, [=](int i, int j) {
            return gathered(r, c, i, j) + (from ? value_of(from[32 * i + j]) : 0.0);
        });
    };
#endif
"""
)

_DIVIDE = """
#ifdef PALPATE_TENSOR_CORES
    // Half of: target = source, rounded, times transposed b
    auto multiply = [=](stored* target, const auto* source, const stored* b, int half) {
        double sum[2][4][2] = {};
        add_tiles(sum, source + 512 * half, b);
        __syncwarp();  // all have read what may be overwritten now
        write(target, sum, half, 1.0);
    };
    __shared__ stored exchange[2][2][32];
    constexpr int warps = WP_TILE_BLOCK_DIM / 32, each = 32 / warps;
    const int warp = thread / 32;
    // The inverse factor of a diagonal tile, by a block of threads; false: a pivot is not positive.
    // Every thread has some numbers of a row. Up to column k they are the inverse factor's,
    // which needs no room before; beyond, what elimination has left of the matrix.
    auto invert = [=](stored (&mine)[each], const auto* diagonal) {
        #pragma unroll
        for (int t = 0; t < each; ++t)
            mine[t] = stored(diagonal[32 * lane + warp + warps * t]);
        bool good = true;
        for (int k = 0; k < 32; ++k) {
            stored* of_column = exchange[k % 2][0];
            stored* of_row = exchange[k % 2][1];
            #pragma unroll
            for (int t = 0; t < each; ++t) {
                if (warp + warps * t == k)
                    of_column[lane] = mine[t];
                if (lane == k)
                    of_row[warp + warps * t] = mine[t];
            }
            __syncthreads();
            const stored pivot = of_column[k];
            good = good && pivot > 0.f && pivot < 1e30f;
            const stored scale = rsqrtf(pivot), factor = of_column[lane] * scale;
            #pragma unroll
            for (int t = 0; t < each; ++t) {
                const int j = warp + warps * t;
                const stored other = (j > k ? of_column[j] : j < k ? of_row[j] : 1.f) * scale;
                const stored before = j == k ? 0.f : mine[t];
                if (lane > k)
                    mine[t] = before - factor * other;
                else if (j <= k)
                    mine[t] = lane == k ? other : before;
            }
        }
        return good;
    };
    auto put = [=](stored* to, const stored (&mine)[each], bool good) {
        #pragma unroll
        for (int t = 0; t < each; ++t) {
            const int j = warp + warps * t;
            to[32 * lane + j] = good ? mine[t] : (j == lane ? 1.f : 0.f);
        }
    };
#else
    auto invert = [](stored* to, const auto* diagonal) {
        double factor[1024] = {}, inverse[1024] = {};
        bool good = true;
        for (int j = 0; j < 32; ++j)
            for (int i = j; i < 32; ++i) {
                double sum = stored(diagonal[32 * i + j]);
                for (int k = 0; k < j; ++k)
                    sum -= factor[32 * i + k] * factor[32 * j + k];
                if (i == j)
                    good = good && sum > 0.0 && sum < 1e30;
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
            to[i] = stored(good ? inverse[i] : (i % 33 == 0 ? 1.0 : 0.0));
        return good;
    };
    auto multiply = [](stored* target, const auto* source, const stored* b) {
        for (int i = 0; i < 32; ++i) {
            double answer[32] = {};
            for (int j = 0; j < 32; ++j)
                for (int k = 0; k <= j; ++k)
                    answer[j] += double(stored(source[32 * i + k])) * b[32 * j + k];
            for (int j = 0; j < 32; ++j)
                target[32 * i + j] = stored(answer[j]);
        }
    };
#endif
"""

_FACTORISE = (
    _PANEL
    + _DIVIDE
    + """
    bool all_good = true;
#ifdef PALPATE_TENSOR_CORES
    for (int c = 0; c < own; ++c) {
        stored* diagonal = tiles_of(c) + 1024 * c;
        for (int half = 2 * c + warp; half < 2 * rows; half += warps)
            begin(tiles_of(half / 2) + 1024 * c, half / 2, c, half % 2, c);
        __syncthreads();
        stored mine[each];
        const bool good = invert(mine, diagonal);
        put(diagonal, mine, good);
        all_good = all_good && good;
        __syncthreads();
        for (int half = 2 * c + 2 + warp; half < 2 * rows; half += warps) {
            stored* tile = tiles_of(half / 2) + 1024 * c;
            multiply(tile, tile, diagonal, half % 2);
        }
        __syncthreads();
    }
#else
    if (thread != 0)
        return;
    for (int c = 0; c < own; ++c) {
        stored* diagonal = tiles_of(c) + 1024 * c;
        for (int r = c; r < rows; ++r)
            begin(tiles_of(r) + 1024 * c, r, c, c);
        all_good = invert(diagonal, diagonal) && all_good;
        for (int r = c + 1; r < rows; ++r)
            multiply(tiles_of(r) + 1024 * c, tiles_of(r) + 1024 * c, diagonal);
    }
#endif
    if (thread == 0 && !all_good)
        bad.data[slot] = 1;
"""
)

_UNFINISHED = """
    // Tile (r, c) of a panel before its column is divided.
    auto unfinished_at = [=](int r, int c) {
        return unfinished.data + (size_t(first_unfinished) + above(r) + c) * 1024;
    };
"""

_BEGIN_TILE = (
    _PANEL
    + _UNFINISHED
    + """
    double* target = unfinished_at(r, c);
#ifdef PALPATE_TENSOR_CORES
    begin(target, r, c, thread / 32, 0);
#else
    if (thread == 0)
        begin(target, r, c, 0);
#endif
"""
)

_DIVIDE_COLUMN = (
    PRODUCTS
    + FRONT
    + _UNFINISHED
    + _DIVIDE
    + """
    stored* to = tiles_of(c) + 1024 * c;
#ifdef PALPATE_TENSOR_CORES
    __shared__ __align__(16) stored inverse[1024];
    stored mine[each];
    const bool good = invert(mine, unfinished_at(c, c));
    put(inverse, mine, good);
    if (part == 0)
        put(to, mine, good);
    __syncthreads();
    for (int half = 2 * c + 2 + part * warps + warp; half < 2 * rows; half += parts * warps)
        multiply(
            tiles_of(half / 2) + 1024 * c, unfinished_at(half / 2, c), inverse, half % 2);
    if (part == 0 && thread == 0 && !good)
        bad.data[slot] = 1;
#else
    if (part > 0 || thread > 0)
        return;
    if (!invert(to, unfinished_at(c, c)))
        bad.data[slot] = 1;
    for (int r = c + 1; r < rows; ++r)
        multiply(tiles_of(r) + 1024 * c, unfinished_at(r, c), to);
#endif
"""
)

_INVERT_TRIANGLE = (
    PRODUCTS
    + FRONT
    + """
    // Row after row, in place: times the diagonal's inverse, negative, then times the rows above,
    // which are inverted.
#ifdef PALPATE_TENSOR_CORES
    // Half of: sum += a times b
    auto add_product_of = [=](double (&sum)[2][4][2], const stored* a, const stored* b) {
        a += row * 32 + four;
        b += four * 32 + row;
        #pragma unroll 1
        for (int k = 0; k < 32; k += 16, a += 16, b += 512) {
            const Four upper = four_at(a), lower = four_at(a + 256);
            #pragma unroll
            for (int n = 0; n < 4; ++n) {
                const stored* at = b + 8 * n;
                add_product(
                    sum[0][n], sum[1][n], upper.first, lower.first, make_double2(at[0], at[32]));
                add_product(
                    sum[0][n], sum[1][n], upper.second, lower.second, make_double2(at[64], at[96]));
            }
        }
    };
    constexpr int warps = WP_TILE_BLOCK_DIM / 32;
    const int warp = thread / 32;
    for (int c = corner + 1; c < end; ++c) {
        stored* tiles_in_row = tiles_of(c);
        const stored* diagonal = tiles_in_row + 1024 * c;
        // Warps of one round read what they overwrite; later ones read none of it.
        for (int first = 2 * corner; first < 2 * c; first += warps) {
            const int j = (first + warp) / 2, half = warp % 2;
            double sum[2][4][2] = {};
            if (j < c)
                add_product_of(sum, diagonal + 512 * half, tiles_in_row + 1024 * j);
            __syncthreads();
            if (j < c)
                write(tiles_in_row + 1024 * j, sum, half, -1.0);
        }
        __syncthreads();
        for (int first = 2 * corner; first < 2 * c; first += warps) {
            const int j = (first + warp) / 2, half = warp % 2;
            double sum[2][4][2] = {};
            if (j < c)
                for (int k = j; k < c; ++k)
                    add_product_of(
                        sum, tiles_in_row + 1024 * k + 512 * half, tiles_of(k) + 1024 * j);
            __syncthreads();
            if (j < c)
                write(tiles_in_row + 1024 * j, sum, half, 1.0);
        }
    }
#else
    if (thread != 0)
        return;
    auto add_product_of = [](double* sum, const stored* a, const stored* b) {
        for (int i = 0; i < 32; ++i)
            for (int j = 0; j < 32; ++j)
                for (int k = 0; k < 32; ++k)
                    sum[32 * i + j] += double(a[32 * i + k]) * b[32 * k + j];
    };
    for (int c = corner + 1; c < end; ++c) {
        stored* tiles_in_row = tiles_of(c);
        for (int j = corner; j < c; ++j) {
            double sum[1024] = {};
            add_product_of(sum, tiles_in_row + 1024 * c, tiles_in_row + 1024 * j);
            for (int i = 0; i < 1024; ++i)
                tiles_in_row[1024 * j + i] = stored(-sum[i]);
        }
        for (int j = corner; j < c; ++j) {
            double sum[1024] = {};
            for (int k = j; k < c; ++k)
                add_product_of(sum, tiles_in_row + 1024 * k, tiles_of(k) + 1024 * j);
            for (int i = 0; i < 1024; ++i)
                tiles_in_row[1024 * j + i] = stored(sum[i]);
        }
    }
#endif
"""
)

_SUBTRACT_COLUMN = (
    PRODUCTS
    + FRONT
    + _UNFINISHED
    + """
    double* tile = unfinished_at(r, j);
    const stored* a = tiles_of(r) + 1024 * c;
    const stored* b = tiles_of(j) + 1024 * c;
#ifdef PALPATE_TENSOR_CORES
    const int half = thread / 32;
    double sum[2][4][2];
    #pragma unroll
    for (int m = 0; m < 2; ++m)
        #pragma unroll
        for (int n = 0; n < 4; ++n) {
            const double2 before = *reinterpret_cast<const double2*>(
                tile + 512 * half + (8 * m + row) * 32 + 8 * n + column);
            sum[m][n][0] = -before.x;
            sum[m][n][1] = -before.y;
        }
    subtract(sum, tile, a, b, 1, half);
#else
    if (thread == 0)
        subtract(tile, a, b, 1, [=](int i, int k) { return tile[32 * i + k]; });
#endif
"""
)


@wp.func_native(_FACTORISE)
def factorise_panel(
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    child: int,
    last_child: int,
    first_share: int,
    shares: wp.array3d(dtype=wp.float32),
    sources_at: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    first_tile: int,
    values: wp.array2d(dtype=wp.float32),
    slot: int,
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    rows: int,
    bad: wp.array(dtype=wp.int32),
    thread: int,
):
    """Gather and factorise the own columns of a front, and divide the rows of its border.

    Children as for `subtract_product`; ``sources_at`` says for each tile of a matrix where the
    numbers of its entries stand in ``sources``. ``first_tile`` is the front's first one in a
    matrix, ``panel`` that in ``panels``, ``rows`` its rows of tiles. A diagonal tile becomes the
    inverse of its Cholesky factor; ``bad`` is set where a pivot is not positive, and a tile of ones
    on the diagonal takes its place. All threads of a block call it.
    """
    ...


@wp.func_native(_BEGIN_TILE)
def begin_tile(
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    child: int,
    last_child: int,
    first_share: int,
    shares: wp.array3d(dtype=wp.float32),
    sources_at: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    first_tile: int,
    values: wp.array2d(dtype=wp.float32),
    slot: int,
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    r: int,
    c: int,
    unfinished: wp.array3d(dtype=wp.float64),
    first_unfinished: int,
    thread: int,
):
    """Gather tile (r, c) of a front's panel into ``unfinished``. For two warps.

    With `divide_column` and `subtract_column` for each column after it, the same numbers in the
    same order as `factorise_panel`, to the bit, by as many blocks of threads as there are: sums
    that are not complete keep their precision. The front's tiles are ``first_unfinished`` and on.
    """
    ...


@wp.func_native(_DIVIDE_COLUMN)
def divide_column(
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    rows: int,
    c: int,
    unfinished: wp.array3d(dtype=wp.float64),
    first_unfinished: int,
    part: int,
    parts: int,
    slot: int,
    bad: wp.array(dtype=wp.int32),
    thread: int,
):
    """Invert the factor of a diagonal tile, and divide the column below it: ``unfinished`` no more.

    For ``parts`` blocks of threads, each of which inverts it, since to wait for one takes longer.
    """
    ...


@wp.func_native(_SUBTRACT_COLUMN)
def subtract_column(
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    c: int,
    r: int,
    j: int,
    unfinished: wp.array3d(dtype=wp.float64),
    first_unfinished: int,
    thread: int,
):
    """Subtract column c's product from tile (r, j), which is ``unfinished``. For two warps."""
    ...


@wp.func_native(_INVERT_TRIANGLE)
def invert_triangle(
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    corner: int,
    end: int,
    thread: int,
):
    """Invert a triangle on the diagonal of a factorised panel, tiles ``corner`` up to ``end``.

    Its diagonal tiles are inverted. All threads of a block call it.
    """
    ...
