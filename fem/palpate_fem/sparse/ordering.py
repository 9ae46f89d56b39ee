"""Elimination order of a sparse symmetric matrix, and its dense fronts.

METIS orders the graph of the nodes by nested dissection, which keeps the factor sparse. Columns of
the elimination tree with nearly the same pattern are merged into fronts (supernodes). A front
eliminates its own unknowns; the Schur complement at its border is added to its parent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pymetis
import scipy.sparse as sp
from numpy.typing import NDArray

Ints = NDArray[np.int64]

SMALL = 12
"""Up to so many nodes a front takes in any child: small fronts cost more than stored zeros."""

LARGE = 4 * SMALL
"""Above so many nodes a front takes in only children that add no zeros."""

ZEROS = 0.1
"""Between the two, share of zeros that a child may add."""

MOST_ON_TOP = 40
"""Most fronts above both halves of the tree."""


@dataclass(frozen=True, slots=True)
class Front:
    """Unknowns that are eliminated together.

    Attributes:
        first: First of its own unknowns, in order of elimination.
        last: One past the last of them.
        border: Later unknowns that it is coupled with, ascending.
        parent: Front that its Schur complement is added to; -1 at a root.
    """

    first: int
    last: int
    border: Ints
    parent: int


@dataclass(frozen=True, slots=True)
class EliminationTree:
    """Order and fronts; children stand before parents.

    Attributes:
        order: Old number of each unknown, in order of elimination.
        fronts: Two halves of the tree that are independent, then the fronts above both.
        first: Number of fronts in the first half.
        second: Number of fronts in the second half.
    """

    order: Ints
    fronts: tuple[Front, ...]
    first: int
    second: int

    @property
    def entries(self) -> int:
        """Entries of the triangular factor."""
        return sum(
            own * (own + 1) // 2 + own * len(front.border)
            for front in self.fronts
            for own in (front.last - front.first,)
        )

    @property
    def flop(self) -> float:
        """Operations of one factorisation, multiplications and additions."""
        return sum(_flop(f.last - f.first, len(f.border)) for f in self.fronts)


def plan_elimination(indptr: Ints, indices: Ints, groups: Ints) -> EliminationTree:
    """Order and fronts of a matrix.

    Args:
        indptr: Upper triangle in CSR.
        indices: Its columns.
        groups: Node of each unknown, (n,); unknowns of a node stay together.
    """
    names, groups = np.unique(groups, return_inverse=True)
    graph = _graph_of_nodes(indptr, indices, groups, len(names))
    position = _dissect(graph)
    own, border, children = _gather(graph, position)
    return _number(own, border, children, np.argsort(position), groups)


def _graph_of_nodes(indptr: Ints, indices: Ints, groups: Ints, count: int) -> sp.csr_matrix:
    rows = groups[np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))]
    columns = groups[indices]
    off = rows != columns
    rows, columns = rows[off], columns[off]
    ones = np.ones(2 * len(rows))
    graph = sp.csr_matrix(
        (ones, (np.concatenate((rows, columns)), np.concatenate((columns, rows)))),
        shape=(count, count),
    )
    graph.sum_duplicates()
    return graph


def _dissect(graph: sp.csr_matrix) -> Ints:
    """Place of each node in the order by METIS, (N,)."""
    if not graph.nnz:
        return np.arange(graph.shape[0])
    adjacency = pymetis.CSRAdjacency(
        adj_starts=graph.indptr.tolist(), adjacent=graph.indices.tolist()
    )
    _, position = pymetis.nested_dissection(adjacency)
    return np.asarray(position, np.int64)


def _gather(
    graph: sp.csr_matrix, position: Ints
) -> tuple[dict[int, list[int]], dict[int, set[int]], dict[int, list[int]]]:
    """Fronts by their last node: own nodes, border nodes and children, as places in the order.

    Nodes are visited in order of elimination. The border of a node are the later nodes that it is
    coupled with, directly or through its children; its parent is the first of them.
    """
    order = np.argsort(position)
    own: dict[int, list[int]] = {}
    border: dict[int, set[int]] = {}
    children: dict[int, list[int]] = {place: [] for place in range(len(order))}
    coupled: dict[int, set[int]] = {}
    parents: dict[int, int] = {}
    for place, node in enumerate(order):
        row = graph.indices[graph.indptr[node] : graph.indptr[node + 1]]
        later = {int(other) for other in position[row] if other > place}
        for child in children[place]:
            later |= coupled[child]
        later.discard(place)
        coupled[place] = later
        if later:
            parents[place] = min(later)
            children[parents[place]].append(place)
    for place in range(len(order)):
        own[place], border[place] = [place], coupled[place]
        for child in sorted(children[place], key=lambda c: -len(border[c])):
            if _worth(len(own[place]), len(border[place]), len(own[child]), len(border[child])):
                own[place] = own.pop(child) + own[place]
                del border[child]
                children[place].remove(child)
                children[place] += children.pop(child)
    return own, border, children


def _worth(own: int, border: int, child: int, child_border: int) -> bool:
    """Whether a front of so many nodes should take a child in."""
    zeros = child * (own + border - child_border)
    size = own + child
    if zeros == 0 or size <= SMALL:
        return True
    return size <= LARGE and zeros < ZEROS * size * ((size + 1) / 2 + border)


def _flop(own: int, border: int) -> float:
    """Operations of eliminating a front."""
    columns = np.arange(own, 0, -1, dtype=np.float64)
    return float(((columns + border) ** 2).sum())


def _sequence(
    own: dict[int, list[int]], border: dict[int, set[int]], children: dict[int, list[int]]
) -> tuple[list[int], list[int], list[int]]:
    """Fronts of two halves and of the top, in each the children first."""
    # Borders hold later places only, so ascending is children first.
    work = {place: _flop(len(own[place]), len(border[place])) for place in own}
    below = dict(work)
    inner = set()
    for place in sorted(own):
        below[place] += sum(below[child] for child in children[place])
        inner.update(children[place])
    apart = sorted((place for place in own if place not in inner), key=lambda p: -below[p])
    top: list[int] = []
    best: tuple[float, list[int], list[int], list[int]] | None = None
    for _ in range(MOST_ON_TOP):
        bins: tuple[list[int], list[int]] = ([], [])
        loads = [0.0, 0.0]
        for place in apart:
            lighter = int(loads[1] < loads[0])
            bins[lighter].append(place)
            loads[lighter] += below[place]
        time = max(loads) + sum(work[place] for place in top)
        if best is None or time < best[0]:
            best = (time, *bins, list(top))
        if not apart:
            break
        heaviest = apart.pop(0)
        top.append(heaviest)
        apart = sorted(apart + children[heaviest], key=lambda p: -below[p])
    assert best is not None

    def whole(roots: list[int]) -> list[int]:
        found, todo = [], list(roots)
        while todo:
            place = todo.pop()
            found.append(place)
            todo += children[place]
        return sorted(found)

    return whole(best[1]), whole(best[2]), sorted(best[3])


def _number(
    own: dict[int, list[int]],
    border: dict[int, set[int]],
    children: dict[int, list[int]],
    order: Ints,
    groups: Ints,
) -> EliminationTree:
    """Number the unknowns front by front, children first."""
    first, second, top = _sequence(own, border, children)
    sequence = first + second + top
    by_node = np.split(np.argsort(groups, kind="stable"), np.cumsum(np.bincount(groups))[:-1])
    nodes = np.array([order[k] for place in sequence for k in own[place]], np.int64)
    places = np.array([k for place in sequence for k in own[place]], np.int64)
    sizes = np.array([len(by_node[node]) for node in nodes], np.int64)
    starts = np.concatenate(([0], np.cumsum(sizes)))
    new_place = np.empty(len(places), np.int64)
    new_place[places] = np.arange(len(places))
    index = {place: i for i, place in enumerate(sequence)}
    parent = {index[child]: index[place] for place in sequence for child in children[place]}
    fronts, begin = [], 0
    for i, place in enumerate(sequence):
        end = begin + len(own[place])
        far = np.sort(new_place[np.fromiter(border[place], np.int64, len(border[place]))])
        fronts.append(
            Front(
                first=int(starts[begin]),
                last=int(starts[end]),
                border=np.concatenate(
                    [np.arange(starts[k], starts[k + 1]) for k in far] or [np.zeros(0, np.int64)]
                ),
                parent=parent.get(i, -1),
            )
        )
        begin = end
    unknowns = np.concatenate([by_node[node] for node in nodes] or [np.zeros(0, np.int64)])
    return EliminationTree(unknowns, tuple(fronts), len(first), len(second))
