"""The metrics on errors that were put there by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate_training.learning.metrics import (
    electrode_errors,
    electrode_summary,
    field_errors,
    field_summary,
    join,
)

SUBSET = np.array([0, 1])


def test_a_known_error_of_one_node() -> None:
    truth = np.zeros((2, 4, 3), np.float32)
    truth[0, 3] = [0.0, 0.0, 2e-3]  # node 3 moves in row 0; nothing does in row 1
    estimate = truth.copy()
    estimate[0, 0] = [3e-4, 4e-4, 0.0]
    estimate[0, 3, 2] += 1e-3
    errors = field_errors(estimate, truth, SUBSET)
    assert errors["subset_m"] == pytest.approx([2.5e-4, 0])
    assert errors["all_m"] == pytest.approx([1.5e-3 / 4, 0])
    assert errors["moving_m"][0] == pytest.approx(1e-3)
    assert np.isnan(errors["moving_m"][1]), "where nothing moves there is nothing to average"
    assert errors["max_m"] == pytest.approx([1e-3, 0])


@given(st.floats(0, 2), st.integers(0, 100))
def test_skill_is_the_share_of_the_motion_that_is_known(share: float, seed: int) -> None:
    truth = np.random.default_rng(seed).normal(0, 1e-3, (3, 5, 3))
    zero = field_errors(np.zeros_like(truth), truth, SUBSET)
    summary = field_summary(field_errors(share * truth, truth, SUBSET), zero)
    for name in ("skill_subset", "skill_all", "skill_moving"):
        assert summary[name] == pytest.approx(1 - abs(1 - share), abs=1e-9)


def test_electrodes_in_counts_and_over_full_scale() -> None:
    truth = np.zeros((3, 19))
    estimate = truth.copy()
    estimate[0, 0], estimate[1, :2] = 19.0, [30.0, 40.0]
    errors = electrode_errors(estimate, truth)
    assert errors["l2_counts"] == pytest.approx([19, 50, 0])
    zero = electrode_errors(truth - 100.0, truth)
    summary = electrode_summary(errors, zero)
    rmse = np.sqrt((19.0**2 + 50.0**2) / 57)
    assert summary["electrode_rmse_counts"] == pytest.approx(rmse)
    assert summary["electrode_rmse"] == pytest.approx(rmse / 4095)
    assert summary["electrode_l2_median_counts"] == pytest.approx(19)
    assert summary["skill_rmse"] == pytest.approx(1 - rmse / 100)


def test_parts_join_in_order_and_shapes_must_agree() -> None:
    joined = join([{"a": np.array([1.0])}, {"a": np.array([2.0, 3.0])}])
    assert joined["a"].tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="shapes"):
        field_errors(np.zeros((1, 4, 3)), np.zeros((1, 5, 3)), SUBSET)
    with pytest.raises(ValueError, match="shapes"):
        electrode_errors(np.zeros((2, 19)), np.zeros((1, 19)))
