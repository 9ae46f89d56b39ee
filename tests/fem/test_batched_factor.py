"""Many factors of one pattern: each solves its own system, and none disturbs another."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp
import warp as wp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from tests.fem.batched_cases import DEVICE

from palpate_fem.batched.dense_tiles import INVERTED, TILE
from palpate_fem.batched.factor import BatchedFactor
from palpate_fem.mechanics.contact import ContactSettings
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.solid import SolidMesh

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

SAME = 1e-5
"""Relative, of solutions with matrices whose condition is 1e3: tiles are in single precision."""

BODIES = [
    (1, 0),  # fewer unknowns than a tile, and a forest
    (1, 1),
    (TILE - 1, 1),
    (TILE, TILE),
    (TILE + 1, 3),
    (2 * TILE + 5, TILE + 2),
    ((INVERTED + 1) * TILE + 3, TILE),  # more than one triangle is kept inverted
]
"""Sizes of a body and of the joint of two."""


def two_bodies(size: int, joint: int, seed: int = 8) -> Floats:
    """Two dense bodies that are coupled by a joint only; positive definite."""
    total = 2 * size + joint
    matrix = np.random.default_rng(seed).normal(size=(total, total)) / np.sqrt(total)
    matrix = matrix @ matrix.T + 3.0 * np.eye(total)
    matrix[:size, size : 2 * size] = matrix[size : 2 * size, :size] = 0.0
    return np.asarray(matrix)


def grid(rows: int, columns: int, seed: int) -> Floats:
    """Springs between the points of a grid that METIS has to cut; positive definite."""
    random = np.random.default_rng(seed)
    number = np.arange(rows * columns).reshape(rows, columns)
    matrix = np.diag(random.uniform(0.01, 0.02, rows * columns))
    for one, other in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1])):
        for i, j in zip(one.ravel(), other.ravel(), strict=True):
            spring = random.uniform(0.5, 2.0)
            matrix[[i, j], [i, j]] += spring
            matrix[[i, j], [j, i]] -= spring
    return matrix


def forest(seed: int) -> Floats:
    """Three grids that know nothing of one another, and an unknown on its own."""
    parts = [grid(9, 11, seed), grid(6, 7, seed + 1), grid(9, 12, seed + 2), np.eye(1)]
    return np.asarray(sp.block_diag(parts).toarray())


class Bench:
    """A factor, and its slots' matrices."""

    def __init__(
        self, matrices: list[Floats], groups: Ints | None = None, few: int | None = None
    ) -> None:
        upper = sp.triu(sp.csr_matrix(sum(abs(matrix) for matrix in matrices)), format="csr")
        upper.sort_indices()
        self.size, self.slots = len(matrices[0]), len(matrices)
        self.indptr, self.indices = upper.indptr.astype(np.int32), upper.indices.astype(np.int32)
        self.rows = np.repeat(np.arange(self.size), np.diff(self.indptr))
        groups = np.arange(self.size, dtype=np.int32) if groups is None else groups
        self.factor = BatchedFactor(
            self.indptr, self.indices, groups, slots=self.slots, device=DEVICE, few=few, columns=1
        )
        for slot, matrix in enumerate(matrices):
            self.put(slot, matrix)

    def put(self, slot: int, matrix: Floats) -> None:
        values = self.factor.values.numpy()
        values[slot] = matrix[self.rows, self.indices]
        self.factor.values.assign(values)

    def factorise(self, *slots: int) -> list[int]:
        """Factorise; which of all slots are bad."""
        self.factor.factorise(listed(slots or range(self.slots)))
        return [int(bad) for bad in self.factor.bad.numpy()]

    def solve(self, right: Floats, *slots: int) -> Floats:
        """Right-hand sides and solutions (slots, lanes, n)."""
        vectors = wp.array(right, dtype=wp.float64, device=DEVICE)
        self.factor.solve(listed(slots or range(self.slots)), vectors, right.shape[1])
        return np.array(vectors.numpy())

    def right(self, lanes: int = 1) -> Floats:
        return np.random.default_rng(9).normal(size=(self.slots, lanes, self.size))


def listed(slots: tuple[int, ...] | range) -> wp.array:
    return wp.array(np.array(slots, np.int32), dtype=wp.int32, device=DEVICE)


def assert_solves(matrix: Floats, answers: Floats, rights: Floats) -> None:
    """Answers and right-hand sides (lanes, n)."""
    wanted = np.linalg.solve(matrix, rights.T).T
    assert np.abs(answers - wanted).max() < SAME * np.abs(wanted).max()


@pytest.fixture(scope="module", params=[0, 1000], ids=["panels", "columns"])
def grids(request: pytest.FixtureRequest) -> Bench:
    """Three slots and several levels, by one block of threads a front or by many."""
    return Bench([grid(20, 30, seed) for seed in range(3)], few=request.param)


def restored(bench: Bench) -> Bench:
    for slot in range(bench.slots):
        bench.put(slot, grid(20, 30, slot))
    return bench


