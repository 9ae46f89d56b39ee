"""Dense algebra of the fronts, compiled for the processor that it runs on.

Warp compiles the loops. They run over many fronts in one call and without the interpreter lock, so
that both halves of the tree advance at once.

A front is a *panel* and a *share*. The panel has a column for each unknown that the front
eliminates, and a row for each of its unknowns: its own and then the border. It is stored as blocks
of BLOCK x BLOCK entries, row of blocks after row of blocks, in a block column after column: what
the innermost loops read is contiguous, as BLAS has to arrange it first. Own unknowns and border
are filled up to whole blocks with zeros. The share, the Schur complement of the border, is stored
column after column.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, no_type_check

import numpy as np
import warp as wp
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from palpate_fem.device import DEVICE

wp.set_module_options({"enable_backward": False})

Array = NDArray[Any]

_LIBRARIES = ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep BLAS, NumPy's too, on the calling thread.

    Its own threads would compete with the two that work on the halves of the tree, and starting
    them takes longer than our short vectors do.
    """
    with _LIBRARIES.limit(limits=1, user_api="blas"):
        yield


BLOCK = 8
"""Rows and columns of a block: a column of a block is one register in single precision."""

DEPTH = 256
"""Columns whose product is subtracted at a time: three rows of so many blocks fit the L1 cache."""

LOST = {np.dtype(np.float32): 1e-6, np.dtype(np.float64): 2e-14}
"""Share of a diagonal entry below which its remainder after elimination may be rounding error."""

FIELDS = (
    "own",  # unknowns that the front eliminates
    "border",  # other unknowns
    "columns",  # of the panel: ``own``, rounded up to blocks
    "stride",  # distance of two columns of the share
    "panel",  # place of the panel in all panels
    "share",  # place of the share in all shares
    "first",  # its first unknown in the order of elimination
    "parent",  # its parent, or -1
    "far",  # place of its border in the list of all borders
    "entries",  # first and last of its entries of the matrix
    "entries_end",
    "children",  # first and last in the list of all children
    "children_end",
    "runs",  # first and last of the runs of its border unknowns
    "runs_end",
)
"""Columns of the table of fronts."""

_PRELUDE = (
    "enum { " + ", ".join(name.upper() for name in FIELDS) + ", FIELDS };"
    f"enum {{ BLOCK = {BLOCK}, DEPTH = {DEPTH} }};"
    f"const double lost = sizeof(*panels.data) == 4 ? {LOST[np.dtype(np.float32)]}"
    f" : {LOST[np.dtype(np.float64)]};"
    r"""
using Real = __remove_reference_t(decltype(*panels.data));
typedef Real Column __attribute__((vector_size(BLOCK * sizeof(Real)), may_alias));
struct One { char size[1]; };
struct Two { char size[2]; };
struct Four { char size[4]; };
const long* fronts = (const long*)table.data;
auto blocks = [](long size) { return (size + BLOCK - 1) / BLOCK; };
"""
)

