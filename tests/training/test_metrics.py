"""The metrics against values made by hand."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from palpate_training.learning import baselines
from palpate_training.learning.metrics import (
    cluster_bootstrap,
    drawn_medians,
    force_errors,
    force_metrics,
    interval,
    location_metrics,
    summarise,
)

TRUTH = np.array([[0.0, 0.0, 2.0], [3.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
ESTIMATE = np.array([[0.0, 0.0, 3.0], [0.0, 3.0, 0.0], [0.0, 1.0, 1.0]])


def test_force_errors_by_hand() -> None:
    errors = force_errors(ESTIMATE, TRUTH)
    np.testing.assert_allclose(errors["magnitude_n"], [1.0, 0.0, math.sqrt(2) - 1], atol=1e-12)
    np.testing.assert_allclose(errors["vector_n"], [1.0, math.sqrt(18), 1.0])
    np.testing.assert_allclose(errors["angle_rad"], [0.0, math.pi / 2, math.pi / 4], atol=1e-12)
    np.testing.assert_allclose(errors["one_minus_cos"], [0.0, 1.0, 1 - math.sqrt(0.5)], atol=1e-12)
    np.testing.assert_allclose(errors["magnitude_over_norm"], [0.5, 0.0, math.sqrt(2) - 1])


def test_force_metrics_by_hand() -> None:
    metrics = force_metrics(ESTIMATE, TRUTH)
    median = math.sqrt(2) - 1
    assert metrics["force_magnitude_median_n"] == pytest.approx(median)
    assert metrics["force_magnitude_mean_n"] == pytest.approx((1 + median) / 3)
    assert metrics["force_magnitude_over_std_median"] == pytest.approx(median / np.std([2, 3, 1]))
    assert metrics["force_angle_median_rad"] == pytest.approx(math.pi / 4)
    assert metrics["force_rmse_x_n"] == pytest.approx(math.sqrt(9 / 3))
    assert metrics["force_rmse_y_n"] == pytest.approx(math.sqrt(9 / 3))
    assert metrics["force_rmse_z_n"] == pytest.approx(math.sqrt(2 / 3))


def test_the_two_readings_of_an_angle_differ() -> None:
    """0.06 as 1 - cos is an angle of 0.35 rad, not of 0.06 rad."""
    angle = 0.3482
    estimate = np.array([[math.sin(angle), 0.0, math.cos(angle)]])
    errors = force_errors(estimate, np.array([[0.0, 0.0, 1.0]]))
    assert errors["angle_rad"][0] == pytest.approx(angle)
    assert errors["one_minus_cos"][0] == pytest.approx(0.06, abs=1e-4)


def test_no_direction_without_force() -> None:
    errors = force_errors(np.zeros((2, 3)), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert math.isnan(errors["angle_rad"][0])
    assert errors["angle_rad"][1] == pytest.approx(math.pi / 2), "a zero estimate is not perfect"
    assert force_metrics(np.zeros((2, 3)), np.zeros((2, 3)))["force_magnitude_median_n"] == 0.0


def test_location_by_hand() -> None:
    estimate = np.array([[0.003, 0.004, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.001]])
    metrics = location_metrics(estimate, np.zeros((3, 3)))
    assert metrics["location_distance_median_m"] == pytest.approx(0.001)
    assert metrics["location_distance_mean_m"] == pytest.approx(0.002)
    assert metrics["location_rmse_y_m"] == pytest.approx(0.004 / math.sqrt(3))


def test_iqr_by_hand() -> None:
    assert summarise("x_{}", np.array([1.0, 2.0, 3.0, 4.0, 5.0])) == {
        "x_median": 3.0,
        "x_mean": 3.0,
        "x_iqr": 2.0,
    }


def test_bootstrap_draws_clusters_not_rows() -> None:
    """Two clusters of equal rows: a draw is all 0, all 1 or half of each, whatever the rows."""
    values = np.repeat([0.0, 1.0], 1000)
    cluster = np.repeat(np.array([0, 1], dtype=np.int32), 1000)
    interval = cluster_bootstrap({"e": values}, cluster, statistic=lambda v: float(np.mean(v)))
    assert interval["e"] == (0.0, 1.0)
    rows = cluster_bootstrap(
        {"e": values},
        np.arange(2000, dtype=np.int32),
        statistic=lambda v: float(np.mean(v)),
        draws=200,
    )
    low, high = rows["e"]
    assert 0.45 < low < 0.5 < high < 0.55


def test_bootstrap_averages_seeds_and_repeats() -> None:
    rng = np.random.default_rng(0)
    errors = {"e": rng.random((300, 2))}
    cluster = np.repeat(np.arange(10, dtype=np.int32), 30)
    first = cluster_bootstrap(errors, cluster, draws=100)
    assert first == cluster_bootstrap(errors, cluster, draws=100)
    low, high = first["e"]
    assert low < np.median(errors["e"]) < high


def test_bootstrap_draws_clusters_whose_rows_are_anywhere() -> None:
    """In the order of their names, each with its rows in their order."""
    rng = np.random.default_rng(2)
    cluster = rng.integers(0, 9, 200).astype(np.int32) * 5
    values = rng.normal(size=200)
    draw = np.random.default_rng(0)
    means = []
    for _ in range(50):
        names = 5 * draw.integers(9, size=9)
        means.append(np.mean(np.concatenate([values[cluster == name] for name in names])))
    found = cluster_bootstrap({"e": values}, cluster, statistic=lambda v: float(v.mean()), draws=50)
    assert found["e"] == pytest.approx(tuple(np.percentile(means, [2.5, 97.5])), rel=1e-12)


def test_baselines() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(50, 19)) * 200 + 30
    weight, offset = rng.normal(size=(19, 3)), np.array([1.0, -2.0, 5.0])
    y = x @ weight + offset
    np.testing.assert_allclose(baselines.linear(x, y).predict(x), y, atol=1e-8)
    np.testing.assert_allclose(baselines.constant(x, y).predict(x[:2]), [y.mean(axis=0)] * 2)
    assert not baselines.zero(x, y).predict(x).any()


@pytest.mark.parametrize("errors", [np.zeros(0), np.full(4, np.nan)])
def test_without_a_row_no_median_is_known(errors: npt.NDArray[np.float64]) -> None:
    drawn = drawn_medians([errors], np.zeros(len(errors), np.int64), draws=7)
    assert drawn.shape == (7,)
    assert np.isnan(drawn).all()
    assert np.isnan(interval(drawn)).all()
