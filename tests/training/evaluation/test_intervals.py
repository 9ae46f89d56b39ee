"""Intervals of medians, against the plain loop."""

from __future__ import annotations

import numpy as np

from palpate_training.learning.metrics import drawn_medians, interval


def test_draws_are_medians_of_repeated_clusters() -> None:
    rng = np.random.default_rng(0)
    errors, cluster = rng.exponential(1.0, 300), rng.integers(12, size=300)
    errors[::17] = np.nan
    drawn = drawn_medians([errors], cluster, draws=300, seed=3)
    counts = np.random.default_rng(3).multinomial(12, np.full(12, 1 / 12), size=300)
    for count, found in zip(counts, drawn, strict=True):
        repeated = np.sort(np.repeat(errors, count[cluster]))
        kept = repeated[~np.isnan(repeated)]
        assert found == kept[(len(kept) - 1) // 2]  # the lower of the middle two


def test_seeds_are_averaged_and_draws_shared() -> None:
    rng = np.random.default_rng(1)
    cluster = np.repeat(np.arange(10), 20)
    one, two = rng.exponential(1.0, (2, 200))
    both = drawn_medians([one, two], cluster, draws=50)
    alone = [drawn_medians([each], cluster, draws=50) for each in (one, two)]
    np.testing.assert_allclose(both, np.mean(alone, axis=0))


def test_whole_clusters_widen_the_interval() -> None:
    """Rows that are copies of their cluster's do not count as many."""
    rng = np.random.default_rng(2)
    errors = np.repeat(rng.exponential(1.0, 40), 25)
    low, high = interval(drawn_medians([errors], np.repeat(np.arange(40), 25)))
    narrow = interval(drawn_medians([errors], np.arange(1000)))
    assert high - low > 3.0 * (narrow[1] - narrow[0])
    assert low < np.median(errors) < high