_FACTORISE = (
    _PRELUDE
    + r"""
const double* values = (const double*)task.data[2];
typedef Real Run __attribute__((vector_size(BLOCK * sizeof(Real)), aligned(sizeof(Real)),
                                may_alias));
typedef decltype(Column{} < Column{}) Mask;
Mask lane;
for (int k = 0; k < BLOCK; ++k) lane[k] = k;

// Adds the entries of a column that the mask names; reads and writes a whole one.
auto add_some = [](Real* to, const Real* from, Mask mask) {
    *(Run*)to += (Run)((Mask)*(const Run*)from & mask);
};

// Extend-add: the part of the children's shares that belongs to the panel.
auto add_to_panel = [&](const long* front) {
    const int own = front[OWN];
    const long row = front[COLUMNS] * (long)BLOCK;
    for (long c = front[CHILDREN]; c < front[CHILDREN_END]; ++c) {
        const long* child = fronts + children.data[c] * (long)FIELDS;
        const long stride = child[STRIDE];
        const int* end = runs.data + 3 * child[RUNS_END];
        for (const int* run = runs.data + 3 * child[RUNS]; run < end && run[1] < own; run += 3) {
            const int width = run[2] < own - run[1] ? run[2] : own - run[1];
            const Real* from = shares.data + child[SHARE] + run[0] * stride;
            Real* to = panels.data + front[PANEL] + run[1] * (long)BLOCK;
            for (const int* other = run; other < end; other += 3) {
                const int last = other[1] + other[2];
                for (int first = other[1] / BLOCK * BLOCK; first < last; first += BLOCK) {
                    const Mask mask = (lane >= other[1] - first) & (lane < last - first);
                    const Real* source = from + other[0] - other[1] + first;
                    Real* target = to + first / BLOCK * row;
                    // Above the diagonal there is nothing to add.
                    const int below = first + BLOCK - run[1];
                    const int count = below < width ? below : width;
                    for (int k = 0; k < count; ++k)
                        add_some(target + k * BLOCK, source + k * stride, mask);
                }
            }
        }
    }
};

// And the part that belongs to the share.
auto add_to_share = [&](const long* front) {
    const int own = front[OWN], columns = front[COLUMNS];
    for (long c = front[CHILDREN]; c < front[CHILDREN_END]; ++c) {
        const long* child = fronts + children.data[c] * (long)FIELDS;
        const int* end = runs.data + 3 * child[RUNS_END];
        for (const int* run = runs.data + 3 * child[RUNS]; run < end; run += 3)
            for (int i = run[1] < own ? own - run[1] : 0; i < run[2]; ++i) {
                const Real* from = shares.data + child[SHARE] + (run[0] + i) * child[STRIDE];
                Real* to = shares.data + front[SHARE] + (run[1] + i - columns) * front[STRIDE];
                for (const int* other = run; other < end; other += 3) {
                    const int skip = other == run ? i : 0, count = other[2] - skip;
                    const Real* source = from + other[0] + skip;
                    Real* target = to + other[1] + skip - columns;
                    int k = 0;
                    for (; k + BLOCK <= count; k += BLOCK)
                        *(Run*)(target + k) += *(const Run*)(source + k);
                    if (k < count) add_some(target + k, source + k, lane < count - k);
                }
            }
    }
};

auto fill_panel = [&](const long* front) {
    const long rows = blocks(front[COLUMNS] + front[BORDER]) * BLOCK;
    __builtin_memset(panels.data + front[PANEL], 0, rows * front[COLUMNS] * sizeof(Real));
    for (long e = front[ENTRIES]; e < front[ENTRIES_END]; ++e)
        panels.data[places.data[e]] = entries.data[e];
    add_to_panel(front);
};

// C - A B^T for a tile of some blocks of rows and some columns.
auto subtract = [](auto height, auto width, Real* c, long c_block, long c_column, const Real* a,
                   long a_block, const Real* b, int depth,
                   bool clear) __attribute__((always_inline)) {
    #pragma clang fp contract(fast)
    constexpr int H = sizeof(height), W = sizeof(width);
    Column x[H][W];
    #pragma unroll
    for (int h = 0; h < H; ++h)
        #pragma unroll
        for (int j = 0; j < W; ++j)
            x[h][j] = clear ? Column{} : *(const Column*)(c + h * c_block + j * c_column);
    for (int k = 0; k < depth; ++k) {
        Column left[H];
        #pragma unroll
        for (int h = 0; h < H; ++h) left[h] = *(const Column*)(a + h * a_block + k * BLOCK);
        #pragma unroll
        for (int j = 0; j < W; ++j)
            #pragma unroll
            for (int h = 0; h < H; ++h) x[h][j] -= left[h] * b[k * BLOCK + j];
    }
    #pragma unroll
    for (int h = 0; h < H; ++h)
        #pragma unroll
        for (int j = 0; j < W; ++j) *(Column*)(c + h * c_block + j * c_column) = x[h][j];
};
// The same for a block column of C, from its first block of rows to the last.
auto subtract_column = [&](Real* c, long c_block, long c_column, const Real* a, long a_block,
                           const Real* b, int depth, int count, bool clear) {
    int i = 0;
    if (sizeof(Real) == 4)  // in double precision there are registers for one
        for (; i + 1 < count; i += 2)
            for (int j = 0; j < BLOCK; j += 4)
                subtract(Two{}, Four{}, c + i * c_block + j * c_column, c_block, c_column,
                         a + i * a_block, a_block, b + j, depth, clear);
    for (; i < count; ++i)
        for (int j = 0; j < BLOCK; j += 4)
            subtract(One{}, Four{}, c + i * c_block + j * c_column, c_block, c_column,
                     a + i * a_block, a_block, b + j, depth, clear);
};

// C L^-T for one block; the diagonal of L is inverted.
auto divide = [](Real* c, const Real* factor) {
    #pragma clang fp contract(fast)
    Column x[BLOCK];
    #pragma unroll
    for (int j = 0; j < BLOCK; ++j) x[j] = *(const Column*)(c + j * BLOCK);
    #pragma unroll
    for (int j = 0; j < BLOCK; ++j) {
        x[j] *= factor[j * BLOCK + j];
        #pragma unroll
        for (int k = j + 1; k < BLOCK; ++k) x[k] -= x[j] * factor[j * BLOCK + k];
    }
    #pragma unroll
    for (int j = 0; j < BLOCK; ++j) *(Column*)(c + j * BLOCK) = x[j];
};

// Cholesky factor of a block on the diagonal, with an inverted diagonal; false if it is not safe.
auto invert_corner = [](const Real* block, int count, const Real* least, Real* factor) {
    Real rest[BLOCK * BLOCK];
    for (int k = 0; k < BLOCK * BLOCK; ++k) {
        rest[k] = block[k];
        factor[k] = k % (BLOCK + 1) == 0;
    }
    for (int p = 0; p < count; ++p) {
        const Real pivot = rest[p * BLOCK + p];
        // What little is left of an entry has lost its digits by cancellation.
        if (!(pivot > 0 && pivot >= least[p])) return false;
        const Real inverse = 1 / wp::sqrt(pivot);
        Real* column = factor + p * BLOCK;
        column[p] = inverse;
        for (int r = p + 1; r < count; ++r) column[r] = rest[p * BLOCK + r] * inverse;
        for (int q = p + 1; q < count; ++q)
            for (int r = q; r < count; ++r) rest[q * BLOCK + r] -= column[r] * column[q];
    }
    return true;
};

// Cholesky factorisation of a panel; returns whether all pivots are safe.
auto eliminate = [&](const long* front) {
    const int own = front[OWN], columns = front[COLUMNS];
    const int rows = blocks(columns + front[BORDER]);  // of blocks
    const long row = columns * (long)BLOCK;
    Real* panel = panels.data + front[PANEL];
    Real* least = scales.data + front[FIRST];
    for (int j = 0; j < own; ++j)
        least[j] = lost * __builtin_fabs(panel[j / BLOCK * row + j * BLOCK + j % BLOCK]);
    for (int begin = 0; begin < columns; begin += DEPTH) {
        const int end = columns < begin + DEPTH ? columns : begin + DEPTH;
        for (int j = begin; j < end; j += BLOCK) {
            const int corner = j / BLOCK, depth = j - begin;
            const Real* left = panel + corner * row + begin * BLOCK;
            Real* block = panel + corner * row + j * BLOCK;
            const int count = own - j < BLOCK ? own - j : BLOCK;
            Real factor[BLOCK * BLOCK];
            subtract_column(block, row, BLOCK, left, row, left, depth, rows - corner, false);
            if (!invert_corner(block, count, least + j, factor)) return false;
            for (int p = 0; p < count; ++p) {
                block[p * BLOCK + p] = 1 / factor[p * BLOCK + p];
                for (int r = p + 1; r < count; ++r) block[p * BLOCK + r] = factor[p * BLOCK + r];
            }
            for (int i = 1; i < rows - corner; ++i) divide(block + i * row, factor);
        }
        for (int j = end; j < columns; j += BLOCK) {
            const Real* left = panel + j / BLOCK * row + begin * BLOCK;
            subtract_column(panel + j / BLOCK * row + j * BLOCK, row, BLOCK, left, row, left,
                            end - begin, rows - j / BLOCK, false);
        }
    }
    return true;
};

for (long i = task.data[0]; i < task.data[1]; ++i) {
    const long* front = fronts + i * FIELDS;
    bool different = changed.data[i];
    for (long e = front[ENTRIES]; e < front[ENTRIES_END]; ++e) {
        const Real value = values[sources.data[e]];
        different |= value != entries.data[e];
        entries.data[e] = value;
    }
    if (!different) continue;
    changed.data[i] = 1;
    if (front[PARENT] >= 0) changed.data[front[PARENT]] = 1;
    diagonal.data[i] = 0;
    const int own = front[OWN], border = front[BORDER], columns = front[COLUMNS];
    Real* share = shares.data + front[SHARE];
    fill_panel(front);
    if (!eliminate(front)) {
        // As it was, for the caller to see to.
        fill_panel(front);
        __builtin_memset(share, 0, blocks(border) * BLOCK * front[STRIDE] * sizeof(Real));
        add_to_share(front);
        task.data[0] = i;
        return;
    }
    // Writes all that is read of the share, which need not be cleared before.
    const Real* below = panels.data + front[PANEL] + columns * (long)columns;
    for (int begin = 0; begin < own; begin += DEPTH)
        for (int j = 0; j < border; j += BLOCK) {
            const Real* left = below + (j * (long)columns + begin * BLOCK);
            subtract_column(share + j * (front[STRIDE] + 1), BLOCK, front[STRIDE], left,
                            columns * (long)BLOCK, left, own < begin + DEPTH ? own - begin : DEPTH,
                            blocks(border - j), !begin);
        }
    add_to_share(front);
}
task.data[0] = task.data[1];
"""
)

