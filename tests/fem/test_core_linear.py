"""Direct solvers: both give the answer, again and again, and say so where there is none."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

from palpate.errors import ConfigError, SimulationError
from palpate_fem.mechanics.contact import ContactSettings
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.sparse.blas import BLOCK, DEPTH
from palpate_fem.sparse.factor import Multifrontal, SparseFactor, make_factor
from palpate_fem.sparse.fronts import FrontalFactor

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

SIZE = 80
SAME = 1e-10  # of two eliminations of matrices with a condition of 1e3


def pattern_of(matrix: Floats) -> tuple[Ints, Ints]:
    upper = sp.triu(sp.csr_matrix(matrix), format="csr")
    upper.sort_indices()
    return upper.indptr.astype(np.int32), upper.indices.astype(np.int32)


def values_of(matrix: Floats, indptr: Ints, indices: Ints) -> Floats:
    rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    return np.asarray(matrix[rows, indices])


def indefinite(seed: int) -> Floats:
    """Sparse and symmetric, with eigenvalues of both signs; all seeds share a pattern."""
    places = sp.random(SIZE, SIZE, 0.06, random_state=7, format="csr")
    random = np.random.default_rng(seed)
    places.data = random.normal(size=places.nnz)
    sign = np.where(np.arange(SIZE) % 3 == 0, -1.0, 1.0)
    matrix = (places + places.T).toarray() + np.diag(sign * random.uniform(3.0, 6.0, SIZE))
    return np.asarray(matrix)


@pytest.fixture(params=["fronts-double", "superlu"])
def solver(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def factor(solver: str) -> SparseFactor:
    return make_factor(*pattern_of(indefinite(0)), solver=solver)


def test_solves_an_indefinite_matrix(factor: SparseFactor, solver: str) -> None:
    assert solver.startswith(factor.name)
    matrix = indefinite(0)
    assert np.linalg.eigvalsh(matrix)[[0, -1]].prod() < 0.0
    factor.factorise(values_of(matrix, *pattern_of(matrix)))
    right = np.random.default_rng(1).normal(size=SIZE)
    answer = factor.solve(right)
    assert answer.shape == (SIZE,)
    np.testing.assert_allclose(answer, np.linalg.solve(matrix, right), rtol=SAME, atol=SAME)


def test_factorises_new_values_and_forgets_the_old(factor: SparseFactor) -> None:
    right = np.random.default_rng(2).normal(size=SIZE)
    for seed in (0, 3, 4, 0):
        matrix = indefinite(seed)
        values = values_of(matrix, *pattern_of(indefinite(0)))
        factor.factorise(values)
        values[:] = np.nan  # the caller's array is its own
        wanted = np.linalg.solve(matrix, right)
        np.testing.assert_allclose(factor.solve(right), wanted, rtol=SAME, atol=SAME)


@pytest.mark.parametrize("columns", [1, 5])
def test_solves_many_right_hand_sides_and_leaves_them_alone(
    factor: SparseFactor, columns: int
) -> None:
    matrix = indefinite(0)
    factor.factorise(values_of(matrix, *pattern_of(matrix)))
    wide = np.random.default_rng(5).normal(size=(SIZE, 2 * columns))
    for right in (wide[:, :columns].copy(), wide[:, ::2], np.asfortranarray(wide[:, :columns])):
        before = right.copy()
        answer = factor.solve(right)
        np.testing.assert_array_equal(right, before)
        assert answer.shape == (SIZE, columns)
        np.testing.assert_allclose(matrix @ answer, right, atol=1e-11)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_none_are_refused_and_the_next_matrix_is_not(
    factor: SparseFactor, bad: float
) -> None:
    matrix = indefinite(0)
    good = values_of(matrix, *pattern_of(matrix))
    for _ in range(2):
        broken = good.copy()
        broken[3] = bad
        with pytest.raises(SimulationError, match="not numbers"):
            factor.factorise(broken)
        factor.factorise(good)
        np.testing.assert_allclose(matrix @ factor.solve(np.ones(SIZE)), 1.0, atol=1e-11)


@pytest.mark.parametrize("singular", ["zero", "empty row", "floating"])
def test_a_singular_matrix_is_refused_and_the_next_is_not(solver: str, singular: str) -> None:
    matrix = indefinite(0)
    indptr, indices = pattern_of(matrix)
    broken = matrix * (singular != "zero")
    if singular == "empty row":
        broken[5], broken[:, 5] = 0.0, 0.0
    if singular == "floating":  # a chain of springs that is held nowhere
        matrix = 2.0 * np.eye(SIZE) - np.eye(SIZE, k=1) - np.eye(SIZE, k=-1)
        broken = matrix.copy()
        broken[0, 0] = broken[-1, -1] = 1.0
        indptr, indices = pattern_of(matrix)
    factor = make_factor(indptr, indices, solver=solver)
    for _ in range(2):
        with pytest.raises(SimulationError):
            factor.factorise(values_of(broken, indptr, indices))
        factor.factorise(values_of(matrix, indptr, indices))
        np.testing.assert_allclose(matrix @ factor.solve(np.ones(SIZE)), 1.0, atol=1e-10)


@pytest.mark.parametrize("solver", ["fronts", "fronts-double", "superlu"])
def test_definite_is_neither_singular_nor_indefinite(solver: str) -> None:
    chain = 2.0 * np.eye(SIZE) - np.eye(SIZE, k=1) - np.eye(SIZE, k=-1)
    loose = chain.copy()
    loose[5], loose[:, 5] = 0.0, 0.0
    indptr, indices = pattern_of(chain)
    factor = make_factor(indptr, indices, solver=solver)
    for matrix, definite in ((chain, True), (loose, False), (-chain, False), (chain, True)):
        values = values_of(matrix, indptr, indices)
        assert factor.factorise_definite(values) is definite
    with pytest.raises(SimulationError, match="not numbers"):
        factor.factorise_definite(np.nan * values)


@pytest.mark.parametrize("solver", ["fronts", "fronts-double", "superlu"])
@pytest.mark.parametrize("share", [np.nan, 0.0])
@pytest.mark.parametrize("call", ["factorise", "factorise_definite"])
def test_a_refused_matrix_leaves_no_factor_of_the_one_before(
    solver: str, share: float, call: str
) -> None:
    good = values_of(indefinite(0), *pattern_of(indefinite(0)))
    factor = make_factor(*pattern_of(indefinite(0)), solver=solver)
    factor.factorise(good)
    with contextlib.suppress(SimulationError):
        getattr(factor, call)(share * good)
    with pytest.raises(SimulationError, match="factorise first"):
        factor.solve(np.ones(SIZE))


def test_a_matrix_that_is_not_there_cannot_be_solved(solver: str) -> None:
    index = np.arange(4, dtype=np.int32)
    factor = make_factor(index, index[:3], solver=solver)
    with pytest.raises(SimulationError, match="factorise first"):
        factor.solve(np.ones(3))


def test_solvers_agree_on_a_tangent(shell: Callable[..., SolidMesh]) -> None:
    """Nearly incompressible and with contact's stiffness in it: the worst that there is."""
    mesh = shell(4, 2, 3e-3, 4e-3)
    held = np.zeros(mesh.nodes.shape, bool)
    held[mesh.nodes[:, 2] > 0.0] = True
    system = EquilibriumSystem(
        mesh, None, shear_modulus_pa=2.8e5, bulk_ratio=1e7, contact=ContactSettings(), held=held
    )
    system.balance(SolutionState.at_rest(mesh), None)
    values = system.tangent_values()
    right = np.random.default_rng(6).normal(size=len(system.pattern.free))
    answers = []
    pattern = system.pattern
    for name in ("fronts", "superlu"):
        factor = make_factor(pattern.indptr, pattern.indices, groups=pattern.free // 3, solver=name)
        factor.factorise(values)
        answers.append(factor.solve(right))
    assert np.abs(answers[0] - answers[1]).max() < 1e-6 * np.abs(answers[0]).max()


def test_several_factors_live_side_by_side_and_are_freed(solver: str) -> None:
    matrices = [indefinite(seed) for seed in range(4)]
    pattern = pattern_of(matrices[0])
    factors = [make_factor(*pattern, solver=solver) for _ in matrices]
    for factor, matrix in zip(factors, matrices, strict=True):
        factor.factorise(values_of(matrix, *pattern))
    del factors[1]
    gc.collect()
    for factor, matrix in zip(factors, matrices[:1] + matrices[2:], strict=True):
        np.testing.assert_allclose(matrix @ factor.solve(np.ones(SIZE)), 1.0, atol=1e-11)


def test_an_unknown_solver_is_refused() -> None:
    with pytest.raises(ConfigError, match="no solver 'mumps'"):
        make_factor(*pattern_of(np.eye(2)), solver="mumps")


def stiff_chain(seed: int) -> Floats:
    """Positive definite, on a grid of 20 x 30 points that METIS has to cut."""
    random = np.random.default_rng(seed)
    number = np.arange(600).reshape(20, 30)
    matrix = np.zeros((600, 600))
    for one, other in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1])):
        spring = random.uniform(0.5, 2.0, one.shape)
        for i, j, k in zip(one.ravel(), other.ravel(), spring.ravel(), strict=True):
            matrix[i, i] += k
            matrix[j, j] += k
            matrix[i, j] -= k
            matrix[j, i] -= k
    return matrix + np.diag(random.uniform(0.01, 0.02, 600))