@pytest.mark.parametrize(("size", "joint"), BODIES)
def test_fronts_of_any_size(size: int, joint: int) -> None:
    matrices = [scale * two_bodies(size, joint, seed) for scale, seed in ((1.0, 8), (1e6, 4))]
    bench = Bench(matrices)
    right = bench.right(2)
    for _ in range(2):  # what an earlier factor has left behind does no harm
        assert bench.factorise() == [0, 0]
        for matrix, answer, wanted in zip(matrices, bench.solve(right), right, strict=True):
            assert_solves(matrix, answer, wanted)


def test_a_forest_has_many_roots() -> None:
    matrices = [forest(seed) for seed in (0, 5)]
    bench = Bench(matrices)
    right = bench.right()
    assert bench.factorise() == [0, 0]
    for matrix, answer, wanted in zip(matrices, bench.solve(right), right, strict=True):
        assert_solves(matrix, answer, wanted)


@pytest.mark.parametrize("lanes", [1, 2])
def test_slots_have_their_own_matrices(grids: Bench, lanes: int) -> None:
    bench = restored(grids)
    statistics = bench.factor.statistics
    assert statistics["levels"] > 2
    assert statistics["fronts"] > 4
    assert statistics["padded_gflop"] > statistics["gflop"] > 0.0
    right = bench.right(lanes)
    assert bench.factorise() == [0, 0, 0]
    for slot, answer in enumerate(bench.solve(right)):
        assert_solves(grid(20, 30, slot), answer, right[slot])


def test_a_load_at_one_place_is_solved_for_like_any_other(grids: Bench) -> None:
    bench = restored(grids)
    bench.factorise()
    for place in (0, 311, 599):
        right = np.zeros((3, 2, bench.size))
        right[1, 1, place] = 2.0
        answers = bench.solve(right)
        assert not answers[[0, 2]].any()
        assert not answers[1, 0].any()
        assert_solves(grid(20, 30, 1), answers[1, 1:], right[1, 1:])
    right = bench.right(2)  # and nothing of it is left
    assert_solves(grid(20, 30, 0), bench.solve(right)[0], right[0])


def test_lanes_do_not_mix(grids: Bench) -> None:
    """A second lane, and lanes that nobody asked for, change no bit of the first."""
    bench = restored(grids)
    bench.factorise()
    right = bench.right(2)
    both = bench.solve(right)
    vectors = wp.array(right, dtype=wp.float64, device=DEVICE)
    bench.factor.solve(listed(range(3)), vectors, 1)
    np.testing.assert_array_equal(vectors.numpy()[:, 0], both[:, 0])
    np.testing.assert_array_equal(vectors.numpy()[:, 1], right[:, 1])


def test_a_factor_made_twice_has_the_same_bits() -> None:
    answers = []
    for _ in range(2):
        bench = Bench([grid(20, 30, seed) for seed in range(3)])
        bench.factorise()
        answers.append(bench.solve(bench.right(2)))
    np.testing.assert_array_equal(answers[0], answers[1])


@pytest.mark.parametrize("body", range(len(BODIES) + 1))
def test_columns_by_many_blocks_have_the_bits_of_panels_by_one(body: int) -> None:
    """All levels, or the last ones only; also where a slot's matrix is not definite."""
    if body < len(BODIES):
        matrices = [two_bodies(*BODIES[body], seed) for seed in (8, 4, 2)]
    else:
        matrices = [grid(20, 30, seed) for seed in range(3)]
    matrices[1][-1, -1] = -1.0
    found = []
    for few in (0, 3, 1000):
        bench = Bench(matrices, few=few)
        bad = bench.factorise()
        assert bad == [0, 1, 0]
        found.append(bench.solve(bench.right(2))[[0, 2]])
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_solutions_do_not_depend_on_the_size_of_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for filled in (0, 10**6):  # threads that keep a processor busy: blocks of 64, and of 256
        monkeypatch.setattr("palpate_fem.batched.factor.FILLED", filled)
        bench = Bench([two_bodies(100, 150, seed) for seed in (8, 4)])
        bench.factorise()
        found.append(bench.solve(bench.right(2)))
    np.testing.assert_array_equal(found[0], found[1])


def test_only_what_has_changed_is_factorised_again(grids: Bench) -> None:
    """And gives the bits of a factorisation of everything."""
    bench = restored(grids)
    bench.factorise()
    fronts = bench.factor.marked.shape[1]
    matrix = grid(20, 30, 1)
    matrix[[44, 45], [44, 45]] += 0.5
    bench.put(1, matrix)
    bench.factorise()
    worked_on = bench.factor.marked.numpy().sum(axis=1)
    assert worked_on[[0, 2]].tolist() == [0, 0]
    assert 0 < worked_on[1] < fronts / 2
    fresh = Bench([grid(20, 30, 0), matrix, grid(20, 30, 2)])
    fresh.factorise()
    assert fresh.factor.marked.numpy().all()
    right = bench.right(2)
    np.testing.assert_array_equal(bench.solve(right), fresh.solve(right))
    bench.put(1, grid(20, 30, 1))  # and back again
    bench.factorise(1)
    assert_solves(grid(20, 30, 1), bench.solve(right)[1], right[1])