_SUBSTITUTE = (
    _PRELUDE
    + r"""
const long length = vectors.shape[1], room = scratch.shape[1];

// A front that was diagonalised, A11^-1 = W D W^T: plain loops, for there are few.
auto substitute_diagonal = [&](const long* front, const Real* panel, Real* y, bool down) {
    const int own = front[OWN], columns = front[COLUMNS], size = columns + front[BORDER];
    const Real* sign = signs.data + front[FIRST];
    auto at = [&](int r, int c) {
        return panel[(r / BLOCK * (long)columns + c) * BLOCK + r % BLOCK];
    };
    Real* x = y + blocks(size) * BLOCK;
    for (int j = 0; j < own; ++j) {
        Real sum = 0;
        for (int r = down ? 0 : columns; r < (down ? own : size); ++r) sum += at(r, j) * y[r];
        x[j] = down ? sign[j] * sum : y[j] - sign[j] * sum;
    }
    for (int r = 0; r < own; ++r) y[r] = 0;
    for (int j = 0; j < own; ++j)
        if (down) {
            y[j] = x[j];
            for (int r = columns; r < size; ++r) y[r] -= at(r, j) * x[j];
        } else
            for (int r = 0; r < own; ++r) y[r] += at(r, j) * x[j];
};

// Both read the panel once, from one end to the other.
auto forward = [&](const long* front, const Real* panel, Real* y, auto kind) {
    #pragma clang fp contract(fast)
    constexpr int count = sizeof(kind);
    const int own = front[OWN], columns = front[COLUMNS];
    const int rows = blocks(columns + front[BORDER]);
    for (int i = 0; i < rows; ++i) {
        const Real* row = panel + i * (long)columns * BLOCK;
        const int before = i * BLOCK < columns ? i * BLOCK : columns;
        Column sum[count][4] = {};  // sums that do not wait for one another
        for (int k = 0; k < before; k += 4)
            #pragma unroll
            for (int l = 0; l < 4; ++l) {
                const Column column = *(const Column*)(row + (k + l) * BLOCK);
                #pragma unroll
                for (int v = 0; v < count; ++v) sum[v][l] += column * y[v * room + k + l];
            }
        for (int v = 0; v < count; ++v) {
            Real* at = y + v * room + i * BLOCK;
            *(Column*)at -= (sum[v][0] + sum[v][1]) + (sum[v][2] + sum[v][3]);
            const Real* corner = row + i * BLOCK * BLOCK;
            for (int a = 0; a < BLOCK && i * BLOCK + a < own; ++a) {
                at[a] /= corner[a * BLOCK + a];
                for (int r = a + 1; r < BLOCK; ++r) at[r] -= corner[a * BLOCK + r] * at[a];
            }
        }
    }
};
// Products of some rows of blocks, for the first columns, with the rows' unknowns: a sum of each
// column in each of a block's lanes.
auto add_rows = [&](const Real* rows, const Real* y, Real* sums, int before, long row, auto height,
                    auto kind) __attribute__((always_inline)) {
    #pragma clang fp contract(fast)
    constexpr int H = sizeof(height), count = sizeof(kind);
    Column x[count][H];
    for (int v = 0; v < count; ++v)
        for (int h = 0; h < H; ++h) x[v][h] = *(const Column*)(y + v * room + h * BLOCK);
    for (int k = 0; k < before; ++k) {
        Column sum[count];
        #pragma unroll
        for (int v = 0; v < count; ++v) sum[v] = *(Column*)(sums + (v * room + k) * BLOCK);
        #pragma unroll
        for (int h = 0; h < H; ++h) {
            const Column column = *(const Column*)(rows + h * row + k * BLOCK);
            #pragma unroll
            for (int v = 0; v < count; ++v) sum[v] += column * x[v][h];
        }
        #pragma unroll
        for (int v = 0; v < count; ++v) *(Column*)(sums + (v * room + k) * BLOCK) = sum[v];
    }
};
auto backward = [&](const long* front, const Real* panel, Real* y, Real* sums, auto kind) {
    constexpr int count = sizeof(kind);
    const int own = front[OWN], columns = front[COLUMNS];
    const long row = columns * (long)BLOCK;
    for (int v = 0; v < count; ++v)
        for (int k = 0; k < columns; ++k) *(Column*)(sums + (v * room + k) * BLOCK) = Column{};
    int i = blocks(columns + front[BORDER]);
    for (; (i - 4) * BLOCK >= columns; i -= 4)
        add_rows(panel + (i - 4) * row, y + (i - 4) * BLOCK, sums, columns, row, Four{}, kind);
    for (; i * BLOCK > columns; --i)
        add_rows(panel + (i - 1) * row, y + (i - 1) * BLOCK, sums, columns, row, One{}, kind);
    while (i-- > 0) {
        const Real* corner = panel + i * row + i * BLOCK * BLOCK;
        for (int v = 0; v < count; ++v) {
            Real* at = y + v * room + i * BLOCK;
            const Real* sum = sums + (v * room + i * BLOCK) * BLOCK;
            for (int a = (own - i * BLOCK < BLOCK ? own - i * BLOCK : BLOCK) - 1; a >= 0; --a) {
                const Real* lanes = sum + a * BLOCK;
                Real rest = ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) +
                            ((lanes[4] + lanes[5]) + (lanes[6] + lanes[7]));
                rest = at[a] - rest;
                for (int r = a + 1; r < BLOCK; ++r) rest -= corner[a * BLOCK + r] * at[r];
                at[a] = rest / corner[a * BLOCK + a];
            }
        }
        add_rows(panel + i * row, y + i * BLOCK, sums, i * BLOCK, row, One{}, kind);
    }
};

const int count = task.data[2];
const bool down = task.data[3];
for (long n = task.data[0]; n < task.data[1]; ++n) {
    const long i = down ? n : task.data[0] + task.data[1] - 1 - n;
    const long* front = fronts + i * FIELDS;
    const int own = front[OWN], border = front[BORDER], columns = front[COLUMNS];
    const Real* panel = panels.data + front[PANEL];
    const int* to = far.data + front[FAR];
    Real* y = scratch.data;
    Real* sums = y + count * room;
    bool any = !down;
    for (int v = 0; v < count; ++v) {
        const Real* vector = vectors.data + v * length;
        Real* at = y + v * room;
        for (int k = 0; k < own; ++k) {
            at[k] = vector[front[FIRST] + k];
            any |= at[k] != 0;
        }
        for (int k = own; k < columns; ++k) at[k] = 0;
        for (int k = 0; k < border; ++k) at[columns + k] = down ? 0 : vector[to[k]];
        for (int k = columns + border; k < blocks(columns + border) * BLOCK; ++k) at[k] = 0;
    }
    if (!any) continue;
    if (diagonal.data[i]) {
        for (int v = 0; v < count; ++v) substitute_diagonal(front, panel, y + v * room, down);
    } else if (count == 1) {
        if (down) forward(front, panel, y, One{}); else backward(front, panel, y, sums, One{});
    } else {
        if (down) forward(front, panel, y, Two{}); else backward(front, panel, y, sums, Two{});
    }
    for (int v = 0; v < count; ++v) {
        Real* vector = vectors.data + v * length;
        const Real* at = y + v * room;
        for (int k = 0; k < own; ++k) vector[front[FIRST] + k] = at[k];
        if (down)
            for (int k = 0; k < border; ++k) vector[to[k]] += at[columns + k];
    }
}
"""
)