@pytest.fixture(scope="module")
def grid() -> tuple[Multifrontal, Floats, Ints, Ints]:
    matrix = stiff_chain(0)
    indptr, indices = pattern_of(matrix)
    factor = make_factor(indptr, indices, solver="fronts")
    assert isinstance(factor, Multifrontal)
    return factor, matrix, indptr, indices


@pytest.mark.parametrize("places", [[0], [311], [599], [5, 300, 420], []])
def test_a_factor_brought_up_to_date_is_a_new_one(
    grid: tuple[Multifrontal, Floats, Ints, Ints], places: list[int]
) -> None:
    """Only the fronts above the changed entries are redone, and the answer has the same bits."""
    factor, matrix, indptr, indices = grid
    right = np.random.default_rng(1).normal(size=len(matrix))
    factor.factorise(values_of(matrix, indptr, indices))
    before = factor.solve(right)
    changed = matrix.copy()
    changed[places, places] += 3.0
    factor.factorise(values_of(changed, indptr, indices))
    assert factor.redone < factor.statistics["factor_fronts"] or len(places) == 3
    fresh = make_factor(indptr, indices, solver="fronts")
    fresh.factorise(values_of(changed, indptr, indices))
    np.testing.assert_array_equal(factor.solve(right), fresh.solve(right))
    assert np.array_equal(before, factor.solve(right)) == (not places)


