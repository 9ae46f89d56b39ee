"""Baselines, mixture, support vectors, LWPR and trees."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.mixture import GaussianMixture
from tests.training.systems.conftest import MakeSamples

from palpate_training.systems import statistical
from palpate_training.systems.samples import System, error_of


def test_one_gaussian_is_a_linear_regression() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(0, 1, (4000, 3)) @ rng.normal(0, 1, (3, 3))
    y = x @ rng.normal(0, 1, (3, 2)) + rng.normal(0, 0.1, (4000, 2)) + 5.0
    model = GaussianMixture(1, reg_covar=1e-12, random_state=0).fit(np.hstack([x, y]))
    design = np.column_stack([np.ones(len(x)), x])
    line = design @ np.linalg.lstsq(design, y, rcond=None)[0]
    np.testing.assert_allclose(statistical.conditional_mean(model, x), line, atol=1e-6)


def test_all_directions_are_weighted_least_squares() -> None:
    rng = np.random.default_rng(0)
    x, weight = rng.normal(0, 1, (200, 3)), rng.uniform(0.1, 1.0, 200)
    y = x @ rng.normal(0, 1, (3, 2)) + np.square(x[:, :1])
    offset, slope, mean = statistical._weighted_pls(x, y, weight)
    design = np.column_stack([np.ones(len(x)), x])
    root = np.sqrt(weight)[:, None]
    found = np.linalg.lstsq(design * root, y * root, rcond=None)[0]
    np.testing.assert_allclose(slope, found[1:], atol=1e-8)
    np.testing.assert_allclose(offset - mean @ slope, found[0], atol=1e-8)


def test_receptive_fields_blend_lines() -> None:
    x = np.linspace(-3, 3, 400)[:, None]
    y = np.hstack([2.0 * x + 1.0, np.abs(x)])
    fields = statistical.ReceptiveFields.of(x, y, 4.0)
    assert 3 < len(fields) < 40
    found = fields.estimate(x)
    np.testing.assert_allclose(found[:, 0], y[:, 0], atol=1e-9)  # a line stays one
    assert np.abs(found[:, 1] - y[:, 1]).max() < 0.3
    assert np.isfinite(fields.estimate(np.array([[50.0]]))).all()  # far from every field


@pytest.mark.parametrize("system", statistical.STATISTICAL[2:], ids=lambda system: system.name)
def test_each_beats_the_mean(system: System, make_samples: MakeSamples) -> None:
    train, validation, test = (make_samples(seed=seed) for seed in (1, 2, 3))
    quantity = system.quantities[0]
    estimate = system.fit(quantity, train, validation, 0)
    truth = test.truth(quantity)
    mean = statistical.fit_mean(quantity, train, validation, 0)
    assert error_of(estimate(test), truth) < 0.9 * error_of(mean(test), truth)


def test_the_same_seed_gives_the_same(make_samples: MakeSamples) -> None:
    train, test = make_samples(seed=1), make_samples(seed=2)
    for fit in (statistical.fit_mixture, statistical.fit_trees):
        first, second = (fit("force", train, test, 3)(test) for _ in range(2))
        np.testing.assert_array_equal(first, second)


def test_trees_of_many_rows_are_the_same_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more than 200,000 rows the library draws some to choose its bins."""
    monkeypatch.setattr(statistical, "TREES", 1)
    x = np.random.default_rng(0).normal(size=(200_001, 1))
    first, second = (statistical.boosted_trees(x, 2.0 * x)(x[:1000]) for _ in range(2))
    np.testing.assert_array_equal(first, second)
