# mypy: ignore-errors
"""Dense fronts in tiles of 32 x 32: gather and multiply; CUDA and C++ (ADR 0026).

What a front takes from its children's shares, and from the matrix, it gathers where it needs it:
sums begin with that, products are subtracted, and a tile is written once.

Tiles are kept in single precision, as half the bytes take half the time, and sums are added up in
double. On a GPU from compute capability 8.0 on a warp of threads works on a tile with the tensor
cores and loads what they take from memory straight into registers: `warp.tile_matmul` goes through
shared memory, whose banks conflict. On a CPU, and on older GPUs, one thread works on a front.

What the tensor cores add is C (16 x 8) += A (16 x 8) B (8 x 8). Thread t of the warp holds, with
g = t / 4 and s = t % 4: A in rows g and g + 8, B in column g, C in rows g and g + 8 and columns 2 s
and 2 s + 1. Which eight of the summed numbers meet in one product does not matter, so a thread
takes four neighbours of a row, which it loads at once, for two products. A GPU before 9.0 does each
in four parts.
"""

from __future__ import annotations

import warp as wp

TILE = 32
"""Rows and columns of a tile."""

LANES = 2
"""Vectors that are multiplied together."""

INVERTED = 12
"""Tiles along a side of the triangles on a front's diagonal that are kept inverted.

What such a triangle is multiplied with is solved for at once; the next triangle waits for it.
"""

THREADS, WIDE = 256, 512
"""Threads of a block, which share a front: where there are many fronts, and where there are few."""

TENSOR_CORES = """
    using stored = float;  // what tiles are stored in
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
    struct Four { double2 first, second; };
    auto four_at = [](const auto* p) {
        using number = decltype(+*p);
        struct alignas(4 * sizeof(number)) Numbers { number x, y, z, w; };
        const Numbers four = *reinterpret_cast<const Numbers*>(p);
        return Four{make_double2(stored(four.x), stored(four.y)),
                    make_double2(stored(four.z), stored(four.w))};
    };
#endif
"""

PRODUCTS = (
    TENSOR_CORES
    + """
    const int lane = thread % 32;
#ifdef PALPATE_TENSOR_CORES
    const int row = lane / 4, column = 2 * (lane % 4), four = 4 * (lane % 4);
    // A warp works on half a tile, 16 rows of it: the sums of a whole one take too many registers.
    auto add_tiles = [=](double (&sum)[2][4][2], const auto* a, const stored* b) {
        a += row * 32 + four;
        b += row * 32 + four;
        #pragma unroll 1
        for (int k = 0; k < 32; k += 16, a += 16, b += 16) {
            const Four upper = four_at(a), lower = four_at(a + 256);
            #pragma unroll
            for (int n = 0; n < 4; ++n) {
                const Four other = four_at(b + 256 * n);
                add_product(sum[0][n], sum[1][n], upper.first, lower.first, other.first);
                add_product(sum[0][n], sum[1][n], upper.second, lower.second, other.second);
            }
        }
    };
    auto int_pair_at = [](const int* p) { return *reinterpret_cast<const int2*>(p); };
    // Half of: target = sign times sum
    auto write = [=](auto* target, const double (&sum)[2][4][2], int half, double sign) {
        using number = decltype(+*target);
        struct alignas(2 * sizeof(number)) Pair { number x, y; };
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int n = 0; n < 4; ++n)
                *reinterpret_cast<Pair*>(
                    target + 512 * half + (8 * m + row) * 32 + 8 * n + column)
                    = Pair{number(sign * sum[m][n][0]), number(sign * sum[m][n][1])};
    };
    // Half of: target = - sum - sum over i of a_i times transposed b_i
    auto subtract = [=](double (&sum)[2][4][2], auto* target, const stored* a, const stored* b,
                        int count, int half) {
        __syncwarp();  // threads that gathered meet again
        for (int i = 0; i < count; ++i)
            add_tiles(sum, a + 1024 * i + 512 * half, b + 1024 * i);
        write(target, sum, half, -1.0);
    };
#else
    // Target = begin - sum over n of a_n times transposed b_n
    auto subtract = [](auto* target, const stored* a, const stored* b, int count, auto begin) {
        for (int i = 0; i < 32; ++i)
            for (int j = 0; j < 32; ++j) {
                double sum = begin(i, j);
                for (int n = 0; n < count; ++n)
                    for (int k = 0; k < 32; ++k)
                        sum -= double(a[1024 * n + 32 * i + k]) * b[1024 * n + 32 * j + k];
                target[32 * i + j] = sum;
            }
    };
#endif
"""
)