@wp.func_native(_FACTORISE)
@no_type_check  # Warp's annotations are not types
def _factorise(
    task: wp.array(dtype=wp.int64),
    table: wp.array(dtype=wp.int64),
    changed: wp.array(dtype=wp.uint8),
    diagonal: wp.array(dtype=wp.uint8),
    sources: wp.array(dtype=wp.int32),
    places: wp.array(dtype=wp.int64),
    children: wp.array(dtype=wp.int32),
    runs: wp.array(dtype=wp.int32),
    entries: wp.array(dtype=Any),
    scales: wp.array(dtype=Any),
    panels: wp.array(dtype=Any),
    shares: wp.array(dtype=Any),
): ...


@wp.kernel
@no_type_check
def factorise(
    task: wp.array(dtype=wp.int64),
    table: wp.array(dtype=wp.int64),
    changed: wp.array(dtype=wp.uint8),
    diagonal: wp.array(dtype=wp.uint8),
    sources: wp.array(dtype=wp.int32),
    places: wp.array(dtype=wp.int64),
    children: wp.array(dtype=wp.int32),
    runs: wp.array(dtype=wp.int32),
    entries: wp.array(dtype=Any),
    scales: wp.array(dtype=Any),
    panels: wp.array(dtype=Any),
    shares: wp.array(dtype=Any),
):
    """Factorise the fronts ``task[0]`` to ``task[1]`` whose entries or children have changed.

    Args:
        task: First front, one past the last, address of the matrix's values in double. Out: the
            first of them is the front whose pivots are not safe, or else one past the last.
        table: A row for each front, see FIELDS.
        changed: Whether to factorise each front in any case, (F,). Out: whether it was.
        diagonal: Out: 0 for each front that was factorised, (F,).
        sources: Number of each entry's value, front after front, (E,).
        places: Place of each entry in the panels, (E,).
        children: Numbers of the children, parent after parent.
        runs: Runs of border unknowns: place in the front's border, row in the parent's
            panel, length.
        entries: Values of the entries in the present factor, (E,).
        scales: Room for a number for each unknown, (n,).
        panels: All panels.
        shares: All shares.
    """
    _factorise(
        task,
        table,
        changed,
        diagonal,
        sources,
        places,
        children,
        runs,
        entries,
        scales,
        panels,
        shares,
    )


