"""Latent spaces and their projection, and Ruppel's networks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.training.systems.conftest import MakeSamples

from palpate_training.systems import latent, ruppel


@pytest.mark.parametrize("to_mesh", [True, False])
def test_one_side_is_found_from_the_other(to_mesh: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = replace(latent.LATENT_CONFIG, epochs=40)
    monkeypatch.setattr(latent, "LATENT_CONFIG", quick)
    rng = np.random.default_rng(0)
    hidden = rng.normal(0, 1, (1500, 3))
    counts = np.tanh(hidden @ rng.normal(0, 0.6, (3, 19)))
    fields = hidden @ rng.normal(0, 0.6, (3, 10))
    counts, fields = ((one / one.std(axis=0)).astype(np.float32) for one in (counts, fields))
    found = latent.fit_latents(counts[:1200], fields[:1200], to_mesh=to_mesh, seed=0)
    given, wanted = (counts, fields) if to_mesh else (fields, counts)
    left = found.apply(given[1200:]) - wanted[1200:]
    assert np.sqrt(np.mean(np.square(left))) < 0.45  # predicting the mean: 1


def test_rows_before_and_after_are_of_the_same_trial(make_samples: MakeSamples) -> None:
    samples = make_samples(50, trials=5)
    inputs = ruppel.ruppel_inputs(samples)
    assert inputs.shape == (50, 12)
    for row in range(50):
        mine = np.flatnonzero(samples.trial == samples.trial[row])
        before, after = max(row - 1, mine[0]), min(row + 1, mine[-1])
        np.testing.assert_array_equal(inputs[row, :3], samples.location[row])
        np.testing.assert_array_equal(
            inputs[row, 3:], np.concatenate([samples.force[k] for k in (row, before, after)])
        )


def test_network_a_has_the_published_size() -> None:
    net = ruppel.network_a(19)
    assert sum(one.numel() for one in net.parameters()) > 6_000_000


def test_network_b_multiplies_its_branches() -> None:
    torch.manual_seed(0)
    net = ruppel.BranchedLayers(19)
    with torch.no_grad():
        for weights in net.force[-1].parameters():
            weights.zero_()
    # Without activation by the force the position does not matter.
    first, second = net(torch.randn(2, 12))
    assert torch.equal(first, second)
    assert float(net.penalty().detach()) > 0.0
