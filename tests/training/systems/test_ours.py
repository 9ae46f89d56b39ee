"""Our networks for features."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from tests.training.systems.conftest import MakeSamples, assert_exports

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.messages import COUNTS_MAX
from palpate_training.learning.electrode_nets import (
    ASSUMED_REST,
    MIRROR_AXES,
    NOISE_COUNTS,
    ResidualLayers,
)
from palpate_training.systems import ours
from palpate_training.systems.samples import error_of, impedance_ohm


def test_the_second_input_does_not_see_the_fluid(make_samples: MakeSamples) -> None:
    """A conductivity that is the same for all electrodes cancels in the logarithm's change."""
    samples = make_samples()
    counts = samples.rest + samples.tared

    def with_factor(values: np.ndarray) -> np.ndarray:
        return COUNTS_MAX / (1.0 + 0.7 * (COUNTS_MAX / values - 1.0))

    warm_rest = with_factor(samples.rest)
    warm = dataclasses.replace(
        samples,
        rest=warm_rest.astype(np.float32),
        tared=(with_factor(counts) - warm_rest).astype(np.float32),
    )
    (cold, _), (hot, _) = ours.inputs_of(samples), ours.inputs_of(warm)
    np.testing.assert_allclose(cold[:, 19:], hot[:, 19:], atol=2e-4)
    assert np.abs(cold[:, :19] - hot[:, :19]).max() > 20.0


def test_an_unknown_rest_leaves_room_for_every_fall(make_samples: MakeSamples) -> None:
    samples = make_samples(known_rest=False)
    deep = dataclasses.replace(samples, tared=samples.tared - np.float32(3500.0))
    assert np.isfinite(ours.inputs_of(deep)[0]).all()


def test_an_estimate_of_the_mirror_image_is_the_mirror_image(
    make_samples: MakeSamples, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = dataclasses.replace(ours.OURS_CONFIG, epochs=5, batch_rows=64)
    monkeypatch.setattr(ours, "OURS_CONFIG", quick)
    train, test = make_samples(200, seed=1), make_samples(100, seed=2)
    image = dataclasses.replace(
        test, tared=test.tared[:, ELECTRODE_MIRROR], rest=test.rest[:, ELECTRODE_MIRROR]
    )
    for system in ours.OURS:
        if "three" in system.name:
            continue
        estimate = system.fit("force", train, test, 0)
        np.testing.assert_allclose(estimate(image), estimate(test) * MIRROR_AXES, atol=1e-4)


def test_normals_are_unit_vectors_and_it_learns(
    make_samples: MakeSamples, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = dataclasses.replace(ours.OURS_CONFIG, epochs=10, batch_rows=64)
    monkeypatch.setattr(ours, "OURS_CONFIG", quick)
    train, test = make_samples(300, seed=1), make_samples(200, seed=2)
    normal = ours.OURS[0].fit("normal", train, test, 0)(test)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-5)
    estimate = ours.OURS[0].fit("force", train, test, 0)
    mean = np.repeat(train.force.mean(axis=0)[None], len(test), axis=0)
    assert error_of(estimate(test), test.force) < 0.5 * error_of(mean, test.force)


def test_noise_of_both_inputs_is_that_of_the_counts() -> None:
    """The same draw, in counts and, by the slope of the logarithm, in the fall of impedance."""
    torch.manual_seed(0)
    noise = ours.INPUTS.noisy(torch.zeros(20_000, 38), gain_spread=0.1, drift_counts=0.0).numpy()
    np.testing.assert_allclose(noise[:, :19].std(axis=0), NOISE_COUNTS, rtol=0.03)
    steps = np.log(impedance_ohm(np.array([ASSUMED_REST, ASSUMED_REST + 1.0])))
    np.testing.assert_allclose(noise[:, 19:], noise[:, :19] * (steps[0] - steps[1]), rtol=0.01)


@pytest.mark.parametrize(
    "make", [lambda: ResidualLayers(38, 3), lambda: ours.ElectrodeAttention(3)]
)
def test_exports_with_standard_operators(make: object) -> None:
    torch.manual_seed(0)
    assert_exports(make(), torch.randn(5, 38))  # type: ignore[operator]