def test_single_precision_is_told_from_double(
    grid: tuple[Multifrontal, Floats, Ints, Ints],
) -> None:
    """Answers differ by single precision's rounding, not by more."""
    factor, matrix, indptr, indices = grid
    right = np.random.default_rng(2).normal(size=len(matrix))
    factor.factorise(values_of(matrix, indptr, indices))
    error = np.abs(factor.solve(right) - np.linalg.solve(matrix, right)).max()
    assert 1e-9 < error / np.abs(np.linalg.solve(matrix, right)).max() < 1e-4


def test_a_sparse_right_hand_side_is_solved_like_any(
    grid: tuple[Multifrontal, Floats, Ints, Ints],
) -> None:
    factor, matrix, indptr, indices = grid
    factor.factorise(values_of(matrix, indptr, indices))
    right = np.zeros((len(matrix), 3))
    right[17, 0] = right[450, 2] = 1.0
    wanted = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(factor.solve(right), wanted, atol=1e-3 * np.abs(wanted).max())


def test_directions_of_instability_are_counted(
    grid: tuple[Multifrontal, Floats, Ints, Ints],
) -> None:
    """Sylvester: as many negative pivots as eigenvalues, in double after single has given up."""
    factor, matrix, indptr, indices = grid
    for shift in (0.0, 0.05, 0.5):
        shifted = matrix - shift * np.eye(len(matrix))
        factor.factorise(values_of(shifted, indptr, indices))
        assert factor.negative == int((np.linalg.eigvalsh(shifted) < 0.0).sum())
        right = np.random.default_rng(3).normal(size=len(matrix))
        answer = factor.solve(right)
        assert np.abs(shifted @ answer - right).max() < 1e-3 * np.abs(right).max()