@wp.func_native(_SUBSTITUTE)
@no_type_check
def _substitute(
    task: wp.array(dtype=wp.int64),
    table: wp.array(dtype=wp.int64),
    far: wp.array(dtype=wp.int32),
    diagonal: wp.array(dtype=wp.uint8),
    signs: wp.array(dtype=Any),
    panels: wp.array(dtype=Any),
    scratch: wp.array2d(dtype=Any),
    vectors: wp.array2d(dtype=Any),
): ...


@wp.kernel
@no_type_check
def substitute(
    task: wp.array(dtype=wp.int64),
    table: wp.array(dtype=wp.int64),
    far: wp.array(dtype=wp.int32),
    diagonal: wp.array(dtype=wp.uint8),
    signs: wp.array(dtype=Any),
    panels: wp.array(dtype=Any),
    scratch: wp.array2d(dtype=Any),
    vectors: wp.array2d(dtype=Any),
):
    """Substitute in the fronts ``task[0]`` to ``task[1]``.

    Args:
        task: First front, one past the last, number of vectors, whether forward.
        table: A row for each front, see FIELDS.
        far: Borders of all fronts.
        diagonal: Whether a front is diagonalised, (F,).
        signs: Signs of its eigenvalues, (n,).
        panels: All panels.
        scratch: Room for a front's rows and own unknowns, 1 + BLOCK times for each vector.
        vectors: Right-hand sides, and solutions in their place, (LANES, n).
    """
    _substitute(task, table, far, diagonal, signs, panels, scratch, vectors)


for _kind in (wp.float32, wp.float64):
    _list, _lists = wp.array(dtype=_kind), wp.array2d(dtype=_kind)
    wp.overload(factorise, {"entries": _list, "scales": _list, "panels": _list, "shares": _list})
    wp.overload(substitute, {"signs": _list, "panels": _list, "scratch": _lists, "vectors": _lists})


class Call:
    """A call of a kernel with its arrays, prepared to be made many times.

    Args:
        kernel: `factorise` or `substitute`.
        arrays: Its arguments; the first is the task, which may change between calls.
    """

    def __init__(self, kernel: wp.Kernel, *arrays: Array) -> None:
        self.task = arrays[0]
        self._arrays = arrays  # a recorded launch has only their addresses
        self._launch = wp.launch(
            kernel,
            dim=1,
            inputs=[wp.array(array, device=DEVICE, copy=False) for array in arrays],
            device=DEVICE,
            record_cmd=True,
        )

    def __call__(self) -> None:
        """Run it."""
        self._launch.launch()