def test_order_and_company_of_slots_change_nothing(grids: Bench) -> None:
    bench = restored(grids)
    right = bench.right()
    bench.factorise()
    together = bench.solve(right)
    for slot in range(3):
        bench.factorise(slot)
        np.testing.assert_array_equal(bench.solve(right, slot)[slot], together[slot])
    bench.factorise(2, 0, 1)
    np.testing.assert_array_equal(bench.solve(right, 1, 2, 0), together)


def test_slots_that_are_not_listed_keep_factor_and_vectors(grids: Bench) -> None:
    bench = restored(grids)
    right = bench.right()
    bench.factorise()
    before = bench.solve(right)
    for slot in range(3):
        bench.put(slot, grid(20, 30, 7 + slot))
    bench.factorise(1)
    after = bench.solve(right)
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert_solves(grid(20, 30, 8), after[1], right[1])
    some = bench.solve(right, 2)
    np.testing.assert_array_equal(some[:2], right[:2])
    np.testing.assert_array_equal(some[2], before[2])


@pytest.mark.parametrize("broken", ["one", "all", "hidden", "zero", "nan", "inf"])
def test_a_matrix_that_is_not_definite_harms_no_other(grids: Bench, broken: str) -> None:
    bench = restored(grids)
    right = bench.right()
    bench.factorise()
    before = bench.solve(right)
    matrix = grid(20, 30, 1)
    if broken == "one":
        matrix[311, 311] -= 9.0
    elif broken == "all":
        matrix -= 9.0 * np.eye(len(matrix))
    elif broken == "hidden":  # every diagonal entry stays positive
        matrix -= 0.5 * np.eye(len(matrix))
        assert matrix.diagonal().min() > 0.0
    elif broken == "zero":
        matrix[:] = 0.0
    else:
        matrix[40, 40] = float(broken)
    bench.put(1, matrix)
    assert bench.factorise() == [0, 1, 0]
    np.testing.assert_array_equal(bench.solve(right)[[0, 2]], before[[0, 2]])
    assert bench.factorise(1, 2) == [0, 1, 0]  # by slot, not by place in the list
    restored(bench)
    assert bench.factorise(0) == [0, 1, 0]  # told until the slot is factorised again
    assert bench.factorise(1) == [0, 0, 0]
    np.testing.assert_array_equal(bench.solve(right), before)


@pytest.mark.parametrize("place", [0, 1, TILE - 1, TILE, 2 * TILE + 4])
def test_any_pivot_may_be_the_bad_one(place: int) -> None:
    """Positive on the diagonal, negative after elimination, anywhere in a tile."""
    size = 2 * TILE + 5
    matrix = two_bodies(size, 0)
    other = (place + 3) % size
    matrix[place, other] = matrix[other, place] = 2.0 * matrix.diagonal().max()
    assert matrix.diagonal().min() > 0.0
    assert np.linalg.eigvalsh(matrix)[0] < 0.0
    good = two_bodies(size, 0, 3)
    bench = Bench([good, matrix])
    assert bench.factorise() == [0, 1]
    right = bench.right()
    assert_solves(good, bench.solve(right)[0], right[0])


def test_solves_for_a_tangent(shell: Callable[..., SolidMesh]) -> None:
    """A sphere's skin, three unknowns to a node; in two slots one is stiffer than the other."""
    mesh = shell(4, 2, 3e-3, 4e-3)
    held = np.zeros(mesh.nodes.shape, bool)
    held[mesh.nodes[:, 2] > 0.0] = True
    system = EquilibriumSystem(
        mesh, None, shear_modulus_pa=2.8e5, bulk_ratio=1e4, contact=ContactSettings(), held=held
    )
    system.balance(SolutionState.at_rest(mesh), None)
    pattern, values = system.pattern, np.asarray(system.tangent_values())
    factor = BatchedFactor(
        pattern.indptr, pattern.indices, pattern.free // 3, slots=2, device=DEVICE
    )
    factor.values.assign(np.stack((values, 3.0 * values)))
    factor.factorise(listed((0, 1)))
    assert not factor.bad.numpy().any()
    size = len(pattern.free)
    upper = sp.csr_matrix((values, pattern.indices, pattern.indptr), shape=(size, size))
    matrix = (upper + sp.triu(upper, 1).T).tocsc()
    right = np.random.default_rng(6).normal(size=(2, 2, size))
    wanted = splu(matrix).solve(right.reshape(-1, size).T).T.reshape(right.shape)
    wanted[1] /= 3.0
    found, errors = np.zeros_like(right), []
    for _ in range(3):  # what is left over is solved for again
        left = [
            right[slot] - scale * (matrix @ found[slot].T).T for slot, scale in ((0, 1.0), (1, 3.0))
        ]
        vectors = wp.array(np.stack(left), dtype=wp.float64, device=DEVICE)
        factor.solve(listed((0, 1)), vectors, 2)
        found = found + vectors.numpy()
        errors.append(np.abs(found - wanted).max() / np.abs(wanted).max())
    assert errors[0] < 1e-2  # nearly incompressible: the bulk modulus is 1e4 times the other
    assert errors[1] < 1e-2 * errors[0]
    assert errors[2] < 1e-2 * errors[1]
