# mypy: ignore-errors
"""Products of a panel's tiles with vectors, two at once; CUDA and C++ (ADR 0026).

A row of tiles, or a column transposed, is shared by ``PARTS`` warps. A small front is solved with
by one block of threads, which gathers what it takes and passes it on in shared memory. On a CPU one
thread does it. Sums are in single precision: no error of a solution is seen of it beside the
factor's, and to make doubles of the tiles takes as long as to read them.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched.dense_tiles import FRONT, INVERTED

PARTS = 2
"""Warps that share a row or a column of tiles. Sums do not depend on anything else."""

SMALL = 24
"""Rows of tiles of a small front, at most; no more than `INVERTED` are its own."""

JOBS = 8
"""Columns of a small front, and parts of them, among which the tiles below its own are shared."""

_VECTORS = (
    """
    using stored = float;  // tiles, vectors and sums
"""
    + FRONT
    + """
#ifdef __CUDA_ARCH__
    // A warp loads four rows of a tile at once, each by eight threads with four numbers.
    const int lane = thread % 32, warp = thread / 32, group = lane / 8, four = 4 * (lane % 8);
    auto four_at = [](const stored* p) { return *reinterpret_cast<const float4*>(p); };
    auto two_at = [](const stored* p) { return *reinterpret_cast<const float2*>(p); };
    // Threads whose numbers differ in a bit add up: each keeps half of the sums, the upper ones
    // where its bit is set.
    auto halve = [=](auto& sums, int half, int bit) {
        const bool upper = lane & bit;
        #pragma unroll
        for (int i = 0; i < 4; ++i)
            if (i < half)
                #pragma unroll
                for (int n = 0; n < 2; ++n) {
                    const stored low = sums[i][n], high = sums[i + half][n];
                    const stored given = __shfl_xor_sync(~0u, upper ? low : high, bit);
                    sums[i][n] = (upper ? high : low) + given;
                }
    };
    // A row of tiles times a vector, of which tiles ``first``, first + each, ... are taken; the
    // thread gets what belongs to ``row`` of the 32.
    const int row = 4 * (lane % 8) + group;
    auto row_product = [=](int r, const stored* vector, int first, int last, int each) {
        const stored* tile = tiles_of(r);
        stored sums[8][2] = {};
        #pragma unroll 2
        for (int c = first; c < last; c += each) {
            const float4 one = four_at(vector + 64 * c + 2 * four);
            const float4 two = four_at(vector + 64 * c + 2 * four + 4);
            #pragma unroll
            for (int i = 0; i < 8; ++i) {
                const float4 t = four_at(tile + 1024 * c + (4 * i + group) * 32 + four);
                sums[i][0] += t.x * one.x + t.y * one.z + t.z * two.x + t.w * two.z;
                sums[i][1] += t.x * one.y + t.y * one.w + t.z * two.y + t.w * two.w;
            }
        }
        halve(sums, 4, 4);
        halve(sums, 2, 2);
        halve(sums, 1, 1);
        return make_float2(sums[0][0], sums[0][1]);
    };
    // The same with transposed tiles of column c, in rows ``first``, first + each, ...
    const int column = four + 2 * (lane / 16) + group % 2;
    auto column_product = [=](int c, const stored* vector, int first, int last, int each) {
        stored sums[4][2] = {};
        #pragma unroll 2
        for (int r = first; r < last; r += each) {
            const stored* tile = tiles_of(r) + 1024 * c;
            #pragma unroll
            for (int i = 0; i < 8; ++i) {
                const int k = 4 * i + group;
                const float4 t = four_at(tile + 32 * k + four);
                const float2 factor = two_at(vector + 64 * r + 2 * k);
                const stored numbers[4] = {t.x, t.y, t.z, t.w};
                #pragma unroll
                for (int j = 0; j < 4; ++j) {
                    sums[j][0] += numbers[j] * factor.x;
                    sums[j][1] += numbers[j] * factor.y;
                }
            }
        }
        halve(sums, 2, 16);
        halve(sums, 1, 8);
        return make_float2(sums[0][0], sums[0][1]);
    };
