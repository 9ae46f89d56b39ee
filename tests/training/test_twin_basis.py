"""Modes of displacement fields: few, accurate, and their loss measured."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets import basis as basis_module
from palpate_training.datasets.basis import (
    LOSS_MEAN_M,
    Blocks,
    FieldEncoder,
    FieldFile,
    encode,
    fit_basis,
    mean_and_largest,
)
from palpate_training.datasets.experiment import FieldBasis, FloatArray

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


def loss(basis: FieldBasis, blocks: Blocks) -> tuple[float, float]:
    """Mean and largest loss of fields that are compressed anew."""
    encoder = FieldEncoder(basis)
    return mean_and_largest(encoder.lost(block) for block in blocks())


def test_as_many_modes_as_the_loss_asks_for_and_no_more() -> None:
    data = fields(200, [1e-3, 1e-4, 1e-5, 2e-6, 1e-7])
    basis = fit_basis(in_blocks(data, 17))
    # Without the fourth the loss is about 2 um, without the fifth about 0.1 um.
    assert len(basis.modes) == 4
    assert 1e-8 < basis.loss_mean < 1e-6
    assert len(fit_basis(in_blocks(data, 17), loss_mean=2e-5).modes) == 2
    flat = basis.modes.reshape(4, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(4), atol=1e-5)


def test_some_rows_say_how_many_modes_and_all_are_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rows that none of the few that were asked are like need modes of their own."""
    whole = fields(300, [1e-3 * 0.7**k for k in range(40)])
    blocks = in_blocks(whole, 37)
    all_asked = fit_basis(blocks)
    monkeypatch.setattr(basis_module, "_SOME_ROWS", 12)
    few_asked = fit_basis(blocks)
    assert len(all_asked.modes) <= len(few_asked.modes) <= 1.1 * len(all_asked.modes) + 1
    assert few_asked.loss_mean < LOSS_MEAN_M
    # Each 25th row is asked, and the others have modes that those have not.
    odd = fields(300, [1e-3, 1e-4])
    odd[::25] = odd[:1] * np.linspace(0.5, 1.0, 12, dtype=np.float32)[:, None, None]
    assert fit_basis(in_blocks(odd, 37)).loss_mean < LOSS_MEAN_M


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


@pytest.mark.parametrize("count", [None, 3])
def test_coefficients_have_few_digits_that_lose_nothing(count: int | None) -> None:
    data = fields(200, [1e-3, 1e-4, 1e-5, 2e-6, 1e-7])
    basis = fit_basis(in_blocks(data, 17), count=count)
    assert basis.step > 0.0
    assert math.frexp(basis.step)[0] == 0.5, "no power of two"
    coefficients = encode(basis, data)
    np.testing.assert_array_equal(coefficients / basis.step, np.rint(coefficients / basis.step))
    exact = replace(basis, step=0.0)
    np.testing.assert_allclose(encode(exact, data), coefficients, rtol=0, atol=basis.step)
    assert basis.loss_mean <= 1.01 * loss(exact, in_blocks(data, 17))[0]
    coarser = replace(basis, step=64 * basis.step)
    assert loss(coarser, in_blocks(data, 17))[0] > 1.01 * basis.loss_mean, "too fine a step"


def test_fields_on_disk_make_the_same_basis(tmp_path: Path) -> None:
    data = fields(900, [1e-3, 1e-4, 1e-5])
    with FieldFile(tmp_path) as file:
        for block in in_blocks(data, 37)():
            file.add(block)
        blocks = list(file())
        np.testing.assert_array_equal(np.concatenate(blocks), data)
        assert 200 < max(len(block) for block in blocks) < 600, "too few rows, or all at once"
        there, here = fit_basis(file), fit_basis(in_blocks(data, 37))
    np.testing.assert_allclose(there.modes, here.modes, atol=1e-6)
    assert there.loss_mean == pytest.approx(here.loss_mean, rel=1e-3)
    assert there.step == here.step
    assert list(tmp_path.iterdir()) == []


def test_blocks_of_two_meshes_stay_apart_on_disk(tmp_path: Path) -> None:
    with FieldFile(tmp_path) as file:
        file.add(np.zeros((2, 5, 3), np.float32))
        file.add(np.zeros((2, 6, 3), np.float32))
        with pytest.raises(DatasetError, match="one mesh"):
            fit_basis(file)


def test_a_disk_that_takes_no_fields_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none.*fields cannot be kept there"):
        FieldFile(tmp_path / "none")


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