CHILDREN = """
    // Where a front's rows are in the border of its child k; the first tile of that one's share.
    auto rows_in = [=](int k) { return rows_in_child.data + children.data[3 * k]; };
    auto share_of = [=](int k) {
        return shares.data + (size_t(first_share) + children.data[3 * k + 1]) * 1024;
    };
    // An entry of a share, a lower triangle. Where there is none, the first one is read in vain:
    // with a branch a thread would wait for each entry before it asks for the next.
    auto entry_of = [](const stored* share, int a, int b) {
        const bool inside = a >= (b & 0x7fffffff);  // -1 becomes the largest number
        const int row = (((a >> 5) * ((a >> 5) + 1)) >> 1) * 1024 + (a & 31) * 32;
        const int column = (b >> 5) * 1024 + (b & 31);
        const double value = share[inside ? row + column : 0];
        return inside ? value : 0.0;
    };
#ifdef PALPATE_TENSOR_CORES
    // Half of what the children's shares add up to in tile (r, c), negative.
    auto gather = [=](double (&sum)[2][4][2], int r, int c, int half) {
        for (int k = child; k < last_child; ++k) {
            const int* rows_there = rows_in(k);
            const int* a = rows_there + 32 * r + 16 * half + row;
            const int* b = rows_there + 32 * c + column;
            const stored* share = share_of(k);
            const int upper = a[0], lower = a[8];
            int2 at[4];
            bool none = true;
            #pragma unroll
            for (int n = 0; n < 4; ++n) {
                at[n] = int_pair_at(b + 8 * n);
                none = none && (at[n].x & at[n].y) < 0;  // both are -1
            }
            if (__all_sync(~0u, none || (upper & lower) < 0))
                continue;
            #pragma unroll
            for (int n = 0; n < 4; ++n) {
                sum[0][n][0] -= entry_of(share, upper, at[n].x);
                sum[0][n][1] -= entry_of(share, upper, at[n].y);
                sum[1][n][0] -= entry_of(share, lower, at[n].x);
                sum[1][n][1] -= entry_of(share, lower, at[n].y);
            }
        }
    };
#else
    // What the children's shares add up to at row i and column j of tile (r, c).
    auto gathered = [=](int r, int c, int i, int j) {
        double sum = 0.0;
        for (int k = child; k < last_child; ++k)
            sum += entry_of(share_of(k), rows_in(k)[32 * r + i], rows_in(k)[32 * c + j]);
        return sum;
    };
#endif
"""

_SUBTRACT_PRODUCT = (
    PRODUCTS
    + CHILDREN
    + """
    stored* target = shares.data + size_t(tile) * 1024;
    const stored* a = panels.data + size_t(left) * 1024;
    const stored* b = panels.data + size_t(right) * 1024;
#ifdef PALPATE_TENSOR_CORES
    double sum[2][4][2] = {};
    gather(sum, r, c, thread / 32);
    subtract(sum, target, a, b, count, thread / 32);
#else
    if (thread == 0)
        subtract(target, a, b, count, [=](int i, int j) { return gathered(r, c, i, j); });
#endif
"""
)

FRONT = """
    stored* tiles = panels.data + size_t(panel) * 1024;
    // First tile of a row of tiles; below the triangle all rows are equally long.
    auto above = [=](int r) {
        return r < own ? r * (r + 1) / 2 : own * (own + 1) / 2 + (r - own) * own;
    };
    auto tiles_of = [=](int r) { return tiles + size_t(above(r)) * 1024; };
"""


@wp.func_native(_SUBTRACT_PRODUCT)
def subtract_product(
    children: wp.array2d(dtype=wp.int32),
    rows_in_child: wp.array(dtype=wp.int32),
    child: int,
    last_child: int,
    first_share: int,
    panels: wp.array3d(dtype=wp.float32),
    left: int,
    right: int,
    count: int,
    shares: wp.array3d(dtype=wp.float32),
    tile: int,
    r: int,
    c: int,
    thread: int,
):
    """Set a tile of a share to what the children's shares add up to, less a product.

    The product is that of two rows of ``count`` tiles, the second transposed. ``r`` and ``c`` are
    the tile's place in the front, and ``tile`` that in ``shares``; the children are those of
    `FrontTiles`, from ``child`` on, and ``first_share`` is the slot's first tile. All threads of
    two warps call it.
    """
    ...


@wp.func
def end_of(corner: int, own: int):
    """First tile after a triangle on the diagonal that begins at tile ``corner``."""
    return wp.min(corner + wp.static(INVERTED), own)