#else
    auto row_product = [=](int r, const stored* vector, int first, int last, int i) {
        stored sum = 0;
        for (int c = first; c < last; ++c)
            for (int k = 0; k < 32; ++k)
                sum += tiles_of(r)[1024 * c + 32 * (i / 2) + k] * vector[64 * c + 2 * k + i % 2];
        return sum;
    };
    auto column_product = [=](int c, const stored* vector, int first, int last, int i) {
        stored sum = 0;
        for (int r = first; r < last; ++r)
            for (int k = 0; k < 32; ++k)
                sum += (tiles_of(r) + 1024 * c)[32 * k + i / 2] * vector[64 * r + 2 * k + i % 2];
        return sum;
    };
#endif
"""
)


def _multiply(product: str, place: str) -> str:
    """A product that warps share: its first arguments, and the thread's place of 32."""
    shared = """
    stored* result = out.data + size_t(out_row) * 2;
    const stored* known = source.data + size_t(source_row) * 2;
#ifdef __CUDA_ARCH__
    __shared__ float2 shared[WP_TILE_BLOCK_DIM / 32][32];
    float2(*mine)[32] = shared + threadIdx.x / 32 - warp;
    mine[warp][PLACE] = PRODUCT(first + warp, last, PARTS);
    __syncthreads();
    if (warp > 0)
        return;
    float2 total = mine[0][lane];
    for (int p = 1; p < PARTS; ++p) {
        total.x += mine[p][lane].x;
        total.y += mine[p][lane].y;
    }
    result[2 * lane] = subtract ? result[2 * lane] - total.x : total.x;
    result[2 * lane + 1] = subtract ? result[2 * lane + 1] - total.y : total.y;
#else
    if (thread == 0)
        for (int i = 0; i < 64; ++i) {
            const stored sum = PRODUCT(first, last, i);
            result[i] = subtract ? result[i] - sum : sum;
        }
#endif
"""
    shared = shared.replace("PARTS", str(PARTS)).replace("PLACE", place)
    return _VECTORS + shared.replace("PRODUCT(", product)


_SMALL_FRONT = """
    const int own_rows = 32 * own, all_rows = 32 * rows;
    const int* links = row_links.data + first_row;
    stored* begun_here = begun.data + (size_t(base) + first_row) * 2;
    stored* half_here = half.data + (size_t(base) + first_row) * 2;
#ifdef __CUDA_ARCH__
    constexpr int threads = WP_TILE_BLOCK_DIM, warps = threads / 32;
    __shared__ __align__(16) stored vector[SMALL * 64], other[INVERTED * 64];
#else
    if (thread > 0)
        return;
    constexpr int threads = 1;
    stored vector[SMALL * 64], other[INVERTED * 64];
#endif
""".replace("SMALL", str(SMALL)).replace("INVERTED", str(INVERTED))

_FORWARD = (
    _VECTORS
    + _SMALL_FRONT
    + """
    bool some = false;
    for (int at = thread; at < all_rows; at += threads) {
        double total[2] = {};
        if (at < own_rows && links[at] >= 0)
            for (int n = 0; n < lanes; ++n)
                total[n] = wp::index(vectors, slot, n, links[at]);
        for (int k = child; k < last_child; ++k) {
            const int there = rows_in_child.data[children.data[3 * k] + at];
            if (there >= 0) {
                const stored* from
                    = begun.data + (size_t(base) + children.data[3 * k + 2] + there) * 2;
                total[0] += from[0];
                total[1] += from[1];
            }
        }
        some = some || (at < own_rows && (total[0] != 0.0 || total[1] != 0.0));
        vector[2 * at] = total[0];
        vector[2 * at + 1] = total[1];
    }
#ifdef __CUDA_ARCH__
    const bool loaded = __syncthreads_or(some);
    for (int r = warp; r < own; r += warps) {
        const float2 product = row_product(r, vector, 0, loaded ? r + 1 : 0, 1);
        const int at = 64 * r + 2 * row;
        half_here[at] = other[at] = product.x;
        half_here[at + 1] = other[at + 1] = product.y;
    }
    __syncthreads();
    for (int r = own + warp; r < rows; r += warps) {
        const float2 product = row_product(r, other, 0, loaded ? own : 0, 1);
        const int at = 64 * r + 2 * row;
        begun_here[at] = vector[at] - product.x;
        begun_here[at + 1] = vector[at + 1] - product.y;
    }
#else
    for (int i = 0; i < 2 * own_rows; ++i)
        half_here[i] = other[i] = some ? row_product(i / 64, vector, 0, i / 64 + 1, i % 64) : 0.0;
    for (int i = 2 * own_rows; i < 2 * all_rows; ++i)
        begun_here[i] = vector[i] - (some ? row_product(i / 64, other, 0, own, i % 64) : 0.0);
#endif
"""
)

