"""Sparsity of the tangent: node-pair blocks, and where they go in the matrix of free unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Pattern:
    """Upper node-pair blocks of a symmetric matrix, and its upper triangle over free unknowns.

    Attributes:
        blocks: Number of blocks (i <= j).
        element_pairs: Block of each node pair of each element, (E, n, n); -1 where i > j.
        outer_pairs: The same for the faces of the outer surface.
        inner_pairs: The same for the faces of the inner surface.
        free: Free unknowns among all 3 V, ascending.
        indptr: Of the upper triangle in CSR.
        indices: Of the upper triangle in CSR, sorted.
        gather: Which entry of the flattened blocks each value of the triangle is.
    """

    blocks: int
    element_pairs: Ints
    outer_pairs: Ints
    inner_pairs: Ints
    free: Ints
    indptr: Ints
    indices: Ints
    gather: Ints


def make_pattern(held: NDArray[np.bool_], elements: Ints, outer: Ints, inner: Ints) -> Pattern:
    """Pattern of a mesh.

    Args:
        held: Which components of which nodes are prescribed, (V, 3).
        elements: Node ids (E, n).
        outer: Faces of the outer surface, each part of an element.
        inner: Faces of the inner surface, each part of an element.
    """
    nodes = len(held)
    keys = np.unique(_keys(elements, nodes))
    keys = keys[keys >= 0]
    free = np.flatnonzero(~held.reshape(-1))
    renumber = np.full(3 * nodes, -1, np.int64)
    renumber[free] = np.arange(len(free))

    r, c = np.divmod(np.arange(9), 3)
    rows = renumber[(3 * (keys // nodes)[:, None] + r).ravel()]
    columns = renumber[(3 * (keys % nodes)[:, None] + c).ravel()]
    source = np.flatnonzero((rows >= 0) & (columns >= rows))
    rows, columns = rows[source], columns[source]
    order = np.lexsort((columns, rows))
    indptr = np.zeros(len(free) + 1, np.int64)
    np.cumsum(np.bincount(rows, minlength=len(free)), out=indptr[1:])
    return Pattern(
        blocks=len(keys),
        element_pairs=_find(keys, elements, nodes),
        outer_pairs=_find(keys, outer, nodes),
        inner_pairs=_find(keys, inner, nodes),
        free=free.astype(np.int32),
        indptr=indptr.astype(np.int32),
        indices=columns[order].astype(np.int32),
        gather=source[order].astype(np.int32),
    )


def _keys(cells: Ints, nodes: int) -> NDArray[np.int64]:
    """Number of each ordered node pair of each cell; -1 below the diagonal."""
    low, high = cells[:, :, None].astype(np.int64), cells[:, None, :].astype(np.int64)
    return np.asarray(np.where(low <= high, low * nodes + high, -1))


def _find(keys: NDArray[np.int64], cells: Ints, nodes: int) -> Ints:
    wanted = _keys(cells, nodes)
    return np.where(wanted >= 0, np.searchsorted(keys, wanted), -1).astype(np.int32)
