"""Modes of displacement fields: few, accurate, and their loss measured."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.basis import Blocks, encode, fit_basis, loss
from palpate_training.datasets.experiment import FloatArray

NODES = 30


def fields(rows: int, sizes_m: list[float], seed: int = 0) -> FloatArray:
    """Fields of orthogonal modes of these r.m.s. nodal sizes, on a mean."""
    rng = np.random.default_rng(seed)
    modes, _ = np.linalg.qr(rng.normal(size=(3 * NODES, len(sizes_m))))
    weights = rng.normal(size=(rows, len(sizes_m))) * sizes_m * np.sqrt(NODES)
    mean = 1e-3 * rng.normal(size=3 * NODES)
    return np.asarray((mean + weights @ modes.T).reshape(rows, NODES, 3), np.float32)


def in_blocks(data: FloatArray, size: int) -> Blocks:
    def blocks() -> Iterable[FloatArray]:
        return (data[i : i + size] for i in range(0, len(data), size))

    return blocks


def test_as_many_modes_as_the_loss_asks_for_and_no_more() -> None:
    data = fields(200, [1e-3, 1e-4, 1e-5, 2e-6, 1e-7])
    basis = fit_basis(in_blocks(data, 17))
    # Without the fourth the loss is about 2 um, without the fifth about 0.1 um.
    assert len(basis.modes) == 4
    assert 1e-8 < basis.loss_mean < 1e-6
    assert len(fit_basis(in_blocks(data, 17), loss_mean=2e-5).modes) == 2
    flat = basis.modes.reshape(4, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(4), atol=1e-5)


def test_the_loss_is_what_the_stored_numbers_lose() -> None:
    data = fields(60, [1e-3, 1e-4, 1e-5])
    basis = fit_basis(in_blocks(data, 25), count=2)
    assert basis.modes.shape == (2, NODES, 3)
    coefficients = encode(basis, data)
    assert coefficients.dtype == np.float32
    distance = np.linalg.norm(basis.decode(coefficients).astype(float) - data, axis=2)
    assert basis.loss_mean == pytest.approx(distance.mean(), rel=1e-6)
    assert basis.loss_max == pytest.approx(distance.max(), rel=1e-6)
    assert loss(basis, in_blocks(data, 7)) == pytest.approx((distance.mean(), distance.max()))


def test_modes_are_the_best_ones() -> None:
    """Beside NumPy's decomposition of the whole matrix, which large data do not allow."""
    data = fields(150, [1e-3 * 0.6**k for k in range(40)])
    basis = fit_basis(in_blocks(data, 32), count=8)
    flat = data.reshape(150, -1).astype(float)
    _, _, best = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    overlap = np.linalg.svd(basis.modes.reshape(8, -1) @ best[:8].T, compute_uv=False)
    np.testing.assert_allclose(overlap, 1.0, atol=1e-3)


def test_more_modes_than_first_drawn_are_found() -> None:
    rng = np.random.default_rng(3)
    data = (1e-4 * rng.normal(size=(88, NODES, 3))).astype(np.float32)  # no structure at all
    basis = fit_basis(in_blocks(data, 40), loss_mean=1e-9)
    assert 70 < len(basis.modes) <= 88
    assert basis.loss_mean < 1e-9


def test_the_same_blocks_give_the_same_basis() -> None:
    data = fields(40, [1e-3, 1e-4])
    one, two = (fit_basis(in_blocks(data, 9)) for _ in range(2))
    np.testing.assert_array_equal(one.modes, two.modes)


@pytest.mark.parametrize(
    ("blocks", "words"),
    [
        ([], "no fields"),
        ([np.zeros((2, 5, 3)), np.zeros((2, 6, 3))], "one mesh"),
        ([np.full((2, 5, 3), np.nan)], "not finite"),
    ],
)
def test_fields_that_make_no_basis_are_refused(blocks: list[FloatArray], words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        fit_basis(lambda: blocks)


def test_a_loss_below_the_precision_is_refused() -> None:
    with pytest.raises(DatasetError, match="lose"):
        fit_basis(in_blocks(fields(10, [1e-3]), 5), loss_mean=1e-20)