_BACKWARD = (
    _VECTORS
    + _SMALL_FRONT
    + """
    for (int at = own_rows + thread; at < all_rows; at += threads)
        for (int n = 0; n < 2; ++n)
            vector[2 * at + n]
                = links[at] < 0 ? 0.f : begun.data[(size_t(base) + links[at]) * 2 + n];
#ifdef __CUDA_ARCH__
    __shared__ float2 sums[INVERTED > JOBS ? INVERTED : JOBS][32];
    __syncthreads();
    const int parts = own < JOBS ? JOBS / own : 1;  // however many warps there are: the same bits
    for (int job = warp; job < own * parts; job += warps)
        sums[job][column] = column_product(job % own, vector, own + job / own, rows, parts);
    __syncthreads();
    for (int at = thread; at < own_rows; at += threads) {
        float2 left = two_at(half_here + 2 * at);
        for (int p = 0; p < parts; ++p) {
            const float2 sum = sums[p * own + at / 32][at % 32];
            left.x -= sum.x;
            left.y -= sum.y;
        }
        other[2 * at] = left.x;
        other[2 * at + 1] = left.y;
    }
    __syncthreads();
    for (int c = warp; c < own; c += warps) {
        const float2 product = column_product(c, other, c, own, 1);
        begun_here[64 * c + 2 * column] = product.x;
        begun_here[64 * c + 2 * column + 1] = product.y;
    }
#else
    for (int i = 0; i < 2 * own_rows; ++i)
        other[i] = half_here[i] - column_product(i / 64, vector, own, rows, i % 64);
    for (int i = 0; i < 2 * own_rows; ++i)
        begun_here[i] = column_product(i / 64, other, i / 64, own, i % 64);
#endif
""".replace("INVERTED", str(INVERTED)).replace("JOBS", str(JOBS))
)


@wp.func_native(_multiply("row_product(r, known, ", "row"))
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


@wp.func_native(_multiply("column_product(c, known, ", "column"))
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


@wp.func_native(_FORWARD)
def solve_small_rows(
    row_links: wp.array(dtype=wp.int32),
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    child: int,
    last_child: int,
    first_row: int,
    vectors: wp.array3d(dtype=wp.float64),
    slot: int,
    lanes: int,
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    rows: int,
    base: int,
    begun: wp.array2d(dtype=wp.float32),
    half: wp.array2d(dtype=wp.float32),
    thread: int,
):
    """What `gather_loads` and `solve_rows` do, for one small front and by one block of threads.

    The children are those of `FrontTiles`, from ``child`` on; ``first_row`` is the front's first
    row in a vector, and ``base`` the slot's. Blocks of any size find the same bits.
    """
    ...


@wp.func_native(_BACKWARD)
def solve_small_columns(
    row_links: wp.array(dtype=wp.int32),
    first_row: int,
    panels: wp.array3d(dtype=wp.float32),
    panel: int,
    own: int,
    rows: int,
    base: int,
    begun: wp.array2d(dtype=wp.float32),
    half: wp.array2d(dtype=wp.float32),
    thread: int,
):
    """What `gather_answers` and `solve_columns` do, likewise; borders keep what they had."""
    ...
