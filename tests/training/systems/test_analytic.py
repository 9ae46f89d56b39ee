"""The systems of a few constants, on rows that they describe exactly."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from tests.training.systems.conftest import MakeSamples

from palpate.anatomy import ELECTRODE_NORMALS, ELECTRODE_POSITIONS
from palpate_training.systems import analytic
from palpate_training.systems.samples import Samples, System, error_of


def rows_that(samples: Samples, **changes: np.ndarray) -> Samples:
    floats: dict[str, Any] = {name: value.astype(np.float32) for name, value in changes.items()}
    return dataclasses.replace(samples, **floats)


def test_su_finds_its_three_factors(make_samples: MakeSamples) -> None:
    samples = make_samples()
    sums = samples.tared.astype(np.float64) @ ELECTRODE_NORMALS
    samples = rows_that(samples, force=sums * (0.01, 0.02, -0.03))
    estimate = analytic.fit_su("force", samples, samples, 0)
    np.testing.assert_allclose(estimate(samples), samples.force, rtol=1e-4, atol=1e-5)


def test_su_takes_the_impedance_where_that_explains_more(make_samples: MakeSamples) -> None:
    samples = make_samples()
    sums = analytic.impedance_change(samples) @ ELECTRODE_NORMALS
    samples = rows_that(samples, force=sums * (0.1, 0.2, 0.3))
    estimate = analytic.fit_su("force", samples, samples, 0)
    np.testing.assert_allclose(estimate(samples), samples.force, rtol=1e-4, atol=1e-5)


def test_without_rest_only_counts_are_tried(make_samples: MakeSamples) -> None:
    samples = make_samples(known_rest=False)
    estimate = analytic.fit_su("force", samples, samples, 0)
    assert np.isfinite(estimate(samples)).all()


def test_free_normals_are_a_linear_map(make_samples: MakeSamples) -> None:
    rng = np.random.default_rng(1)
    samples = rows_that(make_samples(), tared=rng.normal(0, 100, (400, 19)))
    samples = rows_that(samples, force=samples.tared @ rng.normal(0, 0.01, (19, 3)))
    estimate = analytic.fit_free_normals("force", samples, samples, 0)
    assert error_of(estimate(samples), samples.force) < 1e-3


def test_a_single_electrode_is_the_centroid() -> None:
    change = np.zeros((19, 19))
    np.fill_diagonal(change, -50.0)
    np.testing.assert_allclose(analytic.centroid(change), ELECTRODE_POSITIONS, atol=1e-12)
    still = analytic.centroid(np.zeros((1, 19)))
    np.testing.assert_allclose(still[0], ELECTRODE_POSITIONS.mean(axis=0))


def test_points_are_put_on_cylinder_and_sphere() -> None:
    points = np.array([[-5e-3, 0.0, -4e-3], [3e-3, 0.0, -4e-3]])
    placed = analytic.onto_finger(points, 7e-3)
    np.testing.assert_allclose(placed[0], [-5e-3, 0.0, -7e-3])
    np.testing.assert_allclose(placed[1], np.array([3.0, 0.0, -4.0]) / 5.0 * 7e-3)


def test_lin_finds_radius_and_offset(make_samples: MakeSamples) -> None:
    samples = make_samples()
    points = analytic.centroid(samples.tared.astype(np.float64))
    where = analytic.onto_finger(points, 8e-3) + np.array([1e-3, 0.0, -2e-3])
    samples = rows_that(samples, location=where)
    estimate = analytic.fit_lin("location", samples, samples, 0)
    assert error_of(estimate(samples), samples.location) < 1e-6


def test_the_three_strongest_of_four() -> None:
    change = np.zeros((1, 19))
    change[0, [0, 5, 9, 12]] = (-30.0, -40.0, -50.0, -10.0)
    weights = np.array([30.0, 40.0, 50.0])
    wanted = weights @ ELECTRODE_POSITIONS[[0, 5, 9]] / weights.sum()
    found = analytic.strongest(change, 1.0, fallen_only=False)
    np.testing.assert_allclose(found[0], wanted)
    change[0, 12] = 90.0  # risen: it counts unless only falls do
    assert not np.allclose(analytic.strongest(change, 1.0, fallen_only=False)[0], wanted)
    np.testing.assert_allclose(analytic.strongest(change, 1.0, fallen_only=True)[0], wanted)


def test_strongest_electrodes_are_near_the_press(make_samples: MakeSamples) -> None:
    train, test = make_samples(seed=1), make_samples(seed=2)
    estimate = analytic.fit_strongest("location", train, train, 0)
    mean = np.repeat(train.location.mean(axis=0)[None], len(test), axis=0)
    assert error_of(estimate(test), test.location) < 0.6 * error_of(mean, test.location)


def test_the_filter_follows_what_it_cannot_read_off() -> None:
    rng = np.random.default_rng(0)
    seen = rng.normal(0, 1, (2, 4))
    sequences = []
    for _ in range(60):
        force = np.cumsum(np.cumsum(rng.normal(0, 0.05, (30, 2)), axis=0), axis=0)
        sequences.append((force, force @ seen + rng.normal(0, 1.0, (30, 4))))
    model = analytic.KalmanModel.fit(sequences[:40])
    filtered, read = [], []
    for force, electrodes in sequences[40:]:
        filtered.append(model.filtered(electrodes) - force)
        read.append(electrodes @ np.linalg.pinv(seen) - force)
    assert np.std(np.concatenate(filtered)) < 0.6 * np.std(np.concatenate(read))


def test_trials_are_filtered_alone(make_samples: MakeSamples) -> None:
    samples = make_samples()
    estimate = analytic.fit_wettels("force", samples, samples, 0)
    whole = estimate(samples)
    rows = np.flatnonzero(samples.trial == samples.trial[200])
    np.testing.assert_allclose(estimate(samples.take(rows)), whole[rows], atol=1e-5)


@pytest.mark.parametrize("system", analytic.ANALYTIC, ids=lambda system: system.name)
def test_each_beats_the_mean(system: System, make_samples: MakeSamples) -> None:
    train, test = make_samples(seed=1), make_samples(seed=2)
    for quantity in system.quantities:
        estimate = system.fit(quantity, train, test, 0)
        truth = test.truth(quantity)
        mean = np.repeat(train.truth(quantity).mean(axis=0)[None], len(test), axis=0)
        assert error_of(estimate(test), truth) < error_of(mean, truth)