def two_bodies(size: int, joint: int, shift: float = 0.0) -> Floats:
    """Two dense bodies of ``size`` unknowns that are coupled by ``joint`` unknowns only."""
    random = np.random.default_rng(8)
    total = 2 * size + joint
    matrix = random.normal(size=(total, total)) / np.sqrt(total)
    matrix = matrix @ matrix.T + (0.5 - shift) * np.eye(total)
    matrix[:size, size : 2 * size] = matrix[size : 2 * size, :size] = 0.0
    return np.asarray(matrix)


@pytest.mark.parametrize("shift", [0.0, 1.0], ids=["definite", "indefinite"])
@pytest.mark.parametrize(
    ("size", "joint"),
    [(1, 0), (1, 1), (BLOCK - 1, 1), (BLOCK, BLOCK), (BLOCK + 1, 3), (100, 21), (DEPTH + 45, 37)],
)
@pytest.mark.parametrize("solver", ["fronts", "fronts-double"])
def test_fronts_of_any_size(size: int, joint: int, shift: float, solver: str) -> None:
    """Blocks that are not full, and fronts deeper than the columns that are taken together."""
    matrix = two_bodies(size, joint, shift)
    assert joint == 0 or shift or np.linalg.eigvalsh(matrix)[0] > 0.0
    indptr, indices = pattern_of(matrix)
    factor = make_factor(indptr, indices, solver=solver)
    assert isinstance(factor, Multifrontal)
    right = np.random.default_rng(9).normal(size=(len(matrix), 3))
    for scale in (1.0, 3.0):  # what an earlier factor has left behind does no harm
        factor.factorise(scale * values_of(matrix, indptr, indices))
        wanted = np.linalg.solve(scale * matrix, right)
        allowed = 1e-10 if factor.negative or solver == "fronts-double" else 1e-4
        assert np.abs(factor.solve(right) - wanted).max() < allowed * np.abs(wanted).max()
        assert factor.negative == int((np.linalg.eigvalsh(matrix) < 0.0).sum())


def test_an_updated_indefinite_factor_is_a_new_one(
    grid: tuple[Multifrontal, Floats, Ints, Ints],
) -> None:
    """Fronts that were not definite and are again, and the other way round."""
    _, matrix, indptr, indices = grid
    right = np.random.default_rng(4).normal(size=len(matrix))
    factor = make_factor(indptr, indices, solver="fronts-double")
    counts = []
    for place, change in ((0, 0.0), (311, -9.0), (311, 0.0), (40, -9.0)):
        changed = matrix.copy()
        changed[place, place] += change
        factor.factorise(values_of(changed, indptr, indices))
        fresh = make_factor(indptr, indices, solver="fronts-double")
        fresh.factorise(values_of(changed, indptr, indices))
        counts.append(factor.negative)
        assert fresh.negative == factor.negative
        np.testing.assert_array_equal(factor.solve(right), fresh.solve(right))
    assert counts == [0, 1, 0, 1]


@pytest.mark.parametrize("solver", ["fronts", "fronts-double"])
def test_halves_one_after_the_other_give_the_same_bits(
    grid: tuple[Multifrontal, Floats, Ints, Ints], solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, matrix, indptr, indices = grid
    right = np.random.default_rng(5).normal(size=(len(matrix), 2))
    answers = []
    for _ in range(2):
        factor = make_factor(indptr, indices, solver=solver)
        factor.factorise(values_of(matrix, indptr, indices))
        answers.append(factor.solve(right))
        monkeypatch.setattr(FrontalFactor, "_both", one_by_one)
    np.testing.assert_array_equal(answers[0], answers[1])


def one_by_one(_: FrontalFactor, work: Callable[[int], None]) -> None:
    for half in (1, 0):
        work(half)
