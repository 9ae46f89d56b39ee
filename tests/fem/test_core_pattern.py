"""The tangent's pattern: node-pair blocks go to the same places as in a dense assembly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.fem.numpy_mechanics import Rubber, elements

from palpate_fem.mechanics.contact import ContactSettings
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem, TangentPattern, make_pattern
from palpate_fem.mesh.solid import SolidMesh

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Assembled = Callable[..., Floats]

NO_FACES = np.zeros((0, 4), np.int32)


def upper(pattern: TangentPattern, values: Floats) -> Floats:
    size = len(pattern.free)
    matrix = np.zeros((size, size))
    rows = np.repeat(np.arange(size), np.diff(pattern.indptr))
    matrix[rows, pattern.indices] = values
    return matrix


def add_blocks(blocks: Floats, pairs: Ints, cells: Floats) -> None:
    """As a kernel does it: (C, k, 3, k, 3) to (blocks, 3, 3)."""
    there = pairs >= 0
    np.add.at(blocks, pairs[there], cells.transpose(0, 1, 3, 2, 4)[there])


def symmetric_cells(random: np.random.Generator, cells: Ints) -> Floats:
    count, nodes = cells.shape
    half = random.normal(size=(count, 3 * nodes, 3 * nodes))
    return np.asarray((half + half.transpose(0, 2, 1)).reshape(count, nodes, 3, nodes, 3))


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 1.0), corners=st.sampled_from([8, 6]))
@settings(max_examples=25)
def test_equals_dense_assembly(
    block: Callable[..., SolidMesh], assembled: Assembled, seed: int, share: float, corners: int
) -> None:
    """Of elements and of faces, with random components held and nodes numbered anyhow."""
    random = np.random.default_rng(seed)
    mesh = block((2, 2, 1), corners=corners)
    nodes = len(mesh.nodes)
    number = random.permutation(nodes).astype(np.int32)
    cells, outer = number[mesh.elements], number[mesh.outer_faces]
    inner = number[mesh.elements[:, : corners // 2]]
    held = random.random((nodes, 3)) < share
    pattern = make_pattern(held, cells, outer, inner)

    blocks, expected = np.zeros((pattern.blocks, 3, 3)), np.zeros((3 * nodes, 3 * nodes))
    for which, pairs in (
        (cells, pattern.element_pairs),
        (outer, pattern.outer_pairs),
        (inner, pattern.inner_pairs),
    ):
        values = symmetric_cells(random, which)
        add_blocks(blocks, pairs, values)
        expected += assembled(which, values, nodes)
    free = np.flatnonzero(~held.reshape(-1))
    np.testing.assert_array_equal(pattern.free, free)
    found = upper(pattern, blocks.reshape(-1)[pattern.gather])
    np.testing.assert_allclose(found, np.triu(expected[np.ix_(free, free)]), atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 1.0))
@settings(max_examples=25)
def test_is_a_sorted_upper_triangle_with_its_whole_diagonal(
    block: Callable[..., SolidMesh], seed: int, share: float
) -> None:
    """As both solvers want it."""
    mesh = block((2, 1, 2))
    held = np.random.default_rng(seed).random(mesh.nodes.shape) < share
    pattern = make_pattern(held, mesh.elements, mesh.outer_faces, mesh.inner_faces)
    assert pattern.indptr[0] == 0
    assert pattern.indptr[-1] == len(pattern.indices) == len(pattern.gather)
    for row, (first, last) in enumerate(zip(pattern.indptr[:-1], pattern.indptr[1:], strict=True)):
        columns = pattern.indices[first:last]
        assert columns[0] == row
        assert (np.diff(columns) > 0).all()
    assert len(np.unique(pattern.gather)) == len(pattern.gather)


def test_nodes_that_share_no_element_share_no_entry(block: Callable[..., SolidMesh]) -> None:
    mesh = block((3, 1, 1))
    pattern = make_pattern(
        np.zeros(mesh.nodes.shape, bool), mesh.elements, mesh.outer_faces, NO_FACES
    )
    filled = upper(pattern, np.ones(len(pattern.indices))) > 0
    near = np.zeros((len(mesh.nodes),) * 2, bool)
    for cell in mesh.elements:
        near[np.ix_(cell, cell)] = True
    np.testing.assert_array_equal(filled, np.triu(np.kron(near, np.ones((3, 3), bool))))


@pytest.mark.parametrize("corners", [8, 6])
def test_system_holds_single_components(
    shell: Callable[..., SolidMesh],
    assembled: Assembled,
    dense: Callable[[EquilibriumSystem], Floats],
    corners: int,
) -> None:
    """Rollers: the tangent is that of all unknowns without the rows and columns that are held."""
    mesh = shell(3, 1, 3e-3, 4e-3, corners=corners)
    random = np.random.default_rng(0)
    held = random.random(mesh.nodes.shape) < 0.3
    system = EquilibriumSystem(
        mesh, None, shear_modulus_pa=1e5, bulk_ratio=100.0, contact=ContactSettings(), held=held
    )
    state = SolutionState.at_rest(mesh)
    state.position += random.normal(0.0, 2e-5, mesh.nodes.shape)
    state.pressure += random.normal(0.0, 1e4, len(mesh.elements))
    balance = system.balance(state, None)
    twin = elements(mesh, Rubber(1e5), 1e7, state.position, state.pressure)
    free = ~held.reshape(-1)
    matrix = assembled(mesh.elements, twin.tangent, len(mesh.nodes))[np.ix_(free, free)]
    assert np.abs(dense(system) - matrix).max() < 1e-7 * np.abs(matrix).max()
    force = twin.force.reshape(-1)[free]
    assert np.abs(balance.unbalanced - force).max() < 1e-7 * np.abs(force).max()
